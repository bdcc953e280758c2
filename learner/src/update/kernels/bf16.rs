//! The three products with 16-bit operands (bfloat16, the upper half of an f32) and 32-bit sums,
//! for processors with AVX512-BF16.
//!
//! `VDPBF16PS` multiplies pairs of neighbours in depth and adds both products to a sum, which is
//! twice the operations of an f32 instruction. It reads [`Bf16Pair`]s. Parameters, gradients and
//! activations stay f32 in memory. Activations are converted to pairs where they are read, which
//! costs a fiftieth of the product; weights are converted where they change:
//!
//! | product | broadcast            | vectors                                               |
//! |---------|----------------------|-------------------------------------------------------|
//! | Y       | X, pairs of columns  | Wᵀ, pairs of inputs in panels ([`Bf16::pack_forward`]) |
//! | dX      | dY, pairs of columns | W, pairs of outputs ([`Bf16::pack_rows`])             |
//! | dW      | dY, pairs of rows    | X, pairs of rows ([`Bf16::pack_rows`])                |
//!
//! A tile has 8 rows of two vectors. Here a broadcast costs a cycle, which 16 rows of one vector
//! would not hide.

mod instructions;

use std::cell::RefCell;

use super::{Activation, PANEL, pack::NARROW};

/// Two bfloat16 numbers that are neighbours in depth; the first is in the lower half.
pub type Bf16Pair = u32;

/// Returns the number of pairs of `depth` numbers; an odd one is padded with a zero.
#[must_use]
pub const fn pair_count(depth: usize) -> usize {
    depth.div_ceil(2)
}

/// Returns whether a layer is wide enough for a panel. Products of the others stay f32.
#[must_use]
pub const fn is_wide_enough(outputs: usize) -> bool {
    outputs > NARROW
}

/// Returns the number of pairs of a layer packed by [`Bf16::pack_forward`].
#[must_use]
pub const fn forward_len(inputs: usize, outputs: usize) -> usize {
    outputs.next_multiple_of(PANEL) * pair_count(inputs)
}

/// Proof that the processor has AVX512-BF16, with the products that use it.
#[derive(Debug, Clone, Copy)]
pub struct Bf16(instructions::Avx512Bf16);

/// A matrix of pairs that is read as vectors.
#[derive(Debug, Clone, Copy)]
struct Wide<'a> {
    data: &'a [Bf16Pair],
    /// Pairs from one depth to the next.
    stride: usize,
    /// Pairs from one panel to the next.
    panel: usize,
    /// Whether the last panel is padded to the width of the others.
    padded: bool,
}

/// A matrix of pairs whose single pairs are broadcast.
#[derive(Debug, Clone, Copy)]
struct Broadcast<'a> {
    data: &'a [Bf16Pair],
    row_stride: usize,
    depth_stride: usize,
}

/// The operation applied to a product's sums.
enum Epilogue<'a> {
    /// Adds the bias and applies the activation function.
    Layer { bias: &'a [f32], activation: Activation },
    /// Sets sums to zero where the activation is zero.
    Masked(&'a [f32]),
    /// Keeps the sums.
    Plain,
}

/// One product of depth `depth` pairs; the result has shape (rows, cols).
struct Product<'a> {
    rows: usize,
    cols: usize,
    depth: usize,
    left: Broadcast<'a>,
    right: Wide<'a>,
    epilogue: Epilogue<'a>,
    out: &'a mut [f32],
}

thread_local! {
    /// Pairs of the current operand. It grows to the largest operand and stays.
    static SCRATCH: RefCell<Vec<Bf16Pair>> = const { RefCell::new(Vec::new()) };
}

impl Bf16 {
    /// Returns the products if the processor has the instructions.
    #[must_use]
    pub fn detect() -> Option<Self> {
        instructions::Avx512Bf16::new().map(Self)
    }

    /// Calls `f` with the pairs of neighbouring columns, (rows, pair_count(width)), of `numbers`,
    /// (rows, width).
    fn with_columns<R>(self, numbers: &[f32], width: usize, f: impl FnOnce(&[Bf16Pair]) -> R) -> R {
        SCRATCH.with_borrow_mut(|scratch| {
            let len = numbers.len() / width * pair_count(width);
            if scratch.len() < len {
                scratch.resize(len, 0);
            }
            let scratch = &mut scratch[..len];
            self.0.pair_columns(numbers, width, scratch);
            f(scratch)
        })
    }

