//! Zenoh's configuration for a session between hosts of a run.
//!
//! Only ends that know the run's token can open a session: on `tls/` endpoints they need a
//! certificate of the run's authority, and on every endpoint a password that is derived from the
//! token. So others cannot send the gateway anything, and it stores for them only the handshakes of
//! [`HANDSHAKES_MAX`] connections.
//!
//! A user's file for Zenoh can configure TLS and access control itself. Such a session, and one
//! with `tcp/` endpoints, does not count as authenticated, and its messages are sealed.

use std::io::Write;
use std::path::Path;

use anyhow::{Context, anyhow};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use dmprl_run::failure::wrong_use;
use tempfile::NamedTempFile;
use zenoh::Config;

use crate::LinkMode;
use crate::keys::Key;
use crate::tls_identity::{COMMON_NAME, TlsIdentity};

/// Time without any message after which a peer counts as gone \[ms\]. It sends several keep-alives
/// within this time.
const LEASE_MS: u64 = 4_000;
/// Initial and maximum interval between attempts to connect \[ms\].
const RETRY_FIRST_MS: u64 = 250;
const RETRY_MAX_MS: u64 = 2_000;
/// Maximum size of a message to a host, which may be a policy \[bytes\].
const POLICY_BYTES_MAX: usize = 256 << 20;
/// Maximum size of a message to the learner's host \[bytes\]: a few hundred KiB of segments, or one
/// longer segment.
const BATCH_BYTES_MAX: usize = 16 << 20;
/// Maximum number of sessions with the learner's host.
const SESSIONS_MAX: usize = 256;

/// Maximum number of connections that have not yet proven that they know the token, and the time
/// limit for their handshake \[ms\]. A message of a handshake has at most 64 KiB.
const HANDSHAKES_MAX: usize = 64;
const HANDSHAKE_LIMIT_MS: u64 = 10_000;
/// Name of all hosts in Zenoh's authentication.
const USER: &str = "dmprl";

/// The configuration of a session, and files that must exist until it is open.
pub(crate) struct LinkConfig {
    pub config: Config,
    /// Whether the certificates of the run's authority authenticate every peer.
    pub is_authenticated: bool,
    _passwords: Option<NamedTempFile>,
}

impl LinkConfig {
    /// Creates the configuration.
    ///
    /// # Errors
    /// Wrong use: the file is no configuration of Zenoh. Cannot create the file of passwords.
    pub(crate) fn new(
        mode: LinkMode<'_>,
        token: &str,
        zenoh_file: Option<&Path>,
    ) -> anyhow::Result<Self> {
        let mut config = match zenoh_file {
            None => Config::default(),
            Some(path) => Config::from_file(path).map_err(|error| {
                wrong_use(format!("{}: not a configuration of Zenoh: {error}", path.display()))
            })?,
        };
        connections(&mut config, mode)?;
        if !sets_certificates(&config)? {
            certificates(&mut config, token)?;
        }
        let is_authenticated = zenoh_file.is_none() && mode.is_encrypted();
        if is_authenticated {
            admit_only_this_run(&mut config)?;
        }
        let passwords = passwords(&mut config, mode, token)?;
        Ok(Self { config, is_authenticated, _passwords: passwords })
    }
}

fn set(config: &mut Config, key: &str, value: impl serde::Serialize) -> anyhow::Result<()> {
    let value = serde_json::to_string(&value)?;
    // The value may be a secret.
    config.insert_json5(key, &value).map_err(|error| anyhow!("cannot set {key} of Zenoh: {error}"))
}

