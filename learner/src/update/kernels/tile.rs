//! The register tile that computes all products.

use std::ops::Range;

use pulp::{MemMask, Simd};

use super::PANEL;

/// The operand whose single numbers are broadcast. Row `m` and depth `k` are at
/// `m * row_stride + k * depth_stride`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Broadcast<'a> {
    pub data: &'a [f32],
    pub row_stride: usize,
    pub depth_stride: usize,
}

/// The operand that is read as vectors. Column `c` and depth `k` are at
/// `c / PANEL * panel_stride + k * stride + c % PANEL`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Wide<'a> {
    pub data: &'a [f32],
    pub stride: usize,
    pub panel_stride: usize,
    /// Columns to read, at most those of the tile.
    pub width: usize,
    /// Offset to the numbers that the next columns' tiles read at the same depth, if they are to be
    /// prefetched: a network's weights do not stay in a core's caches from one shard to the next.
    /// The first tile of some columns does it for the others.
    pub next: Option<usize>,
}

/// The sums of `M` rows and `V` * lanes columns, which are one or two panels.
pub(super) type Sums<S, const M: usize, const V: usize> = [[<S as Simd>::f32s; V]; M];

/// Depths between two computations of all addresses. In a tile of 16 rows and one vector, addresses
/// cost as many instructions as the products.
const UNROLLED: usize = 4;

/// Adds Σ_k left(m, k) right(k, ·), k < `depth`, to every row m of `sums`. With `MASKED`,
/// `right.width` may be less than the tile's; the other columns keep their sums.
///
/// # Panics
/// If an operand is too short.
#[inline(always)]
pub(super) fn accumulate<S: Simd, const M: usize, const V: usize, const MASKED: bool>(
    simd: S,
    mut sums: Sums<S, M, V>,
    left: Broadcast<'_>,
    right: Wide<'_>,
    depth: usize,
) -> Sums<S, M, V> {
    let tile_width = V * S::F32_LANES;
    assert!(tile_width.is_multiple_of(PANEL), "vectors of a tile");
    if depth == 0 {
        return sums;
    }
    let left_last = (M - 1) * left.row_stride + (depth - 1) * left.depth_stride;
    let width = if MASKED { right.width } else { tile_width };
    assert!(left_last < left.data.len(), "left operand of a tile");
    assert!((1..=tile_width).contains(&width), "a tile is {tile_width} wide");
    let last = width - 1;
    let right_last = last / PANEL * right.panel_stride + (depth - 1) * right.stride + last % PANEL;
    assert!(right_last < right.data.len(), "right operand of a tile");
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
/// At depth k, `right` must have the tile's columns or, if `MASKED`, those that `masks` select, and
/// `left` must have M rows.
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
        // SAFETY: the caller guarantees the length of `right`.
        *vector = unsafe {
            let column = v * S::F32_LANES;
            let offset = column / PANEL * right.panel_stride + column % PANEL;
            let at = right_at.add(k * right.stride).wrapping_add(offset);
            if MASKED {
                simd.mask_load_ptr_f32s(masks[v], at)
            } else {
                at.cast::<S::f32s>().read_unaligned()
            }
        };
    }
    if let Some(next) = right.next {
        for panel in 0..V * S::F32_LANES / PANEL {
            let offset = panel * right.panel_stride + k * right.stride + next;
            prefetch(right_at.wrapping_add(offset));
        }
    }
    let left_at = left.data.as_ptr();
    for (m, sums) in sums.iter_mut().enumerate() {
        // SAFETY: the caller guarantees the length of `left`.
        let number = unsafe { *left_at.add(m * left.row_stride + k * left.depth_stride) };
        let number = simd.splat_f32s(number);
        for (sum, vector) in sums.iter_mut().zip(vectors) {
            *sum = simd.mul_add_e_f32s(number, vector, *sum);
        }
    }
    sums
}

/// Prefetches a cache line into the second-level cache. Any address is allowed.
#[inline(always)]
fn prefetch(at: *const f32) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: prefetching an invalid address has no effect.
    unsafe {
        use std::arch::x86_64::{_MM_HINT_T1, _mm_prefetch};
        _mm_prefetch::<_MM_HINT_T1>(at.cast());
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = at;
}

/// Returns masks that select the first `width` columns of a tile.
#[inline(always)]
fn masks<S: Simd, const V: usize>(simd: S, width: usize) -> [MemMask<S::m32s>; V] {
    let mut masks = [MemMask::new(simd.mask_between_m32s(0, 0).mask()); V];
    for (v, mask) in masks.iter_mut().enumerate() {
        let lanes = width.saturating_sub(v * S::F32_LANES).min(S::F32_LANES);
        *mask = MemMask::new(simd.mask_between_m32s(0, lanes as u32).mask());
    }
    masks
}