    /// Packs `weights`, (outputs, inputs), for [`Bf16::forward`] into panels of [`PANEL`] outputs,
    /// pair by pair of inputs. The last panel is padded with zeros. A layer can be packed in parts
    /// that begin at multiples of [`PANEL`]; the part from output o on begins at
    /// o * pair_count(inputs).
    ///
    /// # Panics
    /// If `packed` does not have [`forward_len`] pairs.
    pub fn pack_forward(self, weights: &[f32], inputs: usize, packed: &mut [Bf16Pair]) {
        let (outputs, depth) = (weights.len() / inputs, pair_count(inputs));
        assert_eq!(packed.len(), forward_len(inputs, outputs), "packed weights");
        let panels = packed.chunks_exact_mut(PANEL * depth);
        for (weights, panel) in weights.chunks(PANEL * inputs).zip(panels) {
            self.with_columns(weights, inputs, |rows| self.0.transpose(rows, depth, panel));
        }
    }

    /// Packs pairs of neighbouring rows of `numbers`, (rows, width), into `out`,
    /// (pair_count(rows), width).
    ///
    /// # Panics
    /// If the lengths are inconsistent.
    pub fn pack_rows(self, numbers: &[f32], width: usize, out: &mut [Bf16Pair]) {
        assert_eq!(out.len(), pair_count(numbers.len() / width) * width, "pairs of rows");
        self.0.pair_rows(numbers, width, out);
    }

    /// Computes outputs = activation(inputs weightsᵀ + bias), like [`super::Forward`].
    ///
    /// # Panics
    /// If the lengths are inconsistent.
    pub fn forward(
        self,
        inputs: &[f32],
        packed: &[Bf16Pair],
        bias: &[f32],
        activation: Activation,
        outputs: &mut [f32],
    ) {
        let cols = bias.len();
        let rows = outputs.len() / cols;
        let width = inputs.len() / rows.max(1);
        let depth = pair_count(width);
        assert_eq!(outputs.len(), rows * cols, "outputs of {cols} columns");
        assert_eq!(inputs.len(), rows * width, "inputs of {rows} rows");
        assert_eq!(packed.len(), forward_len(width, cols), "packed weights");
        let right = Wide { data: packed, stride: PANEL, panel: depth * PANEL, padded: true };
        self.with_columns(inputs, width.max(1), |data| {
            let left = Broadcast { data, row_stride: depth, depth_stride: 1 };
            let epilogue = Epilogue::Layer { bias, activation };
            self.0.run(Product { rows, cols, depth, left, right, epilogue, out: outputs });
        });
    }

    /// Computes the gradient of the inputs like [`super::Backward`], with weights packed by
    /// [`Bf16::pack_rows`].
    ///
    /// # Panics
    /// If the lengths are inconsistent.
    pub fn backward(
        self,
        gradient: &[f32],
        outputs_len: usize,
        weights: &[Bf16Pair],
        first: usize,
        activations: Option<&[f32]>,
        inputs_gradient: &mut [f32],
    ) {
        let (rows, depth) = (gradient.len() / outputs_len, pair_count(outputs_len));
        let inputs_len = weights.len() / depth;
        let cols = inputs_len - first;
        assert_eq!(gradient.len(), rows * outputs_len, "gradient of {outputs_len} columns");
        assert_eq!(weights.len(), depth * inputs_len, "weights of {outputs_len} outputs");
        assert_eq!(inputs_gradient.len(), rows * cols, "gradient of the inputs");
        let data = &weights[first..];
        let right = Wide { data, stride: inputs_len, panel: PANEL, padded: false };
        let epilogue = activations.map_or(Epilogue::Plain, Epilogue::Masked);
        self.with_columns(gradient, outputs_len, |data| {
            let left = Broadcast { data, row_stride: depth, depth_stride: 1 };
            self.0.run(Product { rows, cols, depth, left, right, epilogue, out: inputs_gradient });
        });
    }

    /// Computes the gradient of the weights of `outputs`, (outputs.len(), inputs), from pairs of
    /// rows of the whole batch: `gradient`, (pairs, outputs_len), and `inputs`, (pairs, inputs).
    ///
    /// # Panics
    /// If the lengths are inconsistent.
    pub fn weight_gradient(
        self,
        gradient: &[Bf16Pair],
        outputs_len: usize,
        outputs: std::ops::Range<usize>,
        inputs: &[Bf16Pair],
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
        let (rows, epilogue) = (outputs.len(), Epilogue::Plain);
        self.0.run(Product { rows, cols, depth, left, right, epilogue, out: weights });
    }
}

#[cfg(test)]
mod tests;
