//! `dmprl bench transport` between two hosts: a run's relay and gateway with synthetic data.
//!
//! The `listener` takes the learner's place: it checks, settles and acknowledges segments, and
//! publishes a policy at intervals. The `connector` has workers that only send.

mod connector;
mod listener;

use std::time::Duration;

use dmprl_shared::transport::shared_memory::{Domain, Plan};

pub use connector::connect;
pub use listener::listen;

use crate::synthetic_segments::SIZE_BETWEEN_HOSTS;
use dmprl_run::random_u64;
use dmprl_supervisor::create_domain;

/// Number of values in a policy: half a megabyte.
const PARAMETERS: usize = 131_072;
/// Segments that a worker retains, and the gateway for each worker: more than the measured links
/// have in flight.
const RETAINED_SEGMENTS_MAX: usize = 32_768;
/// Maximum amount of a host's data in flight \[bytes\], also more than the measured links need.
const IN_FLIGHT_BYTES_MAX: u64 = 256 << 20;
/// Token of the run. It is no secret, because the data is synthetic.
const TOKEN: &str = "bench transport between hosts";
const IDLE_SLEEP: Duration = Duration::from_micros(200);
/// Interval between two acknowledgements, and between two attempts to connect.
const INTERVAL: Duration = Duration::from_millis(10);
/// Time limit for the other host to connect, and to return after a lost connection.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(60);

fn plan(workers: usize) -> Plan {
    Plan { parameters_len: PARAMETERS, ..SIZE_BETWEEN_HOSTS.plan(workers) }
}

fn domain() -> anyhow::Result<Domain> {
    create_domain(&format!("bench-{:016x}", random_u64()?))
}
