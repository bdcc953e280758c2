//! `dmprl env`: shows the Python environment, and adds and removes packages.

use clap::{Args, Subcommand};
use dmprl_run::failure::Outcome;

const HELP: &str = "\
Added packages are on a list beside .venv. When dmprl creates .venv again, after a change of Python
or of the project's place, it installs them again. pip chooses versions that go with each other and
with what dmprl needs, or fails without a change. An environment with packages that are not on the
list, such as those installed with pip itself, is renamed and not deleted.

EXAMPLES
  dmprl env                                  show the environment
  dmprl env add gymnasium-robotics 'torch>=2'
  dmprl env add 'dmprl[panda-gym]'           an optional part of dmprl
  dmprl env add --editable ../my-robot       a folder, used in place
  dmprl env remove torch";

/// Arguments of `dmprl env`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct EnvArgs {
    #[command(subcommand)]
    action: Option<Action>,
    /// Print one JSON object on standard output.
    #[arg(long, global = true)]
    json: bool,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Show the interpreter, its folder and the added packages (the default).
    List,
    /// Install packages and remember them.
    Add(AddArgs),
    /// Uninstall packages and forget them.
    Remove(RemoveArgs),
}

#[derive(Debug, Args)]
struct AddArgs {
    /// Packages, in pip's syntax: names with or without versions, paths, URLs.
    #[arg(required = true, value_name = "PACKAGE")]
    packages: Vec<String>,
    /// The packages are folders; use their files in place.
    #[arg(long)]
    editable: bool,
}

#[derive(Debug, Args)]
struct RemoveArgs {
    /// Names of packages, or paths as they were added.
    #[arg(required = true, value_name = "PACKAGE")]
    packages: Vec<String>,
}

#[cfg(feature = "python")]
pub(super) fn run(args: &EnvArgs) -> anyhow::Result<Outcome> {
    use dmprl_run::Progress;
    use dmprl_supervisor::python_setup::{Home, add_packages, overview, remove_packages};

    let home = Home::find()?;
    {
        let progress = crate::terminal::TerminalProgress::default();
        let show = |line: &str| progress.state(line);
        match &args.action {
            None | Some(Action::List) => {}
            Some(Action::Add(add)) => add_packages(&home, &add.packages, add.editable, &show)?,
            Some(Action::Remove(remove)) => remove_packages(&home, &remove.packages, &show)?,
        }
    }
    let found = overview(&home)?;
    super::emit(&if args.json { listing::json(&found) } else { listing::text(&found) })?;
    Ok(Outcome::Done)
}

#[cfg(not(feature = "python"))]
pub(super) fn run(_args: &EnvArgs) -> anyhow::Result<Outcome> {
    super::prepare_python().map(|_| Outcome::Done)
}

#[cfg(feature = "python")]
mod listing {
    use dmprl_actors::python_env::LINKED_PYTHON;
    use dmprl_run::format::shown;
    use dmprl_supervisor::python_setup::{OldEnvironment, Overview, State};

    pub(super) fn json(found: &Overview) -> String {
        let old = found
            .old
            .iter()
            .map(|old| serde_json::json!({ "folder": old.folder, "install_again": old.commands }));
        serde_json::json!({
            "python": LINKED_PYTHON.version_number(),
            "interpreter": found.environment.executable,
            "folder": found.environment.venv,
            "state": state(&found.state),
            "packages": found.added,
            "packages_file": found.file,
            "remember": found.by_hand,
            "old": old.collect::<Vec<_>>(),
        })
        .to_string()
    }

    pub(super) fn text(found: &Overview) -> String {
        let mut lines = vec![
            format!(
                "python    {}, {}",
                LINKED_PYTHON.version_number(),
                shown(&found.environment.executable)
            ),
            format!("folder    {}, {}", shown(&found.environment.venv), state(&found.state)),
        ];
        if found.added.is_empty() {
            lines.push("packages  none added; `dmprl env add PACKAGE` adds one".to_owned());
        } else {
            lines.push(format!("packages  added, listed in {}:", shown(&found.file)));
            lines.extend(found.added.iter().map(|package| format!("  {package}")));
        }
        if !found.by_hand.is_empty() {
            lines.push("not remembered, because pip installed them; to remember them:".to_owned());
            lines.extend(found.by_hand.iter().map(|command| format!("  {command}")));
        }
        found.old.iter().for_each(|old| lines.extend(lines_of(old)));
        lines.join("\n")
    }

    fn lines_of(old: &OldEnvironment) -> Vec<String> {
        let mut lines = vec![format!("old       {}, to be deleted by you", shown(&old.folder))];
        if !old.commands.is_empty() {
            lines.push("  to install its packages again:".to_owned());
            lines.extend(old.commands.iter().map(|command| format!("  {command}")));
        }
        lines
    }

    fn state(state: &State) -> String {
        match state {
            State::Ready => "ready".to_owned(),
            State::Missing => "not created yet".to_owned(),
            State::Stale(why) => format!("stale: {why}"),
        }
    }
}
