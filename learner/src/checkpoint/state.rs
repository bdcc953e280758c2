//! Reads and checks `state.json`. Nothing in it is trusted.

use super::{FORMAT_VERSION, State};

/// Larger counts are rejected. Additions to smaller ones cannot overflow.
const COUNT_MAX: u64 = 1 << 62;
/// Larger numbers of updates are rejected, because the learner would never take a segment again.
const UPDATES_OWED_MAX: f64 = 4e9;

/// Reads `state.json` of this or an earlier format version.
pub(super) fn read(text: &[u8]) -> Result<State, String> {
    let mut state: serde_json::Map<String, serde_json::Value> =
        serde_json::from_slice(text).map_err(|error| error.to_string())?;
    let version = state.get("format_version").and_then(serde_json::Value::as_u64);
    match version {
        // Version 2 has no CRC-32 of the state.
        Some(2) => {}
        Some(version) if version == u64::from(FORMAT_VERSION) => {}
        // Version 1 has only DDPG, with one field for each of its two optimisers.
        Some(1) => {
            let mut steps = serde_json::Map::new();
            for name in ["actor", "critic"] {
                if let Some(step) = state.remove(&format!("{name}_adam_step")) {
                    steps.insert(name.to_owned(), step);
                }
            }
            state.insert("adam_steps".into(), steps.into());
        }
        _ => {
            let got = version.map_or("none".into(), |version| version.to_string());
            return Err(format!("format version {got}, this build reads 1 to {FORMAT_VERSION}"));
        }
    }
    let mut state: State =
        serde_json::from_value(state.into()).map_err(|error| error.to_string())?;
    check(&mut state)?;
    Ok(state)
}

/// Rejects a state that is damaged or impossible.
fn check(state: &mut State) -> Result<(), String> {
    let expected = state.crc32;
    let got = sum(state).map_err(|error| error.to_string())?;
    // Earlier formats may lack the CRC-32, but it must be correct if present.
    let is_required = state.format_version == FORMAT_VERSION || expected.is_some();
    if is_required && expected != Some(got) {
        let expected = expected.map_or("one".into(), |expected| expected.to_string());
        return Err(format!("CRC-32 is {got}, expected {expected}"));
    }
    let counters = serde_json::to_value(state.counters).map_err(|error| error.to_string())?;
    if let Some(count) = largest(&counters).filter(|&count| count > COUNT_MAX) {
        return Err(format!("a counter is {count}, expected at most {COUNT_MAX}"));
    }
    if let Some((name, step)) = state.adam_steps.iter().find(|(_, step)| step.0 > COUNT_MAX) {
        return Err(format!(
            "optimiser steps of {name} are {}, expected at most {COUNT_MAX}",
            step.0
        ));
    }
    let owed = state.updates_owed;
    if !(0.0..=UPDATES_OWED_MAX).contains(&owed) {
        return Err(format!("updates_owed is {owed}, expected 0 to {UPDATES_OWED_MAX}"));
    }
    Ok(())
}

/// Returns the largest count in a tree of counts.
fn largest(counters: &serde_json::Value) -> Option<u64> {
    match counters {
        serde_json::Value::Object(fields) => fields.values().filter_map(largest).max(),
        number => number.as_u64(),
    }
}

/// Returns the CRC-32 of the state without its field `crc32`, which is cleared.
pub(super) fn sum(state: &mut State) -> serde_json::Result<u32> {
    state.crc32 = None;
    Ok(crc32fast::hash(&serde_json::to_vec(state)?))
}
