//! A file with a secret, such as a token, readable only by its owner.

use std::io::{ErrorKind, Write};
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use anyhow::Context;
use tempfile::NamedTempFile;

use crate::failure::wrong_use;
use crate::random::random_u64;

/// Shorter secrets could be guessed.
const CHARACTERS_MIN: usize = 16;
const CHARACTERS_MAX: usize = 1_024;
/// Permission bits that only the owner may have.
const OTHERS: u32 = 0o077;
/// The same for a credential of a systemd service, whose access-control list appears as the
/// group's read permission.
const OTHERS_THAN_A_SERVICE: u32 = 0o037;
/// Environment variable with the folder of a service's credentials.
const CREDENTIALS: &str = "CREDENTIALS_DIRECTORY";

/// Returns a random secret of 64 hexadecimal digits.
///
/// # Errors
/// The system gives no random numbers.
pub fn random() -> anyhow::Result<String> {
    let mut secret = String::new();
    for _ in 0..4 {
        secret += &format!("{:016x}", random_u64()?);
    }
    Ok(secret)
}

/// Reads a secret; creates a random one if the file does not exist. `remedy` ends the message of a
/// wrong file.
///
/// # Errors
/// The file can be read by others, contains no valid secret, or cannot be created.
pub fn ensure(path: &Path, remedy: &str) -> anyhow::Result<String> {
    if !path.exists() {
        create(path).with_context(|| format!("cannot create {}", path.display()))?;
    }
    read(path, remedy)
}

/// Creates the file with its content, unless another process does at the same time.
fn create(path: &Path) -> anyhow::Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    // Readable only by its owner.
    let mut file = NamedTempFile::new_in(folder.unwrap_or(Path::new(".")))?;
    writeln!(file, "{}", random()?)?;
    match file.persist_noclobber(path) {
        Err(error) if error.error.kind() != ErrorKind::AlreadyExists => Err(error.error.into()),
        _ => Ok(()),
    }
}

/// Reads a secret. `remedy` ends the message of a wrong file.
///
/// # Errors
/// Wrong use: the file does not exist, can be read by others, or its content is too short or too
/// long.
pub fn read(path: &Path, remedy: &str) -> anyhow::Result<String> {
    read_as_service(path, std::env::var_os(CREDENTIALS).as_deref().map(Path::new), remedy)
}

fn read_as_service(path: &Path, folder: Option<&Path>, remedy: &str) -> anyhow::Result<String> {
    let shown = path.display();
    let is_credential = folder.is_some() && path.parent() == folder;
    let others = if is_credential { OTHERS_THAN_A_SERVICE } else { OTHERS };
    let metadata = std::fs::metadata(path)
        .map_err(|error| wrong_use(format!("no token in {shown}: {error}; {remedy}")))?;
    if metadata.mode() & others != 0 {
        let mode = metadata.mode() & 0o777;
        return Err(wrong_use(format!(
            "token {shown} can be read by others: expected mode 0600, got {mode:04o}; chmod 600 it"
        )));
    }
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {shown}"))?;
    let secret = text.trim();
    if !(CHARACTERS_MIN..=CHARACTERS_MAX).contains(&secret.len()) {
        return Err(wrong_use(format!(
            "token {shown}: expected {CHARACTERS_MIN} to {CHARACTERS_MAX} characters, got {}; \
             {remedy}",
            secret.len()
        )));
    }
    Ok(secret.to_owned())
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn a_secret_is_created_once_and_must_be_private_to_its_owner() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("token");
        let secret = ensure(&path, "").unwrap();
        assert_eq!(secret.len(), 64);
        assert_eq!(ensure(&path, "").unwrap(), secret);
        assert_eq!(read(&path, "").unwrap(), secret);
        std::fs::set_permissions(&path, PermissionsExt::from_mode(0o640)).unwrap();
        assert!(read(&path, "").unwrap_err().to_string().contains("got 0640"));
        // The mode of a service's credential.
        std::fs::set_permissions(&path, PermissionsExt::from_mode(0o440)).unwrap();
        assert!(read_as_service(&path, Some(Path::new("/other")), "").is_err());
        assert_eq!(read_as_service(&path, Some(folder.path()), "").unwrap(), secret);
        std::fs::set_permissions(&path, PermissionsExt::from_mode(0o444)).unwrap();
        assert!(read_as_service(&path, Some(folder.path()), "").is_err());
        std::fs::set_permissions(&path, PermissionsExt::from_mode(0o600)).unwrap();
        std::fs::write(&path, "short\n").unwrap();
        assert!(read(&path, "make one").unwrap_err().to_string().ends_with("got 5; make one"));
        assert!(read(&folder.path().join("none"), "").is_err());
    }
}
