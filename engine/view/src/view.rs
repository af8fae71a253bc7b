//! The server of the page that shows a running engine.

use std::collections::HashMap;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use axum::Router;
use axum::extract::ws::{Message, WebSocket, WebSocketUpgrade};
use axum::extract::{Path, Query, Request, State};
use axum::http::header::CONTENT_TYPE;
use axum::http::{HeaderMap, StatusCode, Uri};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use endless_gym_page::ServerError;
use endless_gym_page::server::{self, Port};
use endless_gym_service::Namespace;
use serde::Deserialize;
use serde_json::json;
use tokio::time::timeout;

use crate::channel::{Channel, Connected};
use crate::engines;
use crate::watcher;

/// The page's own files. It shares others with the page that plays the environments.
const FILES: [(&str, &[u8]); 6] = [
    ("view.css", include_bytes!("../files/view.css")),
    ("view.js", include_bytes!("../files/view.js")),
    ("curves.js", include_bytes!("../files/curves.js")),
    ("frames.js", include_bytes!("../files/frames.js")),
    ("engines.js", include_bytes!("../files/engines.js")),
    ("numbers.js", include_bytes!("../files/numbers.js")),
];

const INDEX: &str = include_str!("../files/index.html");

/// Longest message that a browser may send, in bytes.
const MAX_REQUEST: usize = 16 * 1024;

/// How long to wait until the observers end.
const END_TIMEOUT: Duration = Duration::from_secs(5);

/// Maximum number of engines that are shown, each by a thread, or whose curves are kept.
const MAX_CHANNELS: usize = 32;

/// How long a browser may take to receive a message.
const SEND_TIMEOUT: Duration = Duration::from_secs(60);

/// Serves a page that shows the environments of running engines on 127.0.0.1.
///
/// A thread observes an engine as long as a browser shows it.
///
/// ```no_run
/// use std::sync::atomic::AtomicBool;
///
/// use endless_gym_service::Namespace;
/// use endless_gym_view::ViewServer;
///
/// let server = ViewServer::bind(0, Namespace::default(), Some("endless"))?;
/// println!("{}", server.url());
/// server.run(&AtomicBool::new(false))?;
/// # Ok::<(), endless_gym_page::ServerError>(())
/// ```
pub struct ViewServer {
    port: Port,
    shared: Arc<Shared>,
}

struct Shared {
    namespace: Namespace,
    /// The engine that is shown first; `None` for the list of engines.
    service: Option<String>,
    /// 128 random bits.
    token: String,
    channels: Mutex<HashMap<String, Arc<Channel>>>,
}

impl ViewServer {
    /// Binds the port; 0 for any free one. The page shows the engine `service`, which need not be running yet, or a
    /// list of the namespace's engines for `None`.
    ///
    /// # Errors
    ///
    /// [`ServerError::Port`] if the port is taken.
    pub fn bind(port: u16, namespace: Namespace, service: Option<&str>) -> Result<Self, ServerError> {
        let token = format!("{:032x}", rand::random::<u128>());
        let (service, channels) = (service.map(str::to_owned), Mutex::default());
        let shared = Arc::new(Shared { namespace, service, token, channels });
        Ok(ViewServer { port: Port::local(port)?, shared })
    }

    /// The address of the page, with the token.
    pub fn url(&self) -> String {
        format!("{}?token={}", self.port.url(), self.shared.token)
    }

    /// Serves until the flag is set.
    ///
    /// # Errors
    ///
    /// [`ServerError::Server`] if the operating system refuses threads or descriptors.
    pub fn run(self, stop: &AtomicBool) -> Result<(), ServerError> {
        let shared = self.shared;
        let router = Router::new()
            .route("/", get(index))
            .route("/{token}/engines", get(list))
            .route("/{token}/socket", get(socket))
            .route("/{token}/{file}", get(file))
            .fallback(|| async { server::not_found() })
            .layer(middleware::from_fn_with_state(Arc::clone(&shared), check_token))
            .with_state(Arc::clone(&shared));
        let served = self.port.serve(router, server::is_set(stop));
        shared.wait_for_observers();
        served
    }
}

impl Shared {
    /// Waits until no engine is observed, so that this process leaves nothing behind for others to remove.
    fn wait_for_observers(&self) {
        let channels = self.channels.lock().unwrap_or_else(PoisonError::into_inner);
        let begin = Instant::now();
        // An observing thread holds its channel until it ends.
        while channels.values().any(|channel| Arc::strong_count(channel) > 1) && begin.elapsed() < END_TIMEOUT {
            thread::sleep(Duration::from_millis(5));
        }
    }
}

#[derive(Deserialize)]
struct Token {
    token: Option<String>,
}

