//! Network parameters as candle variables, flat, and worked on in place.
//!
//! One flat variable a network: a snapshot, a Polyak step, an Adam step and a checkpoint are each
//! one pass over one slice. Kernels of ours read and write candle's own storage, so nothing is
//! copied between two representations.

use std::cell::RefCell;
use std::sync::atomic::{AtomicU64, Ordering};

use candle_core::{CpuStorage, Device, InplaceOp1, Layout, Result, Storage, Tensor, Var};

/// The parameters of one network.
#[derive(Debug)]
pub struct Parameters {
    var: Var,
    /// How often the values were changed: whoever keeps a copy in another order can tell whether
    /// it is still theirs.
    changes: AtomicU64,
}

impl Parameters {
    /// Takes over drawn or loaded parameters.
    ///
    /// # Errors
    /// If candle cannot make the variable.
    pub fn new(values: Vec<f32>) -> Result<Self> {
        let len = values.len();
        let var = Var::from_tensor(&Tensor::from_vec(values, len, &Device::Cpu)?)?;
        Ok(Self { var, changes: AtomicU64::new(1) })
    }

    /// A copy with storage of its own.
    ///
    /// # Errors
    /// If candle cannot make the variable.
    pub fn duplicate(&self) -> Result<Self> {
        self.read(|values| Self::new(values.to_vec()))?
    }

    /// The candle variable.
    #[must_use]
    pub fn var(&self) -> &Var {
        &self.var
    }

    /// A number that every change of the values makes greater; at least 1.
    #[must_use]
    pub fn changes(&self) -> u64 {
        self.changes.load(Ordering::Acquire)
    }

    /// Hands the values to `f`.
    ///
    /// # Errors
    /// If the variable is not a contiguous f32 vector on the CPU.
    pub fn read<R>(&self, f: impl FnOnce(&[f32]) -> R) -> Result<R> {
        let (storage, layout) = self.var.storage_and_layout();
        Ok(f(values(&storage, layout)?))
    }

    /// Hands the values to `f` to change them in place.
    ///
    /// # Errors
    /// As [`Parameters::read`].
    pub fn update(&self, f: impl FnOnce(&mut [f32])) -> Result<()> {
        self.changes.fetch_add(1, Ordering::AcqRel);
        self.var.inplace_op1(&InPlace(RefCell::new(Some(f))))
    }

    /// Replaces the values.
    ///
    /// # Errors
    /// If the lengths differ.
    pub fn set(&self, values: &[f32]) -> Result<()> {
        let len = self.var.elem_count();
        if values.len() != len {
            candle_core::bail!("network has {len} parameters, got {}", values.len());
        }
        self.update(|own| own.copy_from_slice(values))
    }
}

/// The values in a variable's storage.
///
/// # Errors
/// If they are not a contiguous f32 vector on the CPU.
pub(crate) fn values<'a>(storage: &'a Storage, layout: &Layout) -> Result<&'a [f32]> {
    let Storage::Cpu(storage) = storage else {
        candle_core::bail!("network parameters are not on the CPU");
    };
    let values = storage.as_slice::<f32>()?;
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(&values[start..end]),
        None => candle_core::bail!("network parameters are not contiguous"),
    }
}

/// Runs a closure once on a tensor's storage: candle's way to change a tensor in place.
struct InPlace<F>(RefCell<Option<F>>);

impl<F: FnOnce(&mut [f32])> InplaceOp1 for InPlace<F> {
    fn name(&self) -> &'static str {
        "in-place-update"
    }

    fn cpu_fwd(&self, storage: &mut CpuStorage, layout: &Layout) -> Result<()> {
        let Some((start, end)) = layout.contiguous_offsets() else {
            candle_core::bail!("network parameters are not contiguous");
        };
        let CpuStorage::F32(values) = storage else {
            candle_core::bail!("network parameters are not f32");
        };
        if let Some(f) = self.0.borrow_mut().take() {
            f(&mut values[start..end]);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_update_in_place_is_what_candle_sees() {
        let parameters = Parameters::new(vec![1.0, 2.0, 3.0]).unwrap();
        let copy = parameters.duplicate().unwrap();
        parameters.update(|values| values[1] = 7.0).unwrap();
        assert_eq!(parameters.var().to_vec1::<f32>().unwrap(), [1.0, 7.0, 3.0]);
        assert_eq!(copy.var().to_vec1::<f32>().unwrap(), [1.0, 2.0, 3.0]);
        assert!(parameters.set(&[0.0; 2]).is_err());
    }
}
