//! The floor of an update's duration: the time of its matrix products (`products`) alone.
//!
//! [`Floor`] owns the operands of the products. Products of the same shape share their operands,
//! as a network's passes share its weights. It computes them with the library or with the learner's
//! kernels; the faster of the two is the floor.

use dmprl_learner::update::SHARD_ROWS;
use dmprl_learner::update::kernels::bf16::{
    Bf16, Bf16Pair, forward_len, is_wide_enough, pair_count,
};
use dmprl_learner::update::kernels::{
    Activation, Backward, Forward, GradientShard, InstructionSet, WeightGradient, pack, packed_len,
};
use dmprl_shared::config::Precision;
use dmprl_shared::policy::{Keep, Matrix, product};

use super::products::{Product, ProductKind};

/// The implementation of the products.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Engine {
    /// The `gemm` crate.
    Library,
    /// The learner's kernels.
    Kernels,
}

/// The products of an update with their operands.
#[derive(Debug)]
pub(super) struct Floor {
    instructions: InstructionSet,
    products: Vec<FloorProduct>,
    operands: Vec<Operands>,
}

/// A product with the index of its operands.
#[derive(Debug)]
struct FloorProduct {
    product: Product,
    operands: usize,
}

/// Sizes of a product.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Shape {
    rows: usize,
    inputs: usize,
    outputs: usize,
}

/// Operands of the products of one shape.
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
    pairs: Option<Pairs>,
}

/// 16-bit operands, packed. An update packs them once for several products.
#[derive(Debug)]
struct Pairs {
    bf16: Bf16,
    forward: Vec<Bf16Pair>,
    backward: Vec<Bf16Pair>,
    inputs: Vec<Bf16Pair>,
    gradient: Vec<Bf16Pair>,
}

impl Pairs {
    fn new(bf16: Bf16, operands: &Operands) -> Self {
        let Operands { shape, inputs, outputs, weights, .. } = operands;
        let rows = |numbers: &[f32], width: usize| {
            let mut pairs = vec![0; pair_count(numbers.len() / width) * width];
            bf16.pack_rows(numbers, width, &mut pairs);
            pairs
        };
        let mut forward = vec![0; forward_len(shape.inputs, shape.outputs)];
        bf16.pack_forward(weights, shape.inputs, &mut forward);
        Self {
            bf16,
            forward,
            backward: rows(weights, shape.inputs),
            inputs: rows(inputs, shape.inputs),
            gradient: rows(outputs, shape.outputs),
        }
    }
}

impl Operands {
    fn new(shape: Shape, instructions: InstructionSet, bf16: Option<Bf16>) -> Self {
        let Shape { rows, inputs, outputs } = shape;
        // Arbitrary numbers, but not denormals, which are slow.
        let numbers = |len: usize| (0..len).map(|i| (i as f32).sin()).collect::<Vec<_>>();
        let weights = numbers(outputs * inputs);
        let mut packed = vec![0.0; packed_len(inputs, outputs)];
        pack(&weights, inputs, outputs, &mut packed, instructions);
        let mut operands = Self {
            shape,
            inputs: numbers(rows * inputs),
            outputs: numbers(rows * outputs),
            weights,
            packed,
            bias: vec![0.0; outputs],
            pairs: None,
        };
        let bf16 = bf16.filter(|_| is_wide_enough(outputs));
        operands.pairs = bf16.map(|bf16| Pairs::new(bf16, &operands));
        operands
    }

    fn run_library(&mut self, kind: ProductKind) {
        let Shape { rows, inputs, outputs } = self.shape;
        let Self { inputs: x, outputs: y, weights: w, .. } = self;
        match kind {
            ProductKind::Forward => {
                let weights = Matrix::row_major(w, outputs, inputs).transposed();
                product(y, Matrix::row_major(x, rows, inputs), weights, Keep::Replace);
            }
            ProductKind::Backward => {
                let weights = Matrix::row_major(w, outputs, inputs);
                product(x, Matrix::row_major(y, rows, outputs), weights, Keep::Replace);
            }
            ProductKind::WeightGradient => {
                let gradient = Matrix::row_major(y, rows, outputs).transposed();
                product(w, gradient, Matrix::row_major(x, rows, inputs), Keep::Replace);
            }
        }
    }

