//! What the supervisor does about what its children say.

use std::time::Instant;

use anyhow::{bail, ensure};
use dmprl_shared::spec::EnvSpec;

use super::child::Event;
use super::supervisor::{Phase, Supervisor};
use super::{Process, RunEvent};
use crate::control::{Command, EvaluationRequest, EvaluationRow, Progress, Report};
use crate::terminal::{grouped, shown};

/// Lines that are no reports, shown to the user; the rest is only counted.
const GARBAGE_SHOWN_MAX: u32 = 3;

impl Supervisor<'_> {
    pub(super) fn on_event(&mut self, event: Event) -> anyhow::Result<()> {
        match event {
            Event::Report(process, report) => {
                let handled = self.on_report(process, report);
                match handled {
                    Err(error) if self.is_joined(process) => self.send_away(process, &error),
                    handled => return handled,
                }
                Ok(())
            }
            Event::Asked(newcomer) => {
                self.on_asked(newcomer);
                Ok(())
            }
            Event::Gone(process) => self.on_gone(process),
            Event::Exited(process, status) => self.on_exit(process, status),
            Event::Garbage(process, line) => {
                self.garbage += 1;
                if self.garbage <= GARBAGE_SHOWN_MAX {
                    let line: String = line.escape_debug().take(200).collect();
                    self.message(&format!("{process} wrote what is no report: {line}"));
                }
                Ok(())
            }
        }
    }

    fn on_report(&mut self, process: Process, report: Report) -> anyhow::Result<()> {
        self.heard(process, &report);
        match report {
            Report::EnvironmentReady { spec } => return self.on_environment(process, spec),
            Report::LearnerReady => return self.on_learner_ready(process),
            Report::FirstSegment => {
                let message = match self.learner_died.take() {
                    Some(died) => {
                        let seconds = died.elapsed().as_secs_f64();
                        format!("the learner is back: first segment {seconds:.1} s after its death")
                    }
                    None => {
                        let seconds = self.started.elapsed().as_secs_f64();
                        format!("first environment step after {seconds:.1} s")
                    }
                };
                self.message(&message);
            }
            Report::Progress(progress) => self.on_progress(progress),
            Report::Evaluate(request) => self.on_evaluate(request),
            Report::Evaluated(row) => return self.on_evaluated(process, row),
            Report::NotEvaluated { policy_version, reason } => {
                return self.on_not_evaluated(process, policy_version, &reason);
            }
            Report::EnvFailures { count, last } => self.on_env_failures(process, count, &last),
            Report::Sent(sent) => {
                self.sent += sent;
                if let Some(slot) = self.slots.get_mut(&process) {
                    slot.sent += sent;
                }
                if sent.sent > 0 {
                    self.worked(process);
                }
            }
            // Observing and filming are none of a training's children's business.
            Report::Alive { .. } | Report::Observed { .. } | Report::Filmed { .. } => {}
            Report::Hosts(hosts) => {
                // Its first words: it has opened its endpoints.
                self.set_ready(process);
                self.hosts = hosts;
                self.worked(process);
                self.tell_learner_of_counts();
            }
            Report::Left => self.on_left(process),
            Report::EnvHung { message } => self.on_env_hung(process, &message),
            Report::Checkpoint { name, env_steps } => {
                self.checkpointed = true;
                self.worked(process);
                let steps = grouped(env_steps);
                self.message(&format!("checkpoint {name} at {steps} steps"));
            }
            Report::Finished => {
                let regular = process == self.hub() && self.learner_ready;
                ensure!(regular, "{process} reported `finished` before `learner_ready`");
                self.on_finished();
            }
            Report::Warning { message } => self.message(&format!("{process}: {message}")),
        }
        Ok(())
    }

    fn on_environment(&mut self, process: Process, spec: EnvSpec) -> anyhow::Result<()> {
        match &self.spec {
            None => {
                self.launcher.run.write_spec(&spec)?;
                self.spec = Some(spec);
            }
            Some(known) if !known.is_same(&spec) => bail!(
                "the environment of {process} is not the run's: expected {}, got {}",
                serde_json::to_string(known)?,
                serde_json::to_string(&spec)?
            ),
            Some(_) => {}
        }
        if process == self.hub() || matches!(self.phase, Phase::Stopping { .. }) {
            return Ok(());
        }
        self.set_ready(process);
        match process {
            Process::Evaluator => self.send_evaluation(),
            _ if self.learner_ready => self.attach(process),
            _ if !self.slots.contains_key(&self.hub()) => self.spawn(self.hub())?,
            _ => {}
        }
        Ok(())
    }

    fn on_learner_ready(&mut self, process: Process) -> anyhow::Result<()> {
        ensure!(process == self.hub(), "{process} reported `learner_ready`");
        self.set_ready(process);
        self.learner_ready = true;
        if self.learner_restarts > 0 {
            self.forget_what_was_taken_back()?;
        }
        self.advanced = Instant::now();
        self.tell_learner_of_counts();
        if matches!(self.phase, Phase::Draining { .. }) {
            // Its predecessor was asked, and died of something else.
            self.send(self.hub(), Command::Finish);
        }
        if self.is_one_process() || self.phase != Phase::Training {
            return Ok(());
        }
        let waiting: Vec<Process> = self
            .all_running()
            .filter(|(process, running)| {
                matches!(process, Process::Actor(_)) && running.ready && !running.attached
            })
            .map(|(process, _)| process)
            .collect();
        waiting.into_iter().for_each(|process| self.attach(process));
        if self.hub() == Process::Relay {
            return Ok(());
        }
        let mut missing = vec![Process::Evaluator];
        if self.config.bridge.is_open() {
            missing.push(Process::Gateway);
        }
        missing.retain(|process| !self.slots.contains_key(process));
        missing.into_iter().try_for_each(|process| self.spawn(process))
    }

    /// A learner that came back has gone back to a checkpoint, and its run's rows with it.
    fn forget_what_was_taken_back(&mut self) -> anyhow::Result<()> {
        let rows = self.launcher.run.evaluations()?;
        let returns = rows.iter().map(|row| row.return_mean);
        self.best_return = returns.fold(f64::NEG_INFINITY, f64::max);
        self.tell(RunEvent::Rewound { evaluations: rows });
        Ok(())
    }

    fn set_ready(&mut self, process: Process) {
        if let Some(running) = self.slots.get_mut(&process).and_then(|slot| slot.running.as_mut()) {
            running.ready = true;
        }
    }

    fn attach(&mut self, process: Process) {
        if let Some(domain) = self.launcher.domain.clone() {
            self.send(process, Command::Attach { domain });
            if let Some(running) =
                self.slots.get_mut(&process).and_then(|slot| slot.running.as_mut())
            {
                running.attached = true;
            }
            if self.is_joined(process) {
                self.message(&format!("{process} has joined: {}", self.counted()));
            }
            self.tell_learner_of_counts();
        }
    }

    fn on_progress(&mut self, progress: Progress) {
        let now = Instant::now();
        let marks = |progress: &Progress| (progress.env_steps, progress.updates);
        if self.last.as_ref().is_none_or(|(_, last)| marks(last) != marks(&progress)) {
            self.advanced = now;
        }
        self.checkpointed = false;
        self.tell_learner_of_counts();
        let processes = if self.shows_processes() { self.overview(now) } else { Vec::new() };
        self.drawn = now;
        self.tell(RunEvent::Progress { progress: progress.clone(), processes });
        if self.first.is_none() {
            self.first = Some((now, progress.clone()));
        }
        self.last = Some((now, progress));
    }

    fn on_evaluate(&mut self, request: EvaluationRequest) {
        if matches!(self.phase, Phase::Stopping { .. }) {
            // An interrupted run skips what is not yet evaluated.
            return;
        }
        if let Some(skipped) = self.evaluations.push(request) {
            self.message(&format!(
                "the evaluator is too far behind: skipping the evaluation at {} steps",
                grouped(skipped.env_steps)
            ));
        }
        self.send_evaluation();
    }

    /// Sends the next request, if the evaluator is ready and idle.
    fn send_evaluation(&mut self) {
        if !self.running(Process::Evaluator).is_some_and(|running| running.ready) {
            return;
        }
        if let Some(request) = self.evaluations.start(Instant::now()) {
            self.send(Process::Evaluator, Command::Evaluate(request));
        }
    }

    fn on_evaluated(&mut self, process: Process, row: EvaluationRow) -> anyhow::Result<()> {
        if self.wants_no_answer() {
            return Ok(());
        }
        self.on_answer(process, row.policy_version)?;
        let is_best = row.return_mean > self.best_return;
        self.best_return = self.best_return.max(row.return_mean);
        self.tell(RunEvent::Evaluated { row: row.clone(), is_best });
        let run = &self.config.run;
        let reached = if row.return_mean >= run.until_return {
            Some(format!("the return has reached {}", run.until_return))
        } else if row.success_rate.is_some_and(|rate| rate >= run.until_success) {
            Some(format!("the success rate has reached {}", run.until_success))
        } else {
            None
        };
        self.last_row = Some(row);
        if let Some(reason) = reached {
            self.drain(&reason);
        }
        self.complete_if_done();
        Ok(())
    }

    /// A curve with a point less is no reason to end a run.
    fn on_not_evaluated(
        &mut self,
        process: Process,
        policy_version: u64,
        reason: &str,
    ) -> anyhow::Result<()> {
        if self.wants_no_answer() {
            return Ok(());
        }
        self.on_answer(process, policy_version)?;
        self.message(&format!(
            "no evaluation of policy {policy_version}, the run goes on: {reason}; log: {}",
            shown(&self.log_path(process))
        ));
        self.complete_if_done();
        Ok(())
    }

    /// Everything stops; or the learner has died, and an answer that was on its way is to a
    /// question that its successor will ask anew.
    fn wants_no_answer(&self) -> bool {
        self.evaluator_ends || matches!(self.phase, Phase::Stopping { .. })
    }

    /// The evaluator has answered and takes the next request.
    fn on_answer(&mut self, process: Process, policy_version: u64) -> anyhow::Result<()> {
        if self.is_one_process() {
            return Ok(());
        }
        ensure!(
            process == Process::Evaluator && self.evaluations.finish(policy_version),
            "{process} evaluated policy {policy_version}, which nobody asked for"
        );
        // One that answers now and then is worth each restart.
        self.forgive(Process::Evaluator);
        self.send_evaluation();
        Ok(())
    }
}

