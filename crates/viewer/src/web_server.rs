//! The web server: the page, its frames, its requests.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use axum::body::Body;
use axum::extract::{Query, Request, State};
use axum::http::{HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Json, Router};
use bytes::Bytes;
use futures_util::stream;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use serde::Deserialize;
use tokio::sync::{Semaphore, oneshot, watch};

use crate::hub::{Hub, PageRequest};

/// The page.
pub(crate) const INDEX: &str = include_str!("../web/index.html");
/// Its program.
pub(crate) const VIEW_SCRIPT: &str = include_str!("../web/view.js");
/// Its style.
pub(crate) const STYLE: &str = include_str!("../web/view.css");
/// Modules that its program imports by the import map of the page: name and content.
pub(crate) const MODULES: [(&str, &str); 6] = [
    ("controls.js", include_str!("../web/controls.js")),
    ("curves.js", include_str!("../web/curves.js")),
    ("recording.js", include_str!("../web/recording.js")),
    ("shapes.js", include_str!("../web/shapes.js")),
    ("stage.js", include_str!("../web/stage.js")),
    ("three.min.js", include_str!("../web/three.min.js")),
];
const SCRIPT_TYPE: &str = "text/javascript; charset=utf-8";

/// Minimum number of characters of a token.
const MIN_TOKEN: usize = 8;
/// Maximum number of connections. An open page has two or three.
const MAX_CONNECTIONS: usize = 64;
/// Time in which a connection has to send its request.
const HEADER_TIMEOUT: Duration = Duration::from_secs(5);
/// Pause after the system refused a connection, such as for want of files.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// Hosts of a page on this machine, also at the end of an `ssh -L` tunnel.
const LOCAL_HOSTS: [&str; 3] = ["localhost", "127.0.0.1", "[::1]"];

/// Reasons why robots cannot be shown.
#[derive(Debug, thiserror::Error)]
pub enum ViewError {
    /// The address cannot be used.
    #[error("cannot listen at {address}: {cause}\n  choose another one: port 0 selects a free port")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// Error of the system.
        cause: std::io::Error,
    },
    /// Others could look at the robots and move them.
    #[error("others can reach {0}: a page there needs a token")]
    NoToken(SocketAddr),
    /// The token can be guessed.
    #[error(
        "the token has {len} characters; at least {MIN_TOKEN} are needed: `openssl rand -hex 16 > token` makes one"
    )]
    ShortToken {
        /// Number of characters.
        len: usize,
    },
    /// The operating system could not start a thread.
    #[error("cannot start the thread of the web server: {0}")]
    Thread(std::io::Error),
}

/// A running web server. It ends when the value is dropped.
pub struct WebServer {
    address: SocketAddr,
    token: Option<String>,
    end: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

struct Site {
    hub: Arc<Hub>,
    token: Option<String>,
}

impl WebServer {
    /// Serves the pages of `hub` at an address. One that others can reach needs a token.
    pub fn start(address: SocketAddr, token: Option<String>, hub: Arc<Hub>) -> Result<Self, ViewError> {
        let listener = Self::listen(address, token.as_deref())?;
        let failed = |cause| ViewError::Listen { address, cause };
        listener.set_nonblocking(true).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(ViewError::Thread)?;
        let router = router(Arc::new(Site { hub, token: token.clone() }));
        let (end, ended) = oneshot::channel::<()>();
        let serve = async move {
            let Ok(listener) = tokio::net::TcpListener::from_std(listener) else { return };
            // Open pages have an endless response, so the server does not wait for them.
            tokio::select! {
                _ = ended => {}
                () = accept(listener, router) => {}
            }
        };
        let thread = std::thread::Builder::new().name("viewer".to_owned());
        let thread = thread.spawn(move || runtime.block_on(serve)).map_err(ViewError::Thread)?;
        Ok(Self { address, token, end: Some(end), thread: Some(thread) })
    }

    /// Checks that pages can be served at an address.
    pub fn check(address: SocketAddr, token: Option<&str>) -> Result<(), ViewError> {
        Self::listen(address, token).map(drop)
    }

    fn listen(address: SocketAddr, token: Option<&str>) -> Result<std::net::TcpListener, ViewError> {
        match token.map(|token| token.chars().count()) {
            None if !address.ip().is_loopback() => return Err(ViewError::NoToken(address)),
            Some(len) if len < MIN_TOKEN => return Err(ViewError::ShortToken { len }),
            _ => {}
        }
        std::net::TcpListener::bind(address).map_err(|cause| ViewError::Listen { address, cause })
    }

