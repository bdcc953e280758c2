//! Events of a run as JSON, one object per line: `--events json`.
//!
//! `docs/runs.md` lists the kinds and their keys. `FORMAT` is raised if a key changes its
//! meaning or disappears; new kinds and keys do not raise it.

use std::io::Write;
use std::time::{Duration, Instant};

use dmprl_supervisor::{AfterDeath, Ending, NotEvaluated, RunEvent, RunObserver, SessionReport};
use serde_json::{Map, Value, json};

/// Version of the format; written in every line.
const FORMAT: u32 = 1;

/// Writes events to any writer.
pub struct EventLines {
    out: Box<dyn Write + Send>,
    began: Instant,
}

impl EventLines {
    /// Writes to standard error.
    #[must_use]
    pub fn new() -> Self {
        Self::on(Box::new(std::io::stderr()))
    }

    /// Writes to `out`.
    #[must_use]
    pub fn on(out: Box<dyn Write + Send>) -> Self {
        Self { out, began: Instant::now() }
    }
}

impl Default for EventLines {
    fn default() -> Self {
        Self::new()
    }
}

impl RunObserver for EventLines {
    fn on_event(&mut self, event: RunEvent) {
        if let Some((kind, mut keys)) = object(&event) {
            keys["session_s"] = json!(seconds(self.began.elapsed()));
            // A closed standard error does not end the run.
            let _ = writeln!(self.out, "{}", line(kind, &keys)).and_then(|()| self.out.flush());
        }
    }
}

/// Formats the event `finished`, which follows all others of a session.
#[must_use]
pub fn finished(report: &SessionReport) -> String {
    let outcome = match report.ending {
        Ending::Completed => "completed",
        Ending::Interrupted => "interrupted",
        Ending::Failed(_) => "failed",
    };
    let last = report.last.as_ref();
    let keys = json!({
        "outcome": outcome,
        "checkpointed": report.checkpointed,
        "env_steps": last.map(|progress| progress.env_steps),
        "updates": last.map(|progress| progress.updates),
        "segments": last.map(|progress| progress.segments),
        "return_mean": report.last_row.as_ref().map(|row| row.return_mean),
        "env_failures": report.env_failures,
        "learner_restarts": report.learner_restarts,
        "session_s": seconds(report.wall),
    });
    line("finished", &keys)
}

/// Formats the event `error`, with which a command fails.
#[must_use]
pub fn error(message: &str) -> String {
    line("error", &json!({ "message": message }))
}

/// Formats the event `message`: text from outside a session, such as the Python set-up.
#[must_use]
pub fn message(text: &str) -> String {
    line("message", &json!({ "message": text }))
}

fn line(kind: &str, keys: &Value) -> String {
    let mut object = Map::new();
    object.insert("format".to_owned(), json!(FORMAT));
    object.insert("event".to_owned(), json!(kind));
    if let Value::Object(keys) = keys {
        object.extend(keys.clone());
    }
    Value::Object(object).to_string()
}

fn seconds(duration: Duration) -> f64 {
    (duration.as_secs_f64() * 1e3).round() / 1e3
}

