//! Compares every kernel, with every instruction set of this processor, with its definition in f64.

use super::*;

/// Returns numbers in (-1, 1) without a pattern that could hide errors in sums.
pub(super) fn numbers(len: usize, seed: usize) -> Vec<f32> {
    let mix = |i: usize| ((i * 2_654_435_761 + seed * 40_503) >> 7) % 20_011;
    (0..len).map(|i| mix(i) as f32 / 10_005.5 - 1.0).collect()
}

/// Returns a product of (rows, depth) and (depth, cols); `number` gives each term.
pub(super) fn product(
    rows: usize,
    cols: usize,
    depth: usize,
    number: impl Fn(usize, usize, usize) -> f64,
) -> Vec<f64> {
    let cell = |i: usize| (0..depth).map(|k| number(i / cols, i % cols, k)).sum();
    (0..rows * cols).map(cell).collect()
}

fn assert_close(got: &[f32], want: &[f64], what: &str) {
    assert_eq!(got.len(), want.len(), "{what}");
    let scale = want.iter().fold(1.0_f64, |scale, x| scale.max(x.abs()));
    for (i, (got, want)) in got.iter().zip(want).enumerate() {
        assert!((f64::from(*got) - want).abs() < 2e-6 * scale, "{what} at {i}: {got} {want}");
    }
}

/// (rows, inputs, outputs), close to the sizes of panels, vectors and tiles.
pub(super) const SHAPES: [(usize, usize, usize); 9] = [
    (1, 3, 1),
    (64, 23, 256),
    (64, 256, 70),
    (64, 58, 64),
    (37, 16, 17),
    (9, 1, 2),
    (64, 256, 1),
    (31, 65, 3),
    (2, 48, 15),
];

#[test]
fn forward_is_what_the_definition_says() {
    for (rows, depth, width) in SHAPES {
        let (inputs, weights) = (numbers(rows * depth, 1), numbers(width * depth, 2));
        let bias = numbers(width, 3);
        let want = product(rows, width, depth, |r, c, k| {
            f64::from(inputs[r * depth + k]) * f64::from(weights[c * depth + k])
                + f64::from(bias[c]) / depth as f64
        });
        for instructions in InstructionSet::all() {
            let mut packed = vec![9.0; packed_len(depth, width)];
            pack(&weights, depth, width, &mut packed, instructions);
            for activation in [Activation::Linear, Activation::Relu] {
                let mut got = vec![9.0; rows * width];
                Forward {
                    inputs: &inputs,
                    packed: &packed,
                    bias: &bias,
                    activation,
                    outputs: &mut got,
                }
                .run(instructions);
                let relu = |x: &f64| if activation == Activation::Relu { x.max(0.0) } else { *x };
                let want: Vec<f64> = want.iter().map(relu).collect();
                assert_close(&got, &want, &format!("{rows}x{depth}x{width} {instructions:?}"));
            }
        }
    }
}

#[test]
fn a_layer_packed_in_pieces_is_the_layer_packed_at_once() {
    let (inputs, outputs) = (37, 70);
    let weights = numbers(inputs * outputs, 1);
    for instructions in InstructionSet::all() {
        let mut whole = vec![0.0; packed_len(inputs, outputs)];
        pack(&weights, inputs, outputs, &mut whole, instructions);
        assert_eq!(whole[2 * PANEL + 5], weights[5 * inputs + 2]);
        let mut pieces = vec![9.0; whole.len()];
        let cut = 3 * PANEL * inputs;
        pack(&weights[..cut], inputs, outputs, &mut pieces[..cut], instructions);
        pack(&weights[cut..], inputs, outputs, &mut pieces[cut..], instructions);
        assert_eq!(whole, pieces);
    }
}

#[test]
fn backward_is_what_the_definition_says() {
    for (rows, inputs, outputs) in SHAPES {
        for first in [0, inputs / 3] {
            let width = inputs - first;
            let (gradient, weights) = (numbers(rows * outputs, 1), numbers(outputs * inputs, 2));
            let activations = numbers(rows * width, 3);
            let want = product(rows, width, outputs, |r, c, k| {
                f64::from(gradient[r * outputs + k]) * f64::from(weights[k * inputs + first + c])
            });
            let masked: Vec<f64> = want
                .iter()
                .zip(&activations)
                .map(|(want, activation)| if *activation > 0.0 { *want } else { 0.0 })
                .collect();
            for instructions in InstructionSet::all() {
                for (activations, want) in [(None, &want), (Some(&activations[..]), &masked)] {
                    let mut got = vec![9.0; rows * width];
                    Backward {
                        gradient: &gradient,
                        weights: &weights,
                        outputs_len: outputs,
                        first,
                        activations,
                        inputs_gradient: &mut got,
                    }
                    .run(instructions);
                    let what = format!("{rows}x{inputs}x{outputs} from {first} {instructions:?}");
                    assert_close(&got, want, &what);
                }
            }
        }
    }
}

