//! A network's complete step in both precisions.

use dmprl_shared::config::Precision;
use dmprl_shared::policy::{Activations, MlpShape, initial_parameters};
use dmprl_shared::seeds;

use super::backward_pass::Gradients;
use super::kernels::bf16::Bf16;
use super::layer_norm::Normalised;
use super::network::{PassRecord, TrainableNetwork};
use super::skipped::skipped;
use super::thread_pool::ThreadPool;
use super::*;

struct Shard {
    inputs: Vec<f32>,
    activations: Activations,
    normalised: Option<Normalised>,
    gradients: Gradients,
}

impl Shard {
    fn record(&self) -> PassRecord<'_> {
        let Self { inputs, activations, normalised, gradients } = self;
        PassRecord { inputs, activations, normalised: normalised.as_ref(), gradients }
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Hidden {
    Plain,
    Normalised,
}

/// Returns gradient, parameters and target after three steps towards zero outputs.
fn steps(hidden: Hidden, precision: Precision, threads: usize) -> [Vec<f32>; 3] {
    let shape = MlpShape::new(vec![23, 96, 64, 7]);
    let initial = initial_parameters(&shape, &mut seeds::stream(1, "test", 0));
    let mut network = TrainableNetwork::new(shape.clone(), initial, 1e-3, true, precision).unwrap();
    if hidden == Hidden::Normalised {
        network = network.with_layer_norm();
    }
    let mut pool = ThreadPool::new(threads);
    // The last shard is short and has an odd number of rows.
    let shard = |rows: usize| Shard {
        inputs: (0..rows * 23).map(|i| (i as f32 * 0.37).sin()).collect(),
        activations: Activations::new(&shape, rows),
        normalised: Some(Normalised::new(&shape, rows)),
        gradients: Gradients::with_layer_norm(&shape, rows),
    };
    let mut shards = [SHARD_ROWS, SHARD_ROWS, 13].map(shard);
    for _ in 0..3 {
        let view = network.view();
        pool.for_each(&mut shards, |Shard { inputs, activations, normalised, gradients }| {
            let rows = inputs.len() / 23;
            view.forward(inputs, activations, normalised.as_mut());
            let out = gradients.output_mut(&shape, rows);
            out.copy_from_slice(activations.output(&shape, rows));
            view.backward_pass(activations, normalised.as_ref(), rows).run(gradients);
        });
        drop(view);
        network.adam_step(&mut pool, &shards, Shard::record, Some(0.1));
    }
    let target = network.target.as_ref().unwrap().values();
    [network.gradient(), network.parameters.values(), target].map(<[f32]>::to_vec)
}

/// Returns the 16-bit arithmetic, or reports the test as skipped if the processor has none.
pub(super) fn bf16() -> Option<Bf16> {
    let bf16 = Bf16::detect();
    if bf16.is_none() {
        let remedy = "run the tests on a processor with AVX512-BF16";
        skipped("TEST_BF16_REQUIRED", "updates in 16 bits (learner.precision = \"bf16\")", remedy);
    }
    bf16
}

#[test]
fn sixteen_bits_change_a_gradient_by_no_more_than_a_hundredth() {
    if bf16().is_none() {
        return;
    }
    let norm = |x: &mut dyn Iterator<Item = f32>| x.map(|x| x * x).sum::<f32>().sqrt();
    for hidden in [Hidden::Plain, Hidden::Normalised] {
        let [exact, rounded] = [Precision::F32, Precision::Bf16].map(|p| steps(hidden, p, 1));
        for (exact, rounded) in exact.iter().zip(&rounded) {
            let apart = norm(&mut exact.iter().zip(rounded).map(|(a, b)| a - b));
            let ratio = apart / norm(&mut exact.iter().copied());
            assert!(ratio < 1e-2, "{hidden:?}: {ratio}");
            // The arithmetic must really be another one.
            assert!(ratio > 1e-6, "{hidden:?}: {ratio}");
        }
    }
}

#[test]
fn the_number_of_threads_changes_no_bit_in_either_precision() {
    for hidden in [Hidden::Plain, Hidden::Normalised] {
        assert!(steps(hidden, Precision::F32, 1) == steps(hidden, Precision::F32, 3));
        if bf16().is_some() {
            assert!(steps(hidden, Precision::Bf16, 1) == steps(hidden, Precision::Bf16, 3));
        }
    }
}
