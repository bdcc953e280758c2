//! TLS for `tls/` endpoints: a tunnel around the connections of Zenoh, which itself speaks plain
//! TCP on loopback.
//!
//! Zenoh's own TLS reads and writes one connection on several threads at once, which corrupts it
//! (zenoh issue 2557), and its connecting end trusts all public authorities.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use anyhow::Context;
use rustls::pki_types::ServerName;
use tokio::io::{AsyncRead, AsyncWrite, BufReader, copy_bidirectional_with_sizes};
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::{Builder, Runtime};
use tokio::sync::Semaphore;
use tokio::time::{sleep, timeout};
use tokio_rustls::{TlsAcceptor, TlsConnector};

use crate::tls_identity::{NAME, TlsIdentity};

/// Maximum number of connections that have not proven that they know the token, and the time limit
/// for their handshake. A message of a handshake has at most 64 KiB. Further ones are closed and
/// counted.
const HANDSHAKES_MAX: usize = 64;
const HANDSHAKE_LIMIT: Duration = Duration::from_secs(10);
/// Maximum number of open connections.
const CONNECTIONS_MAX: u32 = 256;
const CONNECT_LIMIT: Duration = Duration::from_secs(5);
/// Buffer for each direction of a connection \[bytes\].
const BUFFER_BYTES: usize = 262_144;
/// Wait after the system could not accept a connection, such as for lack of open files.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// Time limit to deliver the last messages of a closed session.
const DRAIN_LIMIT: Duration = Duration::from_secs(1);
const THREADS: usize = 2;

/// Carries connections until it is dropped.
#[derive(Debug)]
pub(crate) struct TlsTunnel {
    runtime: Runtime,
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    handshakes: Arc<Semaphore>,
    connections: Arc<Semaphore>,
    /// Connections that did not complete the handshake.
    refused: AtomicU64,
}

impl TlsTunnel {
    /// Creates a tunnel without connections.
    ///
    /// # Errors
    /// The system cannot start threads.
    pub(crate) fn new() -> anyhow::Result<Self> {
        let mut builder = Builder::new_multi_thread();
        let builder = builder.worker_threads(THREADS).thread_name("tls").enable_all();
        let shared = Shared {
            handshakes: Arc::new(Semaphore::new(HANDSHAKES_MAX)),
            connections: Arc::new(Semaphore::new(CONNECTIONS_MAX as usize)),
            refused: AtomicU64::new(0),
        };
        let runtime = builder.build().context("cannot start the threads of TLS")?;
        Ok(Self { runtime, shared: Arc::new(shared) })
    }

    /// Number of connections that did not complete the handshake.
    pub(crate) fn refused(&self) -> u64 {
        self.shared.refused.load(Ordering::Relaxed)
    }

    /// Listens at `address` for hosts of the run. Forwards their connections to `inner`.
    ///
    /// # Errors
    /// Cannot listen at the address.
    pub(crate) fn listen(
        &self,
        identity: TlsIdentity,
        address: &str,
        inner: SocketAddr,
    ) -> anyhow::Result<()> {
        let acceptor = TlsAcceptor::from(Arc::new(identity.server()?));
        let listener = self.runtime.block_on(TcpListener::bind(address))?;
        self.runtime.spawn(accept_hosts(listener, acceptor, inner, Arc::clone(&self.shared)));
        Ok(())
    }

    /// Returns a loopback address whose connections are forwarded to the learner's host.
    ///
    /// # Errors
    /// No port is free.
    pub(crate) fn connect(
        &self,
        identity: TlsIdentity,
        address: &str,
    ) -> anyhow::Result<SocketAddr> {
        let connector = TlsConnector::from(Arc::new(identity.client()?));
        let listener = self.runtime.block_on(TcpListener::bind("127.0.0.1:0"))?;
        let local = listener.local_addr()?;
        let shared = Arc::clone(&self.shared);
        self.runtime.spawn(accept_local(listener, connector, address.to_owned(), shared));
        Ok(local)
    }
}

impl Drop for TlsTunnel {
    fn drop(&mut self) {
        // Connections end when Zenoh has closed them.
        let connections = Arc::clone(&self.shared.connections);
        let all = async move {
            timeout(DRAIN_LIMIT, connections.acquire_many(CONNECTIONS_MAX)).await.is_ok()
        };
        self.runtime.block_on(all);
    }
}

