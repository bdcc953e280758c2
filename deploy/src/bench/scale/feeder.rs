//! `dmprl segment-feeder`: a process that plays many workers, which only send made-up segments.
//!
//! Each of its workers has what a run's worker has: its own queue and outbox, checksums,
//! acknowledgements. One thread serves all of them in turn: with a thread or a process each, most
//! of a small machine's time would go into waking those whose queues are full.

use std::path::PathBuf;
use std::thread;
use std::time::Duration;

use clap::Args;
use dmprl_actors::delivery::attach;
use dmprl_shared::segment::{Segment, SegmentLayout};
use dmprl_shared::transport::delivery::{Acknowledgements, Outbox};
use dmprl_shared::transport::shared_memory::{Plan, WorkerEnd};
use dmprl_shared::transport::{AcknowledgementSubscriber, SendOutcome};

use crate::bench::made_up::{MadeUp, RUN_ID};
use crate::control::Report;
use crate::roles::{ControlPipe, ORPHAN_LIMIT};

/// A round through all queues that fills less than this part of them is followed by a pause: to ask
/// a full queue takes as long as to send a segment.
const FILLED_PART: usize = 4;
/// The learner empties a small part of the queues meanwhile.
const PAUSE: Duration = Duration::from_micros(500);

const HELP: &str = "\
Speaks JSON lines on standard input and output as the roles of a run do, and ends when its standard
input ends. `bench scale` starts it.

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
    /// How many workers the learner has.
    #[arg(long, value_name = "N")]
    workers: usize,
    /// The first that this process plays, from 0,
    #[arg(long, value_name = "I")]
    first: u32,
    /// and how many.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    count: u32,
    /// Segments that a queue holds.
    #[arg(long, value_name = "N")]
    queue_segments: usize,
    /// Segments that a worker keeps until they are acknowledged.
    #[arg(long, value_name = "N")]
    outbox_segments: usize,
    /// Steps of a segment.
    #[arg(long, value_name = "K")]
    segment_steps: usize,
    /// Numbers of an observation.
    #[arg(long, value_name = "O")]
    observation_len: usize,
    /// Numbers of an action.
    #[arg(long, value_name = "A")]
    action_len: usize,
    /// Parameters of the policy.
    #[arg(long, value_name = "P")]
    parameters_len: usize,
    /// What the learner calls its policy's architecture.
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

    /// The command line that says all this but the directory and which workers.
    pub(super) fn words(plan: &Plan, outbox_segments: usize) -> Vec<String> {
        let numbers = [
            ("--workers", plan.worker_count),
            ("--queue-segments", plan.queue_segments),
            ("--outbox-segments", outbox_segments),
            ("--segment-steps", plan.layout.segment_steps),
            ("--observation-len", plan.layout.observation_len),
            ("--action-len", plan.layout.action_len),
            ("--parameters-len", plan.parameters_len),
        ];
        let mut words = vec!["segment-feeder".to_owned()];
        words.extend(["--architecture-hash".to_owned(), plan.architecture_hash.to_string()]);
        words.extend(numbers.into_iter().flat_map(|(flag, it)| [flag.to_owned(), it.to_string()]));
        words
    }
}

/// Sends until a stop is asked for; then each worker says what it has sent.
///
/// # Errors
/// The learner is gone, or the transport is broken.
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
            made_up: MadeUp::of(plan.layout, index, plan.architecture_hash),
            acknowledgements: Acknowledgements::default(),
        });
    }
    let queued_max = plan.queue_segments * workers.len();
    while !control.stop_requested() {
        let mut sent = 0;
        for worker in &mut workers {
            sent += worker.fill(plan.queue_segments)?;
        }
        if sent * FILLED_PART < queued_max {
            thread::sleep(PAUSE);
        }
    }
    for worker in &mut workers {
        control.send(&Report::Sent(worker.outbox.sent()))?;
    }
    Ok(())
}

/// One of those that this process plays.
struct Worker {
    end: WorkerEnd,
    outbox: Outbox,
    made_up: MadeUp,
    acknowledgements: Acknowledgements,
}

impl Worker {
    /// Sends until its queue is full, `segments_max` at most; returns how many. A worker of a run
    /// would sleep on its full queue, where this one lets others have the processor.
    fn fill(&mut self, segments_max: usize) -> anyhow::Result<usize> {
        let Self { end, outbox, made_up, acknowledgements } = self;
        for sent in 0..segments_max {
            if 2 * outbox.len() >= outbox.capacity()
                && end.acknowledgements.newest(acknowledgements)?
            {
                outbox.acknowledge(acknowledgements);
            }
            // What found no room the last time comes first.
            if outbox.offer(&mut end.segments)? != SendOutcome::Delivered
                || outbox.len() == outbox.capacity()
            {
                return Ok(sent);
            }
            let Segment { header, block } = made_up.next();
            outbox.put(header, block);
        }
        outbox.offer(&mut end.segments)?;
        Ok(segments_max)
    }
}
