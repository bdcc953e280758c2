//! In which arithmetic a layer's products are computed.

use candle_core::Result;
use dmprl_shared::config::Precision;
use dmprl_shared::policy::Layer;

use super::kernels::InstructionSet;
use super::kernels::bf16::{Bf16, suits};

/// The processor's instructions and the precision of the products.
#[derive(Debug, Clone, Copy)]
pub struct Arithmetic {
    /// For everything but products of 16 bits.
    pub instructions: InstructionSet,
    bf16: Option<Bf16>,
}

impl Arithmetic {
    /// What `precision` asks for on this processor.
    ///
    /// # Errors
    /// If the processor cannot do it.
    pub fn new(precision: Precision) -> Result<Self> {
        let bf16 = match precision {
            Precision::F32 => None,
            Precision::Bf16 => match Bf16::detect() {
                None => candle_core::bail!(
                    "learner.precision = \"bf16\" needs a processor with AVX512-BF16, which this \
                     one lacks; \"f32\" runs everywhere"
                ),
                found => found,
            },
        };
        Ok(Self { instructions: InstructionSet::detect(), bf16 })
    }

    /// The instructions of 16 bits, if this layer's products use them.
    #[must_use]
    pub fn bf16(self, layer: &Layer) -> Option<Bf16> {
        self.bf16.filter(|_| suits(layer.outputs) && layer.inputs > 0)
    }
}
