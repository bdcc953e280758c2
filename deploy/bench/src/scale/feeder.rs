//! `dmprl segment-feeder`: many synthetic workers that only send, in one process.
//!
//! Like a run's worker, each has its own queue and outbox, and handles checksums and
//! acknowledgements. One thread serves all of them. With a thread or a process each, a small
//! machine would spend most of its time waking workers with full queues.

use std::path::PathBuf;
use std::thread;
use std::time::Duration;

use clap::Args;
use dmprl_actors::delivery::attach;
use dmprl_control::Report;
use dmprl_control::{ControlPipe, ORPHAN_LIMIT};
use dmprl_shared::segment::{Segment, SegmentLayout};
use dmprl_shared::transport::delivery::{Acknowledgements, Outbox};
use dmprl_shared::transport::shared_memory::{Plan, WorkerEnd};
use dmprl_shared::transport::{AcknowledgementSubscriber, SendOutcome};

use crate::synthetic_segments::{RUN_ID, SyntheticSegments};

/// The feeder sleeps after a round in which it sent less than 1 / `FILLED_DIVISOR` of the capacity
/// of all queues, because checking a full queue costs as much as sending a segment.
const FILLED_DIVISOR: usize = 4;
/// Length of that sleep. The learner empties a small part of the queues in this time.
const SLEEP: Duration = Duration::from_micros(500);

const HELP: &str = "\
Exchanges JSON lines on standard input and output, like the other processes of a run, and exits at
the end of its input. Started by `bench scale`.

EXAMPLES
  dmprl segment-feeder --shared-memory /dev/shm/dmprl-1000/4f2a --workers 256 --first 0 \\
      --count 64 --queue-segments 32 --outbox-segments 1056 --segment-steps 5 \\
      --observation-len 36 --action-len 3 --parameters-len 75000 --architecture-hash 1";

/// Arguments of `dmprl segment-feeder`.
#[derive(Debug, Clone, PartialEq, Eq, Args)]
#[command(after_help = HELP)]
pub struct SegmentFeederArgs {
    /// The shared-memory directory.
    #[arg(long, value_name = "DIR")]
    shared_memory: PathBuf,
    /// Total number of the learner's workers.
    #[arg(long, value_name = "N")]
    workers: usize,
    /// Index of this process's first worker, from 0.
    #[arg(long, value_name = "I")]
    first: u32,
    /// Number of workers in this process.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    count: u32,
    /// Capacity of a queue in segments.
    #[arg(long, value_name = "N")]
    queue_segments: usize,
    /// Capacity in segments of a worker's outbox, which retains them until they are acknowledged.
    #[arg(long, value_name = "N")]
    outbox_segments: usize,
    /// Control steps per segment.
    #[arg(long, value_name = "K")]
    segment_steps: usize,
    /// Length of an observation.
    #[arg(long, value_name = "O")]
    observation_len: usize,
    /// Length of an action.
    #[arg(long, value_name = "A")]
    action_len: usize,
    /// Number of the policy's parameters.
    #[arg(long, value_name = "P")]
    parameters_len: usize,
    /// Hash of the learner's policy architecture.
    #[arg(long, value_name = "H")]
    architecture_hash: u64,
}

impl SegmentFeederArgs {
    fn plan(&self) -> Plan {
        Plan {
            run_id: RUN_ID,
            architecture_hash: self.architecture_hash,
            layout: SegmentLayout {
                segment_steps: self.segment_steps,
                observation_len: self.observation_len,
                action_len: self.action_len,
            },
            worker_count: self.workers,
            queue_segments: self.queue_segments,
            parameters_len: self.parameters_len,
        }
    }

    /// Returns the command-line arguments for a plan, without the directory and the workers'
    /// indices.
    pub(super) fn arguments(plan: &Plan, outbox_segments: usize) -> Vec<String> {
        let numbers = [
            ("--workers", plan.worker_count),
            ("--queue-segments", plan.queue_segments),
            ("--outbox-segments", outbox_segments),
            ("--segment-steps", plan.layout.segment_steps),
            ("--observation-len", plan.layout.observation_len),
            ("--action-len", plan.layout.action_len),
            ("--parameters-len", plan.parameters_len),
        ];
        let mut arguments = vec!["segment-feeder".to_owned()];
        arguments.extend(["--architecture-hash".to_owned(), plan.architecture_hash.to_string()]);
        arguments
            .extend(numbers.into_iter().flat_map(|(flag, it)| [flag.to_owned(), it.to_string()]));
        arguments
    }
}

/// Sends until a stop is requested, then reports the number of segments that each worker sent.
///
/// # Errors
/// The learner has exited, or the transport fails.
pub fn segment_feeder(args: &SegmentFeederArgs) -> anyhow::Result<()> {
    let control = ControlPipe::open(ORPHAN_LIMIT)?;
    let plan = args.plan();
    let mut workers = Vec::new();
    for index in args.first..args.first + args.count {
        let domain = args.shared_memory.as_path();
        let Some(end) = attach(&control, domain, &plan, index)? else { return Ok(()) };
        workers.push(Worker {
            end,
            outbox: Outbox::new(plan.layout, args.outbox_segments, index, 0),
            synthetic_segments: SyntheticSegments::with_hash(
                plan.layout,
                index,
                plan.architecture_hash,
            ),
            acknowledgements: Acknowledgements::default(),
        });
    }
    let queued_max = plan.queue_segments * workers.len();
    while !control.stop_requested() {
        let mut sent = 0;
        for worker in &mut workers {
            sent += worker.fill(plan.queue_segments)?;
        }
        if sent * FILLED_DIVISOR < queued_max {
            thread::sleep(SLEEP);
        }
    }
    for worker in &mut workers {
        control.send(&Report::Sent(worker.outbox.sent()))?;
    }
    Ok(())
}

/// A synthetic worker of this process.
struct Worker {
    end: WorkerEnd,
    outbox: Outbox,
    synthetic_segments: SyntheticSegments,
    acknowledgements: Acknowledgements,
}

impl Worker {
    /// Sends up to `segments_max` segments until the queue is full, and returns their number. A
    /// full queue does not block, because other workers share the thread.
    fn fill(&mut self, segments_max: usize) -> anyhow::Result<usize> {
        let Self { end, outbox, synthetic_segments, acknowledgements } = self;
        for sent in 0..segments_max {
            if 2 * outbox.len() >= outbox.capacity()
                && end.acknowledgements.newest(acknowledgements)?
            {
                outbox.acknowledge(acknowledgements);
            }
            // Retries the segment that did not fit the last time.
            if outbox.offer(&mut end.segments)? != SendOutcome::Delivered
                || outbox.len() == outbox.capacity()
            {
                return Ok(sent);
            }
            let Segment { header, block } = synthetic_segments.next();
            outbox.put(header, block);
        }
        outbox.offer(&mut end.segments)?;
        Ok(segments_max)
    }
}
