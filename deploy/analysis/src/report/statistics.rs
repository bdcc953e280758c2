//! Statistics over seeds: mean and standard deviation, and with at least four seeds, interquartile
//! mean and median with bootstrap intervals. With fewer seeds, the interquartile mean equals the
//! mean, and a bootstrap interval is hardly more than the range, so only the range is given.
//!
//! Interquartile mean and stratified bootstrap follow Agarwal et al. 2021, "Deep Reinforcement
//! Learning at the Edge of the Statistical Precipice" (arXiv 2108.13264), as implemented in their
//! package rliable.

use dmprl_shared::seeds;
use rand::RngExt;
use serde::Serialize;

/// Minimum number of scores for an interquartile mean and an interval.
pub const INTERVAL_SCORES_MIN: usize = 4;
/// Number of bootstrap resamples, which is rliable's default.
const RESAMPLES: usize = 50_000;
/// Fraction of the scores that an interquartile mean drops at each end.
const TRIMMED: f64 = 0.25;
/// Quantiles that bound a 95 % interval.
const QUANTILES: [f64; 2] = [0.025, 0.975];

/// Summary of the scores of several seeds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Summary {
    /// Number of scores.
    pub count: usize,
    /// Mean.
    pub mean: f64,
    /// Sample standard deviation (n - 1); 0 for one score.
    pub std: f64,
    /// Lowest and highest score.
    pub range: [f64; 2],
    /// Interquartile mean; `None` with fewer than four scores.
    pub iqm: Option<f64>,
    /// 95 % bootstrap interval of the interquartile mean; `None` with fewer than four scores.
    pub interval: Option<[f64; 2]>,
}

impl Summary {
    /// Summarises the scores of one task, one per seed; `None` without scores.
    #[must_use]
    pub fn of(scores: &[f64]) -> Option<Self> {
        if scores.is_empty() {
            return None;
        }
        let count = scores.len();
        let mean = scores.iter().sum::<f64>() / count as f64;
        let squares = scores.iter().map(|score| (score - mean).powi(2)).sum::<f64>();
        let std = (squares / count.saturating_sub(1).max(1) as f64).sqrt();
        let range = range(scores);
        if count < INTERVAL_SCORES_MIN {
            return Some(Self { count, mean, std, range, iqm: None, interval: None });
        }
        let (iqm, interval) = interquartile_mean_with_interval(&[scores.to_vec()]);
        Some(Self { count, mean, std, range, iqm: Some(iqm), interval: Some(interval) })
    }

    /// Returns the interquartile mean and its interval, or with fewer than four scores the mean and
    /// the range.
    #[must_use]
    pub fn point_and_bounds(&self) -> (f64, [f64; 2]) {
        (self.iqm.unwrap_or(self.mean), self.interval.unwrap_or(self.range))
    }
}

/// Returns the lowest and the highest score, of at least one.
pub(super) fn range(scores: &[f64]) -> [f64; 2] {
    let low = scores.iter().copied().fold(f64::INFINITY, f64::min);
    let high = scores.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    [low, high]
}

/// Returns the mean of the middle half of the scores.
#[must_use]
pub fn interquartile_mean(scores: &mut [f64]) -> f64 {
    scores.sort_by(f64::total_cmp);
    let cut = (scores.len() as f64 * TRIMMED) as usize;
    let middle = &scores[cut..scores.len() - cut];
    middle.iter().sum::<f64>() / middle.len() as f64
}

/// Returns the interquartile mean of all scores, and its 95 % interval by [`bootstrap`].
///
/// - `scores`: (task, run), at least one.
#[must_use]
pub fn interquartile_mean_with_interval(scores: &[Vec<f64>]) -> (f64, [f64; 2]) {
    bootstrap(scores, interquartile_mean)
}

/// Returns the median, and its 95 % interval by [`bootstrap`], or the range with fewer than four
/// scores. Unlike a mean, the median is finite if fewer than half of the scores are infinite.
///
/// - `scores`: at least one; infinite for a seed that never reached a threshold.
#[must_use]
pub fn median_with_bounds(scores: &[f64]) -> (f64, [f64; 2]) {
    if scores.len() < INTERVAL_SCORES_MIN {
        return (median(&mut scores.to_vec()), range(scores));
    }
    bootstrap(&[scores.to_vec()], median)
}

fn median(scores: &mut [f64]) -> f64 {
    scores.sort_by(f64::total_cmp);
    let upper = scores.len() / 2;
    let lower = scores.len().div_ceil(2) - 1;
    f64::midpoint(scores[lower], scores[upper])
}