/// Sets endpoints and limits.
fn connections(config: &mut Config, mode: LinkMode<'_>) -> anyhow::Result<()> {
    let (listen, connect, bytes_max) = match mode {
        LinkMode::Listen(at) => (at, &[][..], BATCH_BYTES_MAX),
        LinkMode::Connect(to) => (&[][..], &[to.to_owned()][..], POLICY_BYTES_MAX),
    };
    set(config, "mode", "peer")?;
    set(config, "listen/endpoints", listen)?;
    set(config, "connect/endpoints", connect)?;
    set(config, "connect/exit_on_failure", false)?;
    // Zenoh retries forever in the background (-1); callers have their own limit.
    set(config, "connect/timeout_ms", -1)?;
    let retry = serde_json::json!({
        "period_init_ms": RETRY_FIRST_MS,
        "period_max_ms": RETRY_MAX_MS,
        "period_increase_factor": 2,
    });
    set(config, "connect/retry", retry)?;
    set(config, "scouting/multicast/enabled", false)?;
    set(config, "scouting/gossip/enabled", false)?;
    set(config, "transport/link/tx/lease", LEASE_MS)?;
    set(config, "transport/link/rx/max_message_size", bytes_max)?;
    set(config, "transport/unicast/max_sessions", SESSIONS_MAX)?;
    set(config, "transport/unicast/accept_pending", HANDSHAKES_MAX)?;
    set(config, "transport/unicast/accept_timeout", HANDSHAKE_LIMIT_MS)
}

/// Returns true if the user's file configures TLS itself.
fn sets_certificates(config: &Config) -> anyhow::Result<bool> {
    // These are missing in the text of their section.
    let secret = |name: &str| {
        let text = config.get_json(&format!("transport/link/tls/{name}_base64"));
        text.is_ok_and(|text| text != "null")
    };
    let names = ["root_ca_certificate", "listen_certificate", "connect_certificate"];
    Ok(names.into_iter().any(secret) || is_set(config, "transport/link/tls")?)
}

/// Returns true if the user's file sets any key of this section, whose keys are null by default.
fn is_set(config: &Config, section: &str) -> anyhow::Result<bool> {
    let text = config.get_json(section).map_err(|error| anyhow!("{error}"))?;
    let keys: serde_json::Map<String, serde_json::Value> = serde_json::from_str(&text)?;
    Ok(keys.values().any(|value| !value.is_null()))
}

/// Sets the certificates that are derived from the token.
fn certificates(config: &mut Config, token: &str) -> anyhow::Result<()> {
    let identity = TlsIdentity::new(token)?;
    for (key, pem) in [
        ("root_ca_certificate_base64", &identity.authority),
        ("listen_certificate_base64", &identity.certificate),
        ("listen_private_key_base64", &identity.private_key),
        ("connect_certificate_base64", &identity.certificate),
        ("connect_private_key_base64", &identity.private_key),
    ] {
        set(config, &format!("transport/link/tls/{key}"), STANDARD.encode(pem))?;
    }
    set(config, "transport/link/tls/enable_mtls", true)?;
    // The authority identifies the run, whatever name or address the user connects to.
    set(config, "transport/link/tls/verify_name_on_connect", false)
}

/// Exchanges messages only with peers whose certificate has the name of the run's processes. A
/// connecting end of Zenoh also trusts all public authorities, but these sign no such name, which
/// is not one of a host.
fn admit_only_this_run(config: &mut Config) -> anyhow::Result<()> {
    let access_control = serde_json::json!({
        "enabled": true,
        "default_permission": "deny",
        "rules": [{
            "id": "run",
            "permission": "allow",
            "flows": ["ingress", "egress"],
            "messages": [
                "put",
                "query",
                "reply",
                "declare_subscriber",
                "declare_queryable",
                "liveliness_token",
                "liveliness_query",
                "declare_liveliness_subscriber",
            ],
            "key_exprs": ["dmprl/**"],
        }],
        "subjects": [{"id": "processes", "cert_common_names": [COMMON_NAME]}],
        "policies": [{"rules": ["run"], "subjects": ["processes"]}],
    });
    set(config, "access_control", access_control)
}

