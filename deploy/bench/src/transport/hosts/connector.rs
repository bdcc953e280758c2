//! The workers' end of the benchmark between hosts.

use std::path::{Path, PathBuf};
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

use super::{IDLE_SLEEP, INTERVAL, RETAINED_SEGMENTS_MAX, CONNECT_TIMEOUT, TOKEN, IN_FLIGHT_BYTES_MAX, domain, plan};
use crate::synthetic_segments::SyntheticSegments;

/// Segments generated between two checks for acknowledgements.
const BATCH_SEGMENTS: usize = 32;

/// Sends synthetic segments to the listener at the endpoint until it has enough; returns `None` if
/// interrupted. `rate` is the total rate of all workers \[segments/s\]; `None` for the maximum.
///
/// # Errors
/// No process listens there, or an end fails.
pub fn connect(
    endpoint: &str,
    zenoh_file: Option<&Path>,
    (workers, rate): (u32, Option<u32>),
) -> anyhow::Result<Option<Value>> {
    let watch = Watch::start()?;
    let join = JoinSettings {
        endpoint: endpoint.to_owned(),
        token: TOKEN.to_owned(),
        host: random_u64()?,
        name: "bench".to_owned(),
        workers,
    };
    let Some(lease) = welcomed(&join, zenoh_file, &watch)? else { return Ok(None) };
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
    let over = Arc::new(AtomicBool::new(false));
    let each = rate.map(|rate| f64::from(rate) / f64::from(workers));
    let threads: Vec<JoinHandle<anyhow::Result<()>>> = (0..workers)
        .map(|index| {
            let (over, path, plan) = (Arc::clone(&over), domain.path().to_owned(), plan.clone());
            thread::spawn(move || work((index, each), (&path, &plan), &over))
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
    over.store(true, Ordering::Release);
    for thread in threads {
        let ended = thread.join().map_err(|_| anyhow!("a worker has panicked"))?;
        ended.context("a worker failed")?;
    }
    let (acknowledged, window_bytes) = (relay.acked(), relay.window_bytes());
    let figures =
        json!({"workers": workers, "acknowledged": acknowledged, "window_bytes": window_bytes});
    Ok((!interrupted).then_some(figures))
}

fn welcomed(
    join: &JoinSettings,
    zenoh_file: Option<&Path>,
    watch: &Watch,
) -> anyhow::Result<Option<Lease>> {
    let (began, endpoint) = (Instant::now(), &join.endpoint);
    let link = Link::open(LinkMode::Connect(endpoint), zenoh_file)?;
    loop {
        match request_join(&link, join, None)? {
            JoinOutcome::Welcome(welcome) => return Ok(Some(welcome.lease)),
            JoinOutcome::Refused(why) => bail!("{endpoint} refuses: {why}"),
            JoinOutcome::Later(why) if began.elapsed() >= CONNECT_TIMEOUT => bail!("{why}"),
            JoinOutcome::Later(_) if watch.check().is_err() => return Ok(None),
            JoinOutcome::Later(_) => thread::sleep(INTERVAL),
        }
    }
}

/// A worker that only sends, at `rate` segments per second or as fast as possible.
fn work(
    (index, rate): (u32, Option<f64>),
    (domain, plan): (&PathBuf, &Plan),
    over: &AtomicBool,
) -> anyhow::Result<()> {
    let began = Instant::now();
    let mut end = loop {
        match attach(domain, plan, index as usize) {
            Ok(end) => break end,
            Err(error) if began.elapsed() >= CONNECT_TIMEOUT => return Err(error.into()),
            Err(_) => thread::sleep(INTERVAL),
        }
    };
    let mut outbox = Outbox::new(plan.layout, RETAINED_SEGMENTS_MAX, index, 0);
    let mut synthetic_segments = SyntheticSegments::new(plan.layout, index);
    let mut heard = Acknowledgements::default();
    let (began, mut made) = (Instant::now(), 0_usize);
    while !over.load(Ordering::Acquire) {
        if end.acknowledgements.newest(&mut heard)? {
            outbox.acknowledge(&heard);
        }
        let room = outbox.capacity() - outbox.len();
        let due = rate.map_or(BATCH_SEGMENTS, |rate| {
            let due = (began.elapsed().as_secs_f64() * rate) as usize;
            // Segments that could not be sent in time are skipped: a robot cannot catch up either.
            made = made.max(due.saturating_sub(BATCH_SEGMENTS));
            due - made
        });
        let together = if outbox.unsent() == 0 { room.min(BATCH_SEGMENTS).min(due) } else { 0 };
        made += together;
        for _ in 0..together {
            let Segment { header, block } = synthetic_segments.next();
            outbox.put(header, block);
        }
        outbox.offer(&mut end.segments)?;
        if outbox.unsent() > 0 || together == 0 {
            thread::sleep(IDLE_SLEEP);
        }
    }
    Ok(())
}
