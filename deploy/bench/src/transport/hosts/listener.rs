//! The learner's side of the benchmark between hosts.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use anyhow::{anyhow, bail};
use dmprl_bridge::gateway::{Gateway, GatewayEvent, GatewaySettings, RunFacts};
use dmprl_bridge::wire::RunState;
use dmprl_run::Watch;
use dmprl_shared::config::TASKS;
use dmprl_shared::parameters::ParameterSnapshot;
use dmprl_shared::segment::{Segment, check};
use dmprl_shared::transport::delivery::Inbox;
use dmprl_shared::transport::shared_memory::{LearnerEnd, serve};
use dmprl_shared::transport::{AcknowledgementPublisher, ParameterPublisher, SegmentReceiver};
use serde_json::{Value, json};
use tracing::info;

use super::{
    CONNECT_TIMEOUT, IDLE_SLEEP, INTERVAL, PARAMETERS, RETAINED_SEGMENTS_MAX, TOKEN, domain, plan,
};
use crate::statistics::{max, median};
use crate::synthetic_segments::SIZE_BETWEEN_HOSTS;

const WORKERS_MAX: usize = 64;
const PUBLISH_INTERVAL: Duration = Duration::from_millis(300);
/// Time from the first segment to the start of the measurement, in which the sender's window grows.
const SETTLE: Duration = Duration::from_secs(3);
/// Number of messages that announce the end, because a full link can lose some.
const END_MESSAGES: u32 = 10;

/// Receives segments at a Zenoh endpoint for `duration`, and returns the figures. Returns `None` if
/// the user interrupted it.
///
/// # Errors
/// The endpoint is in use, no host connects, or the transport fails.
pub fn listen(
    endpoint: &str,
    zenoh_file: Option<&Path>,
    duration: Duration,
) -> anyhow::Result<Option<Value>> {
    let watch = Watch::start()?;
    let domain = domain()?;
    let mut ingest = Ingest::new(serve(domain.path(), &plan(WORKERS_MAX))?);
    let policies = Arc::new(Policies::default());
    let gateway = start_gateway(&policies, endpoint, zenoh_file, domain.path());
    let start = Instant::now();
    let measured_s = loop {
        if watch.check().is_err() {
            break None;
        }
        ingest.turn(&policies)?;
        if policies.has_confirmed() {
            // A host without workers sends no segments.
            ingest.first_segment.get_or_insert_with(Instant::now);
        }
        if gateway.is_finished() {
            break Some(0.0);
        }
        match ingest.first_segment {
            Some(first) if first.elapsed() >= SETTLE + duration => {
                break Some((first.elapsed() - SETTLE).as_secs_f64());
            }
            None if start.elapsed() >= CONNECT_TIMEOUT => bail!("no host connected to {endpoint}"),
            _ => {}
        }
    };
    policies.stop.store(true, Ordering::Release);
    gateway.join().map_err(|_| anyhow!("the gateway has panicked"))??;
    let Some(seconds) = measured_s else { return Ok(None) };
    let latencies_ms = policies.latencies_ms.lock().unwrap_or_else(PoisonError::into_inner).clone();
    Ok(Some(json!({
        "segment_bytes": SIZE_BETWEEN_HOSTS.bytes,
        "segments_per_s": ingest.taken as f64 / seconds,
        "lost": ingest.lost,
        "sent_again": ingest.repeated,
        "refused": ingest.refused,
        "seconds": seconds,
        "policy_bytes": PARAMETERS * size_of::<f32>(),
        "policies": latencies_ms.len(),
        "policy_ms_median": median(&latencies_ms),
        "policy_ms_max": (!latencies_ms.is_empty()).then(|| max(&latencies_ms)),
    })))
}

/// The policies in flight and their latencies, shared with the gateway's thread.
#[derive(Default)]
struct Policies {
    /// Stops the gateway's thread.
    stop: AtomicBool,
    /// Version and publication time of each policy that no host has confirmed.
    unconfirmed: Mutex<VecDeque<(u64, Instant)>>,
    /// Time from publication to the receipt of the other host's confirmation \[ms\].
    latencies_ms: Mutex<Vec<f64>>,
}

impl Policies {
    fn publish(&self, version: u64) {
        let mut unconfirmed = self.unconfirmed.lock().unwrap_or_else(PoisonError::into_inner);
        unconfirmed.push_back((version, Instant::now()));
    }

    fn has_confirmed(&self) -> bool {
        !self.latencies_ms.lock().unwrap_or_else(PoisonError::into_inner).is_empty()
    }

