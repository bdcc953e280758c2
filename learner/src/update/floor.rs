//! The floor of an update: its matrix products and nothing else, to measure what the rest costs.
//!
//! An algorithm lists its products ([`Product::forward`] and its siblings, once for every pass it
//! makes); [`Floor`] has their operands, shared by products of the same shape as a network's passes
//! share its weights, and runs them with the library's product or with ours. The better of the two
//! is the floor.

use dmprl_shared::policy::{Keep, Matrix, MlpShape, product};

use super::BLOCK_ROWS;
use super::kernels::{
    Activation, Backward, Forward, GradientBlock, InstructionSet, WeightGradient, pack, packed_len,
};

/// Which operand of a layer a product computes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Y = X Wᵀ.
    Forward,
    /// dX = dY W.
    Backward,
    /// dW = dYᵀ X.
    WeightGradient,
}

/// One matrix product of an update: rows * inputs * outputs multiplications and additions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Product {
    /// Which one.
    pub kind: Kind,
    /// Rows of the batch.
    pub rows: usize,
    /// Width of the layer's input, or of the part whose gradient is wanted.
    pub inputs: usize,
    /// Width of the layer's output.
    pub outputs: usize,
}

impl Product {
    /// Those of a forward pass.
    pub fn forward(shape: &MlpShape, rows: usize) -> impl Iterator<Item = Self> + '_ {
        let of_layer = move |layer: &_| Self::of(Kind::Forward, rows, layer);
        shape.layers().iter().map(of_layer)
    }

    /// Those of a backward pass down to the first layer's outputs.
    pub fn backward(shape: &MlpShape, rows: usize) -> impl Iterator<Item = Self> + '_ {
        let of_layer = move |layer: &_| Self::of(Kind::Backward, rows, layer);
        shape.layers()[1..].iter().map(of_layer)
    }

    /// That of the inputs' gradient from column `first` on, after [`Product::backward`].
    #[must_use]
    pub fn input_gradient(shape: &MlpShape, rows: usize, first: usize) -> Self {
        let all = Self::of(Kind::Backward, rows, &shape.layers()[0]);
        Self { inputs: all.inputs - first, ..all }
    }

    /// Those of the parameters' gradient, after [`Product::backward`].
    pub fn weight_gradient(shape: &MlpShape, rows: usize) -> impl Iterator<Item = Self> + '_ {
        let of_layer = move |layer: &_| Self::of(Kind::WeightGradient, rows, layer);
        shape.layers().iter().map(of_layer)
    }

    fn of(kind: Kind, rows: usize, layer: &dmprl_shared::policy::Layer) -> Self {
        Self { kind, rows, inputs: layer.inputs, outputs: layer.outputs }
    }

    /// Multiplications and additions.
    #[must_use]
    pub fn operations(self) -> usize {
        2 * self.rows * self.inputs * self.outputs
    }
}

/// Whose product it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Engine {
    /// The `gemm` crate.
    Library,
    /// `update::kernels`.
    Kernels,
}

/// The products of an update with their operands.
#[derive(Debug)]
pub struct Floor {
    instructions: InstructionSet,
    /// Each with the index of its operands.
    products: Vec<(Product, usize)>,
    operands: Vec<Operands>,
}

/// (rows, inputs, outputs).
type Shape = (usize, usize, usize);

#[derive(Debug)]
struct Operands {
    shape: Shape,
    /// (rows, inputs).
    inputs: Vec<f32>,
    /// (rows, outputs).
    outputs: Vec<f32>,
    /// (outputs, inputs).
    weights: Vec<f32>,
    packed: Vec<f32>,
    bias: Vec<f32>,
}

impl Operands {
    fn new(shape: Shape, instructions: InstructionSet) -> Self {
        let (rows, inputs, outputs) = shape;
        // Any numbers will do that are no denormals.
        let numbers = |len: usize| (0..len).map(|i| (i as f32).sin()).collect::<Vec<_>>();
        let weights = numbers(outputs * inputs);
        let mut packed = vec![0.0; packed_len(inputs, outputs)];
        pack(&weights, inputs, outputs, &mut packed, instructions);
        Self {
            shape,
            inputs: numbers(rows * inputs),
            outputs: numbers(rows * outputs),
            weights,
            packed,
            bias: vec![0.0; outputs],
        }
    }

