//! Measures the smoothness of an episode: change of actions, jerk, and spectral arc length.

use rustfft::FftPlanner;
use rustfft::num_complex::Complex64;

/// Zero padding: the length, rounded up to a power of two, is multiplied by 2^4.
const PAD_LEVEL: u32 = 4;
/// Cutoff frequency [Hz]; higher frequencies are ignored.
const CUTOFF_HZ: f64 = 10.0;
/// The spectrum is cut where it falls below this fraction of its maximum.
const AMPLITUDE_THRESHOLD: f64 = 0.05;

/// Accumulates a mean.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Mean {
    sum: f64,
    count: u64,
}

impl Mean {
    /// Adds a value.
    pub fn add(&mut self, value: f64) {
        self.sum += value;
        self.count += 1;
    }

    /// Returns the mean; `None` without values.
    #[must_use]
    pub fn value(self) -> Option<f64> {
        (self.count > 0).then(|| self.sum / self.count as f64)
    }
}

/// Adds |u_t - u_{t-1}| to the mean of each dimension.
///
/// - `u`: (T, A). `means`: (A,).
pub fn add_action_changes(u: &[Vec<f32>], means: &mut [Mean]) {
    for pair in u.windows(2) {
        for ((before, after), mean) in pair[0].iter().zip(&pair[1]).zip(means.iter_mut()) {
            mean.add(f64::from((after - before).abs()));
        }
    }
}

/// Adds |u_t - 2 u_{t-1} + u_{t-2}| to the mean of each dimension.
///
/// - `u`: (T, A). `means`: (A,).
pub fn add_action_accelerations(u: &[Vec<f32>], means: &mut [Mean]) {
    for rows in u.windows(3) {
        for (dimension, mean) in means.iter_mut().enumerate() {
            let [first, second, third] = [0, 1, 2].map(|row: usize| rows[row][dimension]);
            mean.add(f64::from((third - 2.0 * second + first).abs()));
        }
    }
}

/// Adds the absolute jerk of each joint to its mean. Jerk is the second difference of the velocity
/// at the control rate, `(qd_{t+1} - 2 qd_t + qd_{t-1}) / dt²`, unfiltered.
///
/// - `velocities`: (T+1, J) [rad/s]. `dt`: \[s\]. `means`: (J,) [rad/s³].
pub fn add_jerks(velocities: &[Vec<f64>], dt: f64, means: &mut [Mean]) {
    for rows in velocities.windows(3) {
        for (joint, mean) in means.iter_mut().enumerate() {
            let difference = rows[2][joint] - 2.0 * rows[1][joint] + rows[0][joint];
            mean.add((difference / (dt * dt)).abs());
        }
    }
}

/// Returns the spectral arc length of a speed profile; `None` if nothing moves, or the profile is
/// too short for a spectrum.
///
/// It is about -1.6 for a smooth movement and lower for others (Balasubramanian et al. 2015, "On
/// the analysis of movement smoothness", with the paper's parameters). Difference from the paper:
/// the cutoff is at most half the sampling rate.
///
/// - `speed`: (T,), not negative. `rate_hz`: samples per second.
#[must_use]
pub fn sparc(speed: &[f64], rate_hz: f64) -> Option<f64> {
    if speed.len() < 2 || rate_hz.is_nan() || rate_hz <= 0.0 {
        return None;
    }
    let len = speed.len().next_power_of_two() << PAD_LEVEL;
    let mut spectrum = vec![Complex64::default(); len];
    for (entry, value) in spectrum.iter_mut().zip(speed) {
        entry.re = *value;
    }
    FftPlanner::new().plan_fft_forward(len).process(&mut spectrum);
    let magnitudes: Vec<f64> = spectrum.iter().map(|entry| entry.norm()).collect();
    let largest = magnitudes.iter().copied().fold(0.0, f64::max);
    if largest.is_nan() || largest <= 0.0 {
        return None;
    }
    let (step, cutoff) = (rate_hz / len as f64, CUTOFF_HZ.min(rate_hz / 2.0));
    let below = (0..len).take_while(|&index| index as f64 * step <= cutoff).count();
    let heights: Vec<f64> = magnitudes[..below].iter().map(|value| value / largest).collect();
    let is_high = |height: &f64| *height >= AMPLITUDE_THRESHOLD;
    let (first, last) = (heights.iter().position(is_high)?, heights.iter().rposition(is_high)?);
    let width = 1.0 / (last - first) as f64;
    let arc = heights[first..=last].windows(2).map(|pair| width.hypot(pair[1] - pair[0]));
    (last > first).then(|| -arc.sum::<f64>())
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
        rate_hz: f64,
        speed: Vec<f64>,
        sparc: f64,
    }

    /// Made by tests/golden/sparc/make_golden.py.
    const GOLDEN: &str = include_str!("../../../../tests/golden/sparc/golden.json");

    #[test]
    fn arc_lengths_match_the_authors_package() {
        let golden: Golden = serde_json::from_str(GOLDEN).unwrap();
        assert_eq!(golden.cases.len(), 27);
        for Case { rate_hz, speed, sparc: expected } in golden.cases {
            let got = sparc(&speed, rate_hz).unwrap();
            assert!((got - expected).abs() < 1e-9, "{got}, expected {expected} of {speed:?}");
        }
    }

    #[test]
    fn speed_profile_without_movement_has_no_arc_length() {
        assert_eq!(sparc(&[0.0; 50], 50.0), None);
        assert_eq!(sparc(&[1.0], 50.0), None);
        assert_eq!(sparc(&[0.0, f64::NAN, 1.0], 50.0), None);
        assert_eq!(sparc(&[0.0, 1.0, 0.0], 0.0), None);
    }

    #[test]
    fn jerk_is_the_second_derivative_of_velocity() {
        // qd = 3 t² and sin(2 t): jerk 6 everywhere, and the mean of |4 sin(2 t)|, which is 8 / π.
        let dt = std::f64::consts::PI / 10_000.0;
        let row = |step: u32| {
            let time = f64::from(step) * dt;
            vec![3.0 * time * time, (2.0 * time).sin()]
        };
        let velocities: Vec<_> = (0..=10_001).map(row).collect();
        let mut means = [Mean::default(); 2];
        add_jerks(&velocities, dt, &mut means);
        let [parabola, sine] = means.map(|mean| mean.value().unwrap());
        assert!((parabola - 6.0).abs() < 1e-6, "{parabola}");
        assert!((sine - 8.0 / std::f64::consts::PI).abs() < 1e-4, "{sine}");
    }

    #[test]
    fn two_rows_have_no_jerk() {
        let mut means = [Mean::default()];
        add_jerks(&[vec![0.0], vec![1.0]], 0.1, &mut means);
        assert_eq!(means[0].value(), None);
    }

    #[test]
    fn action_changes_do_not_span_episodes() {
        let mut means = [Mean::default(); 2];
        add_action_changes(&[vec![0.0, 1.0], vec![0.5, -1.0]], &mut means);
        add_action_changes(&[vec![-1.0, 0.0], vec![-1.0, 0.0]], &mut means);
        assert_eq!(means.map(|mean| mean.value().unwrap()), [0.25, 1.0]);
    }
}