/// Sets the password of all hosts, unless the user's file has users of its own. Zenoh reads the
/// passwords that it accepts from a file.
fn passwords(
    config: &mut Config,
    mode: LinkMode<'_>,
    token: &str,
) -> anyhow::Result<Option<NamedTempFile>> {
    if is_set(config, "transport/auth/usrpwd")? {
        return Ok(None);
    }
    let key = Key::from_token(token, "dmprl bridge 2: password");
    let password = STANDARD.encode(key.bytes());
    if let LinkMode::Connect(_) = mode {
        let credentials = serde_json::json!({"user": USER, "password": password});
        set(config, "transport/auth/usrpwd", credentials)?;
        return Ok(None);
    }
    let write = || {
        let mut file = NamedTempFile::new()?;
        writeln!(file, "{USER}:{password}")?;
        Ok::<_, std::io::Error>(file)
    };
    let file = write().context("cannot create a temporary file")?;
    set(config, "transport/auth/usrpwd", serde_json::json!({"dictionary_file": file.path()}))?;
    Ok(Some(file))
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;
    use std::time::{Duration, Instant};

    use super::*;
    use crate::Link;

    const TOKEN: &str = "a secret of some length";

    /// A file for Zenoh with the certificates of a process of the run, but with this name.
    fn zenoh_file(common_name: &str) -> NamedTempFile {
        let identity = TlsIdentity::signed(TOKEN, common_name).unwrap();
        let mut file = NamedTempFile::with_suffix(".json5").unwrap();
        let tls = serde_json::json!({
            "root_ca_certificate_base64": STANDARD.encode(identity.authority),
            "listen_certificate_base64": STANDARD.encode(identity.certificate),
            "listen_private_key_base64": STANDARD.encode(identity.private_key),
        });
        let text = serde_json::json!({"transport": {"link": {"tls": tls}}}).to_string();
        file.write_all(text.as_bytes()).unwrap();
        file
    }

    /// Whether a host gets an answer from a listener with a certificate of this name.
    fn is_answered(common_name: &str) -> bool {
        let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let endpoints = [format!("tls/{free}")];
        let file = zenoh_file(common_name);
        let listener = Link::open(LinkMode::Listen(&endpoints), TOKEN, Some(file.path())).unwrap();
        let requests = listener.requests("dmprl/test").unwrap();
        let host = Link::open(LinkMode::Connect(&endpoints[0]), TOKEN, None).unwrap();
        assert!(host.is_authenticated() && !listener.is_authenticated());
        std::thread::scope(|scope| {
            let asking = scope.spawn(|| {
                let (deadline, limit) =
                    (Instant::now() + Duration::from_secs(3), Duration::from_millis(200));
                while Instant::now() < deadline {
                    let answer = host.request("dmprl/test", Vec::new(), limit, |_| Some(()));
                    if answer.unwrap().is_some() {
                        return true;
                    }
                }
                false
            });
            while !asking.is_finished() {
                match requests.next().unwrap() {
                    Some(request) => request.answer(b"here".to_vec()).unwrap(),
                    None => std::thread::yield_now(),
                }
            }
            asking.join().unwrap()
        })
    }

    /// As if a public authority had signed the certificate: the authority is trusted, but the name
    /// is not the one of the run's processes.
    #[test]
    fn host_exchanges_no_message_with_a_learner_of_another_name() {
        assert!(is_answered(COMMON_NAME));
        assert!(!is_answered("learner.example.org"));
    }

    #[test]
    fn certificates_of_the_users_file_are_kept() {
        let file = zenoh_file("mine");
        let endpoints = ["tls/127.0.0.1:7447".to_owned()];
        let made = LinkConfig::new(LinkMode::Listen(&endpoints), TOKEN, Some(file.path())).unwrap();
        assert!(!made.is_authenticated);
        // Ours would not verify names.
        let verify = made.config.get_json("transport/link/tls/verify_name_on_connect").unwrap();
        assert_eq!(verify, "null");
    }
}
