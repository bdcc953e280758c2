//! Workers that somebody else starts and that join the run: how they come in, and how they go.
//!
//! ```text
//!  dmprl actor --join RUN ──► join.sock, in the run's private directory
//!      greeting ◄── supervisor      which version speaks
//!      request  ──►                 which version asks
//!      welcome or refusal ◄──       an index and an incarnation that nobody else has
//! ```
//! From then on the connection is what a child's standard input and output are, in both
//! directions, and its end is the worker's. Whether the process itself has ended its descriptor
//! says, which can mean no other process however often the system uses numbers again.

use std::os::fd::OwnedFd;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Error, bail, ensure};
use rustix::process::{Pid, PidfdFlags, geteuid, pidfd_open};
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::{Semaphore, mpsc};

use super::Process;
use super::child::{Child, Event};
use super::deaths::Death;
use super::launcher::INCARNATIONS_PER_SESSION;
use super::supervisor::{Phase, Running, Supervisor};
use crate::control::{Greeting, JOIN_SOCKET, JoinAnswer, JoinRequest, Welcome};

/// A newcomer has so long to say who it is.
const INTRODUCTION: Duration = Duration::from_secs(5);
/// Newcomers that introduce themselves at once; more wait in the system's queue.
const INTRODUCTIONS_MAX: usize = 16;
/// After a connection could not be accepted, for want of descriptors perhaps.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// A longer line is no request.
const REQUEST_BYTES_MAX: u64 = 4_096;

/// A worker that asks to join.
#[derive(Debug)]
pub(super) struct Newcomer {
    pub(super) stream: UnixStream,
    /// The process, whatever becomes of its number.
    pub(super) process: OwnedFd,
    /// Its number, for messages.
    pub(super) id: i32,
    request: JoinRequest,
}

impl Newcomer {
    /// Tells it why not. It may be gone, and is then not told.
    fn refuse(mut self, reason: String) {
        tokio::spawn(async move {
            let answer = JoinAnswer::Refused { reason };
            let _ = tokio::time::timeout(INTRODUCTION, write(&mut self.stream, &answer)).await;
        });
    }
}

/// Opens the run for workers that join, until the runtime ends.
pub(super) fn listen(domain: &Path, events: mpsc::Sender<Event>) -> anyhow::Result<()> {
    let path = domain.join(JOIN_SOCKET);
    let listener = UnixListener::bind(&path)
        .with_context(|| format!("cannot make the socket {}", path.display()))?;
    tokio::spawn(accept(listener, events));
    Ok(())
}

async fn accept(listener: UnixListener, events: mpsc::Sender<Event>) {
    let introductions = Arc::new(Semaphore::new(INTRODUCTIONS_MAX));
    loop {
        let Ok(permit) = Arc::clone(&introductions).acquire_owned().await else { return };
        let Ok((stream, _)) = listener.accept().await else {
            tokio::time::sleep(ACCEPT_PAUSE).await;
            continue;
        };
        let events = events.clone();
        tokio::spawn(async move {
            let introduced = tokio::time::timeout(INTRODUCTION, introduce(stream)).await;
            drop(permit);
            // Who says nothing of sense is nobody, and nobody waits for an answer.
            if let Ok(Ok(newcomer)) = introduced {
                let _ = events.send(Event::Asked(newcomer)).await;
            }
        });
    }
}

/// The supervisor speaks first: whoever answers after that has lived when its process was opened,
/// so that it was not another's of the same number.
async fn introduce(mut stream: UnixStream) -> anyhow::Result<Newcomer> {
    let peer = stream.peer_cred()?;
    // The directory is private to this user; root may come all the same.
    ensure!(peer.uid() == geteuid().as_raw(), "another user");
    let id = peer.pid().context("a peer without a process")?;
    let Some(pid) = Pid::from_raw(id) else {
        write(&mut stream, &Greeting::this()).await?;
        let reason = "it runs in another container, where the supervisor cannot watch over it";
        write(&mut stream, &JoinAnswer::Refused { reason: reason.to_owned() }).await?;
        bail!("a peer of another container");
    };
    let process = pidfd_open(pid, PidfdFlags::NONBLOCK).context("cannot open its process")?;
    write(&mut stream, &Greeting::this()).await?;
    let mut line = Vec::new();
    let mut reader = BufReader::new((&mut stream).take(REQUEST_BYTES_MAX));
    if reader.read_until(b'\n', &mut line).await? == 0 {
        bail!("it has gone");
    }
    let request = serde_json::from_slice(&line)?;
    Ok(Newcomer { stream, process, id, request })
}

