//! Controllers, which compute a segment's actions from its samples, one action dimension at a time.
//!
//! There are two: the paper's adaptive inverse controller (section 3.2), a single tanh neuron whose
//! weights rho are outputs of the policy, and the position controller of Neural Dynamic Policies.
//! Neither allocates.

/// Computes the output of the adaptive inverse controller, before its tanh.
///     v_k = rho_1 y_k + rho_2 yd_k / omega + rho_3 ydd_k / omega^2 + rho_4,     u_k = tanh(v_k)
/// Differs from the paper: velocity and acceleration are divided by omega and omega^2, because at
/// alpha_y = 25 the acceleration is about 150 times the position and would saturate the tanh.
/// - `samples`: (3K,) from `SegmentMap::forward`. `values`: v, (K,), overwritten.
/// # Panics
/// If `samples` is not three times as long as `values`.
pub fn act(samples: &[f32], rho: &[f32; 4], values: &mut [f32]) {
    let [y, yd, ydd] = kinds(samples, values.len());
    for (k, value) in values.iter_mut().enumerate() {
        *value = rho[0] * y[k] + rho[1] * yd[k] + rho[2] * ydd[k] + rho[3];
    }
}

/// Computes the gradients of [`act`]. Returns the gradient with respect to rho.
/// - `values_gradient`: with respect to v, (K,). `samples_gradient`: (3K,), overwritten.
/// # Panics
/// If a length is wrong.
pub fn act_backward(
    samples: &[f32],
    rho: &[f32; 4],
    values_gradient: &[f32],
    samples_gradient: &mut [f32],
) -> [f32; 4] {
    let k_count = values_gradient.len();
    let [y, yd, ydd] = kinds(samples, k_count);
    assert_eq!(samples_gradient.len(), 3 * k_count, "one gradient per sample");
    let mut rho_gradient = [0.0; 4];
    for (k, gradient) in values_gradient.iter().enumerate() {
        for (kind, value) in [y[k], yd[k], ydd[k]].into_iter().enumerate() {
            samples_gradient[kind * k_count + k] = gradient * rho[kind];
            rho_gradient[kind] += gradient * value;
        }
        rho_gradient[3] += gradient;
    }
    rho_gradient
}

/// Computes a segment's actions with the position controller (Neural Dynamic Policies).
///     u_k = position_scale (y_k - y_{k-1}),     y_0 the start
/// The actions are unbounded; the caller clips them.
/// - `samples`: (3K,), of which only the positions are read. `actions`: (K,), overwritten.
/// # Panics
/// If `samples` is not three times as long as `actions`.
pub fn act_position(y0: f32, samples: &[f32], position_scale: f32, actions: &mut [f32]) {
    let [y, ..] = kinds(samples, actions.len());
    let mut previous = y0;
    for (action, &y) in actions.iter_mut().zip(y) {
        *action = position_scale * (y - previous);
        previous = y;
    }
}

/// Computes the gradients of [`act_position`]. Returns the gradient with respect to its argument
/// `y0`, on which the samples depend as well.
/// - `actions_gradient`: (K,). `samples_gradient`: (3K,), overwritten.
/// # Panics
/// If `samples_gradient` is not three times as long as `actions_gradient`.
pub fn act_position_backward(
    position_scale: f32,
    actions_gradient: &[f32],
    samples_gradient: &mut [f32],
) -> f32 {
    let k_count = actions_gradient.len();
    assert_eq!(samples_gradient.len(), 3 * k_count, "one gradient per sample");
    samples_gradient.fill(0.0);
    for k in 0..k_count {
        let next = actions_gradient.get(k + 1).copied().unwrap_or(0.0);
        samples_gradient[k] = position_scale * (actions_gradient[k] - next);
    }
    -position_scale * actions_gradient.first().copied().unwrap_or(0.0)
}

/// Splits samples into positions, velocities and accelerations, (K,) each.
fn kinds(samples: &[f32], k_count: usize) -> [&[f32]; 3] {
    assert_eq!(samples.len(), 3 * k_count, "3K samples for K actions");
    [&samples[..k_count], &samples[k_count..2 * k_count], &samples[2 * k_count..]]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rho_weighs_position_velocity_acceleration_and_bias() {
        let samples = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6];
        let mut values = [0.0; 2];
        act(&samples, &[1.0, -2.0, 0.5, 0.25], &mut values);
        // 0.1 - 2 * 0.3 + 0.5 * 0.5 + 0.25 = 0;  0.2 - 2 * 0.4 + 0.5 * 0.6 + 0.25 = -0.05.
        assert!(values[0].abs() < 1e-7);
        assert!((values[1] + 0.05).abs() < 1e-7);
    }

    #[test]
    fn position_controller_takes_successive_differences() {
        let samples = [0.3, 0.1, 0.6, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0];
        let mut actions = [0.0; 3];
        act_position(0.1, &samples, 10.0, &mut actions);
        for (got, expected) in actions.iter().zip([2.0, -2.0, 5.0]) {
            assert!((got - expected).abs() < 1e-6);
        }
        // u = 10 (y1 - y0, y2 - y1, y3 - y2), so d(u . (1, 2, 4)) / d(y0, y1, y2, y3) is
        // (-10, -10, -20, 40).
        let mut gradient = [7.0; 9];
        assert_eq!(act_position_backward(10.0, &[1.0, 2.0, 4.0], &mut gradient), -10.0);
        assert_eq!(gradient, [-10.0, -20.0, 40.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    }
}
