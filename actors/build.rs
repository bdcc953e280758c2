//! Finds the CPython that this build links against, for the linker and the code.
//!
//! A machine often has several Pythons of one version, each with its own `libpython3.11.so`. The
//! program must use the one that creates `.venv`. So its library directory goes into the
//! executables' rpath, and its version and prefix into the code, which compares them at start. The
//! build scripts of `deploy` and `tests` get the linker's argument as `DEP_DMPRL_PYTHON_LINK_ARG`.
//!
//! pyo3 chooses the interpreter: `PYO3_PYTHON`, else an active virtual or conda environment, else
//! `python`, else `python3` on `PATH`.
//!
//! With the feature `extension`, nothing is linked: the Python that loads the program provides
//! these functions.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    #[cfg(all(feature = "python", not(feature = "extension")))]
    python::link();
}

#[cfg(all(feature = "python", not(feature = "extension")))]
mod python {
    use std::{path::Path, process::Command};

    /// Oldest supported Python 3.x: `envs_py` needs its syntax.
    const MINOR_VERSION_MIN: u8 = 11;

    /// Prints one fact per line. Uses `_base_executable`, because `.venv` must not depend on a
    /// virtual environment that is active.
    const FACTS_SCRIPT: &str = "\
import os, sys, sysconfig
base = getattr(sys, '_base_executable', None) or sys.executable
print(base if os.path.exists(base) else sys.executable)
print(' '.join(sys.version.split()))
print(sys.base_prefix)
print(sysconfig.get_config_var('Py_ENABLE_SHARED') or 0)";

    /// Properties of the interpreter.
    struct Facts {
        executable: String,
        version: String,
        base_prefix: String,
        shared: bool,
    }

    pub fn link() {
        let config = pyo3_build_config::get();
        let version = config.target_abi().version();
        let executable = config.executable().unwrap_or_else(|| {
            stop("pyo3 was configured without an interpreter; set PYO3_PYTHON to one")
        });
        if (version.major, version.minor) < (3, MINOR_VERSION_MIN) {
            stop(&format!(
                "{executable} is Python {version}, but 3.{MINOR_VERSION_MIN} or newer is needed. \
                 Install one (on Debian and Ubuntu: apt install python3 python3-dev python3-venv) \
                 and set PYO3_PYTHON to it"
            ));
        }
        let facts = query(executable);
        let library_dir = config.lib_dir().unwrap_or_else(|| {
            stop(&format!("{executable} does not report the directory of its libpython (LIBDIR)"))
        });
        let library = format!("lib{}.so", config.lib_name().unwrap_or("python3"));
        check_library(&facts, library_dir, &library, &version.to_string());

        let link_arg = rpath(library_dir);
        println!("cargo::rustc-link-arg={link_arg}");
        println!("cargo::metadata=LINK_ARG={link_arg}");
        for (name, value) in [
            ("EXECUTABLE", &facts.executable),
            ("VERSION", &facts.version),
            ("BASE_PREFIX", &facts.base_prefix),
        ] {
            println!("cargo::rustc-env=DMPRL_PYTHON_{name}={value}");
        }
        println!("cargo::rustc-env=DMPRL_PYTHON_LIBRARY_DIR={library_dir}");
        // Detects an in-place upgrade (apt), which changes the version but not the paths.
        println!("cargo::rerun-if-changed={}", facts.executable);
        println!("cargo::rerun-if-changed={}", Path::new(library_dir).join(&library).display());
    }

    /// Returns the linker's argument for the library directory.
    ///
    /// pyo3's own argument sets DT_RUNPATH. `LD_LIBRARY_PATH`, as set by a cluster's modules, takes
    /// precedence over it and may contain another installation's library of the same name. DT_RPATH
    /// precedes `LD_LIBRARY_PATH`. System directories use DT_RUNPATH, because they contain other
    /// libraries as well.
    fn rpath(library_dir: &str) -> String {
        let is_system =
            ["/lib", "/usr/lib"].iter().any(|dir| Path::new(library_dir).starts_with(dir));
        let tags = if is_system { "--enable-new-dtags" } else { "--disable-new-dtags" };
        // Last comes the library beside a program that was copied to another machine, for example
        // in a conda environment.
        format!("-Wl,{tags},-rpath,{library_dir}:$ORIGIN/../lib")
    }

    fn check_library(facts: &Facts, library_dir: &str, library: &str, version: &str) {
        if Path::new(library_dir).join(library).exists() {
            return;
        }
        let python = &facts.executable;
        if facts.shared {
            stop(&format!(
                "{python} has no {library} in {library_dir}. On Debian and Ubuntu: apt install \
                 python3-dev (or libpython{version}-dev, for this version)"
            ));
        }
        stop(&format!(
            "{python} was built without a shared libpython (--enable-shared), so it cannot be \
             embedded. Set PYO3_PYTHON to another Python, for example /usr/bin/python3 (apt \
             install python3-dev python3-venv)"
        ));
    }

    fn query(executable: &str) -> Facts {
        let output = Command::new(executable)
            .args(["-I", "-c", FACTS_SCRIPT])
            .output()
            .unwrap_or_else(|error| stop(&format!("cannot run {executable}: {error}")));
        let text = String::from_utf8_lossy(&output.stdout);
        let lines: Vec<&str> = text.lines().collect();
        let [base_executable, version, base_prefix, shared] = lines[..] else {
            let message = String::from_utf8_lossy(&output.stderr);
            stop(&format!("unexpected output of {executable} ({}): {message}", output.status));
        };
        Facts {
            executable: base_executable.to_owned(),
            version: version.to_owned(),
            base_prefix: base_prefix.to_owned(),
            shared: shared == "1",
        }
    }

    /// Ends the build with a one-line message.
    fn stop(message: &str) -> ! {
        println!("cargo::error={message}");
        std::process::exit(1);
    }
}
