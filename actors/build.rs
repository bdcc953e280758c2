//! Finds out which CPython this build links against and passes it on.
//!
//! A machine often has several Pythons of one version, each with its own `libpython3.11.so`.
//! The program must run on the one that makes `.venv`, so: its library directory goes into the
//! executables' rpath, and its version and prefix go into the code, which compares them with what
//! it finds at start. The build scripts of `deploy` and `tests` get the linker's argument as
//! `DEP_DMPRL_PYTHON_LINK_ARG`; they ask no interpreter themselves.
//!
//! pyo3 chooses the interpreter: `PYO3_PYTHON`, else an active virtual or conda environment, else
//! `python`, else `python3` on `PATH`.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    #[cfg(feature = "python")]
    python::link();
}

#[cfg(feature = "python")]
mod python {
    use std::{path::Path, process::Command};

    /// Oldest Python whose syntax and packages `envs_py` is written for.
    const MINOR_VERSION_MIN: u8 = 11;

    /// One fact a line. `_base_executable` because a virtual environment may be active: `.venv`
    /// must not depend on it.
    const QUESTIONS: &str = "\
import os, sys, sysconfig
base = getattr(sys, '_base_executable', None) or sys.executable
print(base if os.path.exists(base) else sys.executable)
print(' '.join(sys.version.split()))
print(sys.base_prefix)
print(sysconfig.get_config_var('Py_ENABLE_SHARED') or 0)";

    /// What the interpreter answered.
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
                 Install one (Debian, Ubuntu: apt install python3 python3-dev python3-venv) and \
                 set PYO3_PYTHON to it"
            ));
        }
        let facts = ask(executable);
        let library_dir = config.lib_dir().unwrap_or_else(|| {
            stop(&format!("{executable} does not say where its libpython lies (LIBDIR)"))
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
        // An upgrade in place (apt) keeps the paths but changes the version: look again.
        println!("cargo::rerun-if-changed={}", facts.executable);
        println!("cargo::rerun-if-changed={}", Path::new(library_dir).join(&library).display());
    }

    /// pyo3's own argument yields DT_RUNPATH, which `LD_LIBRARY_PATH` (a cluster's modules set it)
    /// overrides with another installation's library of the same name. DT_RPATH comes first; only
    /// a directory of the system must not, it holds libraries that are not Python's.
    fn rpath(library_dir: &str) -> String {
        let is_system =
            ["/lib", "/usr/lib"].iter().any(|dir| Path::new(library_dir).starts_with(dir));
        let tags = if is_system { "--enable-new-dtags" } else { "--disable-new-dtags" };
        // Last, the library beside a program that was brought to another machine: a conda
        // environment has its own.
        format!("-Wl,{tags},-rpath,{library_dir}:$ORIGIN/../lib")
    }

    fn check_library(facts: &Facts, library_dir: &str, library: &str, version: &str) {
        if Path::new(library_dir).join(library).exists() {
            return;
        }
        let python = &facts.executable;
        if facts.shared {
            stop(&format!(
                "{python} has no {library} in {library_dir}. Debian, Ubuntu: apt install \
                 python3-dev (or libpython{version}-dev, for this very version)"
            ));
        }
        stop(&format!(
            "{python} was built without a shared libpython (--enable-shared), so it cannot be \
             embedded. Set PYO3_PYTHON to another, for instance /usr/bin/python3 (apt install \
             python3-dev python3-venv)"
        ));
    }

    fn ask(executable: &str) -> Facts {
        let output = Command::new(executable)
            .args(["-I", "-c", QUESTIONS])
            .output()
            .unwrap_or_else(|error| stop(&format!("cannot run {executable}: {error}")));
        let text = String::from_utf8_lossy(&output.stdout);
        let lines: Vec<&str> = text.lines().collect();
        let [base_executable, version, base_prefix, shared] = lines[..] else {
            let message = String::from_utf8_lossy(&output.stderr);
            stop(&format!("{executable} does not answer ({}): {message}", output.status));
        };
        Facts {
            executable: base_executable.to_owned(),
            version: version.to_owned(),
            base_prefix: base_prefix.to_owned(),
            shared: shared == "1",
        }
    }

    /// Ends the build with one line instead of a panic's backtrace.
    fn stop(message: &str) -> ! {
        println!("cargo::error={message}");
        std::process::exit(1);
    }
}
