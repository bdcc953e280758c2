//! Installs a user's packages together with what dmprl needs, so that they cannot break it.

use std::{
    fs,
    path::{Path, PathBuf},
};

use anyhow::Result;

use super::{
    command::Setup,
    declared::Declared,
    home::Home,
    locks,
    requirement::{OURS, Requirement},
    user_packages::UserPackages,
};

/// Start of the name of the file that records an installed optional part.
const EXTRA_STAMP: &str = "dmprl-extra-";
/// End of its name.
const EXTRA_STAMP_END: &str = ".txt";

/// Path of the file in `venv` that records an installed optional part.
pub(super) fn extra_stamp(venv: &Path, extra: &str) -> PathBuf {
    venv.join(format!("{EXTRA_STAMP}{extra}{EXTRA_STAMP_END}"))
}

/// Installs all packages of the list. pip resolves them together with the requirements of dmprl and
/// of its installed parts, so that they cannot break it.
pub(super) fn install_user_packages(
    home: &Home,
    setup: &Setup<'_>,
    user: &UserPackages,
) -> Result<()> {
    if user.list.is_empty() {
        return Ok(());
    }
    let declared = Declared::read(&home.requirements())?;
    let mut requirements = declared.base();
    for extra in installed_extras(&setup.environment.venv) {
        // A part that a later version of dmprl does not have any more needs nothing.
        requirements.extend(declared.extra(&extra).unwrap_or_default());
    }
    for requirement in &user.list {
        if requirement.name().as_deref() == Some(OURS) {
            for extra in requirement.extras() {
                requirements.extend(declared.extra(&extra)?);
            }
        } else {
            requirements.push(requirement.line().to_owned());
        }
    }
    setup.install_together(&requirements)
}

/// Returns the packages that dmprl or the list installs.
pub(super) fn known(home: &Home, user: &UserPackages) -> Result<Vec<Requirement>> {
    let declared = Declared::read(&home.requirements())?;
    let of_list = user.list.iter().filter(|it| it.name().as_deref() == Some(OURS));
    let extras = of_list.flat_map(Requirement::extras).chain(installed_extras(&home.venv()));
    let of_extras = extras.flat_map(|extra| declared.extra(&extra).unwrap_or_default());
    let lines = declared.base().into_iter().chain(of_extras).chain([OURS.to_owned()]);
    let mut known: Vec<_> = lines.map(|line| Requirement::of_line(&line)).collect();
    if let Home::Clone(_) = home {
        known.extend(locks::all_packages(&home.package_path()));
    }
    known.extend_from_slice(&user.list);
    Ok(known)
}

/// Returns the optional parts that are installed in an environment.
fn installed_extras(venv: &Path) -> Vec<String> {
    let files = fs::read_dir(venv).into_iter().flatten().flatten();
    let names = files.filter_map(|file| file.file_name().into_string().ok());
    let extra = |name: String| {
        let rest = name.strip_prefix(EXTRA_STAMP)?.strip_suffix(EXTRA_STAMP_END)?;
        Some(rest.to_owned())
    };
    let mut extras: Vec<String> = names.filter_map(extra).collect();
    extras.sort();
    extras
}
