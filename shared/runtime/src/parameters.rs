//! Stage 7 of 8, its record: policy snapshots, published by the learner and used by the workers.

use thiserror::Error;

/// The actor's parameters at one version.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ParameterSnapshot {
    /// Number of the snapshot within the run. It never decreases, even after a resume.
    pub version: u64,
    /// Environment steps inserted before publication. With it, workers detect the end of the
    /// warm-up.
    pub env_steps: u64,
    /// Hash of the architecture that `values` belongs to.
    pub architecture_hash: u64,
    /// Whether most recent episodes move the achieved goal. Workers then explore less
    /// (`exploration.settled_share`).
    pub settled: bool,
    /// All parameters as one flat vector.
    pub values: Vec<f32>,
}

/// Why a snapshot was rejected.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum SnapshotError {
    /// A wrong checksum: the snapshot is incomplete or corrupted.
    #[error("policy version {version}: checksum {got:#010x}, expected {expected:#010x}")]
    Checksum {
        /// The snapshot's version.
        version: u64,
        /// Checksum in its header.
        expected: u32,
        /// Checksum of its values.
        got: u32,
    },
    /// A snapshot of another architecture.
    #[error("policy version {version}: architecture {got:#018x}, expected {expected:#018x}")]
    Architecture {
        /// The snapshot's version.
        version: u64,
        /// The receiver's architecture.
        expected: u64,
        /// The snapshot's architecture.
        got: u64,
    },
}

impl ParameterSnapshot {
    /// Returns the CRC-32 of all fields.
    #[must_use]
    pub fn checksum(&self) -> u32 {
        let Self { version, env_steps, architecture_hash, settled, .. } = *self;
        checksum([version, env_steps, architecture_hash, settled.into()], &self.values)
    }
}

/// Returns the checksum of a snapshot whose values are not in a `Vec` yet. `fields` are version,
/// steps, architecture hash, and 1 if it is settled, else 0.
#[must_use]
pub fn checksum(fields: [u64; 4], values: &[f32]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    fields.iter().for_each(|field| hasher.update(&field.to_le_bytes()));
    hasher.update(bytemuck::cast_slice(values));
    hasher.finalize()
}
