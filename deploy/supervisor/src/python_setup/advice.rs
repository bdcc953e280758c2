//! Derives a remedy from the output of a failed `venv` or `pip`.

use dmprl_actors::python_env::{LINKED_PYTHON, host};

/// Phrases in the output and their causes. The first match counts.
const CAUSES: [(&str, Cause); 17] = [
    ("ensurepip is not available", Cause::NoVenv),
    ("No module named venv", Cause::NoVenv),
    ("No module named 'venv'", Cause::NoVenv),
    ("No module named ensurepip", Cause::NoVenv),
    ("'ensurepip'", Cause::NoVenv),
    ("No module named pip", Cause::NoPip),
    ("No space left on device", Cause::DiskFull),
    ("name resolution", Cause::NoNetwork),
    ("Failed to establish a new connection", Cause::NoNetwork),
    ("Network is unreachable", Cause::NoNetwork),
    ("Connection refused", Cause::NoNetwork),
    ("ProxyError", Cause::NoNetwork),
    ("timed out", Cause::NoNetwork),
    ("DO NOT MATCH THE HASHES", Cause::OtherFile),
    ("conflicting dependencies", Cause::Conflict),
    ("ResolutionImpossible", Cause::Conflict),
    ("No matching distribution found", Cause::NoPackage),
];

#[derive(Clone, Copy)]
enum Cause {
    NoVenv,
    NoPip,
    DiskFull,
    NoNetwork,
    OtherFile,
    Conflict,
    NoPackage,
}

/// Returns the first sentence of the error message, with a line break; empty for unknown causes.
pub(super) fn advice(output: &str) -> String {
    let Some((_, cause)) = CAUSES.iter().find(|(phrase, _)| output.contains(phrase)) else {
        return String::new();
    };
    let python = LINKED_PYTHON.executable;
    match cause {
        Cause::NoVenv => {
            format!("{python} lacks its venv module. Debian, Ubuntu: apt install python3-venv\n")
        }
        Cause::NoPip => match host().map(|host| host.executable.display()) {
            Some(python) => format!(
                "{python} has no pip, with which dmprl installs packages. Add it ({python} -m \
                 ensurepip, or uv pip install --python {python} pip), or install dmprl with the \
                 parts that you use, such as 'dmprl[sim,video]'\n"
            ),
            None => {
                format!(
                    "{python} lacks pip. Debian, Ubuntu: apt install python3-pip python3-venv\n"
                )
            }
        },
        Cause::DiskFull => "The disk is full.\n".to_owned(),
        Cause::NoNetwork => "The package index cannot be reached. The first start downloads \
             gymnasium, mujoco and numpy, and the first use of another part its packages; later \
             starts need no network. Behind a proxy, set HTTPS_PROXY. Without a network, set \
             PIP_FIND_LINKS to a directory of the wheels in envs_py/locks and PIP_NO_INDEX=1\n"
            .to_owned(),
        Cause::OtherFile => {
            "The package index has a file with another hash than the locked one in \
             envs_py/locks. If it is a mirror that builds its own files, lock its files: set \
             UV_INDEX_URL and run deploy/lock.sh\n"
                .to_owned()
        }
        Cause::Conflict => {
            "These packages do not go with each other, or with what dmprl needs. Ask \
             for another version, or remove one that you added: dmprl env remove PACKAGE\n"
                .to_owned()
        }
        Cause::NoPackage => format!(
            "A package, or this version of it, is not available for Python {} on this processor.\n",
            LINKED_PYTHON.version_number()
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_parts_of_python_are_named_as_debian_packages() {
        let debian = "The virtual environment was not created successfully because ensurepip is \
                      not available.  On Debian/Ubuntu systems, you need to install the";
        for (output, package) in [
            (debian, "apt install python3-venv"),
            ("/usr/bin/python3: No module named venv", "apt install python3-venv"),
            ("/x/.venv/bin/python: No module named pip", "apt install python3-pip"),
        ] {
            assert!(advice(output).contains(package), "{output}");
        }
    }

    #[test]
    fn unreachable_index_is_not_taken_for_a_missing_package() {
        let output = "WARNING: Retrying after connection broken by 'NewConnectionError(<pip>: \
                      Failed to establish a new connection: [Errno -3] Temporary failure in name \
                      resolution')': /simple/flit-core/\n\
                      ERROR: No matching distribution found for flit_core<5,>=3.9";
        assert!(advice(output).contains("cannot be reached"));
    }

    #[test]
    fn conflicts_and_other_files_have_a_remedy() {
        for (output, remedy) in [
            (
                "ERROR: Cannot install one because these package versions have conflicting \
              dependencies.",
                "dmprl env remove",
            ),
            (
                "ERROR: THESE PACKAGES DO NOT MATCH THE HASHES FROM THE REQUIREMENTS FILE.",
                "lock.sh",
            ),
        ] {
            assert!(advice(output).contains(remedy), "{output}");
        }
    }

    #[test]
    fn unknown_failure_gets_no_advice() {
        assert_eq!(advice("Segmentation fault"), "");
    }
}
