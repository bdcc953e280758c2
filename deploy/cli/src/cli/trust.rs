//! Asks before a command imports code that the configuration of another's run names.

use std::path::Path;

use clap::Args;
use dmprl_run::failure::wrong_use;
use dmprl_run::format::shown;
use dmprl_run::{NamedCode, RunDirectory};
use dmprl_shared::config::ExperimentConfig;
use tracing::warn;

/// The flag of commands that import the modules in a run's configuration.
#[derive(Debug, Clone, Copy, Args)]
pub(super) struct TrustArgs {
    /// Import the modules that the run's configuration names, although you did not make the run on
    /// this machine. Asked once for each run.
    #[arg(long)]
    trust_code: bool,
}

impl TrustArgs {
    /// Rejects a run of others whose configuration names code, unless the user trusts it. Runs of
    /// built-in tasks and registered Gymnasium ids name none.
    pub(super) fn check(self, run: &RunDirectory) -> anyhow::Result<()> {
        self.check_for(run, &run.config()?)
    }

    /// As [`TrustArgs::check`], for a configuration that was read from the run.
    pub(super) fn check_for(
        self,
        run: &RunDirectory,
        config: &ExperimentConfig,
    ) -> anyhow::Result<()> {
        let Some(code) = NamedCode::of(config) else { return Ok(()) };
        if self.trust_code {
            mark_as_own(run, config);
            return Ok(());
        }
        if run.is_own(config)? {
            return Ok(());
        }
        Err(wrong_use(format!(
            "{} was not made by you on this machine, or by an older dmprl, or its task has \
             changed since; its config.toml names code that this command would run:\n{}\n  Look at \
             it. If you trust it, repeat the command with --trust-code, once for this run",
            shown(run.path()),
            described(&code, run.path())
        )))
    }
}

/// Records that the run's code is this user's own. Later commands ask if that is impossible.
pub(super) fn mark_as_own(run: &RunDirectory, config: &ExperimentConfig) {
    if NamedCode::of(config).is_none() {
        return;
    }
    if let Err(error) = run.mark_as_own(config) {
        warn!(
            "cannot record that run {} is yours: {error:#}; commands that import its modules will \
             ask for --trust-code",
            shown(run.path())
        );
    }
}

/// Lists modules, folders and arguments, each on its own line.
fn described(code: &NamedCode, run: &Path) -> String {
    let mut lines = Vec::new();
    let mut named = Vec::new();
    for module in &code.modules {
        let folder = code.folders.iter().find(|folder| has_module(folder, module));
        let place = folder
            .map_or_else(|| "the installed packages".to_owned(), |folder| located(folder, run));
        lines.push(format!("  module {module} from {place}"));
        named.extend(folder);
    }
    let others = code.folders.iter().filter(|folder| !named.contains(folder));
    lines.extend(others.map(|folder| format!("  modules from {}", located(folder, run))));
    let arguments = code.arguments.iter();
    lines.extend(arguments.map(|argument| format!("  whatever the argument {argument} names")));
    lines.join("\n")
}

/// Returns a folder, and whether it is inside the run directory.
fn located(folder: &Path, run: &Path) -> String {
    let resolved = std::fs::canonicalize(folder).unwrap_or_else(|_| folder.to_owned());
    let place = if resolved.starts_with(run) { "inside" } else { "outside" };
    format!("{} ({place} the run directory)", folder.display())
}

/// Returns true if a folder has the module's outermost package, or a file of its name.
fn has_module(folder: &Path, module: &str) -> bool {
    let first = module.split('.').next().unwrap_or_default();
    folder.join(first).is_dir() || folder.join(format!("{first}.py")).is_file()
}

/// The code that the command line of `train` itself names.
#[derive(Debug, Clone, Copy)]
pub(super) struct Said<'a> {
    /// The task.
    pub(super) task: &'a str,
    /// The configuration file.
    pub(super) file: Option<&'a Path>,
    /// Whether it names folders of modules.
    pub(super) python_path: bool,
}

impl Said<'_> {
    /// Rejects the configuration file of another's run if code comes from it, as
    /// [`TrustArgs::check`] does. Code that the command line names needs no trust.
    pub(super) fn check(self, config: &ExperimentConfig, trust: TrustArgs) -> anyhow::Result<()> {
        let own_module = config.task.id == self.task || !config.task.id.contains(':');
        let own_folders = self.python_path || config.task.python_path.is_empty();
        let has_options = config.task.has_options();
        let run = self.file.and_then(Path::parent);
        match run.filter(|run| run.join("manifest.json").is_file()) {
            Some(run) if has_options || !(own_module && own_folders) => {
                trust.check_for(&RunDirectory::open(run)?, config)
            }
            _ => Ok(()),
        }
    }
}
