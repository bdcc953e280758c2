//! The HTTP server on loopback: routes, access checks and shutdown.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::Context;
use axum::extract::{Query, Request, State};
use axum::http::uri::Authority;
use axum::http::{HeaderName, HeaderValue, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Json, Router};
use dmprl_run::failure::Outcome;
use serde::{Deserialize, Serialize};
use serde_json::json;
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tower_http::compression::CompressionLayer;
use tower_http::services::ServeFile;
use tower_http::timeout::TimeoutLayer;

use super::answers::{self, Refusal};
use super::catalogue::Catalogue;
use super::{page, prometheus};

/// Time limit of a request.
const REQUEST_MAX: Duration = Duration::from_secs(30);
/// Time limit for responses in progress after Ctrl-C.
const LAST_ANSWERS: Duration = Duration::from_millis(500);
/// Names under which this machine accepts requests. They protect against DNS rebinding: a page
/// whose domain resolves to this machine still sends its own name.
const OWN_NAMES: [&str; 3] = ["localhost", "127.0.0.1", "[::1]"];
/// Forbids resources of other origins and inline scripts.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; \
                      img-src 'self' data:; media-src 'self'; connect-src 'self'; \
                      base-uri 'none'; form-action 'none'; frame-ancestors 'none'";
/// Headers of every response.
const HEADERS: [(HeaderName, HeaderValue); 4] = [
    (header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(POLICY)),
    (header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff")),
    (header::REFERRER_POLICY, HeaderValue::from_static("no-referrer")),
    // The page of an older version must not be used with a newer program at the same address.
    (header::CACHE_CONTROL, HeaderValue::from_static("no-store")),
];

/// What the dashboard shows, and on which port.
#[derive(Debug)]
pub struct Plan<'p> {
    /// A run, or a directory that contains runs.
    pub root: &'p Path,
    /// Port on 127.0.0.1; 0 for any free port.
    pub port: u16,
}

type Shared = Arc<Mutex<Catalogue>>;

#[derive(Deserialize)]
struct RunQuery {
    run: String,
}

#[derive(Deserialize)]
struct CurvesQuery {
    run: String,
    file: String,
    names: String,
    #[serde(default)]
    table: u64,
    #[serde(default)]
    from: usize,
}

#[derive(Deserialize)]
struct VideoQuery {
    run: String,
    name: String,
}

/// Serves the page until the user interrupts it, which is its normal end.
///
/// - `interrupts`: called in the runtime; returns a stream with one item per interrupt.
/// - `listening`: called with the address once the server accepts connections.
///
/// # Errors
/// Wrong use: the directory does not exist. The port is in use.
pub fn serve(
    plan: &Plan,
    interrupts: fn() -> anyhow::Result<mpsc::Receiver<()>>,
    listening: impl FnOnce(SocketAddr) -> anyhow::Result<()>,
) -> anyhow::Result<Outcome> {
    let mut catalogue = Catalogue::new(plan.root)?;
    catalogue.walk();
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start the dashboard's runtime")?;
    let served = runtime.block_on(async {
        let mut interrupts = interrupts()?;
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, plan.port));
        let listener = TcpListener::bind(address).await.with_context(|| {
            format!("cannot listen on {address}; choose another --port, 0 for any that is free")
        })?;
        listening(listener.local_addr().context("cannot determine the port")?)?;
        let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
        let server = axum::serve(listener, router(Arc::new(Mutex::new(catalogue))))
            .with_graceful_shutdown(async { drop(stopped.await) });
        let mut server = std::pin::pin!(server.into_future());
        tokio::select! {
            ended = &mut server => return ended.context("the dashboard's server has ended"),
            _ = interrupts.recv() => drop(stop),
        }
        // A connection that reads nothing may stay open forever; cutting it is no failure.
        let _ = tokio::time::timeout(LAST_ANSWERS, server).await;
        Ok(())
    });
    // Does not wait for a file that is being read.
    runtime.shutdown_background();
    served.map(|()| Outcome::Done)
}

fn router(shared: Shared) -> Router {
    let mut texts = Router::new()
        .route("/", get(|| async { file(&page::FILES[0]) }))
        .route("/api/runs", get(runs))
        .route("/api/curves", get(curves))
        .route("/api/evaluations", get(evaluations))
        .route("/api/motion", get(motion))
        .route("/api/videos", get(videos))
        .route("/api/processes", get(processes))
        .route("/api/config", get(config))
        .route("/metrics", get(metrics));
    for one in &page::FILES[1..] {
        texts = texts.route(&format!("/page/{}", one.0), get(move || async move { file(one) }));
    }
    // Videos are already compressed, and players request parts of them.
    let texts = texts.layer(CompressionLayer::new());
    let all = texts.route("/video", get(video)).fallback(nothing);
    let timeout = TimeoutLayer::with_status_code(StatusCode::SERVICE_UNAVAILABLE, REQUEST_MAX);
    all.layer(timeout).layer(middleware::from_fn(guard)).with_state(shared)
}

