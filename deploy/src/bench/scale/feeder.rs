//! `dmprl segment-feeder`: a process that plays many workers, which only send made-up segments.
//!
//! Each of its workers is a thread with the code of a run's worker behind it: its own queue and
//! outbox, checksums, acknowledgements, and the pauses of a worker whose queue is full.

use std::path::PathBuf;
use std::thread;
use std::time::Duration;

use clap::Args;
use dmprl_shared::segment::{Segment, SegmentLayout};
use dmprl_shared::transport::delivery::Outbox;
use dmprl_shared::transport::shared_memory::Plan;

use crate::bench::made_up::{MadeUp, RUN_ID};
use crate::roles::{ControlPipe, Delivery, ORPHAN_LIMIT, Stopped, attach_within};

/// A worker that waits for its turn is no reason for a warning.
const NO_WARNING: Duration = Duration::from_secs(1_000_000);

const HELP: &str = "\
Speaks JSON lines on standard input and output as the roles of a run do, and ends when its standard
input ends. `bench scale` starts it.

EXAMPLES
  dmprl segment-feeder --shared-memory /dev/shm/dmprl-1000/4f2a --workers 256 --first 0 --count 64 \\
      --queue-segments 32 --outbox-segments 1056 --segment-steps 5 --observation-len 36 \\
      --action-len 3 --parameters-len 75000 --architecture-hash 1";

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
    let mut ends = Vec::new();
    for index in args.first..args.first + args.count {
        let domain = args.shared_memory.as_path();
        let Some(end) = attach_within(&control, (domain, &plan), index)? else { return Ok(()) };
        ends.push((index, end));
    }
    thread::scope(|scope| {
        let start = |(index, end)| {
            let outbox = Outbox::new(plan.layout, args.outbox_segments, index, 0);
            let mut delivery = Delivery::new(&control, NO_WARNING, end, outbox);
            let mut made_up = MadeUp::of(plan.layout, index, plan.architecture_hash);
            let (control, flag) = (&control, control.stop_flag());
            scope.spawn(move || {
                let sent = deliver(&mut delivery, &mut made_up, control);
                if sent.is_err() {
                    // The others cannot go on without this one's error being seen.
                    flag.store(true, std::sync::atomic::Ordering::Release);
                }
                sent
            })
        };
        let threads: Vec<_> = ends.into_iter().map(start).collect();
        for thread in threads {
            match thread.join() {
                Ok(sent) => sent?,
                Err(panic) => std::panic::resume_unwind(panic),
            }
        }
        Ok(())
    })
}

fn deliver(
    delivery: &mut Delivery<'_>,
    made_up: &mut MadeUp,
    control: &ControlPipe,
) -> anyhow::Result<()> {
    while !control.stop_requested() {
        let Segment { header, block } = made_up.next();
        match delivery.deliver(header, block) {
            Ok(()) => {}
            Err(Stopped::Asked) => break,
            Err(Stopped::Failed(error)) => return Err(error),
        }
    }
    delivery.report()
}
