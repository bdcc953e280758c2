//! Zenoh's configuration for a session between hosts of a run.
//!
//! Only ends that know the run's token can open a session: on `tls/` endpoints they need a
//! certificate of the run's authority (`tls_tunnel.rs`), and on every endpoint a password that is
//! derived from the token. So others cannot send the gateway anything, and it stores for them only
//! the handshakes of [`HANDSHAKES_MAX`] connections.
//!
//! A user's file for Zenoh can configure TLS itself. Zenoh's TLS then replaces ours. Such a
//! session, and one with `tcp/` endpoints, does not count as authenticated, and its messages are
//! sealed.

use std::io::Write;
use std::net::{SocketAddr, TcpListener};
use std::path::Path;

use anyhow::{Context, anyhow};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use dmprl_run::failure::wrong_use;
use tempfile::NamedTempFile;
use zenoh::Config;

use crate::LinkMode;
use crate::keys::Key;
use crate::tls_identity::TlsIdentity;
use crate::tls_tunnel::TlsTunnel;

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
    /// Carries the connections of `tls/` endpoints.
    pub tunnel: Option<TlsTunnel>,
    /// The file of passwords, which Zenoh reads when it opens.
    pub passwords: Option<NamedTempFile>,
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
        let is_own_tls = !sets_certificates(&config)?;
        let tunnel = if is_own_tls && mode.has_tls() { Some(TlsTunnel::new()?) } else { None };
        let endpoint = |endpoint: &String| match (&tunnel, endpoint.strip_prefix("tls/")) {
            (Some(tunnel), Some(address)) => inner_endpoint(tunnel, mode, token, address),
            _ => Ok(endpoint.clone()),
        };
        match mode {
            LinkMode::Listen(at) => {
                let at = at.iter().map(endpoint).collect::<anyhow::Result<Vec<_>>>()?;
                connections(&mut config, &at, &[], BATCH_BYTES_MAX)?;
            }
            LinkMode::Connect(to) => {
                connections(&mut config, &[], &[endpoint(&to.to_owned())?], POLICY_BYTES_MAX)?;
            }
        }
        let passwords = passwords(&mut config, mode, token)?;
        let is_authenticated = is_own_tls && mode.is_encrypted();
        Ok(Self { config, is_authenticated, tunnel, passwords })
    }
}

/// Begins to carry an endpoint's connections. Returns the endpoint of Zenoh on loopback.
fn inner_endpoint(
    tunnel: &TlsTunnel,
    mode: LinkMode<'_>,
    token: &str,
    address: &str,
) -> anyhow::Result<String> {
    let identity = TlsIdentity::new(token)?;
    let inner = match mode {
        LinkMode::Connect(_) => tunnel.connect(identity, address),
        LinkMode::Listen(_) => free_address().and_then(|inner| {
            tunnel.listen(identity, address, inner)?;
            Ok(inner)
        }),
    };
    Ok(format!("tcp/{}", inner.with_context(|| mode.to_string())?))
}

fn free_address() -> anyhow::Result<SocketAddr> {
    Ok(TcpListener::bind("127.0.0.1:0")?.local_addr()?)
}

fn set(config: &mut Config, key: &str, value: impl serde::Serialize) -> anyhow::Result<()> {
    let value = serde_json::to_string(&value)?;
    // The value may be a secret.
    config.insert_json5(key, &value).map_err(|error| anyhow!("cannot set {key} of Zenoh: {error}"))
}

/// Sets endpoints and limits.
fn connections(
    config: &mut Config,
    listen: &[String],
    connect: &[String],
    bytes_max: usize,
) -> anyhow::Result<()> {
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
