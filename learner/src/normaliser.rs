//! Observation normalisation (`policy.normalise_observations`): networks in training get
//! (x - mean) / scale, which is folded into the first layer of published policies.
//!
//! With hindsight, x has the difference between desired and achieved goal in place of the desired
//! goal ([`RelativeGoal`]). This is linear, too, and is folded with the rest.
//!
//! A published policy therefore takes plain observations. When mean and scale are updated, the
//! first layers are rewritten so that every network remains the same function of plain
//! observations. Normalisation changes the steps of the optimiser, never the policy.

use std::borrow::Cow;

use dmprl_shared::goal_rule::GoalRule;
use dmprl_shared::policy::MlpShape;
use serde::{Deserialize, Serialize};

use crate::update::network::TrainableNetwork;

/// Minimum standard deviation of a dimension that is scaled. Dividing by a smaller one would
/// magnify the first deviation.
const SCALE_MIN: f64 = 1e-4;
/// Largest normalised value with goals. Andrychowicz et al. 2017 clip to this value. Clipping is
/// not linear and could not be folded, so an entry with larger values gets a larger scale instead.
/// An example is the velocity of an object that is seldom touched.
const NORMALISED_MAX: f64 = 5.0;
/// Largest scale, in standard deviations. Without this limit, a single fall from the table would
/// make all smaller motions hard to tell apart.
const SCALE_MAX: f64 = 4.0;

/// The place of the goals in an observation. Networks get the desired goal minus the achieved one
/// instead of the desired goal: whether a goal is reached depends on a difference that is small
/// compared to the range of either.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RelativeGoal {
    /// First entry of the achieved goal.
    achieved: usize,
    /// First entry of the desired goal.
    desired: usize,
    /// Number of entries of each goal, G.
    goal_len: usize,
}

impl RelativeGoal {
    /// Returns the place of the goals of a rule.
    #[must_use]
    pub fn new(rule: &GoalRule) -> Self {
        Self { achieved: rule.achieved, desired: rule.desired, goal_len: rule.goal_len }
    }

    /// Returns the achieved entry that belongs to `index`, if that is an entry of the desired goal.
    fn achieved_for(self, index: usize) -> Option<usize> {
        let entry = index.checked_sub(self.desired).filter(|&entry| entry < self.goal_len)?;
        Some(self.achieved + entry)
    }

    /// Returns (achieved, desired) entries of an observation.
    fn pairs(self) -> impl Iterator<Item = (usize, usize)> {
        (0..self.goal_len).map(move |index| (self.achieved + index, self.desired + index))
    }
}

/// Current mean and scale, with the running statistics of each dimension.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Normaliser {
    /// Absent in checkpoints from before 2026-11-25.
    #[serde(default)]
    relative: Option<RelativeGoal>,
    mean: Vec<f32>,
    scale: Vec<f32>,
    /// Observations so far.
    count: u64,
    /// Mean of the observations so far (Welford 1962).
    seen_mean: Vec<f64>,
    /// Sum of squared differences from the mean (Welford 1962).
    seen_squares: Vec<f64>,
    /// Largest distance of an observation from the mean so far. Absent in checkpoints from before
    /// 2026-11-26.
    #[serde(default)]
    seen_farthest: Vec<f64>,
    /// Number of observations at which mean and scale are updated.
    refresh_at: u64,
}

impl Normaliser {
    /// Makes a normaliser that is the identity until its first update, after `first` observations.
    #[must_use]
    pub fn new(observation_len: usize, first: u64, relative: Option<RelativeGoal>) -> Self {
        Self {
            relative,
            mean: vec![0.0; observation_len],
            scale: vec![1.0; observation_len],
            count: 0,
            seen_mean: vec![0.0; observation_len],
            seen_squares: vec![0.0; observation_len],
            seen_farthest: vec![0.0; observation_len],
            refresh_at: first.max(1),
        }
    }

    /// Returns the length O of the observations.
    #[must_use]
    pub fn observation_len(&self) -> usize {
        self.mean.len()
    }