#[test]
fn weight_gradient_is_what_the_definition_says_however_it_is_split() {
    for (rows, inputs_len, outputs_len) in SHAPES {
        let (gradient, inputs) = (numbers(rows * outputs_len, 1), numbers(rows * inputs_len, 2));
        let want = product(outputs_len, inputs_len, rows, |o, i, r| {
            f64::from(gradient[r * outputs_len + o]) * f64::from(inputs[r * inputs_len + i])
        });
        let want_bias =
            product(1, outputs_len, rows, |_, o, r| f64::from(gradient[r * outputs_len + o]));
        let cut = rows / 3;
        let shards = [0..cut, cut..rows].map(|rows| GradientShard {
            gradient: &gradient[rows.start * outputs_len..rows.end * outputs_len],
            inputs: &inputs[rows.start * inputs_len..rows.end * inputs_len],
        });
        for instructions in InstructionSet::all() {
            let run = |outputs: std::ops::Range<usize>| {
                let mut weights = vec![9.0; outputs.len() * inputs_len];
                let mut bias = vec![9.0; outputs.len()];
                WeightGradient {
                    shards: shards.iter().copied(),
                    inputs_len,
                    outputs_len,
                    outputs,
                    weights: &mut weights,
                    bias: &mut bias,
                }
                .run(instructions);
                (weights, bias)
            };
            let (weights, bias) = run(0..outputs_len);
            let what = format!("{rows}x{inputs_len}x{outputs_len} {instructions:?}");
            assert_close(&weights, &want, &what);
            assert_close(&bias, &want_bias, &what);
            let cut = (outputs_len / 2).next_multiple_of(PANEL).min(outputs_len);
            let (mut pieces, mut bias_pieces) = run(0..cut);
            let (rest, bias_rest) = run(cut..outputs_len);
            pieces.extend(rest);
            bias_pieces.extend(bias_rest);
            // Equal to the bit, because the number of threads must not change the result.
            assert_eq!((weights, bias), (pieces, bias_pieces), "{what}");
        }
    }
}

#[test]
fn adam_and_its_target_follow_the_definition() {
    let len = 37;
    for instructions in InstructionSet::all() {
        let mut parameters = numbers(len, 1);
        let mut target = numbers(len, 2);
        let (mut first, mut second) = (vec![0.0; len], vec![0.0; len]);
        let as_f64 = |x: &[f32]| x.iter().map(|x| f64::from(*x)).collect::<Vec<_>>();
        let (mut p, mut goal) = (as_f64(&parameters), as_f64(&target));
        let (mut m, mut v) = (vec![0.0_f64; len], vec![0.0_f64; len]);
        for t in 1..=20 {
            let gradient: Vec<f32> = numbers(len, 2 + t).iter().map(|g| g * 1e-3).collect();
            for i in 0..len {
                let g = f64::from(gradient[i]);
                m[i] = 0.9 * m[i] + 0.1 * g;
                v[i] = 0.999 * v[i] + 0.001 * g * g;
                let t = t as i32;
                p[i] -= 3e-3 * (m[i] / (1.0 - 0.9_f64.powi(t)))
                    / ((v[i] / (1.0 - 0.999_f64.powi(t))).sqrt() + 1e-8);
                goal[i] += 0.005 * (p[i] - goal[i]);
            }
            let pass = AdamPass {
                parameters: &mut parameters,
                first: &mut first,
                second: &mut second,
                gradient: &gradient,
                target_step: Some(PolyakStep { target: &mut target, polyak: 0.005 }),
                sizes: StepSizes::new(3e-3, t as u64),
            };
            adam(pass, instructions);
            assert_close(&parameters, &p, "parameters");
            assert_close(&target, &goal, "target");
        }
    }
}
