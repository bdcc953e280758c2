//! The three products with operands of 16 bits (bfloat16: the upper half of an f32) and sums of
//! 32, for processors that have AVX512-BF16.
//!
//! `VDPBF16PS` multiplies pairs of neighbours in depth and adds both to a sum: twice as many
//! operations an instruction as f32 has. What it reads are [`Pair`]s. Parameters, gradients and
//! activations stay f32 in memory; pairs are made of activations where they are read, which costs a
//! fiftieth of the product, and of weights where they change:
//!
//! | product | broadcast            | vectors                                               |
//! |---------|----------------------|-------------------------------------------------------|
//! | Y       | X, pairs of columns  | Wᵀ, pairs of inputs in panels ([`Bf16::pack_forward`]) |
//! | dX      | dY, pairs of columns | W, pairs of outputs ([`Bf16::pack_rows`])             |
//! | dW      | dY, pairs of rows    | X, pairs of rows ([`Bf16::pack_rows`])                |
//!
//! The tile is 8 rows of two vectors: a broadcast costs a cycle here, which 16 rows of one vector
//! would not hide.

mod instructions;

use std::cell::RefCell;

use super::{Activation, PANEL, pack::NARROW};

/// Two numbers that are neighbours in depth, the first in the lower half.
pub type Pair = u32;

/// Pairs of a depth; an odd one is filled with a zero.
#[must_use]
pub const fn pairs(depth: usize) -> usize {
    depth.div_ceil(2)
}

/// Whether a layer is wide enough for a panel; the others stay f32.
#[must_use]
pub const fn suits(outputs: usize) -> bool {
    outputs > NARROW
}

/// Pairs of a packed layer: see [`Bf16::pack_forward`].
#[must_use]
pub const fn forward_len(inputs: usize, outputs: usize) -> usize {
    outputs.next_multiple_of(PANEL) * pairs(inputs)
}

/// That the processor has the instructions: there is none otherwise.
#[derive(Debug, Clone, Copy)]
pub struct Bf16(instructions::Proof);

/// A matrix of pairs that is read as vectors.
#[derive(Debug, Clone, Copy)]
struct Wide<'a> {
    data: &'a [Pair],
    /// From one depth to the next.
    stride: usize,
    /// From one panel to the next.
    panel: usize,
    /// Whether the last panel is as wide as the others.
    padded: bool,
}

/// A matrix of pairs of which single ones are broadcast.
#[derive(Debug, Clone, Copy)]
struct Broadcast<'a> {
    data: &'a [Pair],
    row_stride: usize,
    depth_stride: usize,
}

/// What becomes of a product's sums.
enum Finish<'a> {
    /// sums + bias, through the activation.
    Layer { bias: &'a [f32], activation: Activation },
    /// Zero where the activation is.
    Masked(&'a [f32]),
    /// The sums.
    Plain,
}

/// One product: out (rows, cols) = left right over `depth` pairs.
struct Product<'a> {
    rows: usize,
    cols: usize,
    depth: usize,
    left: Broadcast<'a>,
    right: Wide<'a>,
    finish: Finish<'a>,
    out: &'a mut [f32],
}

thread_local! {
    /// Pairs of the operand at work; grows to the largest and stays.
    static PAIRS: RefCell<Vec<Pair>> = const { RefCell::new(Vec::new()) };
}

impl Bf16 {
    /// The instructions, if the processor has them.
    #[must_use]
    pub fn detect() -> Option<Self> {
        instructions::Proof::new().map(Self)
    }

    /// Pairs of neighbouring columns of (rows, width) numbers: (rows, pairs(width)).
    fn with_columns<R>(self, numbers: &[f32], width: usize, f: impl FnOnce(&[Pair]) -> R) -> R {
        PAIRS.with_borrow_mut(|scratch| {
            let len = numbers.len() / width * pairs(width);
            if scratch.len() < len {
                scratch.resize(len, 0);
            }
            let scratch = &mut scratch[..len];
            self.0.pair_columns(numbers, width, scratch);
            f(scratch)
        })
    }

    /// Packs (outputs, inputs) weights for [`Bf16::forward`]: panels of [`PANEL`] outputs, pair by
    /// pair of inputs, the last panel filled with zeros. A layer may be packed in pieces that begin
    /// at multiples of [`PANEL`]: the piece from output o on begins at o * pairs(inputs).
    ///
    /// # Panics
    /// If `packed` does not have [`forward_len`] pairs.
    pub fn pack_forward(self, weights: &[f32], inputs: usize, packed: &mut [Pair]) {
        let (outputs, depth) = (weights.len() / inputs, pairs(inputs));
        assert_eq!(packed.len(), forward_len(inputs, outputs), "packed weights");
        let panels = packed.chunks_exact_mut(PANEL * depth);
        for (weights, panel) in weights.chunks(PANEL * inputs).zip(panels) {
            self.with_columns(weights, inputs, |rows| self.0.transpose(rows, depth, panel));
        }
    }

