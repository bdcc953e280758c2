//! Hash of a policy's architecture. With equal hashes, equal parameters and observations give equal
//! actions.

use super::PolicyDescription;
use crate::config::{AlgorithmName, Controller, PolicyKind, Start, StartSource};
use crate::seeds;

/// Version of the hashed list. A new version makes all stored snapshots, policy files and
/// checkpoints invalid.
const VERSION: u32 = 1;

/// Hashes an explicit list of the values that determine the policy's actions. Keys that are added
/// later, or that this kind of policy does not use, do not change the hash of stored policies.
pub(super) fn hash(description: &PolicyDescription) -> u64 {
    let PolicyDescription { spec, algorithm, policy, .. } = description;
    let mut list = format!(
        "{VERSION} {} {} {} {:?} {:?} {:?}",
        spec.id,
        spec.observation_len,
        spec.action_len,
        spec.action_low,
        spec.action_high,
        policy.hidden,
    );
    // The same id with other arguments is another environment.
    if let Some(options) = &description.task_options {
        list.push_str(&format!(" task {options}"));
    }
    if policy.action_range != 1.0 {
        list.push_str(&format!(" range {:?}", policy.action_range));
    }
    match policy.kind {
        PolicyKind::Mlp => list.push_str(" mlp"),
        PolicyKind::Chunk => list.push_str(&format!(" chunk {}", policy.segment_steps)),
        PolicyKind::Dmp => list.push_str(&dmp(description)),
    }
    if policy.follows_actions() {
        list.push_str(" follows actions");
    }
    if algorithm.has_gaussian_policy() {
        list.push_str(" squashed gaussian");
    }
    if *algorithm == AlgorithmName::Ndp {
        list.push_str(" learned std");
    }
    seeds::derive(0, &list, 0)
}

fn dmp(description: &PolicyDescription) -> String {
    let PolicyDescription { spec, policy, dmp, start_sources, .. } = description;
    let mut list = format!(
        " dmp {} {} {:?} {:?} {} {:?} {:?} {:?} {:?} {:?} {:?} {:?} {:?} {:?} {:?}",
        policy.segment_steps,
        dmp.basis_count,
        dmp.alpha_x,
        dmp.alpha_y,
        dmp.integration_steps,
        dmp.integrator,
        dmp.canonical,
        dmp.widths,
        dmp.forcing_scaling,
        policy.goal_range,
        policy.weight_range,
        policy.rho,
        policy.rho_range,
        policy.start,
        policy.start_velocity,
    );
    match policy.controller {
        Controller::Inverse => {}
        Controller::Position => list.push_str(&format!(" position {:?}", policy.position_scale)),
        Controller::Direct => list.push_str(" direct"),
    }
    if policy.start == Start::Observed {
        list.push_str(&format!(" {:?}", spec.control_dt_s));
        for source in start_sources {
            list.push_str(&match source {
                StartSource::Angle { cos, sin, velocity } => {
                    format!(" angle {cos} {sin} {velocity}")
                }
                StartSource::Value { index, velocity, scale } => {
                    format!(" value {index} {velocity} {scale:?}")
                }
            });
        }
    }
    list
}
