//! The run's token, a secret that other hosts need: a file readable only by its owner.

use std::fs::OpenOptions;
use std::io::Write;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;

use anyhow::Context;
use dmprl_run::failure::wrong_use;
use dmprl_run::random_u64;
use subtle::ConstantTimeEq;

/// Shorter tokens could be guessed.
const CHARACTERS_MIN: usize = 16;
const CHARACTERS_MAX: usize = 1_024;
/// Permission bits that only the owner may have.
const OTHERS: u32 = 0o077;
/// The same for a credential of a systemd service, whose access-control list appears as the
/// group's read permission.
const OTHERS_THAN_A_SERVICE: u32 = 0o037;
/// Environment variable with the folder of a service's credentials.
const CREDENTIALS: &str = "CREDENTIALS_DIRECTORY";

/// Reads a run's token; creates it if it does not exist.
///
/// # Errors
/// The file can be read by others, contains no valid token, or cannot be created.
pub fn ensure(path: &Path) -> anyhow::Result<String> {
    if !path.exists() {
        let mut token = String::new();
        for _ in 0..4 {
            token += &format!("{:016x}", random_u64()?);
        }
        let failed = || format!("cannot create {}", path.display());
        let mut options = OpenOptions::new();
        let file = options.write(true).create_new(true).mode(0o600).open(path);
        file.and_then(|mut file| writeln!(file, "{token}")).with_context(failed)?;
    }
    read(path)
}

/// Reads a run's token.
///
/// # Errors
/// Wrong use: the file does not exist, can be read by others, or its content is too short or too
/// long.
pub fn read(path: &Path) -> anyhow::Result<String> {
    read_as_service(path, std::env::var_os(CREDENTIALS).as_deref().map(Path::new))
}

fn read_as_service(path: &Path, credentials: Option<&Path>) -> anyhow::Result<String> {
    let shown = path.display();
    let is_credential = credentials.is_some() && path.parent() == credentials;
    let others = if is_credential { OTHERS_THAN_A_SERVICE } else { OTHERS };
    let metadata = std::fs::metadata(path)
        .map_err(|error| wrong_use(format!("no token in {shown}: {error}; {WHERE}")))?;
    if metadata.mode() & others != 0 {
        let mode = metadata.mode() & 0o777;
        return Err(wrong_use(format!(
            "token {shown} can be read by others: expected mode 0600, got {mode:04o}; chmod 600 it"
        )));
    }
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {shown}"))?;
    let token = text.trim();
    if !(CHARACTERS_MIN..=CHARACTERS_MAX).contains(&token.len()) {
        return Err(wrong_use(format!(
            "token {shown}: expected {CHARACTERS_MIN} to {CHARACTERS_MAX} characters, got {}; \
             {WHERE}",
            token.len()
        )));
    }
    Ok(token.to_owned())
}

const WHERE: &str = "copy bridge.token of the run's directory from the learner's host";

/// Compares two secrets in constant time, so that the time does not reveal where they differ.
#[must_use]
pub fn equal(one: &str, other: &str) -> bool {
    one.as_bytes().ct_eq(other.as_bytes()).into()
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn a_token_is_created_once_and_must_be_private_to_its_owner() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bridge.token");
        let token = ensure(&path).unwrap();
        assert_eq!(token.len(), 64);
        assert_eq!(ensure(&path).unwrap(), token);
        assert!(equal(&token, &read(&path).unwrap()));
        assert!(!equal(&token, &token[1..]) && !equal(&token, &token.replace(&token[..1], "x")));
        std::fs::set_permissions(&path, PermissionsExt::from_mode(0o640)).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("got 0640"));
        // The mode of a service's credential.
        std::fs::set_permissions(&path, PermissionsExt::from_mode(0o440)).unwrap();
        assert!(read_as_service(&path, Some(Path::new("/other"))).is_err());
        assert_eq!(read_as_service(&path, Some(folder.path())).unwrap(), token);
        std::fs::set_permissions(&path, PermissionsExt::from_mode(0o444)).unwrap();
        assert!(read_as_service(&path, Some(folder.path())).is_err());
        std::fs::set_permissions(&path, PermissionsExt::from_mode(0o600)).unwrap();
        std::fs::write(&path, "short\n").unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("got 5"));
        assert!(read(&folder.path().join("none")).is_err());
    }
}
