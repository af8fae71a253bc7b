//! Common parts of the web servers: a port with a limited number of connections, the check of a request's origin,
//! and files.

use std::collections::VecDeque;
use std::io;
use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::pin::pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::extract::Request;
use axum::http::header::{
    ACCEPT_ENCODING, CACHE_CONTROL, CONTENT_ENCODING, CONTENT_TYPE, HOST, ORIGIN, REFERRER_POLICY,
    X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::TcpStream;
use tokio::task::AbortHandle;
use tokio::time::{sleep, timeout};

use crate::error::ServerError;
use crate::files::decompress;

/// Maximum number of HTTP connections. Another one closes the oldest, so that idle clients keep nobody out.
const MAX_CONNECTIONS: usize = 64;

/// How long a client may take for a request's headers, also for the next request of an open connection.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(30);

/// How long a connection may take in total, so that a client that does not read its answer ends too.
const CONNECTION_TIMEOUT: Duration = Duration::from_secs(600);

/// Maximum bytes of a request's headers, which include the cookies of all servers on this host.
const MAX_BUFFER: usize = 64 * 1024;

/// Threads for calls that block.
const BLOCKING_THREADS: usize = 4;

/// The pause after a connection cannot be accepted, as when the process has no more descriptors.
const ACCEPT_PAUSE: Duration = Duration::from_millis(200);

/// How often a server checks its stop flag.
const STOP_INTERVAL: Duration = Duration::from_millis(20);

/// A port on which a server listens.
#[derive(Debug)]
pub struct Port {
    listener: TcpListener,
    address: SocketAddr,
}

impl Port {
    /// Binds the address; port 0 for any free one.
    ///
    /// # Errors
    ///
    /// The operating system's, such as that the port is taken.
    pub fn bind(address: SocketAddr) -> io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        listener.set_nonblocking(true)?;
        Ok(Port { address: listener.local_addr()?, listener })
    }

    /// Binds a port on 127.0.0.1; 0 for any free one.
    ///
    /// # Errors
    ///
    /// [`ServerError::Port`] if the port is taken.
    pub fn local(port: u16) -> Result<Self, ServerError> {
        Port::bind((Ipv4Addr::LOCALHOST, port).into()).map_err(|reason| ServerError::Port { port, reason })
    }

    /// `http://ADDRESS/`.
    pub fn url(&self) -> String {
        format!("http://{}/", self.address)
    }

    /// Serves in this thread until `stopped` is ready, and then closes open connections.
    ///
    /// # Errors
    ///
    /// [`ServerError::Server`] if the operating system refuses threads or descriptors.
    pub fn serve(self, router: Router, stopped: impl Future<Output = ()>) -> Result<(), ServerError> {
        let runtime =
            tokio::runtime::Builder::new_current_thread().enable_all().max_blocking_threads(BLOCKING_THREADS).build();
        let runtime = runtime.map_err(|reason| ServerError::Server { reason })?;
        // Other names may lead to an address that other hosts reach.
        let hosts = self
            .address
            .ip()
            .is_loopback()
            .then(|| [self.address.to_string(), format!("localhost:{}", self.address.port())]);
        let router = router.layer(middleware::from_fn(move |request: Request, next: Next| {
            let refusal = refusal(request.headers(), hosts.as_ref());
            async move { if let Some(why) = refusal { refuse(why) } else { protected(next.run(request).await) } }
        }));
        let served = runtime.block_on(async {
            let listener = tokio::net::TcpListener::from_std(self.listener)?;
            tokio::select! {
                () = accept(&listener, router) => {}
                () = stopped => {}
            }
            Ok(())
        });
        // Blocking tasks that still run have no visible effect.
        runtime.shutdown_background();
        served.map_err(|reason| ServerError::Server { reason })
    }
}

/// Waits until the flag is set.
pub async fn is_set(stop: &AtomicBool) {
    while !stop.load(Ordering::Relaxed) {
        sleep(STOP_INTERVAL).await;
    }
}