/// Loads the first `row.len()` columns of a tile's row; the others are zero.
///
/// # Panics
/// If `row` is wider than the tile.
#[inline(always)]
pub(super) fn load<S: Simd, const V: usize>(simd: S, row: &[f32]) -> [S::f32s; V] {
    assert!(row.len() <= V * S::F32_LANES, "a row of {} columns in a tile", row.len());
    let masks = masks::<S, V>(simd, row.len());
    let mut values = [simd.splat_f32s(0.0); V];
    for (v, values) in values.iter_mut().enumerate() {
        let at = row.as_ptr().wrapping_add(v * S::F32_LANES);
        // SAFETY: the masks select exactly the numbers of `row`.
        *values = unsafe { simd.mask_load_ptr_f32s(masks[v], at) };
    }
    values
}

/// Stores the first `row.len()` columns of a tile's row.
///
/// # Panics
/// If `row` is wider than the tile.
#[inline(always)]
pub(super) fn store<S: Simd, const V: usize>(simd: S, row: &mut [f32], values: [S::f32s; V]) {
    assert!(row.len() <= V * S::F32_LANES, "a row of {} columns in a tile", row.len());
    if row.len() == V * S::F32_LANES {
        // Stores with a mask take tens of cycles on AMD's processors before AVX-512.
        for (v, values) in values.into_iter().enumerate() {
            let at = row[v * S::F32_LANES..].as_mut_ptr();
            // SAFETY: `row` has V vectors.
            unsafe { at.cast::<S::f32s>().write_unaligned(values) };
        }
        return;
    }
    let masks = masks::<S, V>(simd, row.len());
    for (v, values) in values.into_iter().enumerate() {
        let at = row.as_mut_ptr().wrapping_add(v * S::F32_LANES);
        // SAFETY: the masks select exactly the numbers of `row`.
        unsafe { simd.mask_store_ptr_f32s(masks[v], at, values) };
    }
}

/// A kernel that computes a tile of `M` rows, beginning at `row`.
pub(super) trait Tiled<S: Simd> {
    /// Computes and stores the tile.
    fn tile<const M: usize, const V: usize>(&mut self, simd: S, row: usize);
}

/// Returns the width of the tiles that compute the next of `left` columns: one panel, or two where
/// a panel is one vector. A processor that multiplies two such vectors in a cycle also loads only
/// two, and a tile of one vector loads a number of the left operand for each product.
#[inline(always)]
pub(super) fn tile_width<S: Simd>(left: usize) -> usize {
    if S::F32_LANES == PANEL && left > PANEL { 2 * PANEL } else { PANEL }
}

/// Cuts `rows` into tiles of `width` columns ([`tile_width`]) and as many rows as the registers
/// hold. The size of a tile changes no bit of the results.
#[inline(always)]
pub(super) fn for_rows<S: Simd, K: Tiled<S>>(
    simd: S,
    rows: Range<usize>,
    width: usize,
    kernel: &mut K,
) {
    let mut row = rows.start;
    while row < rows.end {
        row += match (width / S::F32_LANES, rows.end - row) {
            (1, 16..) => run_tile::<S, K, 16, 1>(simd, row, kernel),
            (1, 8..) => run_tile::<S, K, 8, 1>(simd, row, kernel),
            (1, 4..) => run_tile::<S, K, 4, 1>(simd, row, kernel),
            (1, 2..) => run_tile::<S, K, 2, 1>(simd, row, kernel),
            (1, _) => run_tile::<S, K, 1, 1>(simd, row, kernel),
            (2, 8..) if S::F32_LANES == PANEL => run_tile::<S, K, 8, 2>(simd, row, kernel),
            (2, 6..) => run_tile::<S, K, 6, 2>(simd, row, kernel),
            (2, 4..) => run_tile::<S, K, 4, 2>(simd, row, kernel),
            (2, 2..) => run_tile::<S, K, 2, 2>(simd, row, kernel),
            (2, _) => run_tile::<S, K, 1, 2>(simd, row, kernel),
            (4, 4..) => run_tile::<S, K, 4, 4>(simd, row, kernel),
            (4, _) => run_tile::<S, K, 1, 4>(simd, row, kernel),
            _ => run_tile::<S, K, 1, PANEL>(simd, row, kernel),
        };
    }
}

#[inline(always)]
fn run_tile<S: Simd, K: Tiled<S>, const M: usize, const V: usize>(
    simd: S,
    row: usize,
    kernel: &mut K,
) -> usize {
    kernel.tile::<M, V>(simd, row);
    M
}