    /// Returns whether the statistics, after reading them from a file, have consistent lengths and
    /// values in range.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        let len = self.mean.len();
        let fits =
            |first: usize, goal: usize| first.checked_add(goal).is_some_and(|end| end <= len);
        let seen = [&self.seen_mean, &self.seen_squares];
        self.scale.len() == len
            && seen.iter().all(|part| part.len() == len)
            && seen.into_iter().flatten().all(|value| value.is_finite())
            && self.seen_squares.iter().all(|&squares| squares >= 0.0)
            && self.seen_farthest.iter().all(|&farthest| farthest >= 0.0 && farthest.is_finite())
            && self.mean.iter().all(|mean| mean.is_finite())
            && self.scale.iter().all(|&scale| scale.is_finite() && scale > 0.0)
            && self.count.checked_mul(4).is_some()
            && self.relative.is_none_or(|goal| {
                fits(goal.achieved, goal.goal_len) && fits(goal.desired, goal.goal_len)
            })
    }

    /// Adds observations, (rows, O), to the statistics.
    pub fn observe(&mut self, observations: &[f32]) {
        for row in observations.chunks_exact(self.mean.len()) {
            self.observe_row(|index| row[index]);
        }
    }

    /// Adds observations, (rows, O), with the achieved goals in place of the desired ones.
    pub fn observe_relabelled(&mut self, observations: &[f32], rule: &GoalRule) {
        let desired = rule.desired..rule.desired + rule.goal_len;
        for row in observations.chunks_exact(self.mean.len()) {
            let achieved = rule.achieved(row);
            self.observe_row(|index| match desired.contains(&index) {
                true => achieved[index - desired.start],
                false => row[index],
            });
        }
    }

    /// Adds an observation, given by its entries.
    fn observe_row(&mut self, value: impl Fn(usize) -> f32) {
        self.count += 1;
        let share = 1.0 / self.count as f64;
        self.seen_farthest.resize(self.mean.len(), 0.0);
        let seen = self.seen_mean.iter_mut().zip(&mut self.seen_squares);
        let seen = seen.zip(&mut self.seen_farthest);
        for (index, ((mean, squares), farthest)) in seen.enumerate() {
            let value = match self.relative.and_then(|goal| goal.achieved_for(index)) {
                Some(achieved) => value(index) - value(achieved),
                None => value(index),
            };
            let value = f64::from(value);
            let before = value - *mean;
            *mean += before * share;
            *squares += before * (value - *mean);
            *farthest = farthest.max((value - *mean).abs());
        }
    }

    fn make_relative(&self, row: &mut [f32]) {
        for (achieved, desired) in self.relative.into_iter().flat_map(RelativeGoal::pairs) {
            row[desired] -= row[achieved];
        }
    }

    /// Computes (x - mean) / scale of `observations`, (rows, O), into `out`.
    pub fn apply(&self, observations: &[f32], out: &mut [f32]) {
        let o = self.mean.len();
        for (row, out) in observations.chunks_exact(o).zip(out.chunks_exact_mut(o)) {
            self.apply_row(row, out);
        }
    }

    /// Computes (x - mean) / scale of one observation, (O,), into `out`.
    pub fn apply_row(&self, observation: &[f32], out: &mut [f32]) {
        out.copy_from_slice(observation);
        self.make_relative(out);
        for (out, (mean, scale)) in out.iter_mut().zip(self.mean.iter().zip(&self.scale)) {
            *out = (*out - mean) / scale;
        }
    }

    /// Returns true if mean and scale must be updated.
    #[must_use]
    pub fn is_due(&self) -> bool {
        self.count >= self.refresh_at
    }

    /// Updates mean and scale and returns the change. The next update is due at twice as many
    /// observations.
    pub fn update(&mut self) -> NormalisationChange<'static> {
        self.refresh_at = 2 * self.count.max(1);
        let before = self.mean_and_scale();
        for index in 0..self.mean.len() {
            let scale = self.seen_scale(index);
            self.mean[index] = self.seen_mean[index] as f32;
            self.scale[index] = if scale < SCALE_MIN { 1.0 } else { scale as f32 };
        }
        NormalisationChange { before, after: Some(self.mean_and_scale()) }
    }

    /// Returns the scale of an entry: its standard deviation, or more with goals if values were far
    /// from the mean.
    fn seen_scale(&self, index: usize) -> f64 {
        let std = (self.seen_squares[index] / self.count.max(1) as f64).sqrt();
        let farthest = self.seen_farthest.get(index).filter(|_| self.relative.is_some());
        let scale = farthest.map_or(std, |farthest| farthest / NORMALISED_MAX);
        scale.clamp(std, SCALE_MAX * std)
    }

    fn mean_and_scale(&self) -> [Cow<'static, [f32]>; 2] {
        [self.mean.clone(), self.scale.clone()].map(Cow::Owned)
    }

    /// Rewrites the flat parameters of a network of normalised observations, so that it is the same
    /// function of plain observations.
    pub fn fold(&self, shape: &MlpShape, parameters: &mut [f32]) {
        let before = [&self.mean, &self.scale].map(|values| Cow::Borrowed(values.as_slice()));
        NormalisationChange { before, after: None }.rewrite(shape, parameters);
        // w (g - a) = w g - w a.
        self.add_to_achieved(shape, parameters, -1.0);
    }

    /// Reverses [`Normaliser::fold`].
    pub fn unfold(&self, shape: &MlpShape, parameters: &mut [f32]) {
        self.add_to_achieved(shape, parameters, 1.0);
        let len = self.mean.len();
        let before = [vec![0.0; len], vec![1.0; len]].map(Cow::Owned);
        let after = Some(self.mean_and_scale());
        NormalisationChange { before, after }.rewrite(shape, parameters);
    }

    /// Adds `factor` times the weight of each entry of the desired goal to that of the same entry
    /// of the achieved goal.
    fn add_to_achieved(&self, shape: &MlpShape, parameters: &mut [f32], factor: f32) {
        let layer = &shape.layers()[0];
        for output in 0..layer.outputs {
            let from = layer.weights.start + output * layer.inputs;
            for (achieved, desired) in self.relative.into_iter().flat_map(RelativeGoal::pairs) {
                parameters[from + achieved] += factor * parameters[from + desired];
            }
        }
    }
}