/// Answers only requests that name this machine, and adds the headers to the response.
async fn guard(request: Request, next: Next) -> Response {
    let host = request.headers().get(header::HOST).and_then(|host| host.to_str().ok());
    let mut response = match host {
        Some(host) if is_own_name(host) => next.run(request).await,
        _ => {
            let host = host.unwrap_or("nothing");
            let message = format!(
                "expected a request to localhost or 127.0.0.1, got one to {host:?}; from another \
                 machine: ssh -L 8787:127.0.0.1:PORT, then http://127.0.0.1:8787\n"
            );
            (StatusCode::FORBIDDEN, message).into_response()
        }
    };
    response.headers_mut().extend(HEADERS);
    response
}

/// Returns true if a host is this machine. Any port is accepted, since it may have been forwarded.
fn is_own_name(host: &str) -> bool {
    let host = host.parse::<Authority>();
    host.is_ok_and(|host| OWN_NAMES.iter().any(|name| host.host().eq_ignore_ascii_case(name)))
}

fn file((_, kind, content): &(&str, &'static str, &'static [u8])) -> Response {
    ([(header::CONTENT_TYPE, *kind)], *content).into_response()
}

async fn nothing(request: Request) -> Response {
    let message = format!("there is no {}; the page is at /", request.uri().path());
    Refusal::Missing(message).into_response()
}

/// Reads files on a blocking thread.
async fn read<T: Send + 'static>(
    shared: Shared,
    work: impl FnOnce(&mut Catalogue) -> Result<T, Refusal> + Send + 'static,
) -> Result<T, Refusal> {
    let work = move || work(&mut shared.lock().unwrap_or_else(PoisonError::into_inner));
    let joined = tokio::task::spawn_blocking(work).await;
    joined.map_err(|error| Refusal::Failed(error.into()))?
}

async fn answer<T: Serialize + Send + 'static>(
    shared: Shared,
    work: impl FnOnce(&mut Catalogue) -> Result<T, Refusal> + Send + 'static,
) -> Result<Json<T>, Refusal> {
    read(shared, work).await.map(Json)
}

async fn runs(State(shared): State<Shared>) -> impl IntoResponse {
    answer(shared, |catalogue| Ok(answers::runs(catalogue))).await
}

async fn curves(
    State(shared): State<Shared>,
    Query(query): Query<CurvesQuery>,
) -> impl IntoResponse {
    answer(shared, move |catalogue| {
        let CurvesQuery { run, file, names, table, from } = query;
        answers::curves(catalogue, (&run, &file), &names, (table, from))
    })
    .await
}

async fn evaluations(
    State(shared): State<Shared>,
    Query(query): Query<RunQuery>,
) -> impl IntoResponse {
    answer(shared, move |catalogue| answers::evaluations(catalogue, &query.run)).await
}

async fn motion(State(shared): State<Shared>, Query(query): Query<RunQuery>) -> impl IntoResponse {
    answer(shared, move |catalogue| answers::motion(catalogue, &query.run)).await
}

async fn videos(State(shared): State<Shared>, Query(query): Query<RunQuery>) -> impl IntoResponse {
    answer(shared, move |catalogue| answers::videos(catalogue, &query.run)).await
}

async fn processes(
    State(shared): State<Shared>,
    Query(query): Query<RunQuery>,
) -> impl IntoResponse {
    answer(shared, move |catalogue| answers::processes(catalogue, &query.run)).await
}

async fn config(State(shared): State<Shared>, Query(query): Query<RunQuery>) -> impl IntoResponse {
    answer(shared, move |catalogue| answers::config(catalogue, &query.run)).await
}

async fn metrics(State(shared): State<Shared>) -> Result<Response, Refusal> {
    let text = read(shared, |catalogue| Ok(prometheus::text(catalogue)?)).await?;
    Ok(([(header::CONTENT_TYPE, prometheus::CONTENT_TYPE)], text).into_response())
}

async fn video(
    State(shared): State<Shared>,
    Query(query): Query<VideoQuery>,
    request: Request,
) -> Result<Response, Refusal> {
    let find = move |catalogue: &mut Catalogue| answers::video(catalogue, &query.run, &query.name);
    let path: PathBuf = read(shared, find).await?;
    // Supports ranges, which players request.
    let served = ServeFile::new(&path).try_call(request).await;
    let served = served.with_context(|| format!("cannot read {}", path.display()))?;
    Ok(served.into_response())
}

impl IntoResponse for Refusal {
    fn into_response(self) -> Response {
        let (status, message) = match self {
            Self::Missing(message) => (StatusCode::NOT_FOUND, message),
            Self::Senseless(message) => (StatusCode::BAD_REQUEST, message),
            Self::Failed(error) => (StatusCode::INTERNAL_SERVER_ERROR, format!("{error:#}")),
        };
        (status, Json(json!({ "error": message }))).into_response()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_of_this_machine_are_its_own() {
        for own in ["localhost", "127.0.0.1:8787", "LOCALHOST:1", "[::1]:8787"] {
            assert!(is_own_name(own), "{own}");
        }
        for foreign in ["", "evil.example:8787", "localhost.evil.example", "0.0.0.0", "a b"] {
            assert!(!is_own_name(foreign), "{foreign}");
        }
    }
}
