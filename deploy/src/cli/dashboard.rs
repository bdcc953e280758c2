//! `dmprl dashboard`: runs on a web page, while they are trained and afterwards.

use std::path::PathBuf;

use clap::Args;

use super::emit;
use crate::dashboard::{Plan, serve};
use crate::failure::Outcome;
use crate::terminal::say;

const HELP: &str = "\
Prints the address of a page with the curves of every run below the directory, several side by
side, throughput and queues, workers, evaluations, joints and videos, and how configurations
differ. It listens on 127.0.0.1 only, reads run directories and changes nothing; Ctrl-C ends it,
with exit status 0. /metrics at the same address is for Prometheus.

From another machine:
  ssh -L 8787:127.0.0.1:8787 HOST, then http://127.0.0.1:8787

EXAMPLES
  dmprl dashboard                          every run in runs/
  dmprl dashboard runs/reacher-s1          one run
  dmprl dashboard runs/paper --port 0      a sweep, on any port that is free";

/// Arguments of `dmprl dashboard`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct DashboardArgs {
    /// A run directory, or a directory with runs at any depth.
    #[arg(value_name = "RUN|DIR", default_value = "runs")]
    directory: PathBuf,
    /// Port on 127.0.0.1; 0: any that is free.
    #[arg(long, default_value_t = 8787)]
    port: u16,
}

pub(super) fn run(args: &DashboardArgs) -> anyhow::Result<Outcome> {
    let plan = Plan { root: &args.directory, port: args.port };
    serve(&plan, |address| {
        emit(&format!("http://{address}"))?;
        say("the dashboard is at this address until Ctrl-C");
        Ok(())
    })
}
