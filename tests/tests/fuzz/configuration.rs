//! Configurations: files, and single keys as set by `--set` and environment variables.

use std::time::Duration;

use dmprl_shared::config::{ExperimentConfig, Layers, Limits, PRESETS, TASKS};
use dmprl_shared::policy::Policy;

use crate::mutate::{self, Random};
use crate::{Target, Verdict, fixture};

const LIMITS: Limits = Limits { cores: 2 };
/// Values that cause errors where a number, a word or a list is expected.
const VALUES: [&str; 25] = [
    "0",
    "1",
    "-1",
    "2.5",
    "1e308",
    "-1e308",
    "nan",
    "inf",
    "-inf",
    "true",
    "\"\"",
    "[]",
    "[0]",
    "[4, 4]",
    "{}",
    "{ a = 1 }",
    "first",
    "sac",
    "mlp",
    "chunk",
    "observed",
    "9223372036854775807",
    "[[[[1]]]]",
    "1979-05-27",
    "1\nrun.seed = 2",
];
const INTEGRATION_STEPS_MAX: usize = 2_000;
/// Deeper than any tree of keys.
const DEPTH_MAX: usize = 100_000;

fn value(random: &mut Random) -> String {
    match random.below(4) {
        0 => random.number().to_string(),
        1 => f64::from(random.float()).to_string(),
        _ => (*random.pick(&VALUES)).to_owned(),
    }
}

fn key(random: &mut Random, keys: &[String]) -> String {
    let mut key = random.pick(keys).clone();
    match random.below(12) {
        0 => drop(key.pop()),
        1 => key.push_str(".more"),
        2 => key = key.replace('.', ".."),
        3 if random.once_in(20) => key = "a.".repeat(random.below(DEPTH_MAX)),
        _ => {}
    }
    key
}

/// Text of a complete file with changes.
fn file(random: &mut Random, keys: &[String], whole: &str) -> String {
    match random.below(4) {
        0 => {
            let mut bytes = whole.as_bytes().to_vec();
            mutate::bytes(random, &mut bytes, whole.as_bytes());
            String::from_utf8_lossy(&bytes).into_owned()
        }
        1 if random.once_in(8) => "[".repeat(random.below(DEPTH_MAX)),
        2 if random.once_in(8) => format!("a={}", "{a=".repeat(random.below(DEPTH_MAX / 10))),
        _ => {
            let lines = (0..random.below(3)).map(|_| {
                let key = key(random, keys);
                format!("{key} = {}\n", value(random))
            });
            lines.collect()
        }
    }
}

#[test]
fn one_that_is_accepted_is_in_range_and_the_same_when_written_and_read() {
    let target = Target {
        name: "configuration::one_that_is_accepted_is_in_range_and_the_same_when_written_and_read",
        cases: 900,
        bytes_max: 64 << 20,
    };
    let keys = Layers::new().keys();
    let whole = toml::to_string(&ExperimentConfig::default()).unwrap();
    target.fuzz(|random| {
        let mut layers = Layers::new();
        layers.add("task", random.pick(&TASKS).table()).unwrap();
        layers.add("preset", random.pick(&PRESETS).table()).unwrap();
        let before = layers.clone().finish().unwrap();
        let text = file(random, &keys, &whole);
        let table = text.parse::<toml::Table>();
        let mut refused = match table {
            Ok(table) => layers.add("file", table).is_err(),
            Err(_) => true,
        };
        if refused {
            assert_eq!(layers.clone().finish().unwrap(), before, "a refused file changes nothing");
        }
        for _ in 0..random.below(3) {
            let before = layers.clone().finish().unwrap();
            if layers.set("--set", &key(random, &keys), &value(random)).is_err() {
                refused = true;
                assert_same(&layers.clone().finish().unwrap(), &before);
            }
        }
        let resolved = layers.finish().unwrap().resolve(LIMITS);
        if let Ok(config) = &resolved {
            assert_eq!(config.clone().resolve(LIMITS).as_ref(), Ok(config), "resolved for good");
            let text = toml::to_string(config).unwrap();
            assert_eq!(toml::from_str::<ExperimentConfig>(&text).as_ref(), Ok(config));
            use_as_a_run_does(config);
        }
        if refused { Verdict::Refused } else { Verdict::of(&resolved) }
    });
}

/// Numbers that a run turns into durations and sizes. Large ones are left out, because they take
/// long.
fn use_as_a_run_does(config: &ExperimentConfig) {
    for seconds in [config.actors.send_deadline_s, config.actors.env_call_timeout_s] {
        assert!(Duration::try_from_secs_f64(seconds).is_ok(), "{seconds}");
    }
    let mut config = config.clone();
    config.policy.hidden = vec![4];
    if config.dmp.integration_steps <= INTEGRATION_STEPS_MAX {
        // It may not fit the environment, which has four observations and two actions.
        let _ = Policy::new(config.policy_description(&fixture::spec()));
    }
}

/// Compares with NaN equal to itself; ranges reject NaN later.
fn assert_same(one: &ExperimentConfig, other: &ExperimentConfig) {
    assert_eq!(toml::to_string(one).unwrap(), toml::to_string(other).unwrap());
}
