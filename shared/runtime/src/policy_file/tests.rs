//! Tests of policy files: round trips, damage, and files of other policies.

use super::*;
use crate::spec::EnvSpec;
use crate::test_support::description;

fn spec() -> EnvSpec {
    EnvSpec::new("Test-v0", 4, &[(-1.0, 1.0), (0.0, 3.0)], 0.1, 50)
}

fn policy(keys: &[(&str, &str)]) -> Policy {
    Policy::new(description(spec(), keys)).unwrap()
}

#[test]
fn stochastic_policy_keeps_its_standard_deviations() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("1.safetensors");
    let own = policy(&[("algorithm", "ndp")]);
    let mut values = own.initial_parameters(&mut crate::seeds::stream(1, "test", 0));
    values[own.shape().parameters_len()..].fill(-0.5);
    let snapshot = ParameterSnapshot {
        version: 1,
        env_steps: 0,
        architecture_hash: own.architecture_hash(),
        settled: false,
        values,
    };
    fs::write(&path, encode(&own, &snapshot, None, None).unwrap()).unwrap();
    let read = load(&path, &own, Match::Architecture).unwrap();
    assert_eq!(read, snapshot);
    assert_eq!(own.learned_std().unwrap().log_std(&read.values), [-0.5; 2]);
    assert_eq!(read.values.len(), own.shape().parameters_len() + 2);
}

#[test]
fn policy_survives_a_round_trip_and_other_or_corrupted_files_are_rejected() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("7.safetensors");
    let own = policy(&[]);
    let mut random = crate::seeds::stream(1, "test", 0);
    let snapshot = ParameterSnapshot {
        version: 7,
        env_steps: 100,
        architecture_hash: own.architecture_hash(),
        settled: false,
        values: own.initial_parameters(&mut random),
    };
    fs::write(&path, encode(&own, &snapshot, None, None).unwrap()).unwrap();
    assert_eq!(load(&path, &own, Match::Architecture).unwrap(), snapshot);

    let other = policy(&[("dmp.alpha_y", "8.0")]);
    let error = load(&path, &other, Match::Architecture).unwrap_err().to_string();
    assert!(error.contains("architecture_hash"), "{error}");
    assert_eq!(load(&path, &other, Match::Sizes).unwrap().values, snapshot.values);
    let wider = policy(&[("policy.hidden", "[256, 128]")]);
    let error = load(&path, &wider, Match::Sizes).unwrap_err().to_string();
    assert!(error.contains("actor.1.weight") && error.contains("[128, 256]"), "{error}");
    let slower = policy(&[("policy.action_range", "0.5")]);
    let error = load(&path, &slower, Match::Sizes).unwrap_err().to_string();
    assert!(error.contains("0.5, as in this run (or --set policy.action_range=1)"), "{error}");

    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let error = load(&path, &own, Match::Architecture).unwrap_err().to_string();
    assert!(error.contains("not a readable safetensors file"), "{error}");
}

fn saved(keys: &[(&str, &str)], path: &Path) -> (Policy, ParameterSnapshot, Origin) {
    let own = policy(keys);
    let mut random = crate::seeds::stream(1, "test", 0);
    let snapshot = ParameterSnapshot {
        version: 3,
        env_steps: 100,
        architecture_hash: own.architecture_hash(),
        settled: false,
        values: own.initial_parameters(&mut random),
    };
    let origin = Origin {
        run_id: "00000000000000ab".into(),
        task: "test".into(),
        seed: 1,
        dmprl_version: "0.1.0".into(),
        git_commit: None,
        return_mean: Some(-4.25),
        success_rate: None,
    };
    fs::write(path, encode(&own, &snapshot, Some(&origin), None).unwrap()).unwrap();
    (own, snapshot, origin)
}

#[test]
fn equal_policies_have_equal_files() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mine.safetensors");
    // In random order, the fields of ten files would hardly ever be in the same one.
    let files: Vec<Vec<u8>> = (0..10)
        .map(|_| {
            saved(&[], &path);
            fs::read(&path).unwrap()
        })
        .collect();
    assert!(files.iter().all(|file| *file == files[0]));
}

