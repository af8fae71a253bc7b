//! Common parts of this crate's servers: a port on 127.0.0.1, the check of a request's origin, and files.

use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::extract::Request;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE, HOST, ORIGIN, REFERRER_POLICY, X_CONTENT_TYPE_OPTIONS};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};

use crate::error::ViewError;

/// How often a server checks its stop flag.
const STOP_INTERVAL: Duration = Duration::from_millis(20);

/// A port on 127.0.0.1.
#[derive(Debug)]
pub(crate) struct LocalPort {
    listener: TcpListener,
    address: SocketAddr,
}

impl LocalPort {
    /// Binds the port; 0 for any free one.
    pub fn bind(port: u16) -> Result<Self, ViewError> {
        let bound = TcpListener::bind((Ipv4Addr::LOCALHOST, port)).and_then(|listener| {
            listener.set_nonblocking(true)?;
            Ok(LocalPort { address: listener.local_addr()?, listener })
        });
        bound.map_err(|reason| ViewError::Port { port, reason })
    }

    /// `http://127.0.0.1:PORT/`.
    pub fn url(&self) -> String {
        format!("http://{}/", self.address)
    }

    /// Serves until the flag is set, and then closes open connections.
    pub fn serve(self, router: Router, stop: &AtomicBool) -> Result<(), ViewError> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        let runtime = runtime.map_err(|reason| ViewError::Server { reason })?;
        let hosts = [format!("127.0.0.1:{}", self.address.port()), format!("localhost:{}", self.address.port())];
        let router = router.layer(middleware::from_fn(move |request: Request, next: Next| {
            let refusal = refusal(request.headers(), &hosts);
            async move { if let Some(why) = refusal { refuse(why) } else { protected(next.run(request).await) } }
        }));
        let served = runtime.block_on(async {
            let listener = tokio::net::TcpListener::from_std(self.listener)?;
            tokio::select! {
                ended = axum::serve(listener, router) => ended,
                () = stopped(stop) => Ok(()),
            }
        });
        // Blocking tasks that still run have no visible effect.
        runtime.shutdown_background();
        served.map_err(|reason| ViewError::Server { reason })
    }
}

async fn stopped(stop: &AtomicBool) {
    while !stop.load(Ordering::Relaxed) {
        tokio::time::sleep(STOP_INTERVAL).await;
    }
}

/// Why a request is refused: it names another host (as in DNS rebinding), or another site's page sent it.
fn refusal(headers: &HeaderMap, hosts: &[String]) -> Option<&'static str> {
    let text = |name: HeaderName| headers.get(name).map(|value| value.to_str().unwrap_or_default());
    let host = text(HOST).unwrap_or_default();
    if !hosts.iter().any(|ours| ours == host) {
        return Some("the Host header must name this server");
    }
    match text(ORIGIN) {
        Some(origin) if origin.strip_prefix("http://") != Some(host) => Some("requests from other sites are refused"),
        _ => None,
    }
}

/// The answer 403.
pub(crate) fn refuse(why: &'static str) -> Response {
    protected((StatusCode::FORBIDDEN, format!("{why}\n")).into_response())
}

/// The answer 404.
pub(crate) fn not_found() -> Response {
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
pub(crate) fn file(name: &str, bytes: &'static [u8]) -> Response {
    ([(CONTENT_TYPE, HeaderValue::from_static(content_type(name)))], Body::from(bytes)).into_response()
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_for_other_hosts_or_from_other_sites_are_refused() {
        let hosts = ["127.0.0.1:80".to_owned(), "localhost:80".to_owned()];
        let refused = |host: Option<&'static str>, origin: Option<&'static str>| {
            let mut headers = HeaderMap::new();
            for (name, value) in [(HOST, host), (ORIGIN, origin)] {
                value.map(|value| headers.insert(name, HeaderValue::from_static(value)));
            }
            refusal(&headers, &hosts).is_some()
        };
        assert!(!refused(Some("127.0.0.1:80"), None));
        assert!(!refused(Some("localhost:80"), Some("http://localhost:80")));
        for (host, origin) in [
            (None, None),
            (Some("example.org"), None),
            (Some("127.0.0.1:81"), None),
            (Some("127.0.0.1:80"), Some("http://example.org")),
            (Some("127.0.0.1:80"), Some("http://127.0.0.1:81")),
            (Some("127.0.0.1:80"), Some("https://127.0.0.1:80")),
            (Some("127.0.0.1:80"), Some("null")),
        ] {
            assert!(refused(host, origin), "{host:?} {origin:?}");
        }
    }
}
