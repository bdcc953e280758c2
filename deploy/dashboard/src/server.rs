//! The HTTP server on loopback: routes and shutdown.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::Context;
use axum::extract::{Query, Request, State};
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

use super::access::{self, Access};
use super::api::{self, ApiError};
use super::cached_run::TablePosition;
use super::catalogue::Catalogue;
use super::page::{self, PageFile};
use super::prometheus;

/// Time limit of a request.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(30);
/// Time limit for responses in progress after Ctrl-C.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_millis(500);
/// Forbids inline scripts and resources of other origins.
const SECURITY_POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; \
                               img-src 'self' data:; media-src 'self'; connect-src 'self'; \
                               base-uri 'none'; form-action 'none'; frame-ancestors 'none'";
/// Headers of every response.
const HEADERS: [(HeaderName, HeaderValue); 4] = [
    (header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(SECURITY_POLICY)),
    (header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff")),
    (header::REFERRER_POLICY, HeaderValue::from_static("no-referrer")),
    // A cached page of an older version must not be used with a newer server at the same address.
    (header::CACHE_CONTROL, HeaderValue::from_static("no-store")),
];

/// Options of the dashboard.
#[derive(Debug)]
pub struct Options<'o> {
    /// A run, or a directory that contains runs.
    pub root: &'o Path,
    /// Port on 127.0.0.1; 0 for any free port.
    pub port: u16,
    /// Token that each request must have, because every user of a machine can open its ports.
    pub token: String,
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

/// Serves the page until the user interrupts it, which is the normal end.
///
/// - `interrupts`: called in the runtime; returns a channel with one message per interrupt.
/// - `on_listening`: called with the page's URL once the server accepts connections.
///
/// # Errors
/// Wrong use: the directory does not exist, or the token has characters that URLs do not allow. The
/// port is in use.
pub fn serve(
    options: Options,
    interrupts: fn() -> anyhow::Result<mpsc::Receiver<()>>,
    on_listening: impl FnOnce(&str) -> anyhow::Result<()>,
) -> anyhow::Result<Outcome> {
    let access = Arc::new(Access::new(options.token)?);
    let mut catalogue = Catalogue::new(options.root)?;
    catalogue.scan();
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start the dashboard's runtime")?;
    let served = runtime.block_on(async {
        let mut interrupts = interrupts()?;
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, options.port));
        let listener = TcpListener::bind(address).await.with_context(|| {
            format!("cannot listen on {address}; choose another --port, or 0 for any free one")
        })?;
        let address = listener.local_addr().context("cannot determine the port")?;
        on_listening(&format!("http://{address}/{}", access.query()))?;
        let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
        let server = axum::serve(listener, router(Arc::new(Mutex::new(catalogue)), access))
            .with_graceful_shutdown(async { drop(stopped.await) });
        let mut server = std::pin::pin!(server.into_future());
        tokio::select! {
            ended = &mut server => return ended.context("the dashboard's server failed"),
            _ = interrupts.recv() => drop(stop),
        }
        // A client that does not read could keep its connection open forever. Dropping it is not an
        // error.
        let _ = tokio::time::timeout(SHUTDOWN_TIMEOUT, server).await;
        Ok(())
    });
    // Does not wait for blocking threads that read files.
    runtime.shutdown_background();
    served.map(|()| Outcome::Done)
}

fn router(shared: Shared, access: Arc<Access>) -> Router {
    let mut texts = Router::new()
        .route("/", get(|| async { page_file(&page::FILES[0]) }))
        .route("/api/runs", get(runs))
        .route("/api/curves", get(curves))
        .route("/api/evaluations", get(evaluations))
        .route("/api/motion", get(motion))
        .route("/api/videos", get(videos))
        .route("/api/processes", get(processes))
        .route("/api/config", get(config))
        .route("/metrics", get(metrics));
    for file in &page::FILES[1..] {
        let path = format!("/page/{}", file.name);
        texts = texts.route(&path, get(move || async move { page_file(file) }));
    }
    // Videos are not compressed again, since they already are and players request ranges of them.
    let texts = texts.layer(CompressionLayer::new());
    let all = texts.route("/video", get(video)).fallback(not_found);
    let timeout = TimeoutLayer::with_status_code(StatusCode::SERVICE_UNAVAILABLE, REQUEST_TIMEOUT);
    all.layer(timeout)
        .layer(middleware::from_fn_with_state(access, access::check))
        .layer(middleware::from_fn(add_headers))
        .with_state(shared)
}

