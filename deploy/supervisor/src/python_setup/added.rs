//! Adds and removes a user's packages, and lists them.

use std::path::PathBuf;

use anyhow::{Context, Result, bail};

use super::{
    command::Setup,
    ensure::{State, stamp_user_packages},
    environment::PythonEnvironment,
    home::Home,
    installed::{installed_by_hand, installed_packages},
    lock::locked,
    locks,
    old::{OldEnvironment, commands, old_environments},
    requirement::Requirement,
    together::{install_user_packages, known},
    user_packages::UserPackages,
};

/// An environment and a user's packages in it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Overview {
    /// The environment; it may not exist yet.
    pub environment: PythonEnvironment,
    /// Whether it can be used as it is.
    pub state: State,
    /// The list of added packages.
    pub file: PathBuf,
    /// Its entries, in pip's syntax.
    pub added: Vec<String>,
    /// Commands that add the packages that were installed with pip and are not on the list.
    pub by_hand: Vec<String>,
    /// Environments that were renamed when a new one was created.
    pub old: Vec<OldEnvironment>,
}

/// Lists the packages of an environment, without changes and without waiting.
///
/// # Errors
/// The list of added packages cannot be read.
pub fn overview(home: &Home) -> Result<Overview> {
    let user = UserPackages::read(home.user_packages())?;
    let known = known(home, &user)?;
    let environment = PythonEnvironment::of(home.venv());
    let (by_hand, old) = match home {
        Home::Clone(root) => {
            let by_hand = commands(&installed_by_hand(&environment.venv, &known));
            (by_hand, old_environments(root, &known))
        }
        // In a user's own environment everything is.
        Home::Installed(_) => (Vec::new(), Vec::new()),
    };
    Ok(Overview {
        state: home.state(),
        file: home.user_packages(),
        added: user.list.iter().map(|requirement| requirement.line().to_owned()).collect(),
        environment,
        by_hand,
        old,
    })
}

/// Installs packages into the environment, which is created if necessary, and adds them to the
/// list. pip resolves them together with the earlier ones and with what dmprl needs.
///
/// - `packages`: names with or without versions, paths or URLs.
/// - `is_editable`: `packages` are folders whose files are used in place.
///
/// # Errors
/// See [`Home::ensure`]; also if a package cannot be installed, or does not go with the others.
/// The list and the environment are then unchanged.
pub fn add_packages(
    home: &Home,
    packages: &[String],
    is_editable: bool,
    progress: &dyn Fn(&str),
) -> Result<()> {
    let added = packages.iter().map(|package| Requirement::of_argument(package, is_editable));
    let added = added.collect::<Result<Vec<_>>>()?;
    let environment = home.ensure(progress)?;
    let lock = locked(&home.lock(), progress)?;
    let user = UserPackages::read(home.user_packages())?.with(&added);
    let setup = Setup { environment: &environment, lock: &lock, progress };
    install_user_packages(home, &setup, &user)
        .with_context(|| format!("cannot add {}", packages.join(" ")))?;
    user.write()?;
    stamp_user_packages(home)
}

/// Removes packages from the list, and uninstalls those that dmprl does not need.
///
/// # Errors
/// A package is neither on the list nor installed, dmprl needs it, or pip fails.
pub fn remove_packages(home: &Home, packages: &[String], progress: &dyn Fn(&str)) -> Result<()> {
    let lock = locked(&home.lock(), progress)?;
    let mut user = UserPackages::read(home.user_packages())?;
    let environment = PythonEnvironment::of(home.venv());
    let installed = installed_packages(&environment.venv);
    let mut uninstalled = Vec::new();
    for removed in packages.iter().map(|package| Requirement::to_remove(package)) {
        let rest = user.without(std::slice::from_ref(&removed));
        let found = installed.iter().find(|package| {
            let requirement = Requirement::of_line(&package.requirement);
            removed.name().as_ref() == Some(&package.name) || removed.replaces(&requirement)
        });
        let needed = known(home, &rest)?;
        let is_needed = |name: &str| needed.iter().any(|it| it.name().as_deref() == Some(name));
        let was_listed = rest != user;
        user = rest;
        match found {
            Some(package) if !is_needed(&package.name) => {
                // On the list it may be a path.
                user = user.without(&[Requirement::of_line(&package.requirement)]);
                uninstalled.push(package.name.clone());
            }
            Some(_) if !was_listed => bail!("dmprl needs {}", removed.line()),
            None if !was_listed => bail!("{} is not installed", removed.line()),
            _ => {}
        }
    }
    let is_ready = home.state() == State::Ready;
    user.write()?;
    if !is_ready {
        return Ok(()); // the next start installs the rest of the list
    }
    let setup = Setup { environment: &environment, lock: &lock, progress };
    if !uninstalled.is_empty() {
        setup.uninstall(&uninstalled)?;
    }
    // A removed package may have needed another version of a locked one, and a package that remains
    // one that was uninstalled.
    if let Home::Clone(_) = home {
        setup.install_locked("installing packages", &locks::base(&home.package_path()))?;
    }
    install_user_packages(home, &setup, &user)?;
    stamp_user_packages(home)
}
