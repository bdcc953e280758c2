//! The register tile that all products share.

use std::ops::Range;

use pulp::{MemMask, Simd};

use super::PANEL;

/// The operand of which single numbers are broadcast: row `m` and depth `k` at
/// `m * row_stride + k * depth_stride`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Broadcast<'a> {
    pub data: &'a [f32],
    pub row_stride: usize,
    pub depth_stride: usize,
}

/// The operand that is read as vectors: at depth `k`, the `width` numbers from `k * stride` on.
#[derive(Debug, Clone, Copy)]
pub(super) struct Wide<'a> {
    pub data: &'a [f32],
    pub stride: usize,
    /// At most [`PANEL`].
    pub width: usize,
    /// Where, counted from a depth's numbers, those stand that the next tiles read at that depth,
    /// if they are to be fetched ahead: a network's weights do not stay in a core's caches from one
    /// block of rows to the next.
    pub next: Option<usize>,
}

/// The sums of `M` rows and [`PANEL`] = `V` * lanes columns.
pub(super) type Sums<S, const M: usize, const V: usize> = [[<S as Simd>::f32s; V]; M];

/// Depths between two computations of all addresses: with 16 rows they cost as many instructions as
/// the products.
const UNROLLED: usize = 4;

/// Adds Σ_k left(m, k) right(k, ·), k < `depth`, to every row m of `sums`. `MASKED` says that
/// `right.width` may be less than a panel; the columns beyond keep their sums.
///
/// # Panics
/// If an operand does not reach that far.
#[inline(always)]
pub(super) fn accumulate<S: Simd, const M: usize, const V: usize, const MASKED: bool>(
    simd: S,
    mut sums: Sums<S, M, V>,
    left: Broadcast<'_>,
    right: Wide<'_>,
    depth: usize,
) -> Sums<S, M, V> {
    assert!(V * S::F32_LANES == PANEL, "vectors of a tile");
    if depth == 0 {
        return sums;
    }
    let left_last = (M - 1) * left.row_stride + (depth - 1) * left.depth_stride;
    let width = if MASKED { right.width } else { PANEL };
    assert!(left_last < left.data.len(), "left operand of a tile");
    assert!(width <= PANEL, "a tile is {PANEL} wide");
    assert!((depth - 1) * right.stride + width <= right.data.len(), "right operand of a tile");
    let masks = masks::<S, V>(simd, width);
    let mut k = 0;
    while k + UNROLLED <= depth {
        for step in 0..UNROLLED {
            // SAFETY: k + step < depth, for which both operands were checked.
            sums = unsafe { multiply::<S, M, V, MASKED>(simd, sums, left, right, masks, k + step) };
        }
        k += UNROLLED;
    }
    while k < depth {
        // SAFETY: as above.
        sums = unsafe { multiply::<S, M, V, MASKED>(simd, sums, left, right, masks, k) };
        k += 1;
    }
    sums
}

/// Adds left(m, k) right(k, ·) to every row m of `sums`.
///
/// # Safety
/// `right` has, at depth k, a panel or, if `MASKED`, what `masks` leaves of one; `left` has M rows
/// at that depth.
#[inline(always)]
unsafe fn multiply<S: Simd, const M: usize, const V: usize, const MASKED: bool>(
    simd: S,
    mut sums: Sums<S, M, V>,
    left: Broadcast<'_>,
    right: Wide<'_>,
    masks: [MemMask<S::m32s>; V],
    k: usize,
) -> Sums<S, M, V> {
    let mut vectors = [simd.splat_f32s(0.0); V];
    let right_at = right.data.as_ptr();
    for (v, vector) in vectors.iter_mut().enumerate() {
        // SAFETY: the caller's promise about `right`.
        *vector = unsafe {
            let at = right_at.add(k * right.stride).wrapping_add(v * S::F32_LANES);
            if MASKED {
                simd.mask_load_ptr_f32s(masks[v], at)
            } else {
                at.cast::<S::f32s>().read_unaligned()
            }
        };
    }
    if let Some(next) = right.next {
        prefetch(right_at.wrapping_add(k * right.stride + next));
    }
    let left_at = left.data.as_ptr();
    for (m, sums) in sums.iter_mut().enumerate() {
        // SAFETY: the caller's promise about `left`.
        let number = unsafe { *left_at.add(m * left.row_stride + k * left.depth_stride) };
        let number = simd.splat_f32s(number);
        for (sum, vector) in sums.iter_mut().zip(vectors) {
            *sum = simd.mul_add_e_f32s(number, vector, *sum);
        }
    }
    sums
}

