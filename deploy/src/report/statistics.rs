//! Statistics over seeds: mean and spread, and from four seeds on the interquartile mean and median
//! with their bootstrap intervals. Below four, an interquartile mean is the mean, and a bootstrap
//! interval is the range of the scores: only that range is given.
//!
//! Interquartile mean and stratified bootstrap are those of Agarwal et al. 2021, "Deep
//! Reinforcement Learning at the Edge of the Statistical Precipice" (arXiv 2108.13264), as their
//! package rliable computes them.

use dmprl_shared::seeds;
use rand::RngExt;
use serde::Serialize;

/// Fewest scores that have an interquartile mean and an interval.
pub const INTERVAL_SCORES_MIN: usize = 4;
/// Resamplings of a bootstrap, as many as rliable's default.
const REPETITIONS: usize = 50_000;
/// Share of values cut off at either end of an interquartile mean.
const CUT: f64 = 0.25;
/// Ends of the interval: 95 % lie between.
const QUANTILES: [f64; 2] = [0.025, 0.975];

/// What a few scores say together.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Summary {
    /// How many.
    pub count: usize,
    /// Mean.
    pub mean: f64,
    /// Standard deviation over the scores (of the sample: n - 1); 0 for one.
    pub std: f64,
    /// Lowest and highest score.
    pub range: [f64; 2],
    /// Interquartile mean; none below four scores.
    pub iqm: Option<f64>,
    /// Its 95 % interval by bootstrap; none below four scores.
    pub interval: Option<[f64; 2]>,
}

impl Summary {
    /// Of the scores of one task, one a seed; none for none.
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

    /// Interquartile mean with its interval, or mean with range where there are too few scores.
    #[must_use]
    pub fn point_and_bounds(&self) -> (f64, [f64; 2]) {
        (self.iqm.unwrap_or(self.mean), self.interval.unwrap_or(self.range))
    }
}

/// Lowest and highest of at least one score.
pub(super) fn range(scores: &[f64]) -> [f64; 2] {
    let low = scores.iter().copied().fold(f64::INFINITY, f64::min);
    let high = scores.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    [low, high]
}

/// The mean of the middle half.
#[must_use]
pub fn interquartile_mean(scores: &mut [f64]) -> f64 {
    scores.sort_by(f64::total_cmp);
    let cut = (scores.len() as f64 * CUT) as usize;
    let middle = &scores[cut..scores.len() - cut];
    middle.iter().sum::<f64>() / middle.len() as f64
}

/// The interquartile mean over all scores, and its 95 % interval by [`bootstrap`].
///
/// - `scores`: (task, run), at least one.
#[must_use]
pub fn interquartile_mean_with_interval(scores: &[Vec<f64>]) -> (f64, [f64; 2]) {
    bootstrap(scores, interquartile_mean)
}

/// The median, and its 95 % interval by [`bootstrap`], or the range below four scores.
/// Unlike a mean it stays a number while fewer than half of the scores are infinite.
///
/// - `scores`: at least one; infinite for what never came.
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

/// A statistic of all scores, and the interval in which 95 % of its resamplings lie.
///
/// The bootstrap is stratified: the runs of each task are drawn anew from those of the same task.
/// Its random numbers are always the same.
fn bootstrap(scores: &[Vec<f64>], statistic: fn(&mut [f64]) -> f64) -> (f64, [f64; 2]) {
    let mut drawn: Vec<f64> = scores.concat();
    let point = statistic(&mut drawn);
    if scores.iter().all(|runs| runs.iter().all(|score| *score == runs[0])) {
        // Nothing else can be drawn.
        return (point, [point; 2]);
    }
    let mut random = seeds::stream(0, "bootstrap", 0);
    let mut values: Vec<f64> = (0..REPETITIONS)
        .map(|_| {
            drawn.clear();
            for runs in scores {
                drawn.extend((0..runs.len()).map(|_| runs[random.random_range(0..runs.len())]));
            }
            statistic(&mut drawn)
        })
        .collect();
    values.sort_by(f64::total_cmp);
    (point, QUANTILES.map(|quantile| quantile_of(&values, quantile)))
}

/// Between two sorted values linearly, as numpy's default.
fn quantile_of(sorted: &[f64], quantile: f64) -> f64 {
    let place = quantile * (sorted.len() - 1) as f64;
    let (below, share) = (place.floor() as usize, place.fract());
    let above = (below + 1).min(sorted.len() - 1);
    if sorted[below] == sorted[above] {
        // Two infinite ones have no difference.
        return sorted[below];
    }
    sorted[below] + share * (sorted[above] - sorted[below])
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

    /// tests/golden/statistics/make_golden.py
    const GOLDEN: &str = include_str!("../../../tests/golden/statistics/golden.json");

    #[test]
    fn interquartile_means_and_intervals_are_those_of_rliable() {
        let golden: Golden = serde_json::from_str(GOLDEN).unwrap();
        assert_eq!(golden.cases.len(), 5);
        for Case { scores, interquartile_mean, interval } in golden.cases {
            let (point, ours) = interquartile_mean_with_interval(&scores);
            assert!((point - interquartile_mean).abs() < 1e-12, "{point} {interquartile_mean}");
            // Both draw at random, and quantiles of so few values lie on steps.
            let tolerance = 0.04 * (interval[1] - interval[0]);
            for (ours, theirs) in ours.into_iter().zip(interval) {
                assert!((ours - theirs).abs() <= tolerance, "{ours} {theirs} of {scores:?}");
            }
        }
    }

    #[test]
    fn one_score_has_no_spread() {
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
    fn a_median_takes_what_never_came_for_later_than_everything() {
        let never = f64::INFINITY;
        assert_eq!(median_with_bounds(&[3.0, 1.0, 2.0]), (2.0, [1.0, 3.0]));
        assert_eq!(median_with_bounds(&[1.0, 2.0]).0, 1.5);
        assert_eq!(median_with_bounds(&[7.0]), (7.0, [7.0, 7.0]));
        assert_eq!(median_with_bounds(&[never, 1.0, 2.0]), (2.0, [1.0, never]));
        assert_eq!(median_with_bounds(&[never, 1.0, never]), (never, [1.0, never]));
        assert_eq!(median_with_bounds(&[never, never]), (never, [never, never]));
    }
}