/// A change of mean and scale.
#[derive(Debug)]
pub struct NormalisationChange<'a> {
    before: [Cow<'a, [f32]>; 2],
    /// `None` for plain observations.
    after: Option<[Cow<'a, [f32]>; 2]>,
}

impl NormalisationChange<'_> {
    /// Rewrites a network in training and its target, so that they remain the same functions of
    /// plain observations. The observations are the network's first inputs. Moments are scaled like
    /// the gradients of the new weights, without the effect of a shifted mean.
    pub fn apply(&self, network: &mut TrainableNetwork) {
        let TrainableNetwork { shape, parameters, target, adam, .. } = network;
        self.rewrite(shape, parameters.values_mut());
        if let Some(target) = target {
            self.rewrite(shape, target.values_mut());
        }
        self.for_each_weight(shape, |at, input| {
            let factor = self.before[1][input] / self.new_scale(input);
            adam.moments.first[at] *= factor;
            adam.moments.second[at] *= factor * factor;
        });
    }

    fn new_mean(&self, input: usize) -> f32 {
        self.after.as_ref().map_or(0.0, |[mean, _]| mean[input])
    }

    fn new_scale(&self, input: usize) -> f32 {
        self.after.as_ref().map_or(1.0, |[_, scale]| scale[input])
    }

    /// Rewrites the first layer: W (x - m) / s + b = W' (x - m') / s' + b' for every x.
    fn rewrite(&self, shape: &MlpShape, parameters: &mut [f32]) {
        let layer = &shape.layers()[0];
        let [mean, scale] = &self.before;
        for output in 0..layer.outputs {
            let from = layer.weights.start + output * layer.inputs;
            let weights = &parameters[from..from + mean.len()];
            let moved = (0..mean.len()).map(|input| {
                let shift = f64::from(self.new_mean(input)) - f64::from(mean[input]);
                f64::from(weights[input]) * shift / f64::from(scale[input])
            });
            let moved: f64 = moved.sum();
            let bias = &mut parameters[layer.bias.start + output];
            *bias = (f64::from(*bias) + moved) as f32;
        }
        self.for_each_weight(shape, |at, input| {
            parameters[at] *= self.new_scale(input) / scale[input];
        });
    }

    fn for_each_weight(&self, shape: &MlpShape, mut f: impl FnMut(usize, usize)) {
        let layer = &shape.layers()[0];
        for output in 0..layer.outputs {
            let from = layer.weights.start + output * layer.inputs;
            (0..self.before[0].len()).for_each(|input| f(from + input, input));
        }
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::Precision;
    use dmprl_shared::policy::{Activations, forward, initial_parameters};
    use rand::RngExt;

    use super::*;
    use crate::learner::tests::goal_rule;

    fn output(shape: &MlpShape, parameters: &[f32], inputs: &[f32]) -> Vec<f32> {
        let rows = inputs.len() / shape.inputs();
        let mut activations = Activations::new(shape, rows);
        forward(shape, parameters, inputs, &mut activations);
        activations.output(shape, rows).to_vec()
    }

    fn assert_close(got: &[f32], want: &[f32]) {
        assert!(got.iter().zip(want).all(|(a, b)| (a - b).abs() < 1e-4), "{got:?} {want:?}");
    }

    #[test]
    fn seen_observations_become_zero_mean_and_unit_scale() {
        let mut normaliser = Normaliser::new(2, 4, None);
        let seen = [1.0, 7.0, 3.0, 7.0, 5.0, 7.0, 7.0, 7.0];
        assert!(!normaliser.is_due());
        normaliser.observe(&seen);
        assert!(normaliser.is_due());
        normaliser.update();
        assert!(!normaliser.is_due());
        let mut out = [0.0; 8];
        normaliser.apply(&seen, &mut out);
        // Mean 4, standard deviation sqrt(5); the second dimension is constant.
        let unit = 5.0_f32.sqrt();
        assert_close(&out, &[-3.0 / unit, 0.0, -1.0 / unit, 0.0, 1.0 / unit, 0.0, 3.0 / unit, 0.0]);
    }

    #[test]
    fn relative_goals_are_normalised_like_other_entries() {
        let mut normaliser = Normaliser::new(2, 1, Some(RelativeGoal::new(&goal_rule())));
        let mut out = [0.0; 2];
        normaliser.apply_row(&[1.0, 9.0], &mut out);
        assert_eq!(out, [1.0, 8.0]);
        normaliser.observe(&[1.0, 9.0, 3.0, 7.0]); // differences 8 and 4
        normaliser.update();
        normaliser.apply_row(&[1.0, 9.0], &mut out);
        assert_eq!(out, [-1.0, 1.0]);
    }

    /// Returns the scale of an entry that is 0 in `count - 1` observations, and then `value`.
    fn scale_of_rare(value: f32, count: usize, relative: Option<RelativeGoal>) -> f32 {
        let mut rows = vec![0.0; 3 * count];
        rows[3 * count - 1] = value;
        let mut normaliser = Normaliser::new(3, 1, relative);
        normaliser.observe(&rows);
        normaliser.update();
        normaliser.scale[2]
    }

    #[test]
    fn rare_values_far_from_the_mean_get_a_larger_scale_with_goals() {
        let goals = Some(RelativeGoal::new(&goal_rule()));
        // Mean 0.1, variance 100 / 100 - 0.1². The value is 9.9 from the mean, and becomes 5.
        assert_close(&[scale_of_rare(10.0, 100, goals)], &[9.9 / 5.0]);
        assert_close(&[scale_of_rare(10.0, 100, None)], &[0.99_f32.sqrt()]);
        // Standard deviation 2, and 2 from the mean: the scale is not smaller.
        assert_close(&[scale_of_rare(4.0, 2, goals)], &[2.0]);
        // Mean 1/30, variance 900 / 900 - 1/900. 1/5 of the distance is 6: the limit applies.
        let std = (1.0_f32 - 1.0 / 900.0).sqrt();
        assert_close(&[scale_of_rare(30.0, 900, goals)], &[4.0 * std]);
    }

    #[test]
    fn statistics_see_achieved_goals_in_place_of_the_desired_ones() {
        let mut normaliser = Normaliser::new(2, 1, None);
        normaliser.observe(&[1.0, 9.0]);
        normaliser.observe_relabelled(&[1.0, 9.0], &goal_rule());
        normaliser.update();
        // The desired goals were 9 and 1.
        let mut out = [0.0; 2];
        normaliser.apply_row(&[1.0, 9.0], &mut out);
        assert_eq!(out, [0.0, 1.0]);
    }

    #[test]
    fn neither_a_refresh_nor_folding_changes_the_function() {
        function_remains(None);
    }

    #[test]
    fn relative_goals_do_not_change_the_function_of_plain_observations() {
        function_remains(Some(RelativeGoal::new(&goal_rule())));
    }

    fn function_remains(relative: Option<RelativeGoal>) {
        let shape = MlpShape::new(vec![5, 16, 2]);
        let mut random = dmprl_shared::seeds::stream(1, "test", 0);
        let initial = initial_parameters(&shape, &mut random);
        // Three observations and two actions, like a critic.
        let rows: Vec<f32> = (0..40).map(|_| random.random_range(-3.0..9.0)).collect();
        let with = |normaliser: &Normaliser| {
            let mut inputs = rows.clone();
            for (row, out) in rows.chunks_exact(5).zip(inputs.chunks_exact_mut(5)) {
                normaliser.apply_row(&row[..3], &mut out[..3]);
            }
            inputs
        };
        let mut network =
            TrainableNetwork::new(shape.clone(), initial, 1e-3, true, Precision::F32).unwrap();
        let mut normaliser = Normaliser::new(3, 1, relative);
        let plain = output(&shape, network.parameters.values(), &with(&normaliser));
        for _ in 0..3 {
            let seen: Vec<f32> = (0..30).map(|_| random.random_range(-2.0..10.0)).collect();
            normaliser.observe(&seen);
            normaliser.update().apply(&mut network);
            let inputs = with(&normaliser);
            assert!(inputs[..3] != rows[..3]);
            assert_close(&output(&shape, network.parameters.values(), &inputs), &plain);
            let target = network.target.as_ref().unwrap();
            assert_close(&output(&shape, target.values(), &inputs), &plain);
            let mut folded = network.parameters.values().to_vec();
            normaliser.fold(&shape, &mut folded);
            assert_close(&output(&shape, &folded, &rows), &plain);
            normaliser.unfold(&shape, &mut folded);
            assert_close(&folded, network.parameters.values());
        }
    }
}
