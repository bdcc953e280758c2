//! One training by `dmprl train`.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use dmprl_run::Watch;
use dmprl_shared::config::ExperimentConfig;
use dmprl_supervisor::WholeRun;
use serde::Deserialize;

use super::{Target, Training, limit};

/// Interval between checks for the exit. It counts as time of the training.
const CHECK_INTERVAL: Duration = Duration::from_millis(5);

#[derive(Debug, Deserialize)]
struct Evaluated {
    env_steps: u64,
    return_mean: f64,
    success_rate: Option<f64>,
}

#[derive(Debug, Deserialize)]
struct FirstStep {
    event: String,
    after_s: f64,
}

/// Trains in the new folder `place`.
pub(super) fn train(
    program: &Path,
    config: &ExperimentConfig,
    place: &Path,
    watch: &Watch,
) -> anyhow::Result<Training> {
    std::fs::create_dir(place).with_context(|| format!("cannot make {}", place.display()))?;
    let (file, run, log) = (place.join("config.toml"), place.join("run"), place.join("log"));
    let text = toml::to_string(config).context("cannot write the configuration as TOML")?;
    std::fs::write(&file, text).with_context(|| format!("cannot write {}", file.display()))?;
    let mut command = Command::new(program);
    command.arg("train").arg(&config.task.name).arg("--config").arg(&file);
    command.arg("--run-dir").arg(&run).args(["--no-progress", "--events", "json"]);
    let started = Instant::now();
    let mut train = WholeRun::start(command, &log)?;
    let waited = wait(&mut train, started + limit(config), watch);
    let seconds = started.elapsed().as_secs_f64();
    if let Err(error) = waited {
        if train.end()?.is_none() {
            train.stop()?;
        }
        return Err(error);
    }
    training(Target::of(config), seconds, &run, &log)
}

/// Waits until the run has ended successfully.
fn wait(train: &mut WholeRun, deadline: Instant, watch: &Watch) -> anyhow::Result<()> {
    loop {
        watch.check()?;
        match train.outcome()? {
            Some(Ok(())) => return Ok(()),
            Some(Err(how)) => bail!("dmprl train failed: {how}"),
            None if Instant::now() >= deadline => {
                bail!("dmprl train did not end within its time limit (--max-minutes)")
            }
            None => std::thread::sleep(CHECK_INTERVAL),
        }
    }
}

/// Reads the result from the run directory `run` and the events in `log`.
fn training(target: Target, seconds: f64, run: &Path, log: &Path) -> anyhow::Result<Training> {
    let rows = std::fs::read_to_string(run.join("evaluations.jsonl")).unwrap_or_default();
    let last: Option<Evaluated> = match rows.lines().last() {
        Some(line) => Some(serde_json::from_str(line).context("evaluations.jsonl")?),
        None => None,
    };
    let events =
        std::fs::read_to_string(log).with_context(|| format!("cannot read {}", log.display()))?;
    let first = events
        .lines()
        .filter_map(|line| serde_json::from_str::<FirstStep>(line).ok())
        .find(|event| event.event == "first_step");
    let value = last.as_ref().and_then(|row| match target.is_success {
        true => row.success_rate,
        false => Some(row.return_mean),
    });
    Ok(Training {
        reached: value.is_some_and(|value| value >= target.value),
        seconds,
        start_s: first.map_or(0.0, |event| event.after_s),
        evaluation_s: 0.0,
        env_steps: last.map_or(0, |row| row.env_steps),
        value,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn result_is_the_last_evaluation_and_the_event_of_the_first_step() {
        let folder = tempfile::tempdir().unwrap();
        let log = folder.path().join("log");
        let rows = "{\"env_steps\":5000,\"return_mean\":-9.0,\"success_rate\":0.5}\n\
                    {\"env_steps\":9000,\"return_mean\":-5.0,\"success_rate\":null}\n";
        std::fs::write(folder.path().join("evaluations.jsonl"), rows).unwrap();
        std::fs::write(&log, "{\"event\":\"first_step\",\"after_s\":0.5}\nnoise\n").unwrap();
        let read = |target| training(target, 7.0, folder.path(), &log).unwrap();
        let by_return = read(Target { is_success: false, value: -5.2 });
        assert_eq!((by_return.reached, by_return.env_steps), (true, 9000));
        assert_eq!((by_return.start_s, by_return.value), (0.5, Some(-5.0)));
        // The environment reports no success.
        let by_success = read(Target { is_success: true, value: 0.1 });
        assert_eq!((by_success.reached, by_success.value), (false, None));
    }
}
