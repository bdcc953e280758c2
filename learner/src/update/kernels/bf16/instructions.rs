//! The AVX512-BF16 code, with a placeholder for other processor architectures.

#[cfg(target_arch = "x86_64")]
pub(super) use avx512::Avx512Bf16;
#[cfg(not(target_arch = "x86_64"))]
pub(super) use unsupported::Avx512Bf16;

#[cfg(target_arch = "x86_64")]
mod avx512 {
    use std::arch::x86_64::{
        __m256bh, __m256i, __m512, __m512bh, __m512i, _CMP_GT_OQ, _mm256_storeu_si256,
        _mm512_add_ps, _mm512_cmp_ps_mask, _mm512_cvtepu16_epi32, _mm512_cvtneps_pbh,
        _mm512_dpbf16_ps, _mm512_loadu_ps, _mm512_mask_storeu_ps, _mm512_maskz_loadu_ps,
        _mm512_maskz_mov_ps, _mm512_max_ps, _mm512_or_si512, _mm512_set1_epi32, _mm512_setzero_ps,
        _mm512_slli_epi32, _mm512_storeu_si512,
    };

    use super::super::super::{Activation, PANEL, pack::transpose};
    use super::super::{Bf16Pair, Broadcast, Epilogue, Product, Wide, pair_count};

    /// Exists only if the processor has the instructions.
    #[derive(Debug, Clone, Copy)]
    pub(in super::super) struct Avx512Bf16(());

    impl Avx512Bf16 {
        pub fn new() -> Option<Self> {
            let has = is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512vl")
                && is_x86_feature_detected!("avx512bf16");
            has.then_some(Self(()))
        }

        pub fn run(self, mut product: Product<'_>) {
            // SAFETY: `Self` exists only if the processor has the instructions.
            unsafe { run(&mut product) }
        }

        pub fn pair_columns(self, numbers: &[f32], width: usize, out: &mut [Bf16Pair]) {
            // SAFETY: as above.
            unsafe { pair_columns(numbers, width, out) }
        }

        pub fn pair_rows(self, numbers: &[f32], width: usize, out: &mut [Bf16Pair]) {
            // SAFETY: as above.
            unsafe { pair_rows(numbers, width, out) }
        }

        /// Transposes up to [`PANEL`] rows of `depth` pairs into `depth` rows of [`PANEL`], padded
        /// with zeros.
        pub fn transpose(self, rows: &[Bf16Pair], depth: usize, panel: &mut [Bf16Pair]) {
            let whole = if rows.len() == panel.len() { depth / PANEL * PANEL } else { 0 };
            for at in (0..whole).step_by(PANEL) {
                let rows = bytemuck::cast_slice(&rows[at..]);
                let panel = bytemuck::cast_slice_mut(&mut panel[at * PANEL..]);
                // SAFETY: as above.
                unsafe { transpose(rows, depth, panel) };
            }
            if rows.len() < panel.len() {
                panel.fill(0);
            }
            for (column, row) in rows.chunks_exact(depth).enumerate() {
                for at in whole..depth {
                    panel[at * PANEL + column] = row[at];
                }
            }
        }
    }

    /// Loads up to one vector of a row from `first` on, padded with zeros.
    #[inline]
    #[target_feature(enable = "avx512f")]
    fn load(row: &[f32], first: usize) -> __m512 {
        let row = &row[first..];
        // SAFETY: the mask selects only numbers of the row.
        unsafe { _mm512_maskz_loadu_ps(mask(row.len()), row.as_ptr()) }
    }

    fn mask(len: usize) -> u16 {
        if len < PANEL { (1 << len) - 1 } else { u16::MAX }
    }

    /// Rounds to bfloat16, packed side by side.
    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
    fn rounded(numbers: __m512) -> __m256i {
        // SAFETY: both types are 256 plain bits.
        unsafe { std::mem::transmute::<__m256bh, __m256i>(_mm512_cvtneps_pbh(numbers)) }
    }

