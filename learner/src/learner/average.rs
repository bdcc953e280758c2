//! The average of the newest policies, which is saved and evaluated instead of the newest one.

/// Updates between two policies of the average.
const EVERY_UPDATES: u64 = 4;

/// Polynomial-decay average of the policies after every fourth update.
///
/// A policy is better after some updates than after others. Its average is steadier, and usually
/// better (docs/decisions/0128-average-of-policies.md). With η = 1 / share - 1, this is the average
/// of Shamir and Zhang 2013, "Stochastic Gradient Descent for Non-smooth Optimization". About the
/// last `share` of all policies have most of the weight, however many there are.
#[derive(Debug, Clone)]
pub struct PolicyAverage {
    share: f64,
    /// The policy that is added next, or was added last.
    newest: Vec<f32>,
    /// Updates before the policy that was added last; 0 before the first one.
    newest_updates: u64,
    /// Empty before the first policy.
    values: Vec<f32>,
}

impl PolicyAverage {
    /// Makes an average of no policies. `share` is greater than 0 and at most 1.
    #[must_use]
    pub fn new(share: f64) -> Self {
        Self { share, newest: Vec::new(), newest_updates: 0, values: Vec::new() }
    }

    /// Returns whether the policy after `updates` updates is part of the average.
    #[must_use]
    pub fn is_due(updates: u64) -> bool {
        updates.is_multiple_of(EVERY_UPDATES)
    }

    /// Returns the place of the policy that is added next, (P,), for the caller to fill.
    pub fn newest_mut(&mut self, len: usize) -> &mut [f32] {
        self.newest.resize(len, 0.0);
        &mut self.newest
    }

    /// Adds the policy after `updates` updates, which is in its place.
    pub fn add(&mut self, updates: u64) {
        self.newest_updates = updates;
        if self.values.len() != self.newest.len() {
            self.values.clone_from(&self.newest);
            return;
        }
        let count = (updates / EVERY_UPDATES) as f64;
        let weight = (1.0 / (1.0 + self.share * (count - 1.0))).min(1.0) as f32;
        for (average, value) in self.values.iter_mut().zip(&self.newest) {
            *average += weight * (value - *average);
        }
    }

    /// Returns the policy after `updates` updates, (P,), if it was added last.
    #[must_use]
    pub fn newest(&self, updates: u64) -> Option<&[f32]> {
        (updates > 0 && updates == self.newest_updates).then_some(&self.newest)
    }

    /// Returns the average, (P,), or nothing before the first policy.
    #[must_use]
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// Sets the average to that of an earlier session.
    pub fn restore(&mut self, values: Vec<f32>) {
        self.values = values;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The average of policies that are their own number, (1,), after each of them.
    fn averages(share: f64, count: u64) -> Vec<f32> {
        let mut average = PolicyAverage::new(share);
        let after = |index: u64| {
            average.newest_mut(1)[0] = index as f32;
            average.add(index * EVERY_UPDATES);
            average.values()[0]
        };
        (1..=count).map(after).collect()
    }

    #[test]
    fn a_share_of_one_is_the_mean() {
        assert_eq!(averages(1.0, 4), [1.0, 1.5, 2.0, 2.5]);
    }

    #[test]
    fn a_share_of_a_half_weighs_each_policy_by_its_number() {
        // Σ i² / Σ i = (2 n + 1) / 3.
        for (n, average) in (1..).zip(averages(0.5, 20)) {
            assert!((average - (2 * n + 1) as f32 / 3.0).abs() < 1e-5, "{n}: {average}");
        }
    }

    #[test]
    fn a_small_share_forgets_early_policies() {
        let last = averages(0.1, 1000)[999];
        // The weight of policy i is about proportional to i⁹, so the mean is 10/11 of the way.
        assert!((last - 1000.0 * 10.0 / 11.0).abs() < 1.0, "{last}");
    }
}
