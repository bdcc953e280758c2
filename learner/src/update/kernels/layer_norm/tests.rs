//! Compares the kernels with their definition in f64, and the backward pass with central
//! differences.

use super::super::tests::numbers;
use super::*;

/// Widths of less than a vector, and of whole vectors with and without a remainder.
const WIDTHS: [usize; 6] = [1, 2, 12, 64, 75, 256];
const ROWS: usize = 5;

fn as_f64(x: &[f32]) -> Vec<f64> {
    x.iter().copied().map(f64::from).collect()
}

/// Returns the normalised row, and 1 / std.
fn normalised(row: &[f64]) -> (Vec<f64>, f64) {
    let n = row.len() as f64;
    let mean = row.iter().sum::<f64>() / n;
    let variance = row.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n;
    let inverse_std = 1.0 / (variance + 1e-5).sqrt();
    (row.iter().map(|x| (x - mean) * inverse_std).collect(), inverse_std)
}

fn assert_close(got: &[f32], want: &[f64], what: &str) {
    assert_eq!(got.len(), want.len(), "{what}");
    let scale = want.iter().fold(1.0_f64, |scale, x| scale.max(x.abs()));
    for (i, (got, want)) in got.iter().zip(want).enumerate() {
        assert!((f64::from(*got) - want).abs() < 1e-5 * scale, "{what} at {i}: {got} {want}");
    }
}

#[test]
fn rows_are_normalised_scaled_shifted_and_cut_at_zero() {
    for (width, instructions) in WIDTHS
        .into_iter()
        .flat_map(|width| InstructionSet::all().into_iter().map(move |i| (width, i)))
    {
        // Far from zero, where a variance computed from a mean of squares would lose its digits.
        let sums: Vec<f32> = numbers(ROWS * width, 1).iter().map(|x| 0.5 * x + 20.0).collect();
        let (gain, shift) = (numbers(width, 2), numbers(width, 3));
        let mut values = sums.clone();
        let (mut inverse_std, mut outputs) = (vec![9.0; ROWS], vec![9.0; ROWS * width]);
        Normalise {
            values: &mut values,
            inverse_std: &mut inverse_std,
            gain: &gain,
            shift: &shift,
            outputs: &mut outputs,
        }
        .run(instructions);
        for (row, sums) in sums.chunks_exact(width).enumerate() {
            let at = row * width..(row + 1) * width;
            let (want, want_inverse) = normalised(&as_f64(sums));
            let what = format!("{width} {instructions:?}");
            assert!((f64::from(inverse_std[row]) / want_inverse - 1.0).abs() < 1e-4, "{what}");
            // The rounding of the inputs (20 in f32), magnified by 1 / std.
            let close = |got: &[f32], want: &[f64]| {
                let scale = 1e-5_f64.max(want_inverse * 4e-6);
                got.iter().zip(want).all(|(g, w)| (f64::from(*g) - w).abs() < scale)
            };
            assert!(close(&values[at.clone()], &want), "{what}");
            let want: Vec<f64> = want
                .iter()
                .zip(gain.iter().zip(&shift))
                .map(|(z, (gain, shift))| (z * f64::from(*gain) + f64::from(*shift)).max(0.0))
                .collect();
            assert!(close(&outputs[at], &want), "outputs {what}");
        }
    }
}

#[test]
fn the_gradient_is_that_of_central_differences() {
    for width in WIDTHS {
        let (sums, gradient) = (numbers(ROWS * width, 1), numbers(ROWS * width, 2));
        let gain = numbers(width, 3);
        let (mut values, mut inverse_std) = (Vec::new(), Vec::new());
        let mut want = Vec::new();
        for (row, g) in sums.chunks_exact(width).zip(gradient.chunks_exact(width)) {
            let (row, g) = (as_f64(row), as_f64(g));
            let (z, inverse) = normalised(&row);
            values.extend(z.iter().map(|z| *z as f32));
            inverse_std.push(inverse as f32);
            let loss = |at: usize, by: f64| {
                let mut row = row.clone();
                row[at] += by;
                let (z, _) = normalised(&row);
                (0..width).map(|i| g[i] * f64::from(gain[i]) * z[i]).sum::<f64>()
            };
            want.extend((0..width).map(|at| (loss(at, 1e-5) - loss(at, -1e-5)) / 2e-5));
        }
        for instructions in InstructionSet::all() {
            let mut got = vec![9.0; ROWS * width];
            NormaliseBackward {
                gradient: &gradient,
                normalised: &values,
                inverse_std: &inverse_std,
                gain: &gain,
                sums_gradient: &mut got,
            }
            .run(instructions);
            assert_close(&got, &want, &format!("{width} {instructions:?}"));
        }
    }
}

#[test]
fn gradients_of_gain_and_shift_are_sums_over_all_rows_also_in_pieces() {
    for width in WIDTHS {
        let (gradient, normalised) = (numbers(ROWS * width, 1), numbers(ROWS * width, 2));
        let column = |f: &dyn Fn(usize) -> f64, c: usize| {
            (0..ROWS).map(|row| f(row * width + c)).sum::<f64>()
        };
        let of_gain = |i: usize| f64::from(gradient[i]) * f64::from(normalised[i]);
        let of_shift = |i: usize| f64::from(gradient[i]);
        let want_gain: Vec<f64> = (0..width).map(|c| column(&of_gain, c)).collect();
        let want_shift: Vec<f64> = (0..width).map(|c| column(&of_shift, c)).collect();
        for instructions in InstructionSet::all() {
            let run = |outputs: Range<usize>| {
                // Two shards, of two rows and of three.
                let shards = [0..2 * width, 2 * width..ROWS * width].map(|at| NormalisedShard {
                    gradient: &gradient[at.clone()],
                    normalised: &normalised[at],
                });
                let (mut gain, mut shift) = (vec![9.0; outputs.len()], vec![9.0; outputs.len()]);
                let shards = shards.into_iter();
                GainGradient { shards, width, outputs, gain: &mut gain, shift: &mut shift }
                    .run(instructions);
                (gain, shift)
            };
            let (gain, shift) = run(0..width);
            let what = format!("{width} {instructions:?}");
            assert_close(&gain, &want_gain, &what);
            assert_close(&shift, &want_shift, &what);
            let cut = width / 2;
            let pieces = [run(0..cut), run(cut..width)];
            assert_eq!(gain, [&pieces[0].0[..], &pieces[1].0].concat(), "{what}");
            assert_eq!(shift, [&pieces[0].1[..], &pieces[1].1].concat(), "{what}");
        }
    }
}
