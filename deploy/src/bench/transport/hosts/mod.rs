//! The same between two hosts: relay and gateway of a run, with made-up segments and policies.
//!
//! One end (`here`) takes the learner's place: it checks, settles and acknowledges, and publishes a
//! policy now and then. The other (`there`) has workers that only send.

mod here;
mod there;

use std::time::Duration;

use dmprl_shared::transport::shared_memory::{Domain, Plan};

pub use here::listen;
pub use there::connect;

use crate::bench::made_up::BETWEEN_HOSTS;
use crate::launch::create_domain;
use crate::run_directory::random_u64;

/// Values of a policy: half a megabyte.
const PARAMETERS: usize = 131_072;
/// What a worker keeps, and the gateway of each: more than any link here has under way.
const KEPT: usize = 32_768;
/// What a host may have under way \[bytes\]: likewise.
const UNDER_WAY_BYTES_MAX: u64 = 256 << 20;
/// Made-up segments are no secret.
const TOKEN: &str = "bench transport between hosts";
const IDLE: Duration = Duration::from_micros(200);
/// Between two acknowledgements, or looks for somebody who is not there yet.
const INTERVAL: Duration = Duration::from_millis(10);
/// For the other end to come.
const PATIENCE: Duration = Duration::from_secs(60);

fn plan(workers: usize) -> Plan {
    Plan { parameters_len: PARAMETERS, ..BETWEEN_HOSTS.plan(workers) }
}

fn domain() -> anyhow::Result<Domain> {
    create_domain(&format!("bench-{:016x}", random_u64()?))
}
