//! Stage 3 of 8, exploration: random warm-up actions, and noise on actions or DMP parameters.
//! Called by the rollout.

use std::ops::Range;

use dmprl_shared::config::{ExplorationConfig, ExplorationKind, WarmUpKind};
use dmprl_shared::policy::gaussian;
use rand::{Rng, RngExt};
use rand_distr::StandardNormal;
use rand_xoshiro::Xoshiro256PlusPlus;

use crate::policy_runner::PolicyRunner;

/// Exploration noise with its random stream.
#[derive(Debug)]
pub struct Exploration {
    config: ExplorationConfig,
    random: Xoshiro256PlusPlus,
    /// One source for each (environment, action dimension), for `pink`.
    pink: Vec<PinkNoise>,
    /// One draw for each dimension, for `segment`.
    held: Vec<f32>,
}

impl Exploration {
    /// Creates the noise for `envs` environments with `dims` action dimensions.
    #[must_use]
    pub fn new(
        config: ExplorationConfig,
        random: Xoshiro256PlusPlus,
        envs: usize,
        dims: usize,
    ) -> Self {
        let pink = match config.kind {
            ExplorationKind::Pink => vec![PinkNoise::default(); envs * dims],
            _ => Vec::new(),
        };
        Self { config, random, pink, held: vec![0.0; dims] }
    }

    /// Draws random actions `u` for a segment, without the policy.
    pub fn warm_up(&mut self, runner: &mut PolicyRunner) {
        let range = self.config.warm_up_range as f32;
        if self.config.warm_up_kind == WarmUpKind::Segment {
            let segment = runner.policy.layout().actions_len();
            runner.u.chunks_exact_mut(segment).for_each(|u| self.hold_random(u, range));
            return;
        }
        let random = &mut self.random;
        let mut draw = |values: &mut [f32]| {
            values.iter_mut().for_each(|value| *value = random.random_range(-range..=range));
        };
        match self.config.warm_up_kind {
            WarmUpKind::DmpParameters => runner.decode_drawn(&mut draw),
            _ => draw(&mut runner.u),
        }
    }

    /// Fills a segment's actions, (K, A), with one uniform action.
    fn hold_random(&mut self, u: &mut [f32], range: f32) {
        let dims = self.held.len();
        for d in 0..dims {
            let action = self.random.random_range(-range..=range);
            u.iter_mut().skip(d).step_by(dims).for_each(|u| *u = action);
        }
    }

    /// Converts the network's outputs to `u` with noise, within [-1, 1], and replaces the share
    /// `exploration.random_segments` of the segments by random ones. A `settled` policy gets the
    /// share `exploration.settled_share` of both.
    pub fn explore(&mut self, runner: &mut PolicyRunner, settled: bool) {
        let scale = if settled { self.config.settled_share } else { 1.0 };
        self.perturb(runner, (scale * self.config.std) as f32);
        let share = scale * self.config.random_segments;
        if share == 0.0 {
            return;
        }
        let segment = runner.policy.layout().actions_len();
        for u in runner.u.chunks_exact_mut(segment) {
            if self.random.random_bool(share) {
                self.hold_random(u, 1.0);
            }
        }
    }

    /// Converts the network's outputs to `u` with noise of scale `std`, within [-1, 1].
    ///
    /// A Gaussian policy draws from its own distribution; the configured noise then has no effect.
    /// If its standard deviations are learned parameters, its actions are not bounded.
    fn perturb(&mut self, runner: &mut PolicyRunner, std: f32) {
        if !runner.std.is_empty() {
            runner.decode();
            self.draw_unbounded(runner);
            return;
        }
        if let Some(columns) = runner.policy.log_stds() {
            runner.decode();
            self.draw(runner, columns);
            return;
        }
        if self.config.kind == ExplorationKind::DmpParameters {
            let envs = runner.observations.len() / runner.policy.layout().observation_len;
            let outputs = runner.work.activations.output_mut(runner.policy.shape(), envs);
            outputs.iter_mut().for_each(|output| *output += std * normal(&mut self.random));
            runner.decode();
            return;
        }
        runner.decode();
        let dims = self.held.len();
        let segment = runner.policy.layout().segment_steps * dims;
        for (env, u) in runner.u.chunks_exact_mut(segment).enumerate() {
            for step in 0..segment / dims {
                for d in 0..dims {
                    let noise = self.noise(env, step, d);
                    let u = &mut u[step * dims + d];
                    *u = (*u + std * noise).clamp(-1.0, 1.0);
                }
            }
        }
    }

