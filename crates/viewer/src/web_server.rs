//! The web server: the page, its frames, its requests.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::sync::Arc;
use std::thread::JoinHandle;

use axum::body::Body;
use axum::extract::{Query, Request, State};
use axum::http::{HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Json, Router};
use bytes::Bytes;
use futures_util::stream;
use serde::Deserialize;
use tokio::sync::{oneshot, watch};

use crate::hub::{Hub, PageRequest};

/// The page.
pub(crate) const INDEX: &str = include_str!("../web/index.html");
/// Its program.
pub(crate) const VIEW_SCRIPT: &str = include_str!("../web/view.js");
/// The part of its program that plays recorded frames.
pub(crate) const RECORDING_SCRIPT: &str = include_str!("../web/recording.js");
/// Its style.
pub(crate) const STYLE: &str = include_str!("../web/view.css");
/// The library that draws.
pub(crate) const THREE: &str = include_str!("../web/three.min.js");

/// Files of the page: path, type and content.
const FILES: [(&str, &str, &str); 5] = [
    ("/", "text/html; charset=utf-8", INDEX),
    ("/view.js", "text/javascript; charset=utf-8", VIEW_SCRIPT),
    ("/recording.js", "text/javascript; charset=utf-8", RECORDING_SCRIPT),
    ("/view.css", "text/css; charset=utf-8", STYLE),
    ("/three.min.js", "text/javascript; charset=utf-8", THREE),
];
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
    #[error(
        "others can reach {0}\n  give them a token: `--token WORD` of `view`, `--view-token WORD` of the others; the page is then at http://{0}/?token=WORD"
    )]
    NoToken(SocketAddr),
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
                _ = async { axum::serve(listener, router).await } => {}
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
        if !address.ip().is_loopback() && token.is_none() {
            return Err(ViewError::NoToken(address));
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

fn router(site: Arc<Site>) -> Router {
    let mut router = Router::new();
    for (path, kind, content) in FILES {
        router = router.route(path, get(async move || ([(header::CONTENT_TYPE, kind)], content)));
    }
    router
        .route("/scene", get(scene))
        .route("/frames", get(frames))
        .route("/learning", get(learning))
        .route("/request", post(request))
        .layer(axum::middleware::from_fn_with_state(Arc::clone(&site), check_origin))
        .with_state(site)
}

#[derive(Deserialize)]
struct TokenQuery {
    token: Option<String>,
}

/// Lets a request pass that has the token or, without one, that comes from this machine.
async fn check_origin(
    State(site): State<Arc<Site>>,
    Query(query): Query<TokenQuery>,
    request: Request,
    next: Next,
) -> Response {
    let host = request.headers().get(header::HOST).and_then(|host| host.to_str().ok()).unwrap_or_default();
    let name = host.rsplit_once(':').map_or(host, |(name, _)| name);
    let is_allowed = match &site.token {
        Some(token) => query.token.as_ref() == Some(token),
        // A page of another site could have this address under a name of its own.
        None => LOCAL_HOSTS.contains(&name),
    };
    if is_allowed {
        let mut response = next.run(request).await;
        response.headers_mut().insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
        response
    } else if site.token.is_some() {
        (StatusCode::FORBIDDEN, "`token` is missing or wrong: open the address that the program printed\n")
            .into_response()
    } else {
        (StatusCode::FORBIDDEN, "only http://localhost and http://127.0.0.1 are served without a token\n")
            .into_response()
    }
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