    /// Returns the address of the page.
    pub fn url(&self) -> String {
        let token = self.token.as_ref().map_or_else(String::new, |token| format!("?token={token}"));
        format!("http://{}/{token}", self.address)
    }
}

impl Drop for WebServer {
    fn drop(&mut self) {
        drop(self.end.take());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Serves connections. Those above the limit are closed, so that idle ones do not use up the files of this process.
async fn accept(listener: tokio::net::TcpListener, router: Router) {
    let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    loop {
        let Ok((stream, _)) = listener.accept().await else {
            tokio::time::sleep(ACCEPT_PAUSE).await;
            continue;
        };
        let Ok(place) = Arc::clone(&places).try_acquire_owned() else { continue };
        let service = TowerToHyperService::new(router.clone());
        tokio::spawn(async move {
            let mut http = hyper::server::conn::http1::Builder::new();
            http.timer(TokioTimer::new()).header_read_timeout(HEADER_TIMEOUT);
            let _ = http.serve_connection(TokioIo::new(stream), service).await;
            drop(place);
        });
    }
}

fn router(site: Arc<Site>) -> Router {
    let mut files = Router::new();
    let pages = [("/", "text/html; charset=utf-8", INDEX), ("/view.css", "text/css; charset=utf-8", STYLE)];
    let scripts = MODULES.into_iter().chain([("view.js", VIEW_SCRIPT)]);
    let scripts = scripts.map(|(name, content)| (format!("/{name}"), SCRIPT_TYPE, content));
    for (path, kind, content) in
        pages.map(|(path, kind, content)| (path.to_owned(), kind, content)).into_iter().chain(scripts)
    {
        files = files.route(&path, get(async move || ([(header::CONTENT_TYPE, kind)], content)));
    }
    let protected = Router::new()
        .route("/scene", get(scene))
        .route("/frames", get(frames))
        .route("/learning", get(learning))
        .route("/request", post(request))
        .layer(axum::middleware::from_fn_with_state(Arc::clone(&site), check_token));
    // The files are the same for everybody; what they show is not.
    files.merge(protected).layer(axum::middleware::from_fn_with_state(Arc::clone(&site), check_host)).with_state(site)
}

#[derive(Deserialize)]
struct TokenQuery {
    token: Option<String>,
}

/// Lets a request pass if there is a token, or if it is for this machine: a page of another site could have this address under
/// a name of its own.
async fn check_host(State(site): State<Arc<Site>>, request: Request, next: Next) -> Response {
    let host = request.headers().get(header::HOST).and_then(|host| host.to_str().ok()).unwrap_or_default();
    let name = host.rsplit_once(':').map_or(host, |(name, _)| name);
    if site.token.is_none() && !LOCAL_HOSTS.contains(&name) {
        let message = "only http://localhost and http://127.0.0.1 are served without a token\n";
        return (StatusCode::FORBIDDEN, message).into_response();
    }
    let mut response = next.run(request).await;
    response.headers_mut().insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    response
}

/// Lets a request pass that has the token, if there is one.
async fn check_token(
    State(site): State<Arc<Site>>,
    Query(query): Query<TokenQuery>,
    request: Request,
    next: Next,
) -> Response {
    let given = query.token.unwrap_or_default();
    if site.token.as_ref().is_none_or(|token| is_equal(token.as_bytes(), given.as_bytes())) {
        return next.run(request).await;
    }
    (StatusCode::FORBIDDEN, "`token` is missing or wrong: open the address that the program printed\n").into_response()
}

/// Compares two texts in a time that does not depend on where they differ.
fn is_equal(one: &[u8], other: &[u8]) -> bool {
    one.len() == other.len() && one.iter().zip(other).fold(0, |sum, (one, other)| sum | (one ^ other)) == 0
}

async fn scene(State(site): State<Arc<Site>>) -> Response {
    Json(site.hub.scene()).into_response()
}

#[derive(Deserialize)]
struct LearningQuery {
    /// Index of the first point.
    #[serde(default)]
    from: usize,
}

/// Answers with the learning curve, or with the points that a page does not have yet.
async fn learning(State(site): State<Arc<Site>>, Query(query): Query<LearningQuery>) -> Response {
    Json(site.hub.learning_from(query.from)).into_response()
}

/// Answers with frames without an end. One that reads slowly gets the newest frame when it reads again.
async fn frames(State(site): State<Arc<Site>>) -> Response {
    let mut receiver = site.hub.subscribe();
    receiver.mark_changed();
    let frames = stream::unfold(receiver, async |mut receiver| {
        let bytes = next_frame(&mut receiver).await?;
        Some((Ok::<_, Infallible>(bytes), receiver))
    });
    ([(header::CONTENT_TYPE, "application/octet-stream")], Body::from_stream(frames)).into_response()
}

async fn next_frame(receiver: &mut watch::Receiver<Bytes>) -> Option<Bytes> {
    loop {
        receiver.changed().await.ok()?;
        let bytes = receiver.borrow_and_update().clone();
        if !bytes.is_empty() {
            return Some(bytes);
        }
    }
}

/// Takes the request of a page. Its type is JSON, which pages of other sites cannot send.
async fn request(State(site): State<Arc<Site>>, Json(request): Json<PageRequest>) -> Response {
    if site.hub.request(request) {
        StatusCode::NO_CONTENT.into_response()
    } else {
        (StatusCode::CONFLICT, "these robots are only looked at, or too many requests wait\n").into_response()
    }
}