    /// Draws u = mean + std noise with the policy's learned std.
    fn draw_unbounded(&mut self, runner: &mut PolicyRunner) {
        let PolicyRunner { u, std, work, .. } = runner;
        let means = work.actions.chunks_exact(std.len());
        for (u, mean) in u.chunks_exact_mut(std.len()).zip(means) {
            for ((u, mean), std) in u.iter_mut().zip(mean).zip(std.iter()) {
                *u = mean + std * normal(&mut self.random);
            }
        }
    }

    /// Draws u = tanh(mean + std noise) with std from the network's outputs at `columns`.
    fn draw(&mut self, runner: &mut PolicyRunner, columns: Range<usize>) {
        let len = runner.policy.layout().actions_len();
        let envs = runner.u.len() / len;
        let outputs = runner.work.activations.output(runner.policy.shape(), envs);
        let rows = outputs.chunks_exact(runner.policy.shape().outputs());
        for (env, row) in rows.enumerate() {
            for (index, raw_log_std) in row[columns.clone()].iter().enumerate() {
                let at = env * len + index;
                let noise = normal(&mut self.random);
                runner.u[at] = gaussian::draw(runner.work.means[at], *raw_log_std, noise).action;
            }
        }
    }

    fn noise(&mut self, env: usize, step: usize, d: usize) -> f32 {
        let dims = self.held.len();
        match self.config.kind {
            ExplorationKind::Gaussian => normal(&mut self.random),
            ExplorationKind::Segment => {
                if step == 0 {
                    self.held[d] = normal(&mut self.random);
                }
                self.held[d]
            }
            ExplorationKind::Pink => self.pink[env * dims + d].next(&mut self.random),
            ExplorationKind::DmpParameters => 0.0,
        }
    }

    /// Resets the noise of environment `env` at the end of its episode.
    pub fn episode_ended(&mut self, env: usize) {
        let dims = self.held.len();
        if let Some(sources) = self.pink.get_mut(env * dims..(env + 1) * dims) {
            sources.fill(PinkNoise::default());
        }
    }
}

fn normal(random: &mut impl Rng) -> f32 {
    random.sample(StandardNormal)
}

/// Number of octaves of the pink noise. 2^8 steps are longer than typical episodes.
const OCTAVES: usize = 8;

/// Pink noise of unit variance (Voss's method): the sum of white sources, where source i is drawn
/// again every 2^i steps.
#[derive(Debug, Clone, Copy, Default)]
struct PinkNoise {
    sources: [f32; OCTAVES],
    step: u32,
}

