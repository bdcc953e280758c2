//! The matrix product for the networks' forward and backward passes.

use std::ops::Range;

use gemm::Parallelism;

/// A strided view of a slice as a (rows, cols) matrix.
#[derive(Debug, Clone, Copy)]
pub struct Matrix<'a> {
    data: &'a [f32],
    rows: usize,
    cols: usize,
    row_stride: usize,
    col_stride: usize,
}

impl<'a> Matrix<'a> {
    /// Creates a row-major matrix that fills `data`.
    ///
    /// # Panics
    /// If `data` does not have `rows * cols` numbers.
    #[must_use]
    pub fn row_major(data: &'a [f32], rows: usize, cols: usize) -> Self {
        assert_eq!(data.len(), rows * cols, "matrix of {rows} x {cols}");
        Self { data, rows, cols, row_stride: cols, col_stride: 1 }
    }

    /// Returns the transposed matrix.
    #[must_use]
    pub fn transposed(self) -> Self {
        Self {
            rows: self.cols,
            cols: self.rows,
            row_stride: self.col_stride,
            col_stride: self.row_stride,
            ..self
        }
    }

    /// Returns the columns from `first` on.
    ///
    /// # Panics
    /// If the matrix has no such column.
    #[must_use]
    pub fn columns_from(self, first: usize) -> Self {
        assert!(first < self.cols, "column {first} of {}", self.cols);
        Self { data: &self.data[first * self.col_stride..], cols: self.cols - first, ..self }
    }

    /// Returns a range of columns.
    ///
    /// # Panics
    /// If the range is empty or exceeds the matrix.
    #[must_use]
    pub fn columns(self, columns: Range<usize>) -> Self {
        assert!(columns.start < columns.end && columns.end <= self.cols, "{columns:?}");
        Self { cols: columns.len(), ..self.columns_from(columns.start) }
    }

    fn check(&self) {
        let last = (self.rows - 1) * self.row_stride + (self.cols - 1) * self.col_stride;
        assert!(last < self.data.len(), "matrix reaches {last} of {}", self.data.len());
    }
}

/// Computes `out` = a b, or `out` += a b, depending on `keep`; `out` is row-major.
///
/// # Panics
/// If the shapes do not match.
pub fn product(out: &mut [f32], a: Matrix<'_>, b: Matrix<'_>, keep: Keep) {
    assert_eq!(a.cols, b.rows, "inner dimensions of a product");
    assert_eq!(out.len(), a.rows * b.cols, "output of a product");
    if out.is_empty() {
        return;
    }
    a.check();
    b.check();
    let (rows, cols, depth) = (a.rows, b.cols, a.cols);
    let keep = keep == Keep::Add;
    // SAFETY: `check` and the asserts above ensure that every index that the product reads or
    // writes is inside the three slices. `out` is borrowed mutably, so nothing aliases it.
    unsafe {
        gemm::gemm(
            rows,
            cols,
            depth,
            out.as_mut_ptr(),
            1,
            cols as isize,
            keep,
            a.data.as_ptr(),
            a.col_stride as isize,
            a.row_stride as isize,
            b.data.as_ptr(),
            b.col_stride as isize,
            b.row_stride as isize,
            1.0,
            1.0,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
}

/// Whether a product replaces the output or adds to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Keep {
    /// The product replaces the output.
    Replace,
    /// The product is added to the output.
    Add,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn product_matches_its_definition_for_every_orientation() {
        let a: Vec<f32> = (0..6).map(|i| i as f32).collect(); // 2 x 3
        let b: Vec<f32> = (0..12).map(|i| (i as f32).sin()).collect(); // 3 x 4
        let expected: Vec<f32> = (0..8)
            .map(|i| (0..3).map(|k| a[i / 4 * 3 + k] * b[k * 4 + i % 4]).sum::<f32>())
            .collect();
        let mut out = vec![1.0; 8];
        let (left, right) = (Matrix::row_major(&a, 2, 3), Matrix::row_major(&b, 3, 4));
        product(&mut out, left, right, Keep::Replace);
        for (got, want) in out.iter().zip(&expected) {
            assert!((got - want).abs() < 1e-6, "{out:?} {expected:?}");
        }
        let b_t: Vec<f32> = (0..12).map(|i| b[i % 3 * 4 + i / 3]).collect(); // 4 x 3
        let right = Matrix::row_major(&b_t, 4, 3).transposed();
        product(&mut out, left, right, Keep::Add);
        for (got, want) in out.iter().zip(&expected) {
            assert!((got - 2.0 * want).abs() < 1e-5);
        }
        let mut last = vec![0.0; 4];
        product(&mut last, left, right.columns_from(2), Keep::Replace);
        assert!((last[1] - expected[3]).abs() < 1e-6 && (last[2] - expected[6]).abs() < 1e-6);
    }
}