/// Every address contains the token: the page's in its query, all others as their first folder, so that the page's
/// files can refer to each other by name.
async fn check_token(State(shared): State<Arc<Shared>>, request: Request, next: Next) -> Response {
    let address = request.uri();
    let given = match address.path() {
        "/" => Query::<Token>::try_from_uri(address).ok().and_then(|query| query.0.token),
        path => path.split('/').nth(1).map(str::to_owned),
    };
    if given.is_some_and(|given| same(given.as_bytes(), shared.token.as_bytes())) {
        next.run(request).await
    } else {
        server::refuse("the address must have the token that `endless view` has printed")
    }
}

/// Compares in constant time.
fn same(given: &[u8], expected: &[u8]) -> bool {
    given.len() == expected.len() && given.iter().zip(expected).fold(0, |all, (a, b)| all | (a ^ b)) == 0
}

async fn index(State(shared): State<Arc<Shared>>) -> Response {
    let page = INDEX.replace("TOKEN", &shared.token);
    ([(CONTENT_TYPE, "text/html; charset=utf-8")], page).into_response()
}

async fn file(headers: HeaderMap, address: Uri) -> Response {
    let name = address.path().rsplit('/').next().unwrap_or_default();
    if let "style.css" | "icon.svg" | "dom.js" = name
        && let Some(bytes) = endless_gym_page::file(name)
    {
        return server::compressed(&headers, name, bytes);
    }
    let found = FILES.iter().find(|(other, _)| *other == name);
    found.map_or_else(server::not_found, |(name, bytes)| server::file(name, bytes))
}

/// The running engines, and the one to show first.
async fn list(State(shared): State<Arc<Shared>>) -> Response {
    let namespace = shared.namespace.clone();
    // It blocks, since it reads files.
    let engines = tokio::task::spawn_blocking(move || engines::list(&namespace)).await.unwrap_or_default();
    let answer = json!({"service": shared.service, "root": shared.namespace.root(), "engines": engines});
    ([(CONTENT_TYPE, "application/json")], answer.to_string()).into_response()
}

#[derive(Deserialize)]
struct Wanted {
    service: String,
}

async fn socket(
    State(shared): State<Arc<Shared>>,
    Path(_token): Path<String>,
    Query(wanted): Query<Wanted>,
    upgrade: WebSocketUpgrade,
) -> Response {
    let channel = {
        let mut channels = shared.channels.lock().unwrap_or_else(PoisonError::into_inner);
        if channels.len() >= MAX_CHANNELS && !channels.contains_key(&wanted.service) {
            channels.retain(|_, channel| Arc::strong_count(channel) > 1);
            if channels.len() >= MAX_CHANNELS {
                let why = "pages show too many engines: close some\n";
                return (StatusCode::SERVICE_UNAVAILABLE, why).into_response();
            }
        }
        let new = || Arc::new(Channel::new(&shared.namespace, &wanted.service, watcher::run));
        Arc::clone(channels.entry(wanted.service.clone()).or_insert_with(new))
    };
    let Some(connected) = channel.connect() else {
        return (StatusCode::SERVICE_UNAVAILABLE, "too many pages show this engine: close some\n").into_response();
    };
    upgrade
        .max_message_size(MAX_REQUEST)
        .max_frame_size(MAX_REQUEST)
        .on_upgrade(move |socket| show(socket, connected, channel))
}

/// Sends the newest message after the previous one was sent, and the points that the browser's curves lack.
async fn show(mut socket: WebSocket, mut connected: Connected, channel: Arc<Channel>) {
    // The run whose points the browser has, and how many.
    let mut known = (0, 0);
    loop {
        tokio::select! {
            changed = connected.messages.changed() => {
                let message = connected.messages.borrow_and_update().clone();
                if changed.is_err() || !send(&mut socket, Message::Binary(message)).await {
                    return;
                }
                if let Some(points) = new_points(&channel, &mut known)
                    && !send(&mut socket, Message::text(points)).await
                {
                    return;
                }
                connected.viewer.received();
            }
            received = socket.recv() => match received {
                Some(Ok(Message::Text(text))) => match serde_json::from_str(&text) {
                    Ok(selection) => connected.viewer.select(selection),
                    Err(error) => tracing::debug!(%error, "a browser has sent something else than a selection"),
                },
                Some(Ok(Message::Ping(_) | Message::Pong(_) | Message::Binary(_))) => {}
                None | Some(Ok(Message::Close(_)) | Err(_)) => return,
            },
        }
    }
}

/// Sends a message, and returns whether the browser has received it.
async fn send(socket: &mut WebSocket, message: Message) -> bool {
    matches!(timeout(SEND_TIMEOUT, socket.send(message)).await, Ok(Ok(())))
}

/// The points of the curves since the last call, as JSON.
fn new_points(channel: &Channel, (incarnation, known): &mut (u64, u64)) -> Option<String> {
    let history = channel.history();
    let is_new = *incarnation != history.incarnation;
    if is_new {
        (*incarnation, *known) = (history.incarnation, 0);
    }
    let (points, count) = history.since(*known);
    *known = count;
    (is_new || !points.is_empty()).then(|| json!({"anew": is_new, "points": points}).to_string())
}