    fn run_kernels(&mut self, kind: ProductKind, instructions: InstructionSet) {
        let Shape { inputs, outputs, .. } = self.shape;
        let Self { inputs: x, outputs: y, weights, packed, bias, pairs, .. } = self;
        let shards = x.chunks_mut(SHARD_ROWS * inputs).zip(y.chunks_mut(SHARD_ROWS * outputs));
        match (kind, pairs) {
            (ProductKind::Forward, Some(Pairs { bf16, forward, .. })) => {
                shards.for_each(|(x, y)| bf16.forward(x, forward, bias, Activation::Linear, y));
            }
            (ProductKind::Backward, Some(Pairs { bf16, backward, .. })) => {
                shards.for_each(|(x, y)| bf16.backward(y, outputs, backward, 0, None, x));
            }
            (ProductKind::WeightGradient, Some(Pairs { bf16, inputs, gradient, .. })) => {
                bf16.weight_gradient(gradient, outputs, 0..outputs, inputs, weights);
            }
            (ProductKind::Forward, None) => {
                for (inputs, outputs) in shards {
                    let activation = Activation::Linear;
                    Forward { inputs, packed, bias, activation, outputs }.run(instructions);
                }
            }
            (ProductKind::Backward, None) => {
                for (inputs_gradient, gradient) in shards {
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
            (ProductKind::WeightGradient, None) => {
                let shards = x.chunks(SHARD_ROWS * inputs).zip(y.chunks(SHARD_ROWS * outputs));
                WeightGradient {
                    shards: shards.map(|(inputs, gradient)| GradientShard { gradient, inputs }),
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
    /// Allocates the operands of all products.
    pub(super) fn new(products: impl IntoIterator<Item = Product>, precision: Precision) -> Self {
        let instructions = InstructionSet::detect();
        let bf16 = if precision == Precision::Bf16 { Bf16::detect() } else { None };
        let mut floor = Self { instructions, products: Vec::new(), operands: Vec::new() };
        for product in products {
            let Product { rows, inputs, outputs, .. } = product;
            let shape = Shape { rows, inputs, outputs };
            let known = floor.operands.iter().position(|operands| operands.shape == shape);
            let operands = known.unwrap_or_else(|| {
                floor.operands.push(Operands::new(shape, instructions, bf16));
                floor.operands.len() - 1
            });
            floor.products.push(FloorProduct { product, operands });
        }
        floor
    }

    /// Computes all products once, on the calling thread.
    pub(super) fn run(&mut self, engine: Engine) {
        for FloorProduct { product, operands } in &self.products {
            let operands = &mut self.operands[*operands];
            match engine {
                Engine::Library => operands.run_library(product.kind),
                Engine::Kernels => operands.run_kernels(product.kind, self.instructions),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::policy::MlpShape;

    use super::*;

    fn assert_engines_agree(products: &[Product], precision: Precision, tolerance: f32) {
        let floor = || Floor::new(products.iter().copied(), precision);
        let (mut library, mut kernels) = (floor(), floor());
        library.run(Engine::Library);
        kernels.run(Engine::Kernels);
        for (a, b) in library.operands.iter().zip(&kernels.operands) {
            let difference = |a: &[f32], b: &[f32]| {
                let scale = a.iter().fold(1.0_f32, |scale, a| scale.max(a.abs()));
                a.iter().zip(b).fold(0.0_f32, |most, (a, b)| most.max((a - b).abs())) / scale
            };
            let most = difference(&a.inputs, &b.inputs)
                .max(difference(&a.outputs, &b.outputs))
                .max(difference(&a.weights, &b.weights));
            assert!(most < tolerance, "{:?}: {most}", a.shape);
        }
    }

    /// The products write their operands, so each kind is compared alone.
    #[test]
    fn both_engines_compute_every_product_of_an_update() {
        let shape = &MlpShape::new(vec![5, 40, 3]);
        let of_each_kind: [Vec<Product>; 4] = [
            Product::forward(shape, 70).collect(),
            Product::backward(shape, 70).collect(),
            vec![Product::input_gradient(shape, 70, 2)],
            Product::weight_gradient(shape, 70).collect(),
        ];
        for products in of_each_kind {
            assert_engines_agree(&products, Precision::F32, 1e-5);
            assert_engines_agree(&products, Precision::Bf16, 5e-2);
        }
    }
}
