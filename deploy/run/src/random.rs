//! Random numbers from the operating system.

use anyhow::Context;

/// Returns an unpredictable number.
///
/// # Errors
/// The system returns none.
pub fn random_u64() -> anyhow::Result<u64> {
    use std::io::Read;
    let mut bytes = [0; 8];
    std::fs::File::open("/dev/urandom")
        .and_then(|mut file| file.read_exact(&mut bytes))
        .context("cannot read a random number from /dev/urandom")?;
    Ok(u64::from_le_bytes(bytes))
}
