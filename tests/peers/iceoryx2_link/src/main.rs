//! Measures the losses of iceoryx2's own link over Zenoh between two hosts, both in this process.
//!
//! `iceoryx2-link RATE SECONDS [still|cut AFTER FOR]` sends segments of 2 KB with sequence numbers
//! at a rate \[1/s\] through a wire that stalls, or is cut and reconnected, after `AFTER` seconds
//! for `FOR` seconds. The two hosts see each other only over the link: their services have
//! different prefixes.

mod wire;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow};
use iceoryx2::config::Config;
use iceoryx2::prelude::*;
use iceoryx2_integrations_zenoh_tunnel_backend::ZenohBackend;
use iceoryx2_services_tunnel::{Config as TunnelConfig, Tunnel};
use wire::{Fault, Wire};

const SEGMENT_BYTES: usize = 2048;
const QUEUE: usize = 512;
/// Interval between two idle turns.
const IDLE: Duration = Duration::from_micros(100);
/// Limit for the two ends to find each other.
const FOUND_WITHIN: Duration = Duration::from_secs(3);
/// Silence after which nothing more arrives: longer than Zenoh takes to reconnect.
const OVER_AFTER: Duration = Duration::from_secs(15);

type Segment = [u8; SEGMENT_BYTES];
type Service =
    iceoryx2::service::port_factory::publish_subscribe::PortFactory<ipc::Service, Segment, ()>;

/// A host: its shared memory, and its end of the link.
struct Host {
    config: Config,
    service: Service,
    _node: Node<ipc::Service>,
}

impl Host {
    fn new(prefix: &str) -> Result<Self> {
        let mut config = Config::default();
        let prefix = format!("{prefix}{}_", std::process::id());
        config.global.prefix = FileName::new(prefix.as_bytes()).map_err(odd)?;
        let node = NodeBuilder::new().config(&config).create::<ipc::Service>().map_err(odd)?;
        let service = node
            .service_builder(&"segments".try_into().map_err(odd)?)
            .publish_subscribe::<Segment>()
            .enable_safe_overflow(false)
            .history_size(0)
            .subscriber_max_buffer_size(QUEUE)
            .open_or_create()
            .map_err(odd)?;
        Ok(Self { config, service, _node: node })
    }

    /// Runs the link on its own thread, as its command does, until `over`.
    fn join(&self, ends: String, over: &Arc<AtomicBool>) -> JoinHandle<Result<u64>> {
        let (config, over) = (self.config.clone(), Arc::clone(over));
        thread::spawn(move || {
            let zenoh = zenoh::Config::from_json5(&ends).map_err(|error| anyhow!("{error}"))?;
            let mut tunnel = Tunnel::<ipc::Service, ZenohBackend<ipc::Service>>::create(
                &TunnelConfig::default(),
                &config,
                &zenoh,
            )
            .map_err(odd)?;
            let mut errors = 0;
            while !over.load(Ordering::Acquire) {
                tunnel.discover().map_err(odd)?;
                let again = Instant::now() + Duration::from_millis(500);
                while Instant::now() < again {
                    errors += u64::from(tunnel.propagate().is_err());
                    thread::sleep(IDLE);
                }
            }
            Ok(errors)
        })
    }
}

fn odd(error: impl std::fmt::Debug) -> anyhow::Error {
    anyhow!("{error:?}")
}

/// Sends at a steady rate; returns the number sent.
fn send(host: &Host, rate: f64, seconds: f64) -> Result<u64> {
    let publisher = host.service.publisher_builder();
    let publisher =
        publisher.backpressure_strategy(BackpressureStrategy::RetryUntilDelivered).create();
    let publisher = publisher.map_err(odd)?;
    thread::sleep(FOUND_WITHIN);
    let began = Instant::now();
    let mut sent = 0_u64;
    while began.elapsed().as_secs_f64() < seconds {
        let due = (began.elapsed().as_secs_f64() * rate) as u64;
        while sent < due {
            let mut segment = [0; SEGMENT_BYTES];
            segment[..8].copy_from_slice(&sent.to_le_bytes());
            let sample = publisher.loan_uninit().map_err(odd)?;
            sample.write_payload(segment).send().map_err(odd)?;
            sent += 1;
        }
        thread::sleep(IDLE);
    }
    Ok(sent)
}

/// Receives until nothing more arrives; returns the number received.
fn receive(service: &Service, over: &AtomicBool) -> Result<u64> {
    let subscriber = service.subscriber_builder().buffer_size(QUEUE).create().map_err(odd)?;
    let (mut got, mut last) = (0, Instant::now());
    while !over.load(Ordering::Acquire) || last.elapsed() < OVER_AFTER {
        match subscriber.receive().map_err(odd)? {
            Some(_) => (got, last) = (got + 1, Instant::now()),
            None => thread::sleep(IDLE),
        }
    }
    Ok(got)
}

fn main() -> Result<()> {
    set_log_level(LogLevel::Error);
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |at: usize| -> Result<f64> {
        let text = arguments.get(at).context("expected RATE SECONDS [still|cut AFTER FOR]")?;
        text.parse().with_context(|| format!("{text}: expected a number"))
    };
    let (rate, seconds) = (number(0)?, number(1)?);
    let fault = match arguments.get(2).map(String::as_str) {
        None => None,
        Some("still") => Some(Fault::Still),
        Some("cut") => Some(Fault::Cut),
        Some(other) => return Err(anyhow!("{other}: expected still or cut")),
    };
    let wire = Wire::lay()?;
    let (far, near) = (Host::new("far_")?, Host::new("near_")?);
    let (sent_all, over) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicBool::new(false)));
    let none = "scouting:{multicast:{enabled:false},gossip:{enabled:false}},mode:\"peer\"";
    let (listen, connect) = (wire.far_end(), wire.near_end());
    let ends = [
        far.join(format!("{{listen:{{endpoints:[\"tcp/{listen}\"]}},{none}}}"), &over),
        near.join(
            format!("{{connect:{{endpoints:[\"tcp/{connect}\"]}},listen:{{endpoints:[]}},{none}}}"),
            &over,
        ),
    ];
    let ended = Arc::clone(&sent_all);
    let receiver = thread::spawn(move || receive(&far.service, &ended));
    if let Some(fault) = fault {
        let (after, long) = (number(3)?, number(4)?);
        wire.strike(fault, FOUND_WITHIN + Duration::from_secs_f64(after), long);
    }
    let sent = send(&near, rate, seconds)?;
    sent_all.store(true, Ordering::Release);
    let got = receiver.join().map_err(odd)??;
    over.store(true, Ordering::Release);
    let errors = ends.into_iter().map(|end| end.join().map_err(odd)?).sum::<Result<u64>>()?;
    println!("sent {sent}, got {got}, lost {}, errors told {errors}", sent.saturating_sub(got));
    Ok(())
}
