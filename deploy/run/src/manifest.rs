//! `manifest.json`: a run's format, versions, machine and commands.

use std::time::SystemTime;

use anyhow::{Context, bail, ensure};
use dmprl_shared::config::ExperimentConfig;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::processor;
use crate::random::random_u64;
use crate::timestamp::rfc3339;

/// Version of the run directory's format. Other versions are rejected.
pub const FORMAT_VERSION: u32 = 1;

/// Origin of a run: its machine, and the commands and versions of its sessions.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// [`FORMAT_VERSION`] of the writer.
    pub format_version: u32,
    /// Identifies the run's segments and files; 16 hexadecimal digits.
    pub run_id: String,
    /// Machine of the first session; later ones may have run elsewhere.
    pub machine: Machine,
    /// Policy file that the run started from, for a warm start.
    pub init_from: Option<String>,
    /// The session of `train`, then one per `resume`.
    pub sessions: Vec<Session>,
}

/// One start of the supervisor.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Session {
    /// Start time in UTC, as in RFC 3339.
    pub started: String,
    /// Command line, including the program.
    pub command: Vec<String>,
    /// Version of `dmprl`.
    pub dmprl_version: String,
    /// Commit that the program was built from, with `-dirty` if its sources differed from it;
    /// `None` if it was built outside a git repository.
    pub git_commit: Option<String>,
    /// SHA-256 of the resolved configuration, in hexadecimal; `None` in manifests of older
    /// programs.
    #[serde(default)]
    pub config_sha256: Option<String>,
    /// Versions that the environments depend on; `None` in manifests of older programs.
    #[serde(default)]
    pub packages: Option<Packages>,
}

/// Versions of the Python packages that determine how an environment behaves; `None` if a package
/// is not installed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Packages {
    /// The interpreter's version.
    pub python: String,
    /// MuJoCo's version.
    pub mujoco: Option<String>,
    /// Gymnasium's version.
    pub gymnasium: Option<String>,
    /// NumPy's version.
    pub numpy: Option<String>,
    /// SHA-256 of the Python sources of the package `dmprl`, in hexadecimal.
    pub dmprl_sha256: Option<String>,
}

/// The machine, on which measurements such as steps per second depend.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Machine {
    /// Operating system and architecture.
    pub os: String,
    /// Name and generation of the processor, if the system reports them.
    pub cpu: Option<String>,
    /// Number of cores that this process may use.
    pub cores: usize,
    /// Main memory \[bytes\], if the system reports it.
    pub memory_bytes: Option<u64>,
}

impl Manifest {
    /// Creates the manifest of a run that does not train: it records neither configuration nor
    /// packages.
    ///
    /// # Errors
    /// As [`Manifest::begin`].
    pub fn new(init_from: Option<String>) -> anyhow::Result<Self> {
        Self::begin(init_from, Session::now())
    }

    /// Creates the manifest of a run whose first session begins now.
    ///
    /// # Errors
    /// The system returns no random number for the run's id.
    pub fn begin(init_from: Option<String>, session: Session) -> anyhow::Result<Self> {
        Ok(Self {
            format_version: FORMAT_VERSION,
            run_id: format!("{:016x}", random_u64()?),
            machine: Machine::this(),
            init_from,
            sessions: vec![session],
        })
    }

    /// Parses a manifest; one of another format is rejected with its version.
    pub(crate) fn parse(text: &str) -> anyhow::Result<Self> {
        // The version first, because the rest of a newer format may differ.
        #[derive(Deserialize)]
        struct Head {
            format_version: u32,
        }
        let head: Head = serde_json::from_str(text).context("it has no valid format_version")?;
        if head.format_version > FORMAT_VERSION {
            bail!(
                "format version {} is newer than {FORMAT_VERSION}, the newest that this dmprl \
                 reads; update dmprl",
                head.format_version
            );
        }
        ensure!(
            head.format_version == FORMAT_VERSION,
            "format version {}; expected {FORMAT_VERSION}",
            head.format_version
        );
        let manifest: Self = serde_json::from_str(text).context("it is damaged")?;
        manifest.run_id()?;
        ensure!(!manifest.sessions.is_empty(), "expected at least one session, got none");
        Ok(manifest)
    }

    /// Returns the run's id as a number, as in segments.
    ///
    /// # Errors
    /// The id is not a hexadecimal number of 64 bits.
    pub fn run_id(&self) -> anyhow::Result<u64> {
        u64::from_str_radix(&self.run_id, 16).with_context(|| {
            format!("run_id: expected 16 hexadecimal digits, got {:?}", self.run_id)
        })
    }

    /// Returns the preset of the run's first command, if it has one.
    #[must_use]
    pub fn preset(&self) -> Option<&str> {
        let words = &self.sessions.first()?.command;
        let named = words.iter().zip(words.iter().skip(1)).find(|(flag, _)| *flag == "--preset");
        let joined = || words.iter().find_map(|word| word.strip_prefix("--preset="));
        named.map(|(_, name)| name.as_str()).or_else(joined)
    }
}

impl Session {
    /// Creates the session of this process.
    #[must_use]
    pub fn now() -> Self {
        Self {
            started: rfc3339(SystemTime::now()),
            command: std::env::args_os().map(|arg| arg.to_string_lossy().into_owned()).collect(),
            dmprl_version: env!("CARGO_PKG_VERSION").into(),
            git_commit: crate::project::git_commit(),
            config_sha256: None,
            packages: None,
        }
    }

    /// Creates the session of this process, which trains `config` with `packages`.
    ///
    /// # Errors
    /// The configuration cannot be written as TOML.
    pub fn training(config: &ExperimentConfig, packages: Packages) -> anyhow::Result<Self> {
        let config_sha256 = Some(config_sha256(config)?);
        Ok(Self { config_sha256, packages: Some(packages), ..Self::now() })
    }
}

/// Hashes a resolved configuration as in `config.toml`, without the comment above it.
fn config_sha256(config: &ExperimentConfig) -> anyhow::Result<String> {
    let text = toml::to_string(config).context("cannot write the configuration as TOML")?;
    Ok(hexadecimal(&Sha256::digest(text)))
}

/// Formats bytes with two digits each.
pub(crate) fn hexadecimal(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

impl Machine {
    /// Describes the machine that this program runs on.
    pub fn this() -> Self {
        let read = |path| std::fs::read_to_string(path).unwrap_or_default();
        let value = |text: &str, name: &str| {
            let line = text.lines().find(|line| line.starts_with(name))?;
            Some(line.split_once(':')?.1.trim().to_owned())
        };
        let memory = value(&read("/proc/meminfo"), "MemTotal")
            .and_then(|text| text.trim_end_matches("kB").trim().parse::<u64>().ok());
        Self {
            os: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
            cpu: processor::name(&read("/proc/cpuinfo")),
            cores: std::thread::available_parallelism().map_or(1, usize::from),
            memory_bytes: memory.map(|kib| kib * 1024),
        }
    }
}