/// Asks for a line to be brought into the second-level cache; a hint, for any address.
#[inline(always)]
fn prefetch(at: *const f32) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: a prefetch of an address that is not ours does nothing.
    unsafe {
        use std::arch::x86_64::{_MM_HINT_T1, _mm_prefetch};
        _mm_prefetch::<_MM_HINT_T1>(at.cast());
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = at;
}

/// Masks of the first `width` columns of a tile.
#[inline(always)]
fn masks<S: Simd, const V: usize>(simd: S, width: usize) -> [MemMask<S::m32s>; V] {
    let mut masks = [MemMask::new(simd.mask_between_m32s(0, 0).mask()); V];
    for (v, mask) in masks.iter_mut().enumerate() {
        let lanes = width.saturating_sub(v * S::F32_LANES).min(S::F32_LANES);
        *mask = MemMask::new(simd.mask_between_m32s(0, lanes as u32).mask());
    }
    masks
}

/// The first `row.len()` of a tile's row; the rest is zero.
///
/// # Panics
/// If `row` is longer than a panel.
#[inline(always)]
pub(super) fn load<S: Simd, const V: usize>(simd: S, row: &[f32]) -> [S::f32s; V] {
    assert!(row.len() <= PANEL, "a tile is {PANEL} wide");
    let masks = masks::<S, V>(simd, row.len());
    let mut values = [simd.splat_f32s(0.0); V];
    for (v, values) in values.iter_mut().enumerate() {
        let at = row.as_ptr().wrapping_add(v * S::F32_LANES);
        // SAFETY: the masks leave exactly the numbers of `row`.
        *values = unsafe { simd.mask_load_ptr_f32s(masks[v], at) };
    }
    values
}

/// Writes the first `row.len()` columns of a tile's row.
///
/// # Panics
/// If `row` is longer than a panel.
#[inline(always)]
pub(super) fn store<S: Simd, const V: usize>(simd: S, row: &mut [f32], values: [S::f32s; V]) {
    assert!(row.len() <= PANEL, "a tile is {PANEL} wide");
    let masks = masks::<S, V>(simd, row.len());
    for (v, values) in values.into_iter().enumerate() {
        let at = row.as_mut_ptr().wrapping_add(v * S::F32_LANES);
        // SAFETY: the masks leave exactly the numbers of `row`.
        unsafe { simd.mask_store_ptr_f32s(masks[v], at, values) };
    }
}

/// What a kernel does with one tile of `M` rows, the first of which is `row`.
pub(super) trait Tiled<S: Simd> {
    /// Computes and stores the tile.
    fn tile<const M: usize, const V: usize>(&mut self, simd: S, row: usize);
}

/// Cuts `rows` into tiles of as many rows as the registers hold: 16 of one vector of 16 numbers,
/// 4 of two vectors of 8 or four of 4.
#[inline(always)]
pub(super) fn for_rows<S: Simd, K: Tiled<S>>(simd: S, rows: Range<usize>, kernel: &mut K) {
    let mut row = rows.start;
    while row < rows.end {
        row += match (S::F32_LANES, rows.end - row) {
            (16, 16..) => one::<S, K, 16, 1>(simd, row, kernel),
            (16, 8..) => one::<S, K, 8, 1>(simd, row, kernel),
            (16, 4..) => one::<S, K, 4, 1>(simd, row, kernel),
            (16, 2..) => one::<S, K, 2, 1>(simd, row, kernel),
            (16, _) => one::<S, K, 1, 1>(simd, row, kernel),
            (8, 4..) => one::<S, K, 4, 2>(simd, row, kernel),
            (8, 2..) => one::<S, K, 2, 2>(simd, row, kernel),
            (8, _) => one::<S, K, 1, 2>(simd, row, kernel),
            (4, 4..) => one::<S, K, 4, 4>(simd, row, kernel),
            (4, _) => one::<S, K, 1, 4>(simd, row, kernel),
            _ => one::<S, K, 1, PANEL>(simd, row, kernel),
        };
    }
}

#[inline(always)]
fn one<S: Simd, K: Tiled<S>, const M: usize, const V: usize>(
    simd: S,
    row: usize,
    kernel: &mut K,
) -> usize {
    kernel.tile::<M, V>(simd, row);
    M
}