impl PinkNoise {
    fn next(&mut self, random: &mut impl Rng) -> f32 {
        for (octave, source) in self.sources.iter_mut().enumerate() {
            if self.step.is_multiple_of(1 << octave) {
                *source = normal(random);
            }
        }
        self.step += 1;
        self.sources.iter().sum::<f32>() / (OCTAVES as f32).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::{ExperimentConfig, Layers, Limits};
    use dmprl_shared::policy::Policy;
    use dmprl_shared::seeds;
    use dmprl_shared::spec::EnvSpec;

    use super::*;

    const ENVS: usize = 200;
    const DIMS: usize = 2;
    const K: usize = 5;

    fn config(keys: &[(&str, &str)]) -> ExperimentConfig {
        let mut layers = Layers::new();
        layers
            .set("test", "task.start_sources", "[{index=0, velocity=2}, {index=1, velocity=3}]")
            .unwrap();
        for (key, value) in keys {
            layers.set("test", key, value).unwrap();
        }
        layers.finish().unwrap().resolve(Limits { cores: 1 }).unwrap()
    }

    /// Creates a new policy with some observations, and exploration for it.
    fn scene(keys: &[(&str, &str)]) -> (PolicyRunner, Exploration) {
        let config = config(keys);
        let spec = EnvSpec::new("Test-v0", 4, &[(-1.0, 1.0); DIMS], 0.02, 50);
        let policy = Policy::new(config.policy_description(&spec)).unwrap();
        let parameters = policy.initial_parameters(&mut seeds::stream(1, "test", 0));
        let mut runner = PolicyRunner::new(policy, ENVS);
        runner.take_policy(&parameters);
        for (index, value) in runner.observations.iter_mut().enumerate() {
            *value = (index as f32 * 0.7).sin();
        }
        runner.run_network();
        let random = seeds::stream(2, "test", 0);
        (runner, Exploration::new(config.exploration, random, ENVS, DIMS))
    }

    /// Returns the noise that exploration adds to each action, (E, K, A). No action is clipped.
    fn noise(keys: &[(&str, &str)]) -> Vec<f32> {
        let (mut runner, mut exploration) = scene(keys);
        runner.decode();
        let clean = runner.u.clone();
        exploration.explore(&mut runner, false);
        runner.u.iter().zip(&clean).map(|(noisy, clean)| noisy - clean).collect()
    }

    fn std(values: &[f32]) -> f32 {
        (values.iter().map(|value| value * value).sum::<f32>() / values.len() as f32).sqrt()
    }

    #[test]
    fn noise_on_actions_has_the_configured_spread() {
        for kind in ["gaussian", "segment", "pink"] {
            let noise = noise(&[("exploration.kind", kind), ("exploration.std", "0.1")]);
            // At least 400 independent numbers; the tolerance is four standard errors of 0.0035.
            assert!((std(&noise) - 0.1).abs() < 0.014, "{kind}: {}", std(&noise));
        }
    }

    #[test]
    fn a_draw_for_a_segment_is_held_and_one_for_a_step_is_not() {
        let held = |kind| {
            let noise = noise(&[("exploration.kind", kind)]);
            let same = |segment: &[f32]| {
                (0..DIMS).all(|d| (1..K).all(|k| (segment[k * DIMS + d] - segment[d]).abs() < 1e-6))
            };
            noise.chunks_exact(K * DIMS).filter(|segment| same(segment)).count()
        };
        assert_eq!((held("segment"), held("gaussian"), held("pink")), (ENVS, 0, 0));
        let noise = noise(&[("exploration.kind", "segment")]);
        assert!(noise[0] != noise[1] && noise[0] != noise[K * DIMS], "one draw for all dimensions");
    }

    #[test]
    fn noise_stays_within_the_bounds() {
        let keys = [("exploration.kind", "gaussian"), ("exploration.std", "2.0")];
        let (mut runner, mut exploration) = scene(&keys);
        exploration.explore(&mut runner, false);
        assert!(runner.u.iter().all(|u| u.abs() <= 1.0));
        assert!(runner.u.contains(&1.0) && runner.u.contains(&-1.0));
    }

    #[test]
    fn noise_on_parameters_goes_through_the_movement_primitive() {
        let keys = [("exploration.kind", "dmp_parameters"), ("exploration.std", "0.3")];
        let (mut runner, mut exploration) = scene(&keys);
        runner.decode();
        let clean = runner.u.clone();
        exploration.explore(&mut runner, false);
        let explored = runner.u.clone();
        assert!(explored.iter().zip(&clean).filter(|(a, b)| a != b).count() > clean.len() / 2);
        // The decoder adds no noise.
        runner.decode();
        assert_eq!(runner.u, explored);
    }

    #[test]
    fn warm_up_draws_within_its_range_regardless_of_the_policy() {
        for (kind, range) in [("uniform", 0.3), ("uniform", 1.0)] {
            let text = range.to_string();
            let keys =
                [("exploration.warm_up_kind", kind), ("exploration.warm_up_range", text.as_str())];
            let (mut runner, mut exploration) = scene(&keys);
            exploration.warm_up(&mut runner);
            let largest = runner.u.iter().fold(0.0_f32, |largest, u| largest.max(u.abs()));
            assert!(largest <= range && largest > 0.95 * range, "{kind}: {largest} of {range}");
            assert!(runner.u.windows(2).all(|pair| pair[0] != pair[1]));
        }
    }

    #[test]
    fn a_settled_policy_gets_its_share_of_noise_and_random_segments() {
        let settled = [
            ("exploration.random_segments", "1.0"),
            ("exploration.std", "0.5"),
            ("exploration.settled_share", "0.0"),
        ];
        let (mut runner, mut exploration) = scene(&settled);
        runner.decode();
        let clean = runner.u.clone();
        exploration.explore(&mut runner, true);
        assert_eq!(runner.u, clean);
        exploration.explore(&mut runner, false);
        assert!(held(&runner).into_iter().all(|held| held));
    }

    /// Returns which segments hold one action over all steps.
    fn held(runner: &PolicyRunner) -> Vec<bool> {
        let segments = runner.u.chunks_exact(K * DIMS);
        segments.map(|u| (DIMS..K * DIMS).all(|i| u[i] == u[i - DIMS])).collect()
    }

    #[test]
    fn a_share_of_the_segments_is_random_and_held_over_the_full_range() {
        let keys = [("exploration.random_segments", "0.3"), ("exploration.std", "0.0")];
        let (mut runner, mut exploration) = scene(&keys);
        runner.decode();
        let clean = runner.u.clone();
        let (mut count, mut largest) = (0, 0.0_f32);
        for _ in 0..20 {
            exploration.explore(&mut runner, false);
            for (env, held) in held(&runner).into_iter().enumerate() {
                let segment = env * K * DIMS..(env + 1) * K * DIMS;
                assert!(held || runner.u[segment.clone()] == clean[segment.clone()]);
                if held {
                    count += 1;
                    let u = &runner.u[segment];
                    assert!(u[0] != u[1], "one draw for all dimensions");
                    largest = u.iter().fold(largest, |largest, u| largest.max(u.abs()));
                }
            }
        }
        // Binomial(4000, 0.3) has standard deviation 29; five of them are allowed.
        assert!(1200_usize.abs_diff(count) < 145, "{count}");
        assert!((0.95..=1.0).contains(&largest), "{largest}");
    }

    #[test]
    fn warm_up_by_segments_holds_each_action_within_its_range() {
        let keys = [("exploration.warm_up_kind", "segment"), ("exploration.warm_up_range", "0.5")];
        let (mut runner, mut exploration) = scene(&keys);
        exploration.warm_up(&mut runner);
        assert_eq!(held(&runner), [true; ENVS]);
        assert!(runner.u.iter().all(|u| u.abs() <= 0.5) && runner.u[0] != runner.u[K * DIMS]);
    }

    #[test]
    fn warm_up_on_parameters_draws_movement_primitives() {
        let keys = [("exploration.warm_up_kind", "dmp_parameters")];
        let (mut runner, mut exploration) = scene(&keys);
        exploration.warm_up(&mut runner);
        let first = runner.u.clone();
        assert!(std(&first) > 0.01 && first.iter().all(|u| u.abs() <= 1.0));
        // Actions within a segment belong to one motion, so successive ones differ less than across
        // segments.
        let jump = |from: usize, to: usize| {
            let all = first.chunks_exact(K * DIMS).zip(first.chunks_exact(K * DIMS).skip(1));
            std(&all
                .map(|(a, b)| [a, b][to / K][to % K * DIMS] - a[from * DIMS])
                .collect::<Vec<_>>())
        };
        assert!(jump(K - 2, K - 1) < jump(K - 1, K), "not smooth");
        exploration.warm_up(&mut runner);
        assert_ne!(runner.u, first);
    }

    #[test]
    fn a_gaussian_policy_draws_from_its_own_distribution() {
        // Squashed: within the bounds, regardless of the configured noise.
        let (mut runner, mut exploration) =
            scene(&[("algorithm.name", "sac"), ("exploration.std", "0.0")]);
        runner.decode();
        let mean = runner.u.clone();
        exploration.explore(&mut runner, false);
        assert!(runner.u.iter().zip(&mean).all(|(u, mean)| u != mean && u.abs() <= 1.0));
        // With learned standard deviations: also outside the bounds.
        let ndp = [
            ("algorithm.name", "ndp"),
            ("policy.controller", "position"),
            ("exploration.warm_up_steps", "0"),
            ("algorithm.action_rate_penalty", "0.0"),
            ("algorithm.ndp.initial_log_std", "0.0"),
        ];
        let (mut runner, mut exploration) = scene(&ndp);
        runner.decode();
        let mean = runner.work.actions.clone();
        exploration.explore(&mut runner, false);
        let drawn: Vec<f32> = runner.u.iter().zip(&mean).map(|(u, mean)| u - mean).collect();
        assert!((std(&drawn) - 1.0).abs() < 0.1, "{}", std(&drawn));
        assert!(runner.u.iter().any(|u| u.abs() > 1.0));
    }

    #[test]
    fn pink_noise_is_reset_at_the_end_of_an_episode() {
        let (mut runner, mut exploration) = scene(&[("exploration.kind", "pink")]);
        exploration.explore(&mut runner, false);
        exploration.episode_ended(3);
        let sources = |env: usize| &exploration.pink[env * DIMS..(env + 1) * DIMS];
        assert!(sources(3).iter().all(|source| source.step == 0));
        assert!(sources(2).iter().all(|source| source.step == K as u32));
    }

    #[test]
    fn pink_noise_has_unit_variance_and_decaying_correlation() {
        let mut random = dmprl_shared::seeds::stream(1, "test", 0);
        let episodes: Vec<Vec<f32>> = (0..4_000)
            .map(|_| {
                let mut noise = PinkNoise::default();
                (0..64).map(|_| noise.next(&mut random)).collect()
            })
            .collect();
        let correlation = |lag: usize| {
            let products = episodes.iter().map(|e| e[16] * e[16 + lag]).sum::<f32>();
            products / episodes.len() as f32
        };
        // The standard error of each is about 0.02. The expected value is the fraction of sources
        // that are not drawn again in between; at step 32 those of 1, 2, 4, 8, 16 and 32 steps are.
        assert!((correlation(0) - 1.0).abs() < 0.1, "{}", correlation(0));
        assert!((correlation(1) - 7.0 / 8.0).abs() < 0.1, "{}", correlation(1));
        assert!((correlation(16) - 2.0 / 8.0).abs() < 0.1, "{}", correlation(16));
    }
}
