//! Stream peers: the same segments as frames through a pipe or a Unix socket.
//!
//! One process writes. A thread of this process reads, checks and counts like the receiver for
//! shared memory. There are no acknowledgements and no retransmits. Between two measurements, the
//! thread does not read and the writer blocks.

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
use dmprl_run::Watch;
use dmprl_shared::segment::{Expected, Segment, SegmentHeader, check};
use dmprl_shared::transport::delivery::Inbox;

use crate::child::LineChild;
use crate::synthetic_segments::Size;

/// Time limit from the start of a process to its connection.
const CONNECT: Duration = Duration::from_secs(30);
/// Time beyond a measurement's duration until it times out.
const MEASURE_SLACK: Duration = Duration::from_secs(30);
/// Time before the measurement starts, in which the buffered frames are read and the writer returns
/// to full speed.
const SETTLE: Duration = Duration::from_millis(100);
/// Size of the reader's buffer: the default capacity of a pipe.
const BUFFER_BYTES: usize = 64 << 10;

/// Channel of a peer's frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StreamKind {
    Pipe,
    Socket,
}

impl StreamKind {
    pub(super) const ALL: [Self; 2] = [Self::Pipe, Self::Socket];

    /// Returns the channel's name for reports.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Pipe => "pipe",
            Self::Socket => "unix_socket",
        }
    }

    /// Returns a description of the channel for the report.
    pub(super) fn about(self) -> &'static str {
        match self {
            Self::Pipe => "a pipe, one write per frame, reads of 64 KiB, no acknowledgements",
            Self::Socket => "the same with a Unix stream socket",
        }
    }
}

/// Returns the size of a frame after its length field, for a block of `block_len` values.
pub(super) fn frame_bytes(block_len: usize) -> u32 {
    (size_of::<SegmentHeader>() + block_len * size_of::<f32>()) as u32
}

/// A writer process and a reader thread.
pub(super) struct StreamPeer {
    pub(super) kind: StreamKind,
    child: LineChild,
    requests: Sender<Duration>,
    rates: Receiver<anyhow::Result<f64>>,
}

impl StreamPeer {
    /// Starts both. `command` is a `transport-worker` without its route.
    pub(super) fn start(
        kind: StreamKind,
        size: Size,
        mut command: Command,
        folder: &Path,
        watch: &Watch,
    ) -> anyhow::Result<Self> {
        let name = format!("{}-{}", kind.name(), size.bytes);
        let log_path = folder.join(format!("{name}.log"));
        let log = File::create(&log_path);
        command.stderr(log.with_context(|| format!("cannot make {}", log_path.display()))?);
        let (stream, child): (Box<dyn Read + Send>, _) = match kind {
            StreamKind::Pipe => {
                let (reader, writer) = std::io::pipe().context("cannot make a pipe")?;
                // The child opens the pipe by this path: other children must not inherit it.
                let path = format!("/proc/{}/fd/{}", std::process::id(), writer.as_raw_fd());
                command.args(["--pipe", &path]);
                let mut child = LineChild::start(name, command, &log_path)?;
                // Closed once the child has its own, so that the child's death ends the stream.
                child.next_line(watch, CONNECT, "the connection")?;
                drop(writer);
                (Box::new(reader), child)
            }
            StreamKind::Socket => {
                let path = folder.join(&name);
                let listener = UnixListener::bind(&path)
                    .with_context(|| format!("cannot listen at {}", path.display()))?;
                command.arg("--socket").arg(&path);
                let mut child = LineChild::start(name, command, &log_path)?;
                child.next_line(watch, CONNECT, "the connection")?;
                (Box::new(listener.accept().context("cannot accept a connection")?.0), child)
            }
        };
        let (requests, asked) = mpsc::channel();
        let (answers, rates) = mpsc::channel();
        // The thread exits at the end of the stream, or when this peer is dropped.
        thread::spawn(move || {
            let mut reader = FrameReader::new(stream, size);
            for duration in asked {
                let rate = reader.measure(duration);
                if answers.send(rate).is_err() {
                    return;
                }
            }
        });
        Ok(Self { kind, child, requests, rates })
    }

    /// Measures segments per second.
    pub(super) fn measure(&mut self, watch: &Watch, duration: Duration) -> anyhow::Result<f64> {
        // If the thread has exited, receiving the answer fails too.
        let _ = self.requests.send(duration);
        let what = format!("the measurement of {}", self.child.name());
        let rate = watch.next(&self.rates, duration + MEASURE_SLACK, &what)?;
        match rate.ok_or_else(|| anyhow!("the reader of {} has exited", self.child.name()))? {
            Ok(rate) => Ok(rate),
            Err(error) => Err(error.context(self.child.exit_summary())),
        }
    }
}

/// State of the reader thread.
struct FrameReader {
    stream: BufReader<Box<dyn Read + Send>>,
    expected: Expected,
    inbox: Inbox,
    segment: Segment,
}

impl FrameReader {
    fn new(stream: Box<dyn Read + Send>, size: Size) -> Self {
        Self {
            stream: BufReader::with_capacity(BUFFER_BYTES, stream),
            expected: size.expected(1),
            inbox: Inbox::new(1),
            segment: Segment::zeroed(size.layout),
        }
    }

    fn measure(&mut self, duration: Duration) -> anyhow::Result<f64> {
        self.read_for(SETTLE)?;
        self.read_for(duration)
    }

    /// Reads segments for `duration`, and returns their rate per second.
    fn read_for(&mut self, duration: Duration) -> anyhow::Result<f64> {
        let start = Instant::now();
        let mut segments = 0_u64;
        while start.elapsed() < duration {
            self.read_segment()?;
            segments += 1;
        }
        Ok(segments as f64 / start.elapsed().as_secs_f64())
    }

    /// Reads a segment and checks it. A gap in the sequence is an error: streams lose nothing.
    fn read_segment(&mut self) -> anyhow::Result<()> {
        let Self { stream, expected, inbox, segment } = self;
        let Segment { header, block } = segment;
        let mut bytes = [0; size_of::<u32>()];
        stream.read_exact(&mut bytes).context("the stream has ended")?;
        let (got, wanted) = (u32::from_le_bytes(bytes), frame_bytes(block.len()));
        ensure!(got == wanted, "got a frame of {got} bytes, expected {wanted}");
        stream.read_exact(bytemuck::bytes_of_mut(header)).context("the stream has ended")?;
        stream.read_exact(bytemuck::cast_slice_mut(block)).context("the stream has ended")?;
        check(header, block, expected)?;
        match inbox.settle(header, block)? {
            0 => Ok(()),
            lost => bail!("{lost} segments are missing"),
        }
    }
}