    /// Pairs of neighbouring rows of (rows, width) numbers: (pairs(rows), width).
    ///
    /// # Panics
    /// If the lengths do not fit.
    pub fn pack_rows(self, numbers: &[f32], width: usize, out: &mut [Pair]) {
        assert_eq!(out.len(), pairs(numbers.len() / width) * width, "pairs of rows");
        self.0.pair_rows(numbers, width, out);
    }

    /// As [`super::Forward`]: outputs = activation(inputs weightsᵀ + bias).
    ///
    /// # Panics
    /// If the lengths do not fit.
    pub fn forward(
        self,
        inputs: &[f32],
        packed: &[Pair],
        bias: &[f32],
        activation: Activation,
        outputs: &mut [f32],
    ) {
        let cols = bias.len();
        let rows = outputs.len() / cols;
        let width = inputs.len() / rows.max(1);
        let depth = pairs(width);
        assert_eq!(outputs.len(), rows * cols, "outputs of {cols} columns");
        assert_eq!(inputs.len(), rows * width, "inputs of {rows} rows");
        assert_eq!(packed.len(), forward_len(width, cols), "packed weights");
        let right = Wide { data: packed, stride: PANEL, panel: depth * PANEL, padded: true };
        self.with_columns(inputs, width.max(1), |data| {
            let left = Broadcast { data, row_stride: depth, depth_stride: 1 };
            let finish = Finish::Layer { bias, activation };
            self.0.run(Product { rows, cols, depth, left, right, finish, out: outputs });
        });
    }

    /// As [`super::Backward`], with weights as [`Bf16::pack_rows`] leaves them.
    ///
    /// # Panics
    /// If the lengths do not fit.
    pub fn backward(
        self,
        gradient: &[f32],
        outputs_len: usize,
        weights: &[Pair],
        first: usize,
        activations: Option<&[f32]>,
        inputs_gradient: &mut [f32],
    ) {
        let (rows, depth) = (gradient.len() / outputs_len, pairs(outputs_len));
        let inputs_len = weights.len() / depth;
        let cols = inputs_len - first;
        assert_eq!(gradient.len(), rows * outputs_len, "gradient of {outputs_len} columns");
        assert_eq!(weights.len(), depth * inputs_len, "weights of {outputs_len} outputs");
        assert_eq!(inputs_gradient.len(), rows * cols, "gradient of the inputs");
        let data = &weights[first..];
        let right = Wide { data, stride: inputs_len, panel: PANEL, padded: false };
        let finish = activations.map_or(Finish::Plain, Finish::Masked);
        self.with_columns(gradient, outputs_len, |data| {
            let left = Broadcast { data, row_stride: depth, depth_stride: 1 };
            self.0.run(Product { rows, cols, depth, left, right, finish, out: inputs_gradient });
        });
    }

    /// Gradient of the weights of `outputs`, (outputs.len(), inputs), from the pairs of rows of the
    /// whole batch: of the gradient, (pairs, outputs_len), and of the inputs, (pairs, inputs).
    ///
    /// # Panics
    /// If the lengths do not fit.
    pub fn weight_gradient(
        self,
        gradient: &[Pair],
        outputs_len: usize,
        outputs: std::ops::Range<usize>,
        inputs: &[Pair],
        weights: &mut [f32],
    ) {
        let depth = gradient.len() / outputs_len;
        let cols = inputs.len() / depth;
        assert_eq!(gradient.len(), depth * outputs_len, "pairs of the gradient");
        assert_eq!(inputs.len(), depth * cols, "pairs of the inputs");
        assert_eq!(weights.len(), outputs.len() * cols, "weights' gradient");
        let data = &gradient[outputs.start..];
        let left = Broadcast { data, row_stride: 1, depth_stride: outputs_len };
        let right = Wide { data: inputs, stride: cols, panel: PANEL, padded: false };
        let (rows, finish) = (outputs.len(), Finish::Plain);
        self.0.run(Product { rows, cols, depth, left, right, finish, out: weights });
    }
}

#[cfg(test)]
mod tests;