    /// Packs pairs of neighbouring columns.
    #[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
    fn pair_columns(numbers: &[f32], width: usize, out: &mut [Bf16Pair]) {
        let rows = numbers.chunks_exact(width).zip(out.chunks_exact_mut(pair_count(width)));
        for (row, out) in rows {
            let mut whole = 0;
            for out in out.chunks_exact_mut(PANEL / 2).take(width / PANEL) {
                let halves = rounded(load(row, whole));
                // SAFETY: `out` has 8 pairs, 32 bytes.
                unsafe {
                    _mm256_storeu_si256(out.as_mut_ptr().cast(), halves);
                }
                whole += PANEL;
            }
            if whole < width {
                let mut rest = [0; PANEL / 2];
                let halves = rounded(load(row, whole));
                // SAFETY: `rest` has 8 pairs.
                unsafe {
                    _mm256_storeu_si256(rest.as_mut_ptr().cast(), halves);
                }
                let out = &mut out[whole / 2..];
                out.copy_from_slice(&rest[..out.len()]);
            }
        }
    }

    /// Rounds to bfloat16 in the lower halves of 32-bit lanes.
    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
    fn halves(numbers: __m512) -> __m512i {
        _mm512_cvtepu16_epi32(rounded(numbers))
    }

    /// Packs pairs of neighbouring rows.
    #[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
    fn pair_rows(numbers: &[f32], width: usize, out: &mut [Bf16Pair]) {
        let rows = numbers.chunks(2 * width).zip(out.chunks_exact_mut(width));
        for (rows, out) in rows {
            let (upper, lower) = rows.split_at(width);
            for (at, out) in out.chunks_mut(PANEL).enumerate() {
                let mut both = halves(load(upper, at * PANEL));
                if !lower.is_empty() {
                    let second = _mm512_slli_epi32::<16>(halves(load(lower, at * PANEL)));
                    both = _mm512_or_si512(both, second);
                }
                let mut pairs = [0; PANEL];
                // SAFETY: `pairs` has 16 pairs, 64 bytes.
                unsafe { _mm512_storeu_si512(pairs.as_mut_ptr().cast(), both) };
                out.copy_from_slice(&pairs[..out.len()]);
            }
        }
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
    fn run(product: &mut Product<'_>) {
        for col in (0..product.cols).step_by(2 * PANEL) {
            if product.cols - col > PANEL {
                panel::<2>(product, col);
            } else {
                panel::<1>(product, col);
            }
        }
    }

    /// Computes all rows of V panels, which stay in the first-level cache meanwhile.
    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
    fn panel<const V: usize>(product: &mut Product<'_>, col: usize) {
        let mut row = 0;
        while row < product.rows {
            row += match product.rows - row {
                8.. => tile::<8, V>(product, row, col),
                4.. => tile::<4, V>(product, row, col),
                2.. => tile::<2, V>(product, row, col),
                _ => tile::<1, V>(product, row, col),
            };
        }
    }

    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
    fn tile<const M: usize, const V: usize>(
        product: &mut Product<'_>,
        row: usize,
        col: usize,
    ) -> usize {
        let Product { cols, depth, left, right, .. } = *product;
        let last_width = (cols - col - (V - 1) * PANEL).min(PANEL);
        let left = Broadcast { data: &left.data[row * left.row_stride..], ..left };
        let right = Wide { data: &right.data[col / PANEL * right.panel..], ..right };
        let sums = if right.padded || last_width == PANEL {
            sums::<M, V, false>(left, right, depth, PANEL)
        } else {
            sums::<M, V, true>(left, right, depth, last_width)
        };
        for (m, sums) in sums.iter().enumerate() {
            let first = (row + m) * cols;
            for (v, sum) in sums.iter().enumerate() {
                let begin = col + v * PANEL;
                let end = cols.min(begin + PANEL);
                let at = first + begin..first + end;
                let sum = match &product.epilogue {
                    Epilogue::Layer { bias, activation } => {
                        let sum = _mm512_add_ps(*sum, load(&bias[..end], begin));
                        match activation {
                            Activation::Relu => _mm512_max_ps(sum, _mm512_setzero_ps()),
                            Activation::Linear => sum,
                        }
                    }
                    Epilogue::Masked(activations) => {
                        let activations = load(&activations[..at.end], at.start);
                        let zero = _mm512_setzero_ps();
                        let passed = _mm512_cmp_ps_mask::<_CMP_GT_OQ>(activations, zero);
                        _mm512_maskz_mov_ps(passed, *sum)
                    }
                    Epilogue::Plain => *sum,
                };
                let out = &mut product.out[at];
                // SAFETY: the mask selects only numbers of `out`.
                unsafe { _mm512_mask_storeu_ps(out.as_mut_ptr(), mask(out.len()), sum) };
            }
        }
        M
    }

    /// Sums M rows and V panels over the depth. If `MASKED`, the last panel has only `last_width`
    /// columns.
    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
    fn sums<const M: usize, const V: usize, const MASKED: bool>(
        left: Broadcast<'_>,
        right: Wide<'_>,
        depth: usize,
        last_width: usize,
    ) -> [[__m512; V]; M] {
        let mut sums = [[_mm512_setzero_ps(); V]; M];
        if depth == 0 {
            return sums;
        }
        let left_last = (M - 1) * left.row_stride + (depth - 1) * left.depth_stride;
        assert!(left_last < left.data.len(), "left operand of a tile");
        let right_end = (depth - 1) * right.stride + (V - 1) * right.panel + last_width;
        assert!(right_end <= right.data.len(), "right operand of a tile");
        let last_mask = mask(last_width);
        for k in 0..depth {
            let mut vectors = [_mm512_setzero_ps(); V];
            for (v, vector) in vectors.iter_mut().enumerate() {
                // SAFETY: the end of the last read was checked above, and the mask selects the
                // columns of the last panel.
                *vector = unsafe {
                    let at = right.data.as_ptr().add(k * right.stride + v * right.panel).cast();
                    if MASKED && v == V - 1 {
                        _mm512_maskz_loadu_ps(last_mask, at)
                    } else {
                        _mm512_loadu_ps(at)
                    }
                };
            }
            for (m, sums) in sums.iter_mut().enumerate() {
                let at = m * left.row_stride + k * left.depth_stride;
                // SAFETY: the largest index was checked above.
                let pair = unsafe { *left.data.get_unchecked(at) };
                let pair = bits(_mm512_set1_epi32(pair.cast_signed()));
                for (sum, vector) in sums.iter_mut().zip(vectors) {
                    // SAFETY: both types are 512 plain bits.
                    let vector = unsafe { std::mem::transmute::<__m512, __m512bh>(vector) };
                    *sum = _mm512_dpbf16_ps(*sum, pair, vector);
                }
            }
        }
        sums
    }

    #[inline]
    #[target_feature(enable = "avx512f")]
    fn bits(pairs: __m512i) -> __m512bh {
        // SAFETY: both types are 512 plain bits.
        unsafe { std::mem::transmute(pairs) }
    }
}

#[cfg(not(target_arch = "x86_64"))]
mod unsupported {
    use super::super::{Bf16Pair, Product};

    /// Never exists.
    #[derive(Debug, Clone, Copy)]
    pub(in super::super) enum Avx512Bf16 {}

    impl Avx512Bf16 {
        pub fn new() -> Option<Self> {
            None
        }

        pub fn run(self, _: Product<'_>) {
            match self {}
        }

        pub fn pair_columns(self, _: &[f32], _: usize, _: &mut [Bf16Pair]) {
            match self {}
        }

        pub fn pair_rows(self, _: &[f32], _: usize, _: &mut [Bf16Pair]) {
            match self {}
        }

        pub fn transpose(self, _: &[Bf16Pair], _: usize, _: &mut [Bf16Pair]) {
            match self {}
        }
    }
}