#[test]
fn policy_is_restored_from_the_file_alone() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mine.safetensors");
    let sources = r#"[{ "cos": 0, "sin": 1, "velocity": 2 }, { "index": 3, "velocity": 2 }]"#;
    for keys in [
        &[][..],
        &[("policy.kind", "mlp"), ("algorithm", "sac")],
        &[("policy.kind", "chunk")],
        &[("algorithm", "ndp"), ("policy.controller", "position")],
        &[("policy.start", "carry"), ("dmp.alpha_y", "12.5"), ("policy.rho", "free")],
        &[("policy.start", "observed"), ("start_sources", sources)],
        &[("policy.start", "action"), ("policy.controller", "direct")],
        &[("task_options", "{} [\"module:name\"]")],
    ] {
        let (own, snapshot, origin) = saved(keys, &path);
        let opened = open(&path).unwrap();
        assert_eq!(opened.policy.architecture_hash(), own.architecture_hash(), "{keys:?}");
        assert_eq!(opened.policy.description(), own.description());
        assert_eq!((opened.snapshot, opened.origin), (snapshot, Some(origin)));
    }
}

#[test]
fn missing_or_invalid_description_is_rejected() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mine.safetensors");
    let error_after_replacing = |from: &str, to: &str| {
        saved(&[], &path);
        let mut bytes = fs::read(&path).unwrap();
        let at = bytes.windows(from.len()).position(|part| part == from.as_bytes()).unwrap();
        // The header's length must not change.
        bytes[at..at + from.len()].copy_from_slice(format!("{to:<0$}", from.len()).as_bytes());
        fs::write(&path, bytes).unwrap();
        open(&path).unwrap_err().to_string()
    };
    let error = error_after_replacing("\"description\":", "\"descripti--\":");
    assert!(error.contains("description is missing") && error.contains("dmprl export"));
    let hidden = "\\\"hidden\\\":[256,256]";
    let error = error_after_replacing(hidden, &hidden.replace("256,256", "0,99999"));
    assert!(error.contains("policy.hidden"), "{error}");
    let error = error_after_replacing(hidden, &hidden.replace("256,256", "256,255"));
    assert!(error.contains("architecture_hash"), "{error}");
    // The same parameters, but a different function.
    let range = "\\\"goal_range\\\":1.0";
    let error = error_after_replacing(range, &range.replace("1.0", "2.0"));
    assert!(error.contains("architecture_hash"), "{error}");
    let dims = "\\\"action_len\\\":2";
    let error = error_after_replacing(dims, &dims.replace('2', "9"));
    assert!(error.contains("action_low has 2 entries, expected 9"), "{error}");
    // A flipped bit that leaves a valid number.
    saved(&[], &path);
    let mut bytes = fs::read(&path).unwrap();
    let last = bytes.len() - 1;
    bytes[last] ^= 1;
    fs::write(&path, bytes).unwrap();
    let error = open(&path).unwrap_err().to_string();
    assert!(error.contains("checksum"), "{error}");
}

#[test]
fn hold_is_restored_and_damage_to_it_is_noticed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("held.safetensors");
    let (own, snapshot, _) = saved(&[], &path);
    assert_eq!(open(&path).unwrap().hold, None, "none is assumed");
    let write = |hold: &Hold| fs::write(&path, encode(&own, &snapshot, None, Some(hold)).unwrap());
    for hold in [Hold::ZeroVelocity, Hold::ZeroTorque, Hold::Position { values: vec![0.5, 2.5] }] {
        write(&hold).unwrap();
        assert_eq!(open(&path).unwrap().hold, Some(hold));
    }
    let whole = fs::read(&path).unwrap();
    for (from, to, message) in [
        ("[0.5,2.5]", "[0.5,1.5]", "checksum"),
        // A program without holds would ignore the key, so the format must not say the former one.
        ("dmprl-policy-2", "dmprl-policy-1", "format"),
        ("\"hold\"", "\"hald\"", "format"),
    ] {
        let mut bytes = whole.clone();
        let at = bytes.windows(from.len()).position(|part| part == from.as_bytes()).unwrap();
        bytes[at..at + to.len()].copy_from_slice(to.as_bytes());
        fs::write(&path, bytes).unwrap();
        let error = open(&path).unwrap_err().to_string();
        assert!(error.contains(message), "{error}");
    }
    write(&Hold::Position { values: vec![0.5, 9.0] }).unwrap();
    let error = open(&path).unwrap_err().to_string();
    assert!(error.contains("the hold of action dimension 1 is 9: expected 0 to 3"), "{error}");
}
