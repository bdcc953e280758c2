//! The child process that calls Optuna: `dmprl.search`, one line per request and answer.

use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use anyhow::{Context, anyhow, bail};
use dmprl_run::format::shown;
use dmprl_run::last_lines;
use dmprl_run::sweep_files::{StoredTrial, TrialState};
use serde::Deserialize;
use serde_json::{Map, Value, json};
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader, Lines};
use tokio::process::{Child, ChildStdin, ChildStdout};
use tokio::time::timeout;

use crate::run::{background_command, open_log};

/// Storage file in the sweep's directory. An SQLite file survives a kill during a write, and
/// Optuna's own tools can open it.
pub(super) const STORAGE: &str = "optuna.db";
/// Time limit for importing Optuna and creating the storage.
const START_WAIT: Duration = Duration::from_secs(120);
/// Time limit for an answer. With ten thousand trials in the storage, a suggestion takes seconds.
const ANSWER_WAIT: Duration = Duration::from_secs(120);

/// The child process, which is killed on drop. This loses nothing: each answered request is in the
/// storage.
pub(super) struct Optuna {
    // Never read: dropping it kills the child.
    _child: Child,
    input: ChildStdin,
    lines: Lines<BufReader<ChildStdout>>,
    log: PathBuf,
}

/// Content of an opened study.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct OpenedStudy {
    /// Settings shared by all of its trials.
    pub(super) identity: Value,
    pub(super) trials: Vec<StoredTrial>,
}

/// A new trial with its suggested values.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct NewTrial {
    pub(super) trial: u32,
    pub(super) values: Map<String, Value>,
}

impl Optuna {
    /// Starts the child with the interpreter of `.venv`; the storage is in `output`.
    pub(super) async fn start(python: &Path, output: &Path) -> anyhow::Result<Self> {
        let log = output.join("logs").join("search.log");
        let mut command = std::process::Command::new(python);
        command
            // -P keeps the working directory out of the module path.
            .args(["-P", "-m", "dmprl.search"])
            .arg(format!("sqlite:///{STORAGE}"))
            // The storage is given as a URL, in which a `?` in the path would start the query.
            // Therefore the path is relative.
            .current_dir(output)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(open_log(&log)?);
        for name in ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"] {
            command.env(name, "1");
        }
        let mut command = background_command(command);
        let child = command.kill_on_drop(true).spawn();
        let mut child = child.with_context(|| format!("cannot start {}", python.display()))?;
        let (input, output) = (child.stdin.take(), child.stdout.take());
        let (Some(input), Some(output)) = (input, output) else {
            bail!("dmprl.search has no standard input or output");
        };
        let lines = BufReader::new(output).lines();
        let mut optuna = Self { _child: child, input, lines, log };
        let greeting = optuna.read_line(START_WAIT).await?;
        if let Some(why) = greeting.get("absent") {
            bail!("Optuna is not installed in .venv ({why}); rename .venv and start again");
        }
        Ok(optuna)
    }

    /// Sends a request and waits for the answer.
    async fn request(&mut self, request: &Value) -> anyhow::Result<Value> {
        let line = format!("{request}\n");
        let written = self.input.write_all(line.as_bytes()).await;
        if written.is_err() {
            return Err(self.failure("has closed its input"));
        }
        let answer = self.read_line(ANSWER_WAIT).await?;
        match answer.get("error").and_then(Value::as_str) {
            Some(error) => bail!("the Optuna request {} failed: {error}", request["op"]),
            None => Ok(answer),
        }
    }

    async fn read_line(&mut self, limit: Duration) -> anyhow::Result<Value> {
        match timeout(limit, self.lines.next_line()).await {
            Err(_) => Err(self.failure(&format!("did not answer within {} s", limit.as_secs()))),
            Ok(Ok(Some(line))) => {
                serde_json::from_str(&line).with_context(|| format!("dmprl.search sent: {line}"))
            }
            Ok(_) => Err(self.failure("has exited")),
        }
    }

    /// Returns an error about the child, with the last lines of its log.
    fn failure(&self, what: &str) -> anyhow::Error {
        anyhow!("dmprl.search {what}; {}:\n{}", shown(&self.log), last_lines(&self.log))
    }

    /// Opens or creates a study; `request` has all fields that `dmprl.search` needs.
    pub(super) async fn open(&mut self, request: &Value) -> anyhow::Result<OpenedStudy> {
        Ok(serde_json::from_value(self.request(request).await?)?)
    }

    /// Asks for the next trial of a study.
    pub(super) async fn ask(&mut self, study: &str) -> anyhow::Result<NewTrial> {
        let answer = self.request(&json!({ "op": "ask", "study": study })).await?;
        Ok(serde_json::from_value(answer)?)
    }

    /// Reports an intermediate value; returns true if the trial should be pruned.
    pub(super) async fn report(
        &mut self,
        study: &str,
        trial: u32,
        step: u64,
        value: f64,
    ) -> anyhow::Result<bool> {
        let request = json!({
            "op": "report", "study": study, "trial": trial, "step": step, "value": value,
        });
        Ok(self.request(&request).await?["prune"] == json!(true))
    }

    /// Reports the end of a trial; `objective` is `None` unless it finished.
    pub(super) async fn tell(
        &mut self,
        study: &str,
        trial: u32,
        state: TrialState,
        objective: Option<f64>,
    ) -> anyhow::Result<()> {
        let request = json!({
            "op": "tell", "study": study, "trial": trial, "state": state, "objective": objective,
        });
        self.request(&request).await.map(drop)
    }
}
