//! Packs a layer's weights for the forward pass.

use super::{InstructionSet, PANEL};

/// Maximum outputs of a layer whose weights are not packed; its outputs are dot products.
pub(super) const NARROW: usize = 2;

/// Returns the length of a layer's packed weights.
#[must_use]
pub fn packed_len(inputs: usize, outputs: usize) -> usize {
    if outputs <= NARROW { inputs * outputs } else { inputs * outputs.next_multiple_of(PANEL) }
}

/// Packs `weights`, (outputs, inputs), into panels of [`PANEL`] outputs, input by input. The last
/// panel is padded with zeros. A layer of `outputs_len` outputs can be packed in parts that begin
/// at multiples of [`PANEL`]; the part from output o on begins at o * inputs.
///
/// # Panics
/// If the lengths are inconsistent.
pub fn pack(
    weights: &[f32],
    inputs: usize,
    outputs_len: usize,
    packed: &mut [f32],
    instructions: InstructionSet,
) {
    if inputs == 0 {
        return;
    }
    let outputs = weights.len() / inputs;
    assert_eq!(weights.len(), outputs * inputs, "weights of {inputs} inputs");
    let narrow = outputs_len <= NARROW;
    let rows = if narrow { outputs } else { outputs.next_multiple_of(PANEL) };
    assert_eq!(packed.len(), rows * inputs, "packed weights");
    if narrow {
        return packed.copy_from_slice(weights);
    }
    let panels = packed.chunks_exact_mut(PANEL * inputs);
    for (weights, panel) in weights.chunks(PANEL * inputs).zip(panels) {
        let mut done = 0;
        #[cfg(target_arch = "x86_64")]
        if weights.len() == panel.len() {
            if instructions.has_avx512() {
                done = inputs / PANEL * PANEL;
                for input in (0..done).step_by(PANEL) {
                    // SAFETY: `has_avx512` checked that the processor has these instructions.
                    unsafe { transpose(&weights[input..], inputs, &mut panel[input * PANEL..]) };
                }
            } else if instructions.has_avx2() {
                done = inputs / 8 * 8;
                for (input, output) in (0..done).step_by(8).flat_map(|i| [(i, 0), (i, 8)]) {
                    let rows = &weights[output * inputs + input..];
                    // SAFETY: `has_avx2` checked that the processor has these instructions.
                    unsafe { transpose_8(rows, inputs, &mut panel[input * PANEL + output..]) };
                }
            }
        }
        #[cfg(not(target_arch = "x86_64"))]
        let _ = instructions;
        if weights.len() < panel.len() {
            panel.fill(0.0);
        }
        for (output, row) in weights.chunks_exact(inputs).enumerate() {
            for (weight, packed) in row.iter().zip(panel.chunks_exact_mut(PANEL)).skip(done) {
                packed[output] = *weight;
            }
        }
    }
}