/// Accepts connections, each of which has a task.
async fn accept(listener: &tokio::net::TcpListener, router: Router) {
    let mut open = VecDeque::<AbortHandle>::new();
    loop {
        let stream = match listener.accept().await {
            Ok((stream, _)) => stream,
            Err(error) => {
                tracing::debug!(%error, "cannot accept a connection");
                sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        open.retain(|connection| !connection.is_finished());
        if open.len() >= MAX_CONNECTIONS
            && let Some(oldest) = open.pop_front()
        {
            oldest.abort();
        }
        open.push_back(tokio::spawn(answer(stream, router.clone())).abort_handle());
    }
}

/// Answers the requests of a connection. A WebSocket outlives this.
async fn answer(stream: TcpStream, router: Router) {
    let mut http = http1::Builder::new();
    http.timer(TokioTimer::new()).header_read_timeout(REQUEST_TIMEOUT).max_buf_size(MAX_BUFFER);
    let connection = http.serve_connection(TokioIo::new(stream), TowerToHyperService::new(router)).with_upgrades();
    let mut connection = pin!(connection);
    let ended = if let Ok(ended) = timeout(CONNECTION_TIMEOUT, connection.as_mut()).await {
        ended
    } else {
        connection.as_mut().graceful_shutdown();
        timeout(REQUEST_TIMEOUT, connection).await.unwrap_or(Ok(()))
    };
    if let Err(error) = ended {
        tracing::debug!(%error, "a connection has failed");
    }
}

/// Why a request is refused: it names none of the server's `hosts` (as in DNS rebinding), or another site's page sent it.
/// `None` for a server of any name.
fn refusal(headers: &HeaderMap, hosts: Option<&[String; 2]>) -> Option<&'static str> {
    let text = |name: HeaderName| headers.get(name).map(|value| value.to_str().unwrap_or_default());
    let host = text(HOST).unwrap_or_default();
    if hosts.is_some_and(|hosts| !hosts.iter().any(|ours| ours == host)) {
        return Some("the Host header must name this server");
    }
    match text(ORIGIN) {
        Some(origin) if origin.strip_prefix("http://") != Some(host) => Some("requests from other sites are refused"),
        _ => None,
    }
}

/// The answer 403.
pub fn refuse(why: &'static str) -> Response {
    protected((StatusCode::FORBIDDEN, format!("{why}\n")).into_response())
}

/// The answer 404.
pub fn not_found() -> Response {
    (StatusCode::NOT_FOUND, "there is no such file\n").into_response()
}

/// Adds headers that keep a browser from guessing types, from revealing the address to other sites, and from caching.
fn protected(mut response: Response) -> Response {
    let headers = [(X_CONTENT_TYPE_OPTIONS, "nosniff"), (REFERRER_POLICY, "no-referrer"), (CACHE_CONTROL, "no-store")];
    for (name, value) in headers {
        response.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    response
}

/// Answers with a file.
pub fn file(name: &str, bytes: &'static [u8]) -> Response {
    ([(CONTENT_TYPE, HeaderValue::from_static(content_type(name)))], Body::from(bytes)).into_response()
}

/// Answers with a file that is compressed with gzip, and sends it so to clients that take it.
pub fn compressed(headers: &HeaderMap, name: &str, bytes: &'static [u8]) -> Response {
    let accepted = headers.get(ACCEPT_ENCODING).and_then(|value| value.to_str().ok()).unwrap_or_default();
    let content_type = [(CONTENT_TYPE, content_type(name))];
    if accepted.split(',').any(|encoding| encoding.trim() == "gzip") {
        return (content_type, [(CONTENT_ENCODING, "gzip")], bytes).into_response();
    }
    (content_type, decompress(bytes)).into_response()
}

/// The type of a file by its name.
fn content_type(name: &str) -> &'static str {
    match name.rsplit('.').next() {
        Some("html") => "text/html; charset=utf-8",
        Some("css") => "text/css; charset=utf-8",
        Some("js") => "text/javascript; charset=utf-8",
        Some("wasm") => "application/wasm",
        Some("svg") => "image/svg+xml",
        Some("webmanifest") => "application/manifest+json",
        _ => "application/octet-stream",
    }
}
