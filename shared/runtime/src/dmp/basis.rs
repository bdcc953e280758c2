//! Gaussian basis functions of the phase. Used by `forcing`.

use super::DmpError;
use crate::config::BasisWidths;

/// Basis functions with centres c and widths h.
///     psi_i(x) = exp(-h_i (x - c_i)^2)      (paper, equation 10, with h = 1 / (2 sigma^2))
#[derive(Debug, Clone, PartialEq)]
pub struct Basis {
    centres: Vec<f64>,
    widths: Vec<f64>,
}

impl Basis {
    /// Creates N functions whose centres are equally spaced in time: c_i = exp(-alpha_x t_i) with
    /// t_i from 0 to 1.
    ///
    /// The paper does not specify sigma_i. [`BasisWidths`] lists the alternatives.
    /// - `count`: N.
    /// # Errors
    /// `Parameter` if `count` is zero (or one with `overlap`, which needs a neighbour) or `alpha_x`
    /// is not positive and finite.
    pub fn new(count: usize, alpha_x: f64, widths: BasisWidths) -> Result<Self, DmpError> {
        let count_min = match widths {
            BasisWidths::Ndp => 1,
            BasisWidths::Overlap => 2,
        };
        DmpError::parameter(
            count >= count_min,
            "dmp.basis_count",
            || format!("{count_min} or more"),
            count,
        )?;
        DmpError::parameter(
            alpha_x.is_finite() && alpha_x > 0.0,
            "dmp.alpha_x",
            || "a positive number".into(),
            alpha_x,
        )?;
        let spacing = 1.0 / (count.max(2) - 1) as f64;
        let centres: Vec<f64> = (0..count).map(|i| (-alpha_x * spacing * i as f64).exp()).collect();
        let widths = match widths {
            BasisWidths::Ndp => {
                centres.iter().map(|c| (count as f64).powf(1.5) / (c * alpha_x)).collect()
            }
            BasisWidths::Overlap => overlap_widths(&centres),
        };
        Self::from_centres_and_widths(centres, widths)
    }

    /// Creates basis functions with explicit centres and widths.
    /// - `centres`, `widths`: (N,).
    /// # Errors
    /// `Shape` if the lengths differ or are zero; `NotFinite`; `Parameter` if a width is not
    /// positive.
    pub fn from_centres_and_widths(centres: Vec<f64>, widths: Vec<f64>) -> Result<Self, DmpError> {
        DmpError::values("centres", &centres, centres.len().max(1))?;
        DmpError::values("widths", &widths, centres.len())?;
        for &width in &widths {
            DmpError::parameter(width > 0.0, "width", || "a positive number".into(), width)?;
        }
        Ok(Self { centres, widths })
    }

    /// Number of basis functions N.
    #[must_use]
    pub fn count(&self) -> usize {
        self.centres.len()
    }

    /// Centres c, (N,).
    #[must_use]
    pub fn centres(&self) -> &[f64] {
        &self.centres
    }

    /// Widths h, (N,).
    #[must_use]
    pub fn widths(&self) -> &[f64] {
        &self.widths
    }

    /// Computes the normalised activations psi_i / sum psi at phase `x`; they sum to one.
    /// - `out`: (N,), overwritten.
    ///
    /// The largest exponent is subtracted from all, as in a softmax. Otherwise, far from every
    /// centre, all psi would underflow and the result would be 0 / 0. Other implementations add an
    /// epsilon to the denominator instead.
    /// # Panics
    /// If `out` is not N long.
    pub fn normalised(&self, x: f64, out: &mut [f64]) {
        assert_eq!(out.len(), self.count(), "one activation per basis function");
        for ((out, c), h) in out.iter_mut().zip(&self.centres).zip(&self.widths) {
            *out = -h * (x - c).powi(2);
        }
        let max = out.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        for out in out.iter_mut() {
            *out = (*out - max).exp();
        }
        let sum: f64 = out.iter().sum();
        for out in out.iter_mut() {
            *out /= sum;
        }
    }
}

/// Returns widths for which each basis function is 0.8 at the next centre. The last width equals
/// the one before it.
fn overlap_widths(centres: &[f64]) -> Vec<f64> {
    let width = |pair: &[f64]| -(0.8_f64.ln()) / (pair[1] - pair[0]).powi(2);
    let mut widths: Vec<f64> = centres.windows(2).map(width).collect();
    widths.extend(widths.last().copied());
    widths
}

#[cfg(test)]
mod tests {
    use super::*;

    fn assert_close(got: &[f64], expected: &[f64], tolerance: f64) {
        assert_eq!(got.len(), expected.len());
        for (got, expected) in got.iter().zip(expected) {
            assert!((got - expected).abs() < tolerance, "{got} is not {expected}");
        }
    }

    /// Expected values: computed with the released code of Neural Dynamic Policies.
    #[test]
    fn centres_and_widths_match_neural_dynamic_policies() {
        let five = Basis::new(5, 1.0, BasisWidths::Ndp).unwrap();
        assert_close(five.centres(), &[1.0, 0.7788, 0.6065, 0.4724, 0.3679], 5e-5);
        assert_close(five.widths(), &[11.18, 14.36, 18.43, 23.67, 30.39], 6e-3);
        let three = Basis::new(3, 1.0, BasisWidths::Ndp).unwrap();
        assert_close(three.centres(), &[1.0, 0.6065, 0.3679], 5e-5);
        assert_close(three.widths(), &[5.196, 8.567, 14.125], 6e-4);
    }

    #[test]
    fn overlap_widths_give_0_8_at_the_next_centre() {
        let basis = Basis::new(6, 1.0, BasisWidths::Overlap).unwrap();
        let (c, h) = (basis.centres(), basis.widths());
        for i in 0..5 {
            assert!(((-h[i] * (c[i + 1] - c[i]).powi(2)).exp() - 0.8).abs() < 1e-12);
        }
        assert_eq!(h[5], h[4]);
    }

    #[test]
    fn normalised_activations_sum_to_one_even_far_from_every_centre() {
        let basis = Basis::from_centres_and_widths(vec![1.0, 0.5], vec![1e6, 1e7]).unwrap();
        for x in [0.0, 0.4, 0.9, 1.0, 50.0] {
            let mut activations = [0.0; 2];
            basis.normalised(x, &mut activations);
            assert!((activations.iter().sum::<f64>() - 1.0).abs() < 1e-12, "{activations:?}");
        }
    }

    #[test]
    fn invalid_bases_are_rejected() {
        assert!(Basis::new(0, 1.0, BasisWidths::Ndp).is_err());
        assert!(Basis::new(1, 1.0, BasisWidths::Ndp).is_ok());
        assert!(Basis::new(1, 1.0, BasisWidths::Overlap).is_err());
        assert!(Basis::new(5, 0.0, BasisWidths::Ndp).is_err());
        assert!(Basis::new(5, f64::NAN, BasisWidths::Ndp).is_err());
        assert!(Basis::from_centres_and_widths(vec![], vec![]).is_err());
        assert!(Basis::from_centres_and_widths(vec![1.0], vec![1.0, 2.0]).is_err());
        assert!(Basis::from_centres_and_widths(vec![1.0], vec![-1.0]).is_err());
    }
}
