//! Tests of the runtime with valid, invalid and missing observations.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::*;
use crate::policy::Hold;
use crate::seeds;
use crate::test_support::description;

const DIMS: usize = 2;
const STEPS: usize = 5;

fn spec() -> EnvSpec {
    EnvSpec {
        observation_names: ["cos", "sin", "speed", "force"].map(str::to_owned).to_vec(),
        ..EnvSpec::new("Test-v0", 4, &[(-1.0, 1.0), (1.0, 4.0)], 0.05, 50)
    }
}

fn policy(keys: &[(&str, &str)]) -> Policy {
    let keys = [&[("policy.hidden", "[32]"), ("policy.execution", "segment")], keys].concat();
    Policy::new(description(spec(), &keys)).unwrap()
}

/// Creates a runtime with scaled-up parameters, so that actions differ from step to step.
fn runtime(keys: &[(&str, &str)]) -> PolicyRuntime {
    let policy = policy(keys);
    let mut parameters = policy.initial_parameters(&mut seeds::stream(1, "test", 0));
    parameters.iter_mut().for_each(|value| *value *= 3.0);
    PolicyRuntime::new(policy, &parameters)
}

fn position(values: &[f64]) -> Hold {
    Hold::Position { values: values.to_vec() }
}

const CARRY: &[(&str, &str)] = &[("policy.start", "carry")];
const ACTION: &[(&str, &str)] = &[("policy.start", "action"), ("policy.controller", "direct")];

const ENSEMBLE: &[(&str, &str)] = &[("policy.execution", "ensemble")];

fn observation(seed: f64) -> [f64; 4] {
    std::array::from_fn(|i| (seed + i as f64).sin())
}

#[test]
fn segment_equals_the_policys_decision_in_the_environments_units() {
    for keys in [&[][..], &[("policy.kind", "mlp")], CARRY, ACTION, &[("algorithm", "sac")]] {
        let mut runtime = runtime(keys);
        let own = policy(keys);
        let mut parameters = own.initial_parameters(&mut seeds::stream(1, "test", 0));
        parameters.iter_mut().for_each(|value| *value *= 3.0);
        let mut work = own.workspace(1);
        let mut seen: Vec<f32> = observation(0.0).iter().map(|&value| value as f32).collect();
        seen.resize(own.layout().observation_len, 0.0);
        own.act(&parameters, &seen, &mut work);
        let mut expected = vec![0.0; own.layout().actions_len()];
        own.scaling().apply(&work.actions, &mut expected);
        let actions = runtime.segment(&observation(0.0)).unwrap();
        assert_eq!(actions.len(), expected.len());
        for (action, expected) in actions.iter().zip(&expected) {
            assert!((action - expected).abs() < 1e-6, "{keys:?}: {action} {expected}");
        }
    }
}

#[test]
fn actions_step_by_step_equal_the_segment() {
    for keys in [&[][..], CARRY, ACTION] {
        let (mut whole, mut stepwise) = (runtime(keys), runtime(keys));
        stepwise.safety_mut().set_hold(&position(&[0.0, 1.0])).unwrap();
        for decision in 0..3 {
            let first = observation(f64::from(decision));
            let segment = whole.segment(&first).unwrap().to_vec();
            for (k, expected) in segment.chunks(DIMS).enumerate() {
                // Observations within a segment have no effect.
                let now = if k == 0 { first } else { observation(100.0 + k as f64) };
                let action = stepwise.action((k != 2).then_some(&now)).unwrap();
                assert_eq!(action, expected, "{keys:?}, decision {decision}, step {k}");
            }
        }
    }
}

#[test]
fn ensemble_blends_the_segment_of_each_observation_with_its_plan() {
    for (ensemble, keys) in [(true, &[][..]), (true, CARRY), (false, &[("policy.kind", "mlp")])] {
        let mut runtime = runtime(&[keys, ENSEMBLE].concat());
        assert_eq!(runtime.is_ensemble, ensemble, "{keys:?}");
        let mut whole = self::runtime(keys);
        let (mut planned, mut u) = (Plan::new(whole.policy.layout()), [0.0; DIMS]);
        let mut expected = [0.0; DIMS];
        for step in 0..12 {
            let now = observation(f64::from(step));
            whole.state.copy_from_slice(&runtime.state);
            whole.segment(&now).unwrap();
            planned.add(&whole.work.actions);
            u.copy_from_slice(planned.take().unwrap());
            whole.policy.scaling().apply(&u, &mut expected);
            assert_eq!(runtime.action(Some(&now)).unwrap(), expected, "{keys:?}, step {step}");
        }
    }
}