    fn library(&mut self, kind: Kind) {
        let (rows, inputs, outputs) = self.shape;
        let Self { inputs: x, outputs: y, weights: w, .. } = self;
        match kind {
            Kind::Forward => {
                let weights = Matrix::row_major(w, outputs, inputs).transposed();
                product(y, Matrix::row_major(x, rows, inputs), weights, Keep::Replace);
            }
            Kind::Backward => {
                let weights = Matrix::row_major(w, outputs, inputs);
                product(x, Matrix::row_major(y, rows, outputs), weights, Keep::Replace);
            }
            Kind::WeightGradient => {
                let gradient = Matrix::row_major(y, rows, outputs).transposed();
                product(w, gradient, Matrix::row_major(x, rows, inputs), Keep::Replace);
            }
        }
    }

    fn kernels(&mut self, kind: Kind, instructions: InstructionSet) {
        let (_, inputs, outputs) = self.shape;
        let Self { inputs: x, outputs: y, weights, packed, bias, .. } = self;
        let blocks = x.chunks_mut(BLOCK_ROWS * inputs).zip(y.chunks_mut(BLOCK_ROWS * outputs));
        match kind {
            Kind::Forward => {
                for (inputs, outputs) in blocks {
                    let activation = Activation::Linear;
                    Forward { inputs, packed, bias, activation, outputs }.run(instructions);
                }
            }
            Kind::Backward => {
                for (inputs_gradient, gradient) in blocks {
                    Backward {
                        gradient,
                        weights,
                        outputs_len: outputs,
                        first: 0,
                        activations: None,
                        inputs_gradient,
                    }
                    .run(instructions);
                }
            }
            Kind::WeightGradient => {
                let blocks = x.chunks(BLOCK_ROWS * inputs).zip(y.chunks(BLOCK_ROWS * outputs));
                WeightGradient {
                    blocks: blocks.map(|(inputs, gradient)| GradientBlock { gradient, inputs }),
                    inputs_len: inputs,
                    outputs_len: outputs,
                    outputs: 0..outputs,
                    weights,
                    bias,
                }
                .run(instructions);
            }
        }
    }
}

impl Floor {
    /// Buffers for all products.
    #[must_use]
    pub fn new(products: impl IntoIterator<Item = Product>) -> Self {
        let instructions = InstructionSet::detect();
        let mut floor = Self { instructions, products: Vec::new(), operands: Vec::new() };
        for product in products {
            let shape = (product.rows, product.inputs, product.outputs);
            let known = floor.operands.iter().position(|operands| operands.shape == shape);
            let index = known.unwrap_or_else(|| {
                floor.operands.push(Operands::new(shape, instructions));
                floor.operands.len() - 1
            });
            floor.products.push((product, index));
        }
        floor
    }

    /// Multiplications and additions of all products.
    #[must_use]
    pub fn operations(&self) -> usize {
        self.products.iter().map(|(product, _)| product.operations()).sum()
    }

    /// Computes all products once, on the calling thread.
    pub fn run(&mut self, engine: Engine) {
        for (product, index) in &self.products {
            let operands = &mut self.operands[*index];
            match engine {
                Engine::Library => operands.library(product.kind),
                Engine::Kernels => operands.kernels(product.kind, self.instructions),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_engines_compute_every_product_of_an_update() {
        let shape = MlpShape::new(vec![5, 40, 3]);
        let products = || {
            Product::forward(&shape, 70)
                .chain(Product::backward(&shape, 70))
                .chain([Product::input_gradient(&shape, 70, 2)])
                .chain(Product::weight_gradient(&shape, 70))
        };
        let (mut library, mut kernels) = (Floor::new(products()), Floor::new(products()));
        // Forward 5*40 + 40*3, backward 40*3, from column 2 on 3*40, weights 5*40 + 40*3.
        assert_eq!(library.operations(), 2 * 70 * (320 + 120 + 120 + 320));
        // The backward products read what the forward ones wrote, and so on.
        library.run(Engine::Library);
        kernels.run(Engine::Kernels);
        for (a, b) in library.operands.iter().zip(&kernels.operands) {
            let apart = |a: &[f32], b: &[f32]| {
                let scale = a.iter().fold(1.0_f32, |scale, a| scale.max(a.abs()));
                a.iter().zip(b).fold(0.0_f32, |most, (a, b)| most.max((a - b).abs())) / scale
            };
            let most = apart(&a.inputs, &b.inputs)
                .max(apart(&a.outputs, &b.outputs))
                .max(apart(&a.weights, &b.weights));
            assert!(most < 1e-5, "{:?}: {most}", a.shape);
        }
    }
}
