//! Accepts workers that a user starts to join the run.
//!
//! ```text
//!  dmprl actor --join RUN ──► join.sock, in the run's private directory
//!      greeting ◄── supervisor      its version
//!      request  ──►                 the worker's version
//!      welcome or refusal ◄──       the worker's index and incarnation, or a reason
//! ```
//! Afterwards the connection replaces a child's standard input and output. A worker that closes it
//! must exit. The supervisor detects the exit by a descriptor of the process: unlike a process id,
//! it never refers to another process.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use dmprl_control::{Greeting, JOIN_SOCKET, JoinAnswer, JoinRequest};
use rustix::process::{Pid, PidfdFlags, geteuid, pidfd_open};
use tokio::io::{AsyncBufReadExt, AsyncReadExt, BufReader};
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::{Semaphore, mpsc};

use super::child::{Incoming, PendingJoin, write_line};

/// Maximum duration of a handshake, until the request is received.
const HANDSHAKE_LIMIT: Duration = Duration::from_secs(5);
/// Maximum number of concurrent handshakes. More connections wait in the system's queue.
const HANDSHAKES_MAX: usize = 16;
/// Pause after a connection could not be accepted, for instance because no descriptor was free.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// Maximum length of a request.
const REQUEST_BYTES_MAX: u64 = 4_096;

/// Opens the socket for workers that join. It is served until the runtime ends.
pub(super) fn listen(domain: &Path, events: mpsc::Sender<Incoming>) -> anyhow::Result<()> {
    let path = domain.join(JOIN_SOCKET);
    let listener = UnixListener::bind(&path)
        .with_context(|| format!("cannot create the socket {}", path.display()))?;
    tokio::spawn(accept(listener, events));
    Ok(())
}

async fn accept(listener: UnixListener, events: mpsc::Sender<Incoming>) {
    let handshakes = Arc::new(Semaphore::new(HANDSHAKES_MAX));
    loop {
        let Ok(permit) = Arc::clone(&handshakes).acquire_owned().await else { return };
        let Ok((stream, _)) = listener.accept().await else {
            tokio::time::sleep(ACCEPT_PAUSE).await;
            continue;
        };
        let events = events.clone();
        tokio::spawn(async move {
            let request = tokio::time::timeout(HANDSHAKE_LIMIT, handshake(stream)).await;
            drop(permit);
            // Drops clients that send no valid request, without an answer.
            if let Ok(Ok(pending)) = request {
                let _ = events.send(Incoming::Join(pending)).await;
            }
        });
    }
}

/// Receives a request. The supervisor speaks first: a client that answers was alive when its
/// process was opened, so the process id had not been reassigned.
async fn handshake(mut stream: UnixStream) -> anyhow::Result<PendingJoin> {
    let peer = stream.peer_cred()?;
    // The directory is private to this user, but root can still connect.
    ensure!(peer.uid() == geteuid().as_raw(), "another user");
    let id = peer.pid().context("a peer without a process")?;
    let Some(pid) = Pid::from_raw(id) else {
        write_line(&mut stream, &Greeting::this()).await?;
        let reason = "it runs in another container, where the supervisor cannot monitor it";
        write_line(&mut stream, &JoinAnswer::Refused { reason: reason.to_owned() }).await?;
        bail!("a peer of another container");
    };
    let process = pidfd_open(pid, PidfdFlags::NONBLOCK).context("cannot open its process")?;
    write_line(&mut stream, &Greeting::this()).await?;
    let mut line = Vec::new();
    let mut reader = BufReader::new((&mut stream).take(REQUEST_BYTES_MAX));
    if reader.read_until(b'\n', &mut line).await? == 0 {
        bail!("the connection was closed");
    }
    let JoinRequest { speaks } = serde_json::from_slice(&line)?;
    Ok(PendingJoin { stream, process, id, speaks })
}