/// Returns a statistic of all scores, and the interval that contains 95 % of its resamples.
///
/// The bootstrap is stratified: the runs of each task are resampled from those of the same task.
/// Its seed is fixed.
fn bootstrap(scores: &[Vec<f64>], statistic: fn(&mut [f64]) -> f64) -> (f64, [f64; 2]) {
    let mut sample: Vec<f64> = scores.concat();
    let point = statistic(&mut sample);
    if scores.iter().all(|runs| runs.iter().all(|score| *score == runs[0])) {
        // All resamples are equal.
        return (point, [point; 2]);
    }
    let mut random = seeds::stream(0, "bootstrap", 0);
    let mut values: Vec<f64> = (0..RESAMPLES)
        .map(|_| {
            sample.clear();
            for runs in scores {
                sample.extend((0..runs.len()).map(|_| runs[random.random_range(0..runs.len())]));
            }
            statistic(&mut sample)
        })
        .collect();
    values.sort_by(f64::total_cmp);
    (point, QUANTILES.map(|quantile| quantile_of(&values, quantile)))
}

/// Returns a quantile of sorted values, with linear interpolation as in NumPy's default.
fn quantile_of(sorted: &[f64], quantile: f64) -> f64 {
    let position = quantile * (sorted.len() - 1) as f64;
    let (below, fraction) = (position.floor() as usize, position.fract());
    let above = (below + 1).min(sorted.len() - 1);
    if sorted[below] == sorted[above] {
        // Avoids the difference of two infinite values, which is NaN.
        return sorted[below];
    }
    sorted[below] + fraction * (sorted[above] - sorted[below])
}

#[cfg(test)]
mod tests {
    use serde::Deserialize;

    use super::*;

    #[derive(Deserialize)]
    struct Golden {
        cases: Vec<Case>,
    }

    #[derive(Deserialize)]
    struct Case {
        scores: Vec<Vec<f64>>,
        interquartile_mean: f64,
        interval: [f64; 2],
    }

    /// Made by tests/golden/statistics/make_golden.py.
    const GOLDEN: &str = include_str!("../../../../tests/golden/statistics/golden.json");

    #[test]
    fn interquartile_means_and_intervals_match_rliable() {
        let golden: Golden = serde_json::from_str(GOLDEN).unwrap();
        assert_eq!(golden.cases.len(), 5);
        for Case { scores, interquartile_mean, interval } in golden.cases {
            let (point, ours) = interquartile_mean_with_interval(&scores);
            assert!((point - interquartile_mean).abs() < 1e-12, "{point} {interquartile_mean}");
            // Both are random, and quantiles of so few values change in steps.
            let tolerance = 0.04 * (interval[1] - interval[0]);
            for (ours, theirs) in ours.into_iter().zip(interval) {
                assert!((ours - theirs).abs() <= tolerance, "{ours} {theirs} of {scores:?}");
            }
        }
    }

    #[test]
    fn single_score_has_no_spread() {
        let summary = Summary::of(&[-4.5]).unwrap();
        let range = [-4.5; 2];
        let expected = Summary { count: 1, mean: -4.5, std: 0.0, range, iqm: None, interval: None };
        assert_eq!(summary, expected);
        assert_eq!(Summary::of(&[]), None);
        let summary = Summary::of(&[1.0, 2.0, 3.0, 10.0]).unwrap();
        assert_eq!((summary.mean, summary.iqm), (4.0, Some(2.5)));
        assert!((summary.std - (50.0_f64 / 3.0).sqrt()).abs() < 1e-12);
    }

    #[test]
    fn three_scores_have_a_range_and_no_interval() {
        let summary = Summary::of(&[3.0, 1.0, 5.0]).unwrap();
        assert_eq!((summary.range, summary.iqm, summary.interval), ([1.0, 5.0], None, None));
        assert_eq!(summary.point_and_bounds(), (3.0, [1.0, 5.0]));
        let summary = Summary::of(&[3.0, 1.0, 5.0, 4.0]).unwrap();
        assert_eq!((summary.range, summary.iqm), ([1.0, 5.0], Some(3.5)));
        assert!(summary.interval.is_some());
    }

    #[test]
    fn median_treats_infinite_scores_as_the_largest() {
        let never = f64::INFINITY;
        assert_eq!(median_with_bounds(&[3.0, 1.0, 2.0]), (2.0, [1.0, 3.0]));
        assert_eq!(median_with_bounds(&[1.0, 2.0]).0, 1.5);
        assert_eq!(median_with_bounds(&[7.0]), (7.0, [7.0, 7.0]));
        assert_eq!(median_with_bounds(&[never, 1.0, 2.0]), (2.0, [1.0, never]));
        assert_eq!(median_with_bounds(&[never, 1.0, never]), (never, [1.0, never]));
        assert_eq!(median_with_bounds(&[never, never]), (never, [never, never]));
    }
}
