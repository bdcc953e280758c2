//! Compares the products with f64 products of the same rounded numbers, where only the sums are
//! rounded, and with f64 products of the original numbers.

use super::super::tests::{SHAPES, numbers, product};
use super::*;
use crate::update::tests::bf16;

/// Rounds to the nearest bfloat16, ties to even.
fn rounded(number: f32) -> f64 {
    let bits = number.to_bits();
    let up = 0x7fff + ((bits >> 16) & 1);
    f64::from(f32::from_bits((bits + up) & 0xffff_0000))
}

fn distance(got: &[f32], want: &[f64]) -> f64 {
    assert_eq!(got.len(), want.len());
    let norm = |x: &mut dyn Iterator<Item = f64>| x.map(|x| x * x).sum::<f64>().sqrt();
    let apart = norm(&mut got.iter().zip(want).map(|(got, want)| f64::from(*got) - want));
    apart / norm(&mut want.iter().copied()).max(1e-30)
}

fn check(got: &[f32], cols: usize, depth: usize, at: impl Fn(usize, usize, usize) -> [f32; 2]) {
    let rows = got.len() / cols;
    let exact = product(rows, cols, depth, |r, c, k| at(r, c, k).map(f64::from).iter().product());
    let same = product(rows, cols, depth, |r, c, k| at(r, c, k).map(rounded).iter().product());
    let what = format!("{rows} x {cols} x {depth}");
    assert!(distance(got, &same) < 1e-6, "{what}: {}", distance(got, &same));
    assert!(distance(got, &exact) < 1e-2, "{what}: {}", distance(got, &exact));
}

#[test]
fn products_of_rounded_numbers_are_exact_and_of_others_within_a_hundredth() {
    let Some(bf16) = bf16() else { return };
    for (rows, inputs_len, outputs_len) in SHAPES {
        let inputs = numbers(rows * inputs_len, 1);
        let weights = numbers(outputs_len * inputs_len, 2);
        let gradient = numbers(rows * outputs_len, 3);
        let bias = vec![0.0; outputs_len];

        let mut packed = vec![9; forward_len(inputs_len, outputs_len)];
        bf16.pack_forward(&weights, inputs_len, &mut packed);
        let mut out = vec![9.0; rows * outputs_len];
        bf16.forward(&inputs, &packed, &bias, Activation::Linear, &mut out);
        check(&out, outputs_len, inputs_len, |r, c, k| {
            [inputs[r * inputs_len + k], weights[c * inputs_len + k]]
        });

        let mut packed = vec![9; pair_count(outputs_len) * inputs_len];
        bf16.pack_rows(&weights, inputs_len, &mut packed);
        let first = inputs_len / 3;
        let mut out = vec![9.0; rows * (inputs_len - first)];
        bf16.backward(&gradient, outputs_len, &packed, first, None, &mut out);
        check(&out, inputs_len - first, outputs_len, |r, c, k| {
            [gradient[r * outputs_len + k], weights[k * inputs_len + first + c]]
        });

        let mut gradient_pairs = vec![9; pair_count(rows) * outputs_len];
        bf16.pack_rows(&gradient, outputs_len, &mut gradient_pairs);
        let mut input_pairs = vec![9; pair_count(rows) * inputs_len];
        bf16.pack_rows(&inputs, inputs_len, &mut input_pairs);
        let outputs = outputs_len / 2..outputs_len;
        let mut out = vec![9.0; outputs.len() * inputs_len];
        let from = outputs.start;
        bf16.weight_gradient(&gradient_pairs, outputs_len, outputs, &input_pairs, &mut out);
        check(&out, inputs_len, rows, |o, i, r| {
            [gradient[r * outputs_len + from + o], inputs[r * inputs_len + i]]
        });
    }
}

#[test]
fn bias_activation_and_mask_are_those_of_f32() {
    let Some(bf16) = bf16() else { return };
    let (inputs, weights) = ([1.0, 2.0, 4.0], [1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0]);
    let mut packed = vec![0; forward_len(3, 3)];
    bf16.pack_forward(&weights, 3, &mut packed);
    let mut out = [9.0; 3];
    bf16.forward(&inputs, &packed, &[0.5, 1.0, -1.0], Activation::Relu, &mut out);
    assert_eq!(out, [1.5, 0.0, 3.0]);
    let mut packed = vec![0; pair_count(3) * 3];
    bf16.pack_rows(&weights, 3, &mut packed);
    bf16.backward(&inputs, 3, &packed, 0, Some(&[1.0, 0.0, -1.0]), &mut out);
    assert_eq!(out, [1.0, 0.0, 0.0]);
}

#[test]
fn a_layer_packed_in_pieces_is_the_layer_packed_at_once() {
    let Some(bf16) = bf16() else { return };
    let (inputs, outputs) = (37, 70);
    let weights = numbers(inputs * outputs, 1);
    let mut whole = vec![9; forward_len(inputs, outputs)];
    bf16.pack_forward(&weights, inputs, &mut whole);
    let mut pieces = vec![9; whole.len()];
    let cut = 3 * PANEL;
    bf16.pack_forward(&weights[..cut * inputs], inputs, &mut pieces[..cut * pair_count(inputs)]);
    bf16.pack_forward(&weights[cut * inputs..], inputs, &mut pieces[cut * pair_count(inputs)..]);
    assert_eq!(whole, pieces);
}
