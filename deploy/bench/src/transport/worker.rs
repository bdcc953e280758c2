//! `dmprl transport-worker`: sends synthetic segments as fast as possible.
//!
//! Through shared memory, it uses the same code as a run's worker. Through a pipe or a socket, it
//! writes each segment as one frame: length, header, block.

use std::fs::OpenOptions;
use std::io::Write;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Context;
use clap::Args;
use dmprl_actors::delivery::{Delivery, DeliveryError, attach};
use dmprl_control::Report;
use dmprl_control::{ControlPipe, ORPHAN_LIMIT};
use dmprl_shared::segment::Segment;
use dmprl_shared::transport::delivery::{Outbox, Sent};

use super::streams::frame_bytes;
use crate::synthetic_segments::{QUEUE_SEGMENTS, Size, SyntheticSegments};

/// A worker warns when it is blocked for this long. Waiting for the next round is normal.
const SEND_DEADLINE: Duration = Duration::from_secs(1_000_000);

const HELP: &str = "\
Exchanges JSON lines on standard input and output, like the other processes of a run, and exits at
the end of its input. Started by `bench transport`.

EXAMPLES
  dmprl transport-worker --segment-bytes 1024 --shared-memory /dev/shm/dmprl-1000/4f2a";

/// Arguments of `dmprl transport-worker`.
#[derive(Debug, Clone, PartialEq, Eq, Args)]
#[command(after_help = HELP)]
pub struct TransportWorkerArgs {
    /// Size of a segment in bytes: 1024 or 10240.
    #[arg(long, value_name = "N", value_parser = size)]
    segment_bytes: usize,
    /// Total number of workers.
    #[arg(long, value_name = "N", default_value_t = 1)]
    workers: usize,
    /// Index of this worker, from 0.
    #[arg(long, value_name = "I", default_value_t = 0)]
    index: u32,
    #[command(flatten)]
    route: Route,
}

#[derive(Debug, Clone, PartialEq, Eq, Args)]
#[group(required = true, multiple = false)]
struct Route {
    /// Send through this shared-memory directory.
    #[arg(long, value_name = "DIR")]
    shared_memory: Option<PathBuf>,
    /// Send into this pipe.
    #[arg(long, value_name = "PATH")]
    pipe: Option<PathBuf>,
    /// Send through the Unix socket at this path.
    #[arg(long, value_name = "PATH")]
    socket: Option<PathBuf>,
}

fn size(text: &str) -> Result<usize, String> {
    let bytes = text.parse().ok().and_then(Size::of_bytes).map(|size| size.bytes);
    bytes.ok_or_else(|| "expected 1024 or 10240".to_owned())
}

/// Sends until a stop is requested.
///
/// # Errors
/// The receiver has exited, or the transport fails.
pub fn transport_worker(args: &TransportWorkerArgs) -> anyhow::Result<()> {
    let control = ControlPipe::open(ORPHAN_LIMIT)?;
    let size = Size::of_bytes(args.segment_bytes).context("unsupported segment size")?;
    let Route { shared_memory, pipe, socket } = &args.route;
    if let Some(domain) = shared_memory {
        return through_shared_memory(args, size, domain, &control);
    }
    let mut synthetic_segments = SyntheticSegments::new(size.layout, args.index);
    if let Some(path) = pipe {
        let file = OpenOptions::new().write(true).open(path);
        let file = file.with_context(|| format!("cannot open {}", path.display()))?;
        return through_stream(file, &mut synthetic_segments, &control);
    }
    let path = socket.as_deref().context("no route")?;
    let stream = UnixStream::connect(path);
    let stream = stream.with_context(|| format!("cannot connect to {}", path.display()))?;
    through_stream(stream, &mut synthetic_segments, &control)
}

fn through_shared_memory(
    args: &TransportWorkerArgs,
    size: Size,
    domain: &Path,
    control: &ControlPipe,
) -> anyhow::Result<()> {
    let plan = size.plan(args.workers);
    let Some(end) = attach(control, domain, &plan, args.index)? else { return Ok(()) };
    let outbox = Outbox::new(size.layout, QUEUE_SEGMENTS, args.index, 0);
    let mut delivery = Delivery::new(control, SEND_DEADLINE, end, outbox);
    let mut synthetic_segments = SyntheticSegments::new(size.layout, args.index);
    while !control.stop_requested() {
        let Segment { header, block } = synthetic_segments.next();
        match delivery.deliver(header, block) {
            Err(DeliveryError::StopRequested) => break,
            delivered => delivered?,
        }
    }
    Ok(delivery.report()?)
}

fn through_stream(
    mut stream: impl Write,
    synthetic_segments: &mut SyntheticSegments,
    control: &ControlPipe,
) -> anyhow::Result<()> {
    // An empty report announces the connection.
    control.send(&Report::Sent(Sent::default()))?;
    let mut frame = Vec::new();
    while !control.stop_requested() {
        let Segment { header, block } = synthetic_segments.next();
        frame.clear();
        frame.extend_from_slice(&frame_bytes(block.len()).to_le_bytes());
        frame.extend_from_slice(bytemuck::bytes_of(header));
        frame.extend_from_slice(bytemuck::cast_slice(block));
        // Blocks while the stream is full, and fails once it is closed.
        stream.write_all(&frame).context("the receiver has closed the stream")?;
    }
    Ok(())
}