/// Transposes 8 rows of 8 numbers that are `stride` apart into 8 rows that are [`PANEL`] apart.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx")]
fn transpose_8(rows: &[f32], stride: usize, out: &mut [f32]) {
    use std::arch::x86_64::{
        _mm256_castpd_ps, _mm256_castps_pd, _mm256_loadu_ps, _mm256_permute2f128_ps,
        _mm256_setzero_ps, _mm256_storeu_ps, _mm256_unpackhi_pd, _mm256_unpackhi_ps,
        _mm256_unpacklo_pd, _mm256_unpacklo_ps,
    };
    assert!(rows.len() >= 7 * stride + 8 && out.len() >= 7 * PANEL + 8);
    let mut at = [_mm256_setzero_ps(); 8];
    for (i, row) in at.iter_mut().enumerate() {
        // SAFETY: row i ends at i * stride + 8, within `rows` (asserted above).
        *row = unsafe { _mm256_loadu_ps(rows.as_ptr().add(i * stride)) };
    }
    // Within halves of four numbers: pairs of rows, then pairs of pairs.
    for i in (0..8).step_by(2) {
        let (a, b) = (at[i], at[i + 1]);
        (at[i], at[i + 1]) = (_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b));
    }
    for i in [0, 1, 4, 5] {
        let (a, b) = (_mm256_castps_pd(at[i]), _mm256_castps_pd(at[i + 2]));
        at[i] = _mm256_castpd_ps(_mm256_unpacklo_pd(a, b));
        at[i + 2] = _mm256_castpd_ps(_mm256_unpackhi_pd(a, b));
    }
    // Columns 0, 1, 2 and 3 of four rows are now at 0, 2, 1 and 3.
    for (column, i) in [0, 2, 1, 3].into_iter().enumerate() {
        let (upper, lower) = (at[i], at[i + 4]);
        let halves = [
            _mm256_permute2f128_ps::<0x20>(upper, lower),
            _mm256_permute2f128_ps::<0x31>(upper, lower),
        ];
        for (half, row) in halves.into_iter().enumerate() {
            let first = (column + 4 * half) * PANEL;
            // SAFETY: the last row ends at 7 * PANEL + 8, within `out` (asserted above).
            unsafe { _mm256_storeu_ps(out.as_mut_ptr().add(first), row) };
        }
    }
}

/// Transposes 16 rows of 16 numbers that are `stride` apart into 256 consecutive numbers.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
pub(super) fn transpose(rows: &[f32], stride: usize, out: &mut [f32]) {
    use std::arch::x86_64::{_mm512_loadu_ps, _mm512_setzero_ps, _mm512_storeu_ps};
    assert!(rows.len() >= (PANEL - 1) * stride + PANEL && out.len() >= PANEL * PANEL);
    let mut at = [_mm512_setzero_ps(); PANEL];
    for (i, row) in at.iter_mut().enumerate() {
        // SAFETY: row i ends at i * stride + 16, within `rows` (asserted above).
        *row = unsafe { _mm512_loadu_ps(rows.as_ptr().add(i * stride)) };
    }
    swap_blocks::<8>(&mut at);
    swap_blocks::<4>(&mut at);
    swap_blocks::<2>(&mut at);
    swap_blocks::<1>(&mut at);
    for (i, row) in at.iter().enumerate() {
        // SAFETY: `out` has 256 numbers (asserted above).
        unsafe { _mm512_storeu_ps(out.as_mut_ptr().add(i * PANEL), *row) };
    }
}

/// Swaps the off-diagonal blocks of D x D numbers in every pair of rows that are D apart.
#[cfg(target_arch = "x86_64")]
#[inline]
#[target_feature(enable = "avx512f")]
fn swap_blocks<const D: usize>(at: &mut [std::arch::x86_64::__m512; PANEL]) {
    use std::arch::x86_64::{_mm512_loadu_si512, _mm512_permutex2var_ps};
    let tables = const { &swap_tables(D) };
    // SAFETY: each table is 64 bytes.
    let upper = unsafe { _mm512_loadu_si512(tables[0].as_ptr().cast()) };
    // SAFETY: as above.
    let lower = unsafe { _mm512_loadu_si512(tables[1].as_ptr().cast()) };
    for i in 0..PANEL {
        if i & D == 0 {
            let (a, b) = (at[i], at[i + D]);
            at[i] = _mm512_permutex2var_ps(a, upper, b);
            at[i + D] = _mm512_permutex2var_ps(a, lower, b);
        }
    }
}

/// Returns the source index of each number of the two swapped rows. Indices of the second row begin
/// at 16.
#[cfg(target_arch = "x86_64")]
const fn swap_tables(distance: usize) -> [[i32; PANEL]; 2] {
    let mut tables = [[0; PANEL]; 2];
    let mut i = 0;
    while i < PANEL {
        let inside = i & distance != 0;
        tables[0][i] = if inside { i - distance + PANEL } else { i } as i32;
        tables[1][i] = if inside { i + PANEL } else { i + distance } as i32;
        i += 1;
    }
    tables
}
