//! `dmprl dashboard`: shows runs on a web page, during and after training.

use std::path::PathBuf;

use clap::Args;
use dmprl_dashboard::{Options, serve};
use dmprl_run::failure::Outcome;

use super::emit;
use crate::terminal::say;

const HELP: &str = "\
Prints the address of a page that shows every run below the directory: learning curves, also of
several runs together, throughput and queues, workers, evaluations, joints, videos, and differences
between configurations. It listens on 127.0.0.1 only, and only reads run directories; Ctrl-C stops
it, with exit status 0. /metrics at the same address is for Prometheus.

From another machine:
  ssh -L 8787:127.0.0.1:8787 HOST, then http://127.0.0.1:8787

EXAMPLES
  dmprl dashboard                          every run in runs/
  dmprl dashboard runs/reacher-s1          one run
  dmprl dashboard runs/paper --port 0      a sweep, on any free port";

/// Arguments of `dmprl dashboard`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct DashboardArgs {
    /// A run directory, or a directory that contains runs at any depth.
    #[arg(value_name = "RUN|DIR", default_value = "runs")]
    directory: PathBuf,
    /// Port on 127.0.0.1; 0: any free port.
    #[arg(long, default_value_t = 8787)]
    port: u16,
}

pub(super) fn run(args: &DashboardArgs) -> anyhow::Result<Outcome> {
    let options = Options { root: &args.directory, port: args.port };
    serve(&options, dmprl_supervisor::interrupts, |address| {
        emit(&format!("http://{address}"))?;
        say("open this address in a browser (Ctrl-C to stop)");
        Ok(())
    })
}
