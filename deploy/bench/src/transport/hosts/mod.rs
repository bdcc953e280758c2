//! `dmprl bench transport` between two hosts: a run's relay and gateway, with synthetic data.
//!
//! One end (`here`) acts as the learner: it checks, settles and acknowledges segments, and
//! publishes a policy at intervals. The other end (`there`) has workers that only send.

mod listener;
mod connector;

use std::time::Duration;

use dmprl_shared::transport::shared_memory::{Domain, Plan};

pub use listener::listen;
pub use connector::connect;

use crate::synthetic_segments::SIZE_BETWEEN_HOSTS;
use dmprl_run::random_u64;
use dmprl_supervisor::create_domain;

/// Values of a policy: half a megabyte.
const PARAMETERS: usize = 131_072;
/// Segments that a worker retains, and the gateway for each worker: more than any link here has in
/// flight.
const RETAINED_SEGMENTS_MAX: usize = 32_768;
/// Limit of a host's data in flight \[bytes\]: also more than any link needs.
const IN_FLIGHT_BYTES_MAX: u64 = 256 << 20;
/// Synthetic segments need no secret.
const TOKEN: &str = "bench transport between hosts";
const IDLE_SLEEP: Duration = Duration::from_micros(200);
/// Interval between two acknowledgements, and between two attempts to reach the other end.
const INTERVAL: Duration = Duration::from_millis(10);
/// Time limit for the other end to connect.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(60);

fn plan(workers: usize) -> Plan {
    Plan { parameters_len: PARAMETERS, ..SIZE_BETWEEN_HOSTS.plan(workers) }
}

fn domain() -> anyhow::Result<Domain> {
    create_domain(&format!("bench-{:016x}", random_u64()?))
}