async fn accept(listener: &TcpListener) -> TcpStream {
    loop {
        match listener.accept().await {
            Ok((stream, _)) => return stream,
            Err(_) => sleep(ACCEPT_PAUSE).await,
        }
    }
}

async fn accept_hosts(
    listener: TcpListener,
    acceptor: TlsAcceptor,
    inner: SocketAddr,
    shared: Arc<Shared>,
) {
    loop {
        let outer = accept(&listener).await;
        let Ok(handshake) = Arc::clone(&shared.handshakes).try_acquire_owned() else {
            shared.refused.fetch_add(1, Ordering::Relaxed);
            continue;
        };
        let (acceptor, shared) = (acceptor.clone(), Arc::clone(&shared));
        tokio::spawn(async move {
            // Without a delay for small messages, as on Zenoh's own connections.
            let _ = outer.set_nodelay(true);
            let accepted = timeout(HANDSHAKE_LIMIT, acceptor.accept(buffered(outer))).await;
            drop(handshake);
            let Ok(Ok(outer)) = accepted else {
                shared.refused.fetch_add(1, Ordering::Relaxed);
                return;
            };
            if let Ok(inner) = TcpStream::connect(inner).await {
                forward(inner, outer, &shared).await;
            }
        });
    }
}

async fn accept_local(
    listener: TcpListener,
    connector: TlsConnector,
    address: String,
    shared: Arc<Shared>,
) {
    loop {
        let inner = accept(&listener).await;
        let (connector, address) = (connector.clone(), address.clone());
        let shared = Arc::clone(&shared);
        tokio::spawn(async move {
            let connected = timeout(CONNECT_LIMIT, TcpStream::connect(&address)).await;
            let Ok(Ok(outer)) = connected else { return };
            let _ = outer.set_nodelay(true);
            let name = ServerName::try_from(NAME).expect("the name is valid");
            let accepted = timeout(HANDSHAKE_LIMIT, connector.connect(name, buffered(outer))).await;
            if let Ok(Ok(outer)) = accepted {
                forward(inner, outer, &shared).await;
            }
        });
    }
}

/// Rustls would read 4 KiB at a time.
fn buffered(outer: TcpStream) -> BufReader<TcpStream> {
    BufReader::with_capacity(BUFFER_BYTES, outer)
}

/// Copies in both directions until both ends are closed or one fails.
async fn forward(
    mut inner: TcpStream,
    mut outer: impl AsyncRead + AsyncWrite + Unpin,
    shared: &Shared,
) {
    let Ok(_connection) = shared.connections.try_acquire() else { return };
    let _ = inner.set_nodelay(true);
    // Zenoh notices a broken connection by itself.
    let _ = copy_bidirectional_with_sizes(&mut inner, &mut outer, BUFFER_BYTES, BUFFER_BYTES).await;
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{Read, Write};
    use std::time::Instant;

    const TOKEN: &str = "a secret of some length";

    /// Whether a host with one token gets the greeting of a learner with another.
    fn is_connected(learner: &str, host: &str) -> bool {
        let inner = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let address = free.to_string();
        let listening = TlsTunnel::new().unwrap();
        let identity = TlsIdentity::new(learner).unwrap();
        listening.listen(identity, &address, inner.local_addr().unwrap()).unwrap();
        let connecting = TlsTunnel::new().unwrap();
        let identity = TlsIdentity::new(host).unwrap();
        let local = connecting.connect(identity, &address).unwrap();
        std::thread::spawn(move || {
            if let Ok((mut stream, _)) = inner.accept() {
                stream.write_all(b"welcome").unwrap();
            }
        });
        let mut got = Vec::new();
        let _ = std::net::TcpStream::connect(local).unwrap().read_to_end(&mut got);
        // The host may notice the other's certificate before the learner notices that.
        let deadline = Instant::now() + HANDSHAKE_LIMIT;
        while got.is_empty() && listening.refused() == 0 {
            assert!(Instant::now() < deadline, "a handshake that failed is counted");
            std::thread::yield_now();
        }
        assert_eq!(got.is_empty(), listening.refused() > 0);
        got == b"welcome"
    }

    #[test]
    fn only_ends_with_the_same_token_are_connected() {
        assert!(is_connected(TOKEN, TOKEN));
        assert!(!is_connected(TOKEN, "another secret of some length"));
    }
}