#[test]
fn ensemble_follows_its_plan_without_observations_and_drops_it_after_a_hold() {
    let mut runtime = runtime(ENSEMBLE);
    runtime.safety_mut().set_hold(&position(&[0.5, 2.0])).unwrap();
    runtime.action(Some(&observation(1.0))).unwrap();
    let now = observation(2.0);
    runtime.action(Some(&now)).unwrap();
    let mut plan = runtime.plan.clone();
    let mut expected = [0.0; DIMS];
    for step in 1..STEPS {
        runtime.policy.scaling().apply(plan.take().unwrap(), &mut expected);
        assert_eq!(runtime.action(None).unwrap(), expected, "step {step}");
    }
    assert_eq!(runtime.action(None).unwrap(), [0.5, 2.0], "the plan has ended");
    let fresh = self::runtime(ENSEMBLE).action(Some(&now)).unwrap().to_vec();
    assert_eq!(runtime.action(Some(&now)).unwrap(), fresh);
    runtime.hold().unwrap();
    assert_eq!(runtime.action(Some(&now)).unwrap(), fresh, "the plan from before is dropped");
}

/// Segments start where the robot is: at the last action after limits, held ones included.
#[test]
fn state_of_the_commands_follows_the_actions_that_were_given() {
    let ensemble = [ACTION, ENSEMBLE].concat();
    for keys in [ACTION, &ensemble, &[("policy.start", "action"), ("policy.kind", "mlp")]] {
        let mut runtime = runtime(keys);
        runtime.safety_mut().set_hold(&position(&[0.0, 2.5])).unwrap();
        runtime.safety_mut().set_rate(&[0.05, 0.05]).unwrap();
        let (mut state, mut u) = (vec![0.0; 2 * DIMS], vec![0.0; DIMS]);
        for step in 0..40 {
            let now = observation(f64::from(step));
            // Observations are missing for a while.
            let action = runtime.action((!(10..20).contains(&step)).then_some(&now[..])).unwrap();
            let action = action.to_vec();
            runtime.policy.scaling().invert(&action, &mut u);
            runtime.policy.command_state().unwrap().follow(&u, &mut state);
            assert_eq!(runtime.state, state, "{keys:?}, step {step}");
        }
        runtime.reset(Some(&[0.25, -0.5])).unwrap();
        assert_eq!(runtime.state, [0.25, -0.5, 0.0, 0.0]);
    }
}

#[test]
fn invalid_observation_is_rejected_at_every_step_and_changes_nothing() {
    let (mut disturbed, mut reference) = (runtime(CARRY), runtime(CARRY));
    let invalid: [(&[f64], &str); 5] = [
        (&[0.0; 3], "has 3 numbers, expected 4"),
        (&[0.0; 5], "has 5 numbers, expected 4"),
        (&[0.0, f64::NAN, 0.0, 0.0], "observation[1], sin, is NaN"),
        (&[0.0, 0.0, f64::NEG_INFINITY, 0.0], "observation[2], speed, is -inf"),
        (&[0.0, 0.0, 0.0, 1e300], "observation[3], force, is 1"),
    ];
    for step in 0..12 {
        for (observation, message) in invalid {
            let error = disturbed.action(Some(observation)).unwrap_err().to_string();
            assert!(error.contains(message), "{error}");
            assert!(step % STEPS > 0 || disturbed.segment(observation).is_err());
        }
        let now = observation(f64::from(step as u32));
        let expected = reference.action(Some(&now)).unwrap();
        assert_eq!(disturbed.action(Some(&now)).unwrap(), expected, "step {step}");
    }
}

