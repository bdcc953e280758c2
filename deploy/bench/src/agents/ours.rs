//! One training by `dmprl train`.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use dmprl_run::Watch;
use dmprl_shared::config::ExperimentConfig;
use dmprl_supervisor::WholeRun;
use serde::Deserialize;

use super::{Evaluated, Target, Training, limit};

/// Interval between checks for the exit. It counts as time of the training.
const CHECK_INTERVAL: Duration = Duration::from_millis(5);

/// A row of `evaluations.jsonl`.
#[derive(Debug, Deserialize)]
struct Row {
    env_steps: u64,
    #[serde(flatten)]
    evaluated: Evaluated,
}

/// Notices the first environment step in the run's events.
struct FirstStep<'a> {
    log: &'a Path,
    started: Instant,
    /// Time since the start of the process.
    after: Option<Duration>,
}

impl FirstStep<'_> {
    fn look(&mut self) {
        if self.after.is_none() {
            let events = std::fs::read_to_string(self.log).unwrap_or_default();
            let happened = events.contains("\"event\":\"first_step\"");
            self.after = happened.then(|| self.started.elapsed());
        }
    }
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
    let mut first_step = FirstStep { log: &log, started, after: None };
    let waited = wait(&mut train, started + limit(config), watch, &mut first_step);
    let seconds = started.elapsed().as_secs_f64();
    if let Err(error) = waited {
        if train.end()?.is_none() {
            train.stop()?;
        }
        return Err(error);
    }
    training(Target::of(config), seconds, first_step.after, &run)
}

/// Waits until the run has ended successfully.
fn wait(
    train: &mut WholeRun,
    deadline: Instant,
    watch: &Watch,
    first_step: &mut FirstStep<'_>,
) -> anyhow::Result<()> {
    loop {
        watch.check()?;
        first_step.look();
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

/// Reads the result from the run directory `run`. It is the first evaluation that reached the
/// target, since further ones may follow, otherwise the last one.
fn training(
    target: Target,
    seconds: f64,
    start: Option<Duration>,
    run: &Path,
) -> anyhow::Result<Training> {
    let rows = std::fs::read_to_string(run.join("evaluations.jsonl")).unwrap_or_default();
    let rows = rows.lines().map(serde_json::from_str).collect::<Result<Vec<Row>, _>>();
    let rows = rows.context("evaluations.jsonl")?;
    let first = rows.iter().find(|row| target.is_reached(&row.evaluated));
    let row = first.or(rows.last());
    Ok(Training {
        reached: first.is_some(),
        seconds,
        start_s: start.map(|start| start.as_secs_f64()),
        evaluation_s: 0.0,
        env_steps: row.map_or(0, |row| row.env_steps),
        evaluated: row.map(|row| row.evaluated),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn result_is_the_first_evaluation_that_reached_the_target_or_the_last_one() {
        let folder = tempfile::tempdir().unwrap();
        let rows = "{\"env_steps\":5000,\"return_mean\":-9.0,\"success_rate\":null}\n\
                    {\"env_steps\":9000,\"return_mean\":-5.0,\"success_rate\":null}\n\
                    {\"env_steps\":9500,\"return_mean\":-6.0,\"success_rate\":null}\n";
        std::fs::write(folder.path().join("evaluations.jsonl"), rows).unwrap();
        let read = |target| training(target, 7.0, None, folder.path()).unwrap();
        let evaluated = |return_mean| Some(Evaluated { return_mean, success_rate: None });
        let result = |it: Training| (it.reached, it.env_steps, it.evaluated);
        assert_eq!(result(read(Target::Return(-5.2))), (true, 9000, evaluated(-5.0)));
        assert_eq!(result(read(Target::Return(-4.0))), (false, 9500, evaluated(-6.0)));
        assert_eq!(result(read(Target::None)), (false, 9500, evaluated(-6.0)));
        // The environment reports no success.
        assert!(!read(Target::Success(0.1)).reached);
    }
}
