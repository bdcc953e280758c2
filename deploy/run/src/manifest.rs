//! `manifest.json`: format, versions, machine and command of a run.

use std::time::SystemTime;

use anyhow::{Context, bail, ensure};
use dmprl_shared::config::ExperimentConfig;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::random::random_u64;
use crate::timestamp::rfc3339;

/// Version of the run directory's format; older ones are read, newer ones refused.
pub const FORMAT_VERSION: u32 = 1;

/// Who made a run, where, when and with what.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// [`FORMAT_VERSION`] of the writer.
    pub format_version: u32,
    /// Tells the run's segments and files from another's: 16 hexadecimal digits.
    pub run_id: String,
    /// Where it began; sessions may have gone on elsewhere.
    pub machine: Machine,
    /// File of the policy that the run began from, for a warm start.
    pub init_from: Option<String>,
    /// `train`, then one per `resume`.
    pub sessions: Vec<Session>,
}

/// One start of the supervisor.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Session {
    /// UTC, RFC 3339.
    pub started: String,
    /// As typed.
    pub command: Vec<String>,
    /// Version of this program.
    pub dmprl_version: String,
    /// Commit that the program was built from, `-dirty` appended where its sources differed from
    /// it; none if it was built outside a git repository.
    pub git_commit: Option<String>,
    /// SHA-256 of the resolved configuration, as hexadecimal digits; none in manifests of older
    /// programs.
    #[serde(default)]
    pub config_sha256: Option<String>,
    /// What its environments run on; none in manifests of older programs.
    #[serde(default)]
    pub packages: Option<Packages>,
}

/// Versions of the Python packages that decide what an environment does.
///
/// A version is none where the package is not installed.
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
    /// SHA-256 over the Python sources of the package `dmprl`, as hexadecimal digits.
    pub dmprl_sha256: Option<String>,
}

/// What figures like steps per second depend on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Machine {
    /// Operating system and architecture.
    pub os: String,
    /// The processor's name, when the system tells it.
    pub cpu: Option<String>,
    /// Cores this process may use.
    pub cores: usize,
    /// Main memory \[bytes\], when the system tells it.
    pub memory_bytes: Option<u64>,
}

impl Manifest {
    /// The manifest of something other than a training run, which records neither configuration
    /// nor packages.
    ///
    /// # Errors
    /// As [`Manifest::begin`].
    pub fn new(init_from: Option<String>) -> anyhow::Result<Self> {
        Self::begin(init_from, Session::now())
    }

    /// The manifest of a run whose first session begins now.
    ///
    /// # Errors
    /// The system gives no random number for the run's id.
    pub fn begin(init_from: Option<String>, session: Session) -> anyhow::Result<Self> {
        Ok(Self {
            format_version: FORMAT_VERSION,
            run_id: format!("{:016x}", random_u64()?),
            machine: Machine::this(),
            init_from,
            sessions: vec![session],
        })
    }

    /// Reads a manifest of this or an older format.
    pub(crate) fn parse(text: &str) -> anyhow::Result<Self> {
        // The version first: the rest of a newer format may not fit.
        #[derive(Deserialize)]
        struct Head {
            format_version: u32,
        }
        let head: Head = serde_json::from_str(text).context("no format_version")?;
        if head.format_version > FORMAT_VERSION {
            bail!(
                "format version {} is newer than {FORMAT_VERSION}, the newest this dmprl reads; \
                 update dmprl",
                head.format_version
            );
        }
        ensure!(head.format_version == FORMAT_VERSION, "format version {}", head.format_version);
        let manifest: Self = serde_json::from_str(text).context("damaged")?;
        manifest.run_id()?;
        ensure!(!manifest.sessions.is_empty(), "expected at least one session, got none");
        Ok(manifest)
    }

    /// The run's id as the number that segments carry.
    ///
    /// # Errors
    /// It is no hexadecimal number of 64 bits.
    pub fn run_id(&self) -> anyhow::Result<u64> {
        u64::from_str_radix(&self.run_id, 16).with_context(|| {
            format!("run_id: expected 16 hexadecimal digits, got {:?}", self.run_id)
        })
    }

    /// The preset that the run was begun with, where its command names one.
    #[must_use]
    pub fn preset(&self) -> Option<&str> {
        let words = &self.sessions.first()?.command;
        let named = words.iter().zip(words.iter().skip(1)).find(|(flag, _)| *flag == "--preset");
        let joined = || words.iter().find_map(|word| word.strip_prefix("--preset="));
        named.map(|(_, name)| name.as_str()).or_else(joined)
    }
}

impl Session {
    /// The session of this process.
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

    /// The session of this process, which trains `config` with `packages`.
    ///
    /// # Errors
    /// The configuration cannot be written as TOML.
    pub fn training(config: &ExperimentConfig, packages: Packages) -> anyhow::Result<Self> {
        let config_sha256 = Some(config_sha256(config)?);
        Ok(Self { config_sha256, packages: Some(packages), ..Self::now() })
    }
}

/// Hash of a resolved configuration as `config.toml` holds it, without the comment above it.
fn config_sha256(config: &ExperimentConfig) -> anyhow::Result<String> {
    let text = toml::to_string(config).context("cannot write the configuration as TOML")?;
    Ok(hexadecimal(&Sha256::digest(text)))
}

/// Two digits a byte.
fn hexadecimal(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

impl Machine {
    /// The one this program runs on.
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
            cpu: value(&read("/proc/cpuinfo"), "model name"),
            cores: std::thread::available_parallelism().map_or(1, usize::from),
            memory_bytes: memory.map(|kib| kib * 1024),
        }
    }
}
