//! Draws the settings of a simulated session from its seed.

use std::time::Duration;

use dmprl_run::RunDirectory;
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::seeds::Stream;
use rand::RngExt;

use super::fakes::spec;
use crate::limits::TimeLimits;
use crate::process::Process;
use crate::state::Settings;
use crate::totals::Totals;

/// Failures of environments in earlier sessions.
pub const EARLIER_FAILURES: u64 = 7;

/// Draws the settings of a session.
pub fn settings(random: &mut Stream, run: &RunDirectory) -> Settings {
    let mut config = ExperimentConfig::default();
    let (one_process, host) = match random.random_range(0..10) {
        0 => (true, false),
        1 => (false, true),
        _ => (false, false),
    };
    config.actors.workers = if one_process { 1 } else { random.random_range(1..4) };
    config.actors.joined_max = random.random_range(0..3);
    config.actors.restarts_max = random.random_range(0..4);
    config.supervision.learner_restarts_max = random.random_range(0..4);
    if random.random_range(0..4) == 0 {
        config.run.until_return = f64::from(random.random_range(1_u32..40));
    }
    if random.random_range(0..4) == 0 {
        config.run.max_minutes = random.random_range(0.1..3.0);
    }
    if random.random_range(0..3) == 0 && !host {
        config.bridge.listen = vec!["tls/0.0.0.0:7447".to_owned()];
    }
    Settings {
        config,
        limits: TimeLimits::default(),
        hub: if host { Process::Relay } else { Process::Learner },
        one_process,
        patience: host.then(|| Duration::from_secs(60)),
        run: run.clone(),
        earlier: Totals { env_failures: EARLIER_FAILURES, ..Totals::default() },
        spec: (random.random_range(0..2) == 0).then(spec),
    }
}