/// Returns the kind of an event and its keys; `None` for events that only update the display.
fn object(event: &RunEvent) -> Option<(&'static str, Value)> {
    let named = |process: &dmprl_supervisor::Process| process.to_string();
    Some(match event {
        RunEvent::Started { title, run, learner, evaluations } => {
            let evaluations = evaluations.len();
            let keys = json!({ "title": title, "run": run, "learner": learner,
                "evaluations": evaluations });
            ("started", keys)
        }
        RunEvent::ChildStarted { process, start } => {
            ("child_started", json!({ "process": named(process), "start": start }))
        }
        RunEvent::Joined { process, workers } => {
            ("joined", json!({ "process": named(process), "workers": workers }))
        }
        RunEvent::Left { process, death, announced, workers } => {
            let cause = death.as_ref().map(|death| &death.cause);
            let keys = json!({ "process": named(process), "announced": announced, "cause": cause,
                "workers": workers });
            ("left", keys)
        }
        RunEvent::FirstStep { after, is_successor } => {
            let keys = json!({ "after_s": seconds(*after), "after_restart": is_successor });
            ("first_step", keys)
        }
        RunEvent::Progress { progress, .. } => ("progress", serde_json::to_value(progress).ok()?),
        RunEvent::Rewound { evaluations } => {
            ("rewound", json!({ "evaluations": evaluations.len() }))
        }
        RunEvent::Evaluated { row, is_best } => {
            let mut keys = serde_json::to_value(row).ok()?;
            keys["best"] = json!(is_best);
            ("evaluation", keys)
        }
        RunEvent::NotEvaluated { policy_version, reason } => {
            let (reason, message) = skipped(reason);
            let keys = json!({ "policy_version": policy_version, "reason": reason,
                "message": message });
            ("evaluation_skipped", keys)
        }
        RunEvent::Checkpoint { name, env_steps } => {
            ("checkpoint", json!({ "name": name, "env_steps": env_steps }))
        }
        RunEvent::EnvFailure { process, count, last, log } => {
            let keys = json!({ "process": named(process), "count": count, "message": last,
                "log": log });
            ("env_failure", keys)
        }
        RunEvent::ChildDied { process, death, log, next } => {
            let mut keys = after_death(next);
            keys["process"] = json!(named(process));
            (keys["how"], keys["cause"]) = (json!(death.verb), json!(death.cause));
            keys["log"] = json!(log);
            ("child_died", keys)
        }
        RunEvent::Draining { reason } => ("draining", json!({ "reason": reason })),
        RunEvent::Interrupted { .. } => ("interrupted", json!({})),
        RunEvent::Killed { processes, reason } => {
            let processes: Vec<_> = processes.iter().map(named).collect();
            ("killed", json!({ "processes": processes, "reason": reason }))
        }
        RunEvent::Warning { process, message } => {
            let process = process.as_ref().map(named);
            ("warning", json!({ "process": process, "message": message }))
        }
        RunEvent::Processes(_) | RunEvent::Ended => return None,
    })
}

/// Returns the reason why a policy is not evaluated, and the evaluator's message.
fn skipped(reason: &NotEvaluated) -> (&'static str, Option<&String>) {
    match reason {
        NotEvaluated::Failed { reason, .. } => ("failed", Some(reason)),
        NotEvaluated::TooFarBehind { .. } => ("too_far_behind", None),
        NotEvaluated::LearnerDied => ("learner_died", None),
        NotEvaluated::Stopping => ("stopping", None),
    }
}

fn after_death(next: &AfterDeath) -> Value {
    match next {
        AfterDeath::Restart { restart, restarts_max, back_off } => json!({
            "next": "restart",
            "restart": restart,
            "restarts_max": restarts_max,
            "back_off_s": seconds(*back_off),
        }),
        AfterDeath::WorkerGivenUp { restarts, left, of } => json!({
            "next": "given_up",
            "restarts": restarts,
            "workers_left": left,
            "workers": of,
        }),
        AfterDeath::GatewayGivenUp { restarts } => {
            json!({ "next": "given_up", "restarts": restarts })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dmprl_supervisor::{Death, Process};

    #[test]
    fn a_death_has_its_cause_and_its_consequence() {
        let event = RunEvent::ChildDied {
            process: Process::Actor(1),
            death: Death { verb: "died", cause: "exit status 3".to_owned() },
            log: "/r/logs/actor-1.log".into(),
            next: AfterDeath::Restart {
                restart: 1,
                restarts_max: 5,
                back_off: Duration::from_millis(100),
            },
        };
        let (kind, keys) = object(&event).unwrap();
        let read: Value = serde_json::from_str(&line(kind, &keys)).unwrap();
        let expected = json!({
            "format": 1, "event": "child_died", "process": "actor-1", "how": "died",
            "cause": "exit status 3", "log": "/r/logs/actor-1.log", "next": "restart",
            "restart": 1, "restarts_max": 5, "back_off_s": 0.1,
        });
        assert_eq!(read, expected);
    }
}
