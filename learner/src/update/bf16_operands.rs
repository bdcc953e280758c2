//! Operands of the weights' gradient with 16-bit products: the inputs and gradients of every layer
//! for the whole batch, as pairs of rows. They are made once a step instead of once a tile.

use dmprl_shared::policy::MlpShape;

use super::arithmetic::Arithmetic;
use super::kernels::bf16::{Bf16Pair, pair_count};
use super::network::PassRecord;
use super::thread_pool::{DisjointSlice, ThreadPool};

/// Pairs of rows of all layers. The buffers are allocated in the first step.
#[derive(Debug, Default)]
pub struct Bf16Operands {
    layers: Vec<LayerOperands>,
    /// Index of each shard's first pair.
    begins: Vec<usize>,
}

/// Operands of one layer.
#[derive(Debug, Default)]
pub struct LayerOperands {
    /// The layer's inputs, (pairs, inputs).
    pub inputs: Vec<Bf16Pair>,
    /// Gradient with respect to the layer's sums, (pairs, outputs).
    pub gradient: Vec<Bf16Pair>,
}

impl Bf16Operands {
    /// Returns the operands of layer `index`.
    #[must_use]
    pub fn layer(&self, index: usize) -> &LayerOperands {
        &self.layers[index]
    }

    /// Packs the recorded passes over the shards.
    pub fn fill<'b, B: Sync>(
        &mut self,
        shape: &MlpShape,
        arithmetic: Arithmetic,
        pool: &mut ThreadPool,
        shards: &'b [B],
        record: &(impl Fn(&'b B) -> PassRecord<'b> + Sync),
    ) {
        let mut total = 0;
        self.begins.clear();
        for shard in shards {
            self.begins.push(total);
            total += pair_count(record(shard).inputs.len() / shape.inputs());
        }
        self.layers.resize_with(shape.layers().len(), Default::default);
        for (index, layer) in shape.layers().iter().enumerate() {
            let Some(bf16) = arithmetic.bf16(layer) else { continue };
            let LayerOperands { inputs, gradient } = &mut self.layers[index];
            inputs.resize(total * layer.inputs, 0);
            gradient.resize(total * layer.outputs, 0);
            let (inputs, gradient) = (DisjointSlice::new(inputs), DisjointSlice::new(gradient));
            let begins = &self.begins;
            pool.run(shards.len(), &|shard| {
                let record = record(&shards[shard]);
                let rows = record.inputs.len() / shape.inputs();
                let (begin, end) = (begins[shard], begins[shard] + pair_count(rows));
                // SAFETY: the ranges of different shards do not overlap.
                let (inputs, gradient) = unsafe {
                    (
                        inputs.slice(begin * layer.inputs..end * layer.inputs),
                        gradient.slice(begin * layer.outputs..end * layer.outputs),
                    )
                };
                bf16.pack_rows(record.layer_inputs(shape, index, rows), layer.inputs, inputs);
                let sums_gradient = record.gradients.layer(shape, index, rows);
                bf16.pack_rows(sums_gradient, layer.outputs, gradient);
            });
        }
    }
}
