//! `dmprl dashboard`: shows runs on a web page, during and after training.

use std::path::PathBuf;

use clap::Args;
use dmprl_dashboard::{Options, serve};
use dmprl_run::failure::Outcome;
use dmprl_run::secret_file;

use super::emit;
use crate::terminal::say;

const HELP: &str = "\
Prints the address of a page that shows every run below the directory: learning curves, also of
several runs together, throughput and queues, workers, evaluations, joints, videos, and differences
between configurations. It only reads run directories. Ctrl-C stops it, with exit status 0.

It listens on 127.0.0.1 only, which every user of the machine can open, so the address ends with a
token, a new one for each start unless --token-file names one. /metrics at the same address is for
Prometheus, which gives the token as a bearer token.

From another machine:
  ssh -L 8787:127.0.0.1:8787 HOST, then open the printed address

EXAMPLES
  dmprl dashboard                          every run in runs/
  dmprl dashboard runs/reacher-s1          one run
  dmprl dashboard runs/paper --port 0      a sweep, on any free port
  dmprl dashboard --token-file TOKEN       the same token at each start";

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
    /// File with the token, readable only by you; created with a random one if it does not exist.
    /// Default: a new random token.
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
}

pub(super) fn run(args: &DashboardArgs) -> anyhow::Result<Outcome> {
    let token = match &args.token_file {
        Some(path) => secret_file::ensure(path, "delete it for a new one")?,
        None => secret_file::random()?,
    };
    let options = Options { root: &args.directory, port: args.port, token };
    serve(options, dmprl_supervisor::interrupts, |url| {
        emit(url)?;
        say("open this address in a browser (Ctrl-C to stop)");
        Ok(())
    })
}
