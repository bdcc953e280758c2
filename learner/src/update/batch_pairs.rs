//! What the weights' gradient reads of a whole batch when products are of 16 bits: every layer's
//! inputs and gradient as pairs of rows, made once a step instead of once a tile.

use dmprl_shared::policy::MlpShape;

use super::arithmetic::Arithmetic;
use super::crew::{Crew, Disjoint};
use super::kernels::bf16::{Pair, pairs};
use super::trained::Trace;

/// Pairs of rows of all layers; the buffers are made at the first step.
#[derive(Debug, Default)]
pub struct BatchPairs {
    /// (pairs, inputs) and (pairs, outputs) of each layer.
    layers: Vec<[Vec<Pair>; 2]>,
    /// Where each block's pairs begin.
    begins: Vec<usize>,
}

impl BatchPairs {
    /// Inputs and gradient of a layer, (pairs, inputs) and (pairs, outputs).
    #[must_use]
    pub fn layer(&self, index: usize) -> [&[Pair]; 2] {
        self.layers[index].each_ref().map(Vec::as_slice)
    }

    /// Takes over what the blocks' passes left.
    pub fn fill<'b, B: Sync>(
        &mut self,
        shape: &MlpShape,
        arithmetic: Arithmetic,
        crew: &Crew,
        blocks: &'b [B],
        trace: &(impl Fn(&'b B) -> Trace<'b> + Sync),
    ) {
        let mut total = 0;
        self.begins.clear();
        for block in blocks {
            self.begins.push(total);
            total += pairs(trace(block).inputs.len() / shape.inputs());
        }
        self.layers.resize_with(shape.layers().len(), Default::default);
        for (index, layer) in shape.layers().iter().enumerate() {
            let Some(bf16) = arithmetic.bf16(layer) else { continue };
            let [inputs, gradient] = &mut self.layers[index];
            inputs.resize(total * layer.inputs, 0);
            gradient.resize(total * layer.outputs, 0);
            let (inputs, gradient) = (Disjoint::new(inputs), Disjoint::new(gradient));
            let begins = &self.begins;
            crew.run(blocks.len(), &|block| {
                let trace = trace(&blocks[block]);
                let rows = trace.inputs.len() / shape.inputs();
                let (begin, end) = (begins[block], begins[block] + pairs(rows));
                // SAFETY: blocks do not overlap.
                let [inputs, gradient] = unsafe {
                    [
                        inputs.slice(begin * layer.inputs..end * layer.inputs),
                        gradient.slice(begin * layer.outputs..end * layer.outputs),
                    ]
                };
                bf16.pack_rows(trace.layer_inputs(shape, index, rows), layer.inputs, inputs);
                let of_outputs = trace.gradients.layer(shape, index, rows);
                bf16.pack_rows(of_outputs, layer.outputs, gradient);
            });
        }
    }
}
