//! One pass of Adam (Kingma & Ba 2015, Algorithm 1). The target network's step is part of the same
//! pass, while the parameters are in registers.

use pulp::{Simd, WithSimd};

use super::InstructionSet;

pub(crate) const BETA1: f32 = 0.9;
pub(crate) const BETA2: f32 = 0.999;
/// Added to the root of the second moment, as in PyTorch.
pub(crate) const EPSILON: f32 = 1e-8;

/// The bias-corrected factors of one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepSizes {
    step: f32,
    epsilon: f32,
}

impl StepSizes {
    /// Computes the factors of step number `step`, counted from 1.
    ///
    /// Adam subtracts learning_rate m̂ / (sqrt(v̂) + epsilon) with m̂ = m / (1 - beta1^t) and
    /// v̂ = v / (1 - beta2^t). This equals step m / (sqrt(v) + epsilon') with
    /// root = sqrt(1 - beta2^t), step = learning_rate root / (1 - beta1^t) and
    /// epsilon' = epsilon root, which needs one division per parameter instead of two.
    #[must_use]
    pub fn new(learning_rate: f64, step: u64) -> Self {
        // In f64, because 1 - beta2^t would lose its digits in f32 at small t.
        let correction = |beta: f32| 1.0 - f64::from(beta).powf(step as f64);
        let root = correction(BETA2).sqrt();
        Self {
            step: (learning_rate * root / correction(BETA1)) as f32,
            epsilon: (f64::from(EPSILON) * root) as f32,
        }
    }

    /// Returns the factors with the learning rate multiplied by `factor`.
    #[must_use]
    pub fn scaled(self, factor: f32) -> Self {
        Self { step: self.step * factor, ..self }
    }
}

/// Moves a target network: target <- polyak * network + (1 - polyak) * target.
#[derive(Debug)]
pub struct PolyakStep<'a> {
    /// The target's parameters, (P,).
    pub target: &'a mut [f32],
    /// Share of the way to the network.
    pub polyak: f32,
}

/// Some parameters with Adam's state, (P,) each.
#[derive(Debug)]
pub struct AdamPass<'a> {
    /// The parameters.
    pub parameters: &'a mut [f32],
    /// Running mean of the gradient.
    pub first: &'a mut [f32],
    /// Running mean of the gradient's square.
    pub second: &'a mut [f32],
    /// The gradient.
    pub gradient: &'a [f32],
    /// The target network's step, done in the same pass.
    pub target_step: Option<PolyakStep<'a>>,
    /// The factors of this step.
    pub sizes: StepSizes,
}

/// Does one step of Adam, then the target's step if there is one.
///
/// # Panics
/// If the lengths differ.
pub fn adam(pass: AdamPass<'_>, instructions: InstructionSet) {
    let len = pass.parameters.len();
    let others = [pass.first.len(), pass.second.len(), pass.gradient.len()];
    assert_eq!(others, [len; 3], "moments and gradient");
    if let Some(step) = &pass.target_step {
        assert_eq!(step.target.len(), len, "target parameters");
    }
    instructions.run(pass);
}

impl WithSimd for AdamPass<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { parameters, first, second, gradient, target_step, sizes } = self;
        let rule = Rule::new(simd, sizes);
        let (parameters, parameters_tail) = S::as_mut_simd_f32s(parameters);
        let (first, first_tail) = S::as_mut_simd_f32s(first);
        let (second, second_tail) = S::as_mut_simd_f32s(second);
        let (gradient, gradient_tail) = S::as_simd_f32s(gradient);
        let moments = first.iter_mut().zip(second).zip(gradient);
        let numbers = parameters.iter_mut().zip(moments);
        let mut tail = [
            simd.partial_load_f32s(parameters_tail),
            simd.partial_load_f32s(first_tail),
            simd.partial_load_f32s(second_tail),
        ];
        let tail_gradient = simd.partial_load_f32s(gradient_tail);
        let [p, m, v] = &mut tail;
        rule.step(simd, p, m, v, tail_gradient);
        match target_step {
            None => {
                for (p, ((m, v), g)) in numbers {
                    rule.step(simd, p, m, v, *g);
                }
            }
            Some(PolyakStep { target, polyak }) => {
                let share = simd.splat_f32s(polyak);
                let (target, target_tail) = S::as_mut_simd_f32s(target);
                for ((p, ((m, v), g)), target) in numbers.zip(target) {
                    rule.step(simd, p, m, v, *g);
                    *target = polyak_average(simd, *target, *p, share);
                }
                let followed = simd.partial_load_f32s(target_tail);
                simd.partial_store_f32s(
                    target_tail,
                    polyak_average(simd, followed, tail[0], share),
                );
            }
        }
        simd.partial_store_f32s(parameters_tail, tail[0]);
        simd.partial_store_f32s(first_tail, tail[1]);
        simd.partial_store_f32s(second_tail, tail[2]);
    }
}

#[inline(always)]
fn polyak_average<S: Simd>(simd: S, target: S::f32s, network: S::f32s, share: S::f32s) -> S::f32s {
    simd.mul_add_e_f32s(share, simd.sub_f32s(network, target), target)
}

/// Adam's constants, broadcast to all lanes.
struct Rule<S: Simd> {
    beta1: S::f32s,
    rest1: S::f32s,
    beta2: S::f32s,
    rest2: S::f32s,
    step: S::f32s,
    epsilon: S::f32s,
}

impl<S: Simd> Rule<S> {
    #[inline(always)]
    fn new(simd: S, sizes: StepSizes) -> Self {
        Self {
            beta1: simd.splat_f32s(BETA1),
            rest1: simd.splat_f32s(1.0 - BETA1),
            beta2: simd.splat_f32s(BETA2),
            rest2: simd.splat_f32s(1.0 - BETA2),
            step: simd.splat_f32s(-sizes.step),
            epsilon: simd.splat_f32s(sizes.epsilon),
        }
    }

    #[inline(always)]
    fn step(&self, simd: S, p: &mut S::f32s, m: &mut S::f32s, v: &mut S::f32s, g: S::f32s) {
        *m = simd.mul_add_e_f32s(self.beta1, *m, simd.mul_f32s(self.rest1, g));
        let square = simd.mul_f32s(simd.mul_f32s(self.rest2, g), g);
        *v = simd.mul_add_e_f32s(self.beta2, *v, square);
        let root = simd.add_f32s(simd.sqrt_f32s(*v), self.epsilon);
        *p = simd.mul_add_e_f32s(self.step, simd.div_f32s(*m, root), *p);
    }
}