async fn write(stream: &mut UnixStream, line: &impl serde::Serialize) -> anyhow::Result<()> {
    let mut line = serde_json::to_vec(line)?;
    line.push(b'\n');
    Ok(stream.write_all(&line).await?)
}

impl Supervisor<'_> {
    /// Workers that join have the numbers after the run's own.
    pub(super) fn is_joined(&self, process: Process) -> bool {
        matches!(process, Process::Actor(index) if index as usize >= self.config.actors.workers)
    }

    /// Takes a worker in, or says why not.
    pub(super) fn on_asked(&mut self, newcomer: Newcomer) {
        let id = newcomer.id;
        match self.place_for(&newcomer.request) {
            Ok(welcome) => self.take_in(newcomer, welcome),
            Err(reason) => {
                self.message(&format!("process {id} may not join: {reason}"));
                newcomer.refuse(reason);
            }
        }
    }

    fn take_in(&mut self, newcomer: Newcomer, welcome: Welcome) {
        let (id, process) = (newcomer.id, Process::Actor(welcome.index));
        match Child::join(newcomer, &JoinAnswer::Welcome(welcome), process, self.events.clone()) {
            Ok(child) => {
                let slot = self.slots.entry(process).or_default();
                slot.starts += 1;
                slot.running = Some(Running::new(child));
            }
            Err(error) => {
                self.message(&format!("process {id} could not join: {error:#}"));
            }
        }
    }

    fn place_for(&self, request: &JoinRequest) -> Result<Welcome, String> {
        let JoinRequest { speaks } = request;
        if *speaks != Greeting::this() {
            return Err(format!("expected {}, got {speaks}", Greeting::this()));
        }
        if self.phase != Phase::Training {
            return Err("the run is coming to its end".to_owned());
        }
        if !self.slots.contains_key(&self.hub()) {
            return Err("the run is still starting; try again in a moment".to_owned());
        }
        let actors = &self.config.actors;
        let free = |index: &u32| {
            self.slots
                .get(&Process::Actor(*index))
                .is_none_or(|slot| slot.running.is_none() && slot.starts < INCARNATIONS_PER_SESSION)
        };
        // Both are at most a thousand.
        let places = actors.workers as u32..actors.places() as u32;
        let Some(index) = places.clone().find(free) else {
            return Err(format!(
                "{} of {} places for workers that join are taken (actors.joined_max); one that \
                 leaves makes room",
                places.len(),
                places.len()
            ));
        };
        let starts = self.slots.get(&Process::Actor(index)).map_or(0, |slot| slot.starts);
        let incarnation =
            self.launcher.incarnation(starts).map_err(|error| format!("{error:#}"))?;
        let venv = self.launcher.venv.clone();
        Ok(Welcome { index, incarnation, venv, workers: self.workers() + 1 })
    }

    /// Its end follows, and is then no death.
    pub(super) fn on_left(&mut self, process: Process) {
        if let Some(running) = self.slots.get_mut(&process).and_then(|slot| slot.running.as_mut()) {
            running.left = true;
        }
    }

    /// What is wrong with somebody else's worker must not end the run.
    pub(super) fn send_away(&mut self, process: Process, error: &Error) {
        if let Some(running) = self.slots.get_mut(&process).and_then(|slot| slot.running.as_mut()) {
            running.kill_for(Death::sent_away(format!("{error:#}")));
        }
    }

    /// Workers that have joined and live.
    pub(super) fn joined(&self) -> usize {
        self.all_running().filter(|(process, _)| self.is_joined(*process)).count()
    }

    /// How many workers there are, as part of a sentence.
    pub(super) fn counted(&self) -> String {
        let workers = self.workers();
        format!("{workers} worker{}", if workers == 1 { "" } else { "s" })
    }

    /// It is no longer a member, however it ended. Nobody starts it again but who started it.
    pub(super) fn on_gone(&mut self, process: Process) -> anyhow::Result<()> {
        let ended = self.slots.get_mut(&process).and_then(|slot| slot.running.take());
        if self.phase != Phase::Training {
            return Ok(());
        }
        self.tell_learner_of_counts();
        let (left, killed_for) =
            ended.map_or((false, None), |running| (running.left, running.killed_for));
        let how = match killed_for {
            Some(death) => death.to_string(),
            None if left => "has left".to_owned(),
            None => "died (its own terminal may say why)".to_owned(),
        };
        self.message(&format!("{process}, which had joined, {how}: {}", self.counted()));
        ensure!(
            self.workers_left() > 0,
            "no worker is left: those that had joined are gone too{}",
            self.resume_advice()
        );
        Ok(())
    }
}