#[test]
fn actions_stay_within_bounds_for_any_observation() {
    let chunk = [("policy.kind", "chunk")];
    for keys in [&[][..], &[("policy.rho", "free")], CARRY, &[("policy.kind", "mlp")], &chunk] {
        let mut runtime = runtime(keys);
        for exponent in 0..39 {
            for sign in [-1.0, 1.0] {
                let scale = sign * 10_f64.powi(exponent);
                let large = observation(f64::from(exponent)).map(|value| scale * value);
                match runtime.segment(&large) {
                    Ok(actions) => {
                        for action in actions.chunks(DIMS) {
                            assert!((-1.0..=1.0).contains(&action[0]), "{action:?}");
                            assert!((1.0..=4.0).contains(&action[1]), "{action:?}");
                        }
                    }
                    // Sums of large numbers may be NaN.
                    Err(RuntimeError::Decision) => {}
                    Err(error) => panic!("{error}"),
                }
            }
        }
        // After a reset the runtime works normally.
        runtime.reset(None).unwrap();
        runtime.segment(&observation(1.0)).unwrap();
    }
}

#[test]
fn actions_obey_the_rate_limit() {
    let mut runtime = runtime(&[]);
    runtime.safety_mut().set_hold(&position(&[0.0, 1.0])).unwrap();
    for (rate, words) in [
        (&[0.1, 0.0][..], "the rate of action dimension 1 is 0: expected 0.0003"),
        (&[0.1], "the rate of action dimension 1 is missing"),
        (&[0.1, 0.1, 0.1], "dimension 2 is 0.1: expected 2 dimensions"),
        (&[f64::NAN, 0.1], "dimension 0 is NaN"),
        (&[0.0002, 0.1], "to reach the hold in 10000 control steps"),
    ] {
        let error = runtime.safety_mut().set_rate(rate).unwrap_err().to_string();
        assert!(error.contains(words), "{error}");
    }
    runtime.safety_mut().set_rate(&[0.1, f64::INFINITY]).unwrap();
    runtime.reset(None).unwrap();
    let mut before = runtime.safety().hold().unwrap().to_vec();
    let mut limited = 0;
    for step in 0..40 {
        let now = observation(f64::from(step / 10));
        let action = runtime.action(Some(&now)).unwrap();
        let change = (action[0] - before[0]).abs();
        assert!(change <= 0.1 + 1e-12, "{change}");
        limited += usize::from(change > 0.1 - 1e-12);
        before.copy_from_slice(action);
    }
    assert!(limited > 0, "the limit never applied, so this test checked nothing");
}

#[test]
fn robot_holds_when_observations_stop_and_continues_when_they_return() {
    let mut runtime = runtime(&[]);
    runtime.safety_mut().set_hold(&position(&[0.5, 2.0])).unwrap();
    runtime.safety_mut().set_hold_after(2).unwrap();
    runtime.safety_mut().set_rate(&[0.4, 10.0]).unwrap();
    let now = observation(0.0);
    runtime.action(Some(&now)).unwrap();
    for _ in 0..2 {
        runtime.action(None).unwrap();
        assert!(!runtime.is_holding(), "the segment continues for this many steps");
    }
    let mut actions = Vec::new();
    for _ in 0..10 {
        actions.push(runtime.action(None).unwrap().to_vec());
        assert!(runtime.is_holding());
    }
    assert_eq!(actions[9], [0.5, 2.0]);
    assert!(actions.windows(2).all(|pair| (pair[1][0] - pair[0][0]).abs() <= 0.4 + 1e-12));
    // The next observation starts a new segment instead of finishing the old one.
    runtime.safety_mut().set_rate(&[f64::INFINITY; DIMS]).unwrap();
    let expected = self::runtime(&[]).segment(&now).unwrap()[..DIMS].to_vec();
    assert_eq!(runtime.action(Some(&now)).unwrap(), expected);
    assert!(!runtime.is_holding());

    // A missing observation at a segment's first step leads to the hold.
    for _ in 1..STEPS {
        runtime.action(Some(&now)).unwrap();
    }
    assert_eq!(runtime.action(None).unwrap(), [0.5, 2.0]);
    assert!(runtime.is_holding());
}