/// Adds [`HEADERS`] to each response.
async fn add_headers(request: Request, next: Next) -> Response {
    let mut response = next.run(request).await;
    response.headers_mut().extend(HEADERS);
    response
}

fn page_file(file: &PageFile) -> Response {
    ([(header::CONTENT_TYPE, file.content_type)], file.content).into_response()
}

async fn not_found(request: Request) -> Response {
    let message = format!("there is no {}; the page is at /", request.uri().path());
    ApiError::NotFound(message).into_response()
}

/// Runs `work` on a blocking thread, because it reads files.
async fn read<T: Send + 'static>(
    shared: Shared,
    work: impl FnOnce(&mut Catalogue) -> Result<T, ApiError> + Send + 'static,
) -> Result<T, ApiError> {
    let work = move || work(&mut shared.lock().unwrap_or_else(PoisonError::into_inner));
    let joined = tokio::task::spawn_blocking(work).await;
    joined.map_err(|error| ApiError::Internal(error.into()))?
}

/// Responds with the result of `work` as JSON.
async fn answer<T: Serialize + Send + 'static>(
    shared: Shared,
    work: impl FnOnce(&mut Catalogue) -> Result<T, ApiError> + Send + 'static,
) -> Result<Json<T>, ApiError> {
    read(shared, work).await.map(Json)
}

async fn runs(State(shared): State<Shared>) -> impl IntoResponse {
    answer(shared, |catalogue| Ok(api::runs(catalogue))).await
}

async fn curves(
    State(shared): State<Shared>,
    Query(query): Query<CurvesQuery>,
) -> impl IntoResponse {
    answer(shared, move |catalogue| {
        let CurvesQuery { run, file, names, table, from } = query;
        api::curves(catalogue, &run, &file, &names, TablePosition { table, row: from })
    })
    .await
}

async fn evaluations(
    State(shared): State<Shared>,
    Query(query): Query<RunQuery>,
) -> impl IntoResponse {
    answer(shared, move |catalogue| api::evaluations(catalogue, &query.run)).await
}

async fn motion(State(shared): State<Shared>, Query(query): Query<RunQuery>) -> impl IntoResponse {
    answer(shared, move |catalogue| api::motion(catalogue, &query.run)).await
}

async fn videos(State(shared): State<Shared>, Query(query): Query<RunQuery>) -> impl IntoResponse {
    answer(shared, move |catalogue| api::videos(catalogue, &query.run)).await
}

async fn processes(
    State(shared): State<Shared>,
    Query(query): Query<RunQuery>,
) -> impl IntoResponse {
    answer(shared, move |catalogue| api::processes(catalogue, &query.run)).await
}

async fn config(State(shared): State<Shared>, Query(query): Query<RunQuery>) -> impl IntoResponse {
    answer(shared, move |catalogue| api::config(catalogue, &query.run)).await
}

async fn metrics(State(shared): State<Shared>) -> Result<Response, ApiError> {
    let text = read(shared, |catalogue| Ok(prometheus::text(catalogue)?)).await?;
    Ok(([(header::CONTENT_TYPE, prometheus::CONTENT_TYPE)], text).into_response())
}

async fn video(
    State(shared): State<Shared>,
    Query(query): Query<VideoQuery>,
    request: Request,
) -> Result<Response, ApiError> {
    let find = move |catalogue: &mut Catalogue| api::video(catalogue, &query.run, &query.name);
    let path: PathBuf = read(shared, find).await?;
    // `ServeFile` supports the range requests of players.
    let served = ServeFile::new(&path).try_call(request).await;
    let served = served.with_context(|| format!("cannot read {}", path.display()))?;
    Ok(served.into_response())
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        let (status, message) = match self {
            Self::NotFound(message) => (StatusCode::NOT_FOUND, message),
            Self::BadRequest(message) => (StatusCode::BAD_REQUEST, message),
            Self::Internal(error) => (StatusCode::INTERNAL_SERVER_ERROR, format!("{error:#}")),
        };
        (status, Json(json!({ "error": message }))).into_response()
    }
}