    /// Records a confirmation, which also covers earlier versions: newer policies replace them.
    fn confirm(&self, version: u64) {
        let mut unconfirmed = self.unconfirmed.lock().unwrap_or_else(PoisonError::into_inner);
        let confirmed =
            unconfirmed.iter().take_while(|(published, _)| *published <= version).count();
        if let Some((_, since)) = unconfirmed.drain(..confirmed).next_back() {
            let latency_ms = since.elapsed().as_secs_f64() * 1e3;
            self.latencies_ms.lock().unwrap_or_else(PoisonError::into_inner).push(latency_ms);
        }
    }
}

/// Receives, checks, settles and acknowledges segments, and publishes policies.
struct Ingest {
    end: LearnerEnd,
    inbox: Inbox,
    segment: Segment,
    acknowledged_at: Instant,
    published_at: Option<Instant>,
    first_segment: Option<Instant>,
    version: u64,
    taken: u64,
    lost: u64,
    repeated: u64,
    refused: u64,
}

impl Ingest {
    fn new(end: LearnerEnd) -> Self {
        Self {
            end,
            inbox: Inbox::new(WORKERS_MAX),
            segment: Segment::zeroed(SIZE_BETWEEN_HOSTS.layout),
            acknowledged_at: Instant::now(),
            published_at: None,
            first_segment: None,
            version: 0,
            taken: 0,
            lost: 0,
            repeated: 0,
            refused: 0,
        }
    }

    fn turn(&mut self, policies: &Policies) -> anyhow::Result<()> {
        if self.end.segments.try_receive(&mut self.segment)? {
            self.take();
        } else {
            thread::sleep(IDLE_SLEEP);
        }
        let due = self.acknowledged_at.elapsed() >= INTERVAL;
        if due || self.inbox.owes_acknowledgement() {
            self.end.acknowledgements.acknowledge(self.inbox.acknowledge()?)?;
        }
        if due {
            self.acknowledged_at = Instant::now();
            self.end.segments.maintain()?;
            self.end.parameters.maintain()?;
            self.end.acknowledgements.maintain()?;
        }
        if self.published_at.is_none_or(|at| at.elapsed() >= PUBLISH_INTERVAL) {
            self.published_at = Some(Instant::now());
            self.version += 1;
            let version = self.version;
            policies.publish(version);
            let values = vec![version as f32; PARAMETERS];
            let architecture_hash = plan(1).architecture_hash;
            let env_steps = self.taken;
            let snapshot =
                ParameterSnapshot { version, env_steps, architecture_hash, settled: false, values };
            self.end.parameters.publish(&snapshot)?;
        }
        Ok(())
    }

    fn take(&mut self) {
        let since = *self.first_segment.get_or_insert_with(Instant::now);
        let Segment { header, block } = &self.segment;
        if check(header, block, &SIZE_BETWEEN_HOSTS.expected(WORKERS_MAX as u32)).is_err() {
            self.refused += 1;
            return;
        }
        match self.inbox.settle(header, block) {
            Ok(gap) => {
                self.lost += gap;
                self.taken += u64::from(since.elapsed() >= SETTLE);
            }
            Err(_) => self.repeated += 1,
        }
    }
}

fn start_gateway(
    policies: &Arc<Policies>,
    endpoint: &str,
    zenoh_file: Option<&Path>,
    domain: &Path,
) -> JoinHandle<anyhow::Result<()>> {
    let policies = Arc::clone(policies);
    let (endpoints, domain) = ([endpoint.to_owned()], domain.to_owned());
    let zenoh_file = zenoh_file.map(Path::to_owned);
    thread::spawn(move || {
        let facts = RunFacts {
            run_id: format!("{:016x}", plan(1).run_id),
            config: String::new(),
            // Never requested.
            spec: TASKS[0].spec(),
            token: TOKEN.to_owned(),
        };
        let settings = GatewaySettings {
            endpoints: &endpoints,
            zenoh_file: zenoh_file.as_deref(),
            domain: &domain,
            plan: plan(WORKERS_MAX),
            first_worker: 0,
            session: 0,
            segments_max: RETAINED_SEGMENTS_MAX,
        };
        let mut gateway = Gateway::open(settings, facts)?;
        while !policies.stop.load(Ordering::Acquire) {
            if !gateway.turn()? {
                thread::sleep(IDLE_SLEEP);
            }
            gateway.policy_versions().for_each(|version| policies.confirm(version));
            for event in gateway.take_events() {
                if let GatewayEvent::Notice(notice) = event {
                    info!("{notice}");
                }
            }
        }
        for _ in 0..END_MESSAGES {
            gateway.send_acks(RunState::Complete)?;
            thread::sleep(INTERVAL);
        }
        Ok(())
    })
}
