//! `dmprl completions` and `dmprl man`: shell completions and manual pages, generated from the
//! definitions that parse the command line.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{Args, CommandFactory};
use clap_complete::Shell;
use dmprl_run::failure::Outcome;
use dmprl_run::format::shown;
use dmprl_run::replace_file;

use super::{Arguments, emit};
use crate::terminal::say;

/// Section 1 of the manual: commands.
const SECTION: &str = "1";

const COMPLETIONS_HELP: &str = "\
EXAMPLES
  dmprl completions bash > ~/.local/share/bash-completion/completions/dmprl
  dmprl completions zsh > ~/.zfunc/_dmprl      # a folder of fpath
  dmprl completions fish > ~/.config/fish/completions/dmprl.fish";

const MAN_HELP: &str = "\
One page for the program and one for each command: dmprl.1, dmprl-train.1, …

EXAMPLES
  dmprl man --output ~/.local/share/man/man1
  man dmprl-train";

/// Arguments of `dmprl completions`.
#[derive(Debug, Args)]
#[command(after_help = COMPLETIONS_HELP)]
pub(super) struct CompletionsArgs {
    /// Shell for which to print completions.
    shell: Shell,
}

/// Arguments of `dmprl man`.
#[derive(Debug, Args)]
#[command(after_help = MAN_HELP)]
pub(super) struct ManArgs {
    /// Directory for the pages; created if missing.
    #[arg(long, value_name = "DIR", default_value = "man")]
    output: PathBuf,
}

pub(super) fn completions(args: &CompletionsArgs) -> anyhow::Result<Outcome> {
    let program = Arguments::command();
    // Leave out the roles: only the program itself starts them.
    let shown: Vec<_> =
        program.get_subcommands().filter(|own| !own.is_hide_set()).cloned().collect();
    let mut program = clap::Command::new("dmprl").args(program.get_arguments()).subcommands(shown);
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut program, "dmprl", &mut script);
    emit(String::from_utf8_lossy(&script).trim_end())?;
    Ok(Outcome::Done)
}

pub(super) fn man(args: &ManArgs) -> anyhow::Result<Outcome> {
    std::fs::create_dir_all(&args.output)
        .with_context(|| format!("cannot create {}", args.output.display()))?;
    let mut program = Arguments::command();
    program.build();
    let count = write_pages(&program, "dmprl", &args.output)?;
    say(&format!("{count} pages in {}", shown(&args.output)));
    Ok(Outcome::Done)
}

/// Writes the pages of a command and its subcommands; returns their number.
fn write_pages(command: &clap::Command, name: &str, folder: &Path) -> anyhow::Result<usize> {
    let mut page = Vec::new();
    // A page has the name by which `man` finds it: dmprl-bench-policy.
    let named = command.clone().name(name.to_owned()).display_name(name.to_owned());
    clap_mangen::Man::new(named)
        .section(SECTION)
        .render(&mut page)
        .with_context(|| format!("cannot render the page {name}"))?;
    replace_file(&folder.join(format!("{name}.{SECTION}")), &page)?;
    let own = command.get_subcommands().filter(|own| !own.is_hide_set());
    own.filter(|own| own.get_name() != "help").try_fold(1, |count, own| {
        let name = format!("{name}-{}", own.get_name());
        Ok(count + write_pages(own, &name, folder)?)
    })
}