#[cfg(test)]
pub(super) mod tests {
    use dmprl_shared::config::ExperimentConfig;
    use tokio::sync::mpsc;

    use super::*;
    use crate::launch::{EarlierSessions, Launcher, RunObserver, SupervisorPlan, TimeLimits};
    use crate::run_directory::{Manifest, RunDirectory};

    pub(in crate::launch) struct Unwatched;

    impl RunObserver for Unwatched {
        fn on_event(&mut self, _event: RunEvent) {}
    }

    pub(in crate::launch) fn supervisor<'a>(
        folder: &std::path::Path,
        observer: &'a mut dyn RunObserver,
    ) -> Supervisor<'a> {
        let config = ExperimentConfig::default();
        let manifest = Manifest::new(None).unwrap();
        let launcher = Launcher {
            program: "none".into(),
            run: RunDirectory::create(&folder.join("run"), &config, &manifest).unwrap(),
            venv: None,
            domain: Some(folder.to_owned()),
            resume: false,
            init_from: None,
            learner_restarts: 0,
            sessions_before: 0,
            journal: None,
            upstream: None,
        };
        let plan = SupervisorPlan {
            launcher,
            config,
            limits: TimeLimits::default(),
            earlier: EarlierSessions::default(),
            interrupts: mpsc::channel(1).1,
        };
        Supervisor::new(plan, observer, mpsc::channel(1).0)
    }

    /// Killed with the learner, an evaluator may have answered already; that once ended the run.
    #[test]
    fn an_answer_to_a_dead_learner_is_passed_over_and_one_that_nobody_asked_for_is_a_fault() {
        let folder = tempfile::tempdir().unwrap();
        let mut observer = Unwatched;
        let mut supervisor = supervisor(folder.path(), &mut observer);
        let not_evaluated =
            || Report::NotEvaluated { policy_version: 7, reason: "a broken arm".to_owned() };
        let answer = || Event::Report(Process::Evaluator, not_evaluated());
        let fault = supervisor.on_event(answer()).unwrap_err().to_string();
        assert!(fault.contains("policy 7, which nobody asked for"), "{fault}");
        supervisor.evaluator_ends = true;
        supervisor.on_event(answer()).unwrap();
    }
}
