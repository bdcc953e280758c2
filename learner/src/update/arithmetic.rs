//! The instructions and the precision with which a layer's products are computed.

use candle_core::Result;
use dmprl_shared::config::Precision;
use dmprl_shared::policy::Layer;

use super::kernels::InstructionSet;
use super::kernels::bf16::{Bf16, is_wide_enough};

/// Vector instructions and precision of the products.
#[derive(Debug, Clone, Copy)]
pub struct Arithmetic {
    /// Vector instructions of everything except 16-bit products.
    pub instructions: InstructionSet,
    bf16: Option<Bf16>,
}

impl Arithmetic {
    /// Selects the arithmetic for `precision` on this processor.
    ///
    /// # Errors
    /// If the processor does not support `precision`.
    pub fn new(precision: Precision) -> Result<Self> {
        let bf16 = match precision {
            Precision::F32 => None,
            Precision::Bf16 => match Bf16::detect() {
                None => candle_core::bail!(
                    "learner.precision = \"bf16\" needs a processor with AVX512-BF16, which this \
                     one lacks; set it to \"f32\""
                ),
                found => found,
            },
        };
        Ok(Self { instructions: InstructionSet::detect(), bf16 })
    }

    /// Returns the 16-bit instructions if this layer's products use them.
    #[must_use]
    pub fn bf16(self, layer: &Layer) -> Option<Bf16> {
        self.bf16.filter(|_| is_wide_enough(layer.outputs) && layer.inputs > 0)
    }
}