#[test]
fn without_a_stated_hold_nothing_is_limited_and_nothing_holds() {
    let mut runtime = runtime(&[]);
    let now = observation(0.0);
    runtime.action(Some(&now)).unwrap();
    let before = runtime.action(Some(&now)).unwrap().to_vec();
    let refused = |result: Result<(), RuntimeError>| {
        let error = result.unwrap_err();
        assert!(matches!(error, RuntimeError::NoHold), "{error}");
        assert!(error.to_string().contains("dmprl export --hold"), "{error}");
    };
    refused(runtime.safety_mut().set_rate(&[0.1; DIMS]));
    refused(runtime.safety_mut().set_hold_after(1));
    refused(runtime.set_deadline(1.0, || 0.0));
    refused(runtime.hold().map(drop));
    refused(runtime.hold_until_reached(|_| Ok(())).map(drop));
    // The segment would have gone on, but the drive must not begin with an unknown hold.
    refused(runtime.action(None).map(drop));
    assert_eq!(runtime.previous, before, "no action is made up");

    let error = runtime.safety_mut().set_hold(&Hold::ZeroTorque).unwrap_err().to_string();
    assert_eq!(error, "the hold of action dimension 1 is 0: expected 1 to 4");
    refused(runtime.hold().map(drop));
    runtime.safety_mut().set_hold(&position(&[0.5, 2.0])).unwrap();
    assert_eq!(runtime.hold().unwrap(), [0.5, 2.0]);
}

/// One call of `hold` stops short of the hold if the rate is limited.
#[test]
fn last_command_is_the_hold_also_with_a_rate_limit() {
    let mut runtime = runtime(&[]);
    runtime.safety_mut().set_hold(&position(&[0.123, 3.9])).unwrap();
    runtime.safety_mut().set_rate(&[0.01, 0.03]).unwrap();
    runtime.reset(None).unwrap();
    for step in 0..50 {
        runtime.action(Some(&observation(f64::from(step)))).unwrap();
    }
    let mut before = runtime.previous.clone();
    assert_ne!(runtime.hold().unwrap(), [0.123, 3.9], "one call is not enough");
    let mut commands = vec![runtime.previous.clone()];
    let sent = runtime.hold_until_reached::<RuntimeError>(|action| {
        commands.push(action.to_vec());
        Ok(())
    });
    assert_eq!(sent.unwrap(), commands.len() - 1);
    assert_eq!(commands.last().unwrap(), &[0.123, 3.9], "exactly");
    for command in commands {
        let close = |d: usize, rate: f64| (command[d] - before[d]).abs() <= rate + 1e-12;
        assert!(close(0, 0.01) && close(1, 0.03), "{before:?} {command:?}");
        before = command;
    }
    // At the hold, and before any action, one command is enough; the robot gets it in any case.
    assert_eq!(runtime.hold_until_reached::<RuntimeError>(|_| Ok(())).unwrap(), 1);
    runtime.reset(None).unwrap();
    assert_eq!(runtime.hold_until_reached::<RuntimeError>(|_| Ok(())).unwrap(), 1);
}

#[test]
fn hold_is_reached_with_the_smallest_rate_and_a_broken_link_is_reported() {
    let mut runtime = runtime(&[]);
    runtime.safety_mut().set_hold(&position(&[-1.0, 1.0])).unwrap();
    let smallest = [2.0, 3.0].map(|range| range / (HOLD_STEPS_MAX - 1) as f64);
    runtime.action(Some(&observation(0.0))).unwrap();
    runtime.previous.copy_from_slice(&[1.0, 4.0]);
    runtime.safety_mut().set_rate(&smallest).unwrap();
    let sent = runtime.hold_until_reached::<RuntimeError>(|_| Ok(())).unwrap();
    assert!((HOLD_STEPS_MAX - 1..=HOLD_STEPS_MAX).contains(&sent), "{sent}");

    runtime.previous.copy_from_slice(&[1.0, 4.0]);
    let mut sent = 0;
    let error = runtime.hold_until_reached::<Box<dyn std::error::Error>>(|_| {
        sent += 1;
        if sent == 3 { Err("the link is down".into()) } else { Ok(()) }
    });
    assert_eq!((error.unwrap_err().to_string().as_str(), sent), ("the link is down", 3));
}

