//! How a rollout departs from its policy: warm-up draws, and noise on actions or DMP parameters.

use std::ops::Range;

use dmprl_shared::config::{ExplorationConfig, ExplorationKind, WarmUpKind};
use dmprl_shared::policy::gaussian;
use rand::{Rng, RngExt};
use rand_distr::StandardNormal;
use rand_xoshiro::Xoshiro256PlusPlus;

use crate::acting::Acting;

/// The departure, with its random stream.
#[derive(Debug)]
pub struct Exploration {
    config: ExplorationConfig,
    random: Xoshiro256PlusPlus,
    /// One source a (environment, action dimension), for `pink`.
    pink: Vec<PinkNoise>,
    /// One draw a dimension, for `segment`.
    held: Vec<f32>,
}

impl Exploration {
    /// For `envs` environments of `dims` action dimensions.
    #[must_use]
    pub fn new(
        config: ExplorationConfig,
        random: Xoshiro256PlusPlus,
        (envs, dims): (usize, usize),
    ) -> Self {
        let pink = match config.kind {
            ExplorationKind::Pink => vec![PinkNoise::default(); envs * dims],
            _ => Vec::new(),
        };
        Self { config, random, pink, held: vec![0.0; dims] }
    }

    /// Draws the segment's `u` without the policy.
    pub fn warm_up(&mut self, acting: &mut Acting) {
        let range = self.config.warm_up_range as f32;
        let random = &mut self.random;
        let mut draw = |values: &mut [f32]| {
            values.iter_mut().for_each(|value| *value = random.random_range(-range..=range));
        };
        match self.config.warm_up_kind {
            WarmUpKind::Uniform => draw(&mut acting.u),
            WarmUpKind::DmpParameters => acting.decode_drawn(&mut draw),
        }
    }

    /// Turns the network's outputs into `u` with noise, within [-1, 1].
    ///
    /// A Gaussian policy draws from itself; kind and std of the noise then mean nothing. One with
    /// standard deviations of its own is not bounded by a tanh, and its draws not by [-1, 1].
    pub fn explore(&mut self, acting: &mut Acting) {
        if !acting.std.is_empty() {
            acting.decode();
            self.draw_unbounded(acting);
            return;
        }
        if let Some(columns) = acting.policy.log_stds() {
            acting.decode();
            self.draw(acting, columns);
            return;
        }
        let std = self.config.std as f32;
        if self.config.kind == ExplorationKind::DmpParameters {
            let envs = acting.observations.len() / acting.policy.layout().observation_len;
            let outputs = acting.work.activations.output_mut(acting.policy.shape(), envs);
            outputs.iter_mut().for_each(|output| *output += std * normal(&mut self.random));
            acting.decode();
            return;
        }
        acting.decode();
        let dims = self.held.len();
        let segment = acting.policy.layout().segment_steps * dims;
        for (env, u) in acting.u.chunks_exact_mut(segment).enumerate() {
            for step in 0..segment / dims {
                for d in 0..dims {
                    let noise = self.noise(env, step, d);
                    let u = &mut u[step * dims + d];
                    *u = (*u + std * noise).clamp(-1.0, 1.0);
                }
            }
        }
    }

    /// u = mean + std noise, std the policy's own.
    fn draw_unbounded(&mut self, acting: &mut Acting) {
        let Acting { u, std, work, .. } = acting;
        let means = work.actions.chunks_exact(std.len());
        for (u, mean) in u.chunks_exact_mut(std.len()).zip(means) {
            for ((u, mean), std) in u.iter_mut().zip(mean).zip(std.iter()) {
                *u = mean + std * normal(&mut self.random);
            }
        }
    }

    /// u = tanh(mean + std noise), std from the network's outputs at `columns`.
    fn draw(&mut self, acting: &mut Acting, columns: Range<usize>) {
        let len = acting.policy.layout().actions_len();
        let envs = acting.u.len() / len;
        let outputs = acting.work.activations.output(acting.policy.shape(), envs);
        let rows = outputs.chunks_exact(acting.policy.shape().outputs());
        for (env, row) in rows.enumerate() {
            for (index, raw_log_std) in row[columns.clone()].iter().enumerate() {
                let at = env * len + index;
                let noise = normal(&mut self.random);
                acting.u[at] = gaussian::draw(acting.work.means[at], *raw_log_std, noise).action;
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

    /// An episode of environment `env` has ended: its noise starts anew.
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

/// Octaves of the pink noise: 2^8 steps is longer than the episodes it is meant for.
const OCTAVES: usize = 8;

/// Pink noise of unit variance: Voss's sum of held white sources, source i renewed every 2^i steps.
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
    use super::*;

    #[test]
    fn pink_noise_has_unit_variance_and_a_memory_that_fades() {
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
        // Standard error of each about 0.02. Expected: the share of sources not renewed in between;
        // at step 32 those of 1, 2, 4, 8, 16 and 32 steps are.
        assert!((correlation(0) - 1.0).abs() < 0.1, "{}", correlation(0));
        assert!((correlation(1) - 7.0 / 8.0).abs() < 0.1, "{}", correlation(1));
        assert!((correlation(16) - 2.0 / 8.0).abs() < 0.1, "{}", correlation(16));
    }
}
