//! The workers' side of the benchmark between hosts.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Instant;

use anyhow::{Context, anyhow, bail};
use dmprl_bridge::host_messages::Lease;
use dmprl_bridge::join::{JoinOutcome, JoinSettings, request_join};
use dmprl_bridge::relay::{HostCounts, Relay, RelaySettings, Turn};
use dmprl_bridge::{Link, LinkMode};
use dmprl_run::Watch;
use dmprl_run::random_u64;
use dmprl_shared::segment::Segment;
use dmprl_shared::transport::AcknowledgementSubscriber;
use dmprl_shared::transport::delivery::{Acknowledgements, Outbox};
use dmprl_shared::transport::shared_memory::{Plan, attach};
use serde_json::{Value, json};

use super::{
    CONNECT_TIMEOUT, IDLE_SLEEP, IN_FLIGHT_BYTES_MAX, INTERVAL, RETAINED_SEGMENTS_MAX, TOKEN,
    domain, plan,
};
use crate::synthetic_segments::SyntheticSegments;

/// Segments generated between two checks for acknowledgements.
const BATCH_SEGMENTS: usize = 32;

/// Sends synthetic segments to the listener at `endpoint` until it ends the measurement. Returns
/// `None` if the user interrupted it.
/// - `rate`: segments per second of all workers together; `None` for as many as possible.
///
/// # Errors
/// Nothing listens at `endpoint`, or a worker or the relay fails.
pub fn connect(
    endpoint: &str,
    zenoh_file: Option<&Path>,
    workers: u32,
    rate: Option<u32>,
) -> anyhow::Result<Option<Value>> {
    let watch = Watch::start()?;
    let join = JoinSettings {
        endpoint: endpoint.to_owned(),
        token: TOKEN.to_owned(),
        host: random_u64()?,
        name: "bench".to_owned(),
        workers,
    };
    let Some(lease) = request_lease(&join, zenoh_file, &watch)? else { return Ok(None) };
    let domain = domain()?;
    let plan = plan(workers as usize);
    let mut relay = Relay::start(RelaySettings {
        join,
        lease,
        zenoh_file,
        domain: domain.path(),
        plan: &plan,
        segments_max: RETAINED_SEGMENTS_MAX,
        in_flight_bytes_max: IN_FLIGHT_BYTES_MAX,
    })?;
    let stop = Arc::new(AtomicBool::new(false));
    let worker_rate = rate.map(|rate| f64::from(rate) / f64::from(workers));
    let threads: Vec<JoinHandle<anyhow::Result<()>>> = (0..workers)
        .map(|index| {
            let (stop, path, plan) = (Arc::clone(&stop), domain.path().to_owned(), plan.clone());
            thread::spawn(move || work(index, worker_rate, &path, &plan, &stop))
        })
        .collect();
    let interrupted = loop {
        match relay.turn(&HostCounts::default())? {
            Turn::Complete => break false,
            Turn::Idle => thread::sleep(IDLE_SLEEP),
            Turn::Worked => {}
        }
        if watch.check().is_err() || threads.iter().any(JoinHandle::is_finished) {
            break true;
        }
        if relay.away().is_some_and(|(since, _)| since.elapsed() >= CONNECT_TIMEOUT) {
            bail!("{endpoint} no longer answers");
        }
    };
    stop.store(true, Ordering::Release);
    for thread in threads {
        let result = thread.join().map_err(|_| anyhow!("a worker has panicked"))?;
        result.context("a worker failed")?;
    }
    let (acknowledged, window_bytes) = (relay.acked(), relay.window_bytes());
    let figures =
        json!({"workers": workers, "acknowledged": acknowledged, "window_bytes": window_bytes});
    Ok((!interrupted).then_some(figures))
}

/// Joins the run at the endpoint. Returns `None` if the user interrupted it.
fn request_lease(
    join: &JoinSettings,
    zenoh_file: Option<&Path>,
    watch: &Watch,
) -> anyhow::Result<Option<Lease>> {
    let (start, endpoint) = (Instant::now(), &join.endpoint);
    let link = Link::open(LinkMode::Connect(endpoint), &join.token, zenoh_file)?;
    loop {
        match request_join(&link, join, None)? {
            JoinOutcome::Welcome(admission) => return Ok(Some(admission.welcome.lease)),
            JoinOutcome::Refused(why) => bail!("{endpoint} refused the join request: {why}"),
            JoinOutcome::Later(_) | JoinOutcome::Silent if watch.check().is_err() => {
                return Ok(None);
            }
            JoinOutcome::Later(why) if start.elapsed() >= CONNECT_TIMEOUT => bail!("{why}"),
            JoinOutcome::Silent if start.elapsed() >= CONNECT_TIMEOUT => {
                bail!("no listener of the benchmark answers at {endpoint}")
            }
            JoinOutcome::Later(_) | JoinOutcome::Silent => thread::sleep(INTERVAL),
        }
    }
}

/// A worker that only sends, at `rate` segments per second or as fast as possible.
fn work(
    index: u32,
    rate: Option<f64>,
    domain: &Path,
    plan: &Plan,
    stop: &AtomicBool,
) -> anyhow::Result<()> {
    let start = Instant::now();
    let mut end = loop {
        match attach(domain, plan, index as usize) {
            Ok(end) => break end,
            Err(error) if start.elapsed() >= CONNECT_TIMEOUT => return Err(error.into()),
            Err(_) => thread::sleep(INTERVAL),
        }
    };
    let mut outbox = Outbox::new(plan.layout, RETAINED_SEGMENTS_MAX, index, 0);
    let mut synthetic_segments = SyntheticSegments::new(plan.layout, index);
    let mut acknowledgements = Acknowledgements::default();
    let (start, mut generated) = (Instant::now(), 0_usize);
    while !stop.load(Ordering::Acquire) {
        if end.acknowledgements.newest(&mut acknowledgements)? {
            outbox.acknowledge(&acknowledgements);
        }
        let room = outbox.capacity() - outbox.len();
        let due = rate.map_or(BATCH_SEGMENTS, |rate| {
            let due = (start.elapsed().as_secs_f64() * rate) as usize;
            // Skips segments that could not be sent in time: a robot cannot catch up either.
            generated = generated.max(due.saturating_sub(BATCH_SEGMENTS));
            due - generated
        });
        let batch = if outbox.unsent() == 0 { room.min(BATCH_SEGMENTS).min(due) } else { 0 };
        generated += batch;
        for _ in 0..batch {
            let Segment { header, block } = synthetic_segments.next();
            outbox.put(header, block);
        }
        outbox.offer(&mut end.segments)?;
        if outbox.unsent() > 0 || batch == 0 {
            thread::sleep(IDLE_SLEEP);
        }
    }
    Ok(())
}