/// A frozen caller makes no calls, so counting calls does not notice it.
#[test]
fn caller_that_was_frozen_gets_the_hold_and_then_a_new_decision() {
    let now_ms = Arc::new(AtomicU64::new(0));
    let mut runtime = runtime(&[]);
    runtime.safety_mut().set_hold(&position(&[0.5, 2.0])).unwrap();
    let clock = Arc::clone(&now_ms);
    for limit_s in [0.0, -1.0, f64::NAN] {
        let error = runtime.set_deadline(limit_s, || 0.0).unwrap_err().to_string();
        assert!(error.contains("expected a positive number"), "{error}");
    }
    runtime.set_deadline(0.2, move || clock.load(Ordering::Relaxed) as f64 * 1e-3).unwrap();
    runtime.reset(None).unwrap();
    let now = observation(0.0);
    let own = self::runtime(&[]).segment(&now).unwrap().to_vec();
    for action in own.chunks(DIMS).take(2) {
        now_ms.fetch_add(200, Ordering::Relaxed);
        assert_eq!(runtime.action(Some(&now)).unwrap(), action, "200 ms are in time");
        assert!(!runtime.is_holding());
    }
    for frozen in [None, Some(&now[..])] {
        now_ms.fetch_add(201, Ordering::Relaxed);
        assert_eq!(runtime.action(frozen).unwrap(), [0.5, 2.0], "{frozen:?}");
        assert!(runtime.is_holding());
    }
    now_ms.fetch_add(300, Ordering::Relaxed);
    assert!(runtime.action(Some(&[f64::NAN; 4])).is_err(), "at every step");
    assert_eq!(runtime.hold().unwrap(), [0.5, 2.0]);
    // The next call in time decides anew instead of finishing the old segment.
    now_ms.fetch_add(1, Ordering::Relaxed);
    assert_eq!(runtime.action(Some(&now)).unwrap(), &own[..DIMS]);
    assert!(!runtime.is_holding());
    // A clock that goes backwards measures nothing.
    now_ms.fetch_sub(1, Ordering::Relaxed);
    assert_eq!(runtime.action(Some(&now)).unwrap(), [0.5, 2.0]);
    // Between episodes, and for whole segments, no time is measured.
    now_ms.fetch_add(10_000, Ordering::Relaxed);
    runtime.reset(None).unwrap();
    assert_eq!(runtime.action(Some(&now)).unwrap(), &own[..DIMS]);
    now_ms.fetch_add(10_000, Ordering::Relaxed);
    assert_eq!(runtime.segment(&now).unwrap(), own);
}

#[test]
fn only_a_policy_whose_segments_continue_accepts_y0() {
    let error = runtime(&[]).reset(Some(&[0.0; DIMS])).unwrap_err().to_string();
    assert!(error.contains("do not start where"), "{error}");
    let mut carrying = runtime(CARRY);
    let at_rest = carrying.segment(&observation(0.0)).unwrap().to_vec();
    carrying.reset(Some(&[0.5, -0.5])).unwrap();
    assert_ne!(carrying.segment(&observation(0.0)).unwrap(), at_rest);
    carrying.reset(None).unwrap();
    assert_eq!(carrying.segment(&observation(0.0)).unwrap(), at_rest);
    for y0 in [&[0.0][..], &[0.0, f32::NAN]] {
        let error = carrying.reset(Some(y0)).unwrap_err().to_string();
        assert!(error.contains("expected 2 finite numbers"), "{error}");
    }
}

#[test]
fn hold_after_errors_obeys_the_rate_limit() {
    let mut runtime = runtime(&[]);
    runtime.safety_mut().set_hold(&position(&[0.5, 2.0])).unwrap();
    runtime.safety_mut().set_rate(&[0.05, 0.05]).unwrap();
    runtime.reset(None).unwrap();
    let invalid = [f64::NAN; 4];
    let mut before = runtime.safety().hold().unwrap().to_vec();
    let (mut held, mut acted) = (0, 0);
    for step in 0..120 {
        // Twenty valid observations, then twenty invalid ones, and so on.
        let now = if step / 20 % 2 == 0 { observation(f64::from(step)) } else { invalid };
        let action = match runtime.action(Some(&now)) {
            Ok(action) => {
                acted += 1;
                action.to_vec()
            }
            Err(_) => {
                held += 1;
                runtime.hold().unwrap().to_vec()
            }
        };
        for (now, before) in action.iter().zip(&before) {
            assert!((now - before).abs() <= 0.05 + 1e-12, "step {step}: {before} to {now}");
        }
        assert_eq!(runtime.is_holding(), now[0].is_nan());
        before = action;
    }
    assert_eq!((held, acted), (60, 60));
    for (held, wanted) in before.iter().zip([0.5, 2.0]) {
        assert!((held - wanted).abs() < 1e-9, "the hold is reached in 20 steps: {held}");
    }
}
