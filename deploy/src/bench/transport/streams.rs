//! Peers: the same segments as frames through a pipe or a Unix socket.
//!
//! One process writes, a thread here reads, checks and counts as the sink does for shared memory.
//! There is no acknowledgement and nothing that could be sent again. Between two measurements the
//! thread does not read, and the writer sleeps in the kernel.

use std::fs::File;
use std::io::{BufReader, Read};
use std::os::fd::AsRawFd;
use std::os::unix::net::UnixListener;
use std::path::Path;
use std::process::Command;
use std::sync::mpsc::{self, Receiver, Sender};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, bail, ensure};
use dmprl_shared::segment::{Expected, Segment, SegmentHeader, check};
use dmprl_shared::transport::delivery::Inbox;

use crate::bench::child::LineChild;
use crate::bench::made_up::Size;
use crate::bench::watch::Watch;

/// From the start of a process to its connection.
const CONNECT: Duration = Duration::from_secs(30);
/// Beyond what was asked for, a measurement may take so much longer.
const MEASURE_SLACK: Duration = Duration::from_secs(30);
/// Read before the clock starts: what lay in the pipe, and the writer's way back to its pace.
const SETTLE: Duration = Duration::from_millis(100);
/// As much as a pipe holds.
const BUFFER_BYTES: usize = 64 << 10;

/// What a frame is sent through.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StreamKind {
    Pipe,
    Socket,
}

impl StreamKind {
    pub(super) const ALL: [Self; 2] = [Self::Pipe, Self::Socket];

    /// As reports call it.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Pipe => "pipe",
            Self::Socket => "unix_socket",
        }
    }

    /// What it is, for the report.
    pub(super) fn about(self) -> &'static str {
        match self {
            Self::Pipe => "one frame a write into a pipe, read in 64 KiB; no acknowledgement",
            Self::Socket => "the same through a Unix stream socket",
        }
    }
}

/// Bytes of a frame behind its length, for a block of so many numbers.
pub(super) fn frame_bytes(block_len: usize) -> u32 {
    (size_of::<SegmentHeader>() + block_len * size_of::<f32>()) as u32
}

/// A writing process and the thread that reads.
pub(super) struct StreamPeer {
    pub(super) kind: StreamKind,
    child: LineChild,
    requests: Sender<Duration>,
    rates: Receiver<anyhow::Result<f64>>,
}

impl StreamPeer {
    /// Starts both; `command` is a `transport-worker` without its route.
    pub(super) fn start(
        kind: StreamKind,
        size: Size,
        mut command: Command,
        (folder, watch): (&Path, &Watch),
    ) -> anyhow::Result<Self> {
        let name = format!("{}-{}", kind.name(), size.bytes);
        let log_path = folder.join(format!("{name}.log"));
        let log = File::create(&log_path);
        command.stderr(log.with_context(|| format!("cannot make {}", log_path.display()))?);
        let (stream, child): (Box<dyn Read + Send>, _) = match kind {
            StreamKind::Pipe => {
                let (reader, writer) = std::io::pipe().context("cannot make a pipe")?;
                // The child opens it anew in our name, so that it is inherited by nobody.
                let path = format!("/proc/{}/fd/{}", std::process::id(), writer.as_raw_fd());
                command.args(["--pipe", &path]);
                let mut child = LineChild::start(name, command, &log_path)?;
                // Ours is closed once the child has its own: then its death ends the stream.
                child.next(watch, CONNECT, "the connection")?;
                drop(writer);
                (Box::new(reader), child)
            }
            StreamKind::Socket => {
                let path = folder.join(&name);
                let listener = UnixListener::bind(&path)
                    .with_context(|| format!("cannot listen at {}", path.display()))?;
                command.arg("--socket").arg(&path);
                let mut child = LineChild::start(name, command, &log_path)?;
                child.next(watch, CONNECT, "the connection")?;
                (Box::new(listener.accept().context("cannot accept a connection")?.0), child)
            }
        };
        let (requests, asked) = mpsc::channel();
        let (answers, rates) = mpsc::channel();
        // It ends with the child, whose death ends the stream, or with this peer.
        thread::spawn(move || {
            let mut taker = Taker::new(stream, size);
            for duration in asked {
                let rate = taker.measure(duration);
                if answers.send(rate).is_err() {
                    return;
                }
            }
        });
        Ok(Self { kind, child, requests, rates })
    }

    /// Segments a second over so much time.
    pub(super) fn measure(&mut self, watch: &Watch, duration: Duration) -> anyhow::Result<f64> {
        // A thread that has ended has no answer either.
        let _ = self.requests.send(duration);
        let what = format!("the measurement of {}", self.child.name());
        let rate = watch.next(&self.rates, duration + MEASURE_SLACK, &what)?;
        match rate.ok_or_else(|| anyhow!("the reader of {} has ended", self.child.name()))? {
            Ok(rate) => Ok(rate),
            Err(error) => Err(error.context(self.child.last_word())),
        }
    }
}

struct Taker {
    stream: BufReader<Box<dyn Read + Send>>,
    expected: Expected,
    inbox: Inbox,
    segment: Segment,
}

impl Taker {
    fn new(stream: Box<dyn Read + Send>, size: Size) -> Self {
        Self {
            stream: BufReader::with_capacity(BUFFER_BYTES, stream),
            expected: size.expected(1),
            inbox: Inbox::new(1),
            segment: Segment::zeroed(size.layout),
        }
    }

    fn measure(&mut self, duration: Duration) -> anyhow::Result<f64> {
        self.take_for(SETTLE)?;
        self.take_for(duration)
    }

    fn take_for(&mut self, duration: Duration) -> anyhow::Result<f64> {
        let start = Instant::now();
        let mut segments = 0_u64;
        while start.elapsed() < duration {
            self.take()?;
            segments += 1;
        }
        Ok(segments as f64 / start.elapsed().as_secs_f64())
    }

    /// A stream has no gaps: any is an error.
    fn take(&mut self) -> anyhow::Result<()> {
        let Self { stream, expected, inbox, segment } = self;
        let Segment { header, block } = segment;
        let mut bytes = [0; size_of::<u32>()];
        stream.read_exact(&mut bytes).context("the stream has ended")?;
        let (got, wanted) = (u32::from_le_bytes(bytes), frame_bytes(block.len()));
        ensure!(got == wanted, "a frame of {got} bytes, expected {wanted}");
        stream.read_exact(bytemuck::bytes_of_mut(header)).context("the stream has ended")?;
        stream.read_exact(bytemuck::cast_slice_mut(block)).context("the stream has ended")?;
        check(header, block, expected)?;
        match inbox.settle(header, block)? {
            0 => Ok(()),
            lost => bail!("{lost} segments are missing"),
        }
    }
}
