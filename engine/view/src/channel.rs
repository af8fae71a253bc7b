//! One engine and the browsers that show it. A thread observes the engine as long as there are any.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;

use axum::body::Bytes;
use endless_gym_service::Namespace;
use tokio::sync::watch;

use crate::message::Selection;
use crate::statistics::History;

/// Maximum number of browsers that show one engine at a time.
const MAX_VIEWERS: usize = 16;

/// One engine, found by its name.
pub(crate) struct Channel {
    pub namespace: Namespace,
    pub service: String,
    /// Observes the engine until there are no viewers.
    observe: fn(&Channel),
    viewers: Mutex<Viewers>,
    history: Mutex<History>,
}

#[derive(Default)]
struct Viewers {
    shown: Vec<Arc<Viewer>>,
    is_observed: bool,
}

/// One browser: the newest message for it, which replaces the previous one.
pub(crate) struct Viewer {
    newest: watch::Sender<Bytes>,
    selection: Mutex<Selection>,
    /// Whether the browser has received the last message. Until then it gets no other, so that a slow one causes no
    /// copies.
    is_ready: AtomicBool,
    /// Whether there is news or another selection since the last message.
    is_changed: AtomicBool,
}

impl Viewer {
    /// Selects other environments.
    pub fn select(&self, selection: Selection) {
        *lock(&self.selection) = selection;
        self.is_changed.store(true, Ordering::Release);
    }

    /// The environments that it shows.
    pub fn selection(&self) -> Selection {
        lock(&self.selection).clone()
    }

    /// The last message was sent.
    pub fn received(&self) {
        self.is_ready.store(true, Ordering::Release);
    }

    /// Whether it has received the last message.
    pub fn is_ready(&self) -> bool {
        self.is_ready.load(Ordering::Acquire)
    }

    /// Whether it shows no environment, like a page in the background.
    pub fn is_hidden(&self) -> bool {
        lock(&self.selection).envs.is_empty()
    }

    /// Whether it waits for a message, with news (perhaps missed earlier) or for a new selection.
    pub fn wants(&self, is_news: bool) -> bool {
        if is_news {
            self.is_changed.store(true, Ordering::Release);
        }
        self.is_ready() && self.is_changed.load(Ordering::Acquire)
    }

    /// Gives it the newest message, made for its current selection.
    pub fn give(&self, message: impl FnOnce(&Selection) -> Vec<u8>) {
        self.is_ready.store(false, Ordering::Release);
        self.is_changed.store(false, Ordering::Release);
        let message = message(&self.selection());
        self.newest.send_replace(Bytes::from(message));
    }
}

/// A connected browser. Dropping this disconnects it.
pub(crate) struct Connected {
    channel: Arc<Channel>,
    pub viewer: Arc<Viewer>,
    pub messages: watch::Receiver<Bytes>,
}

impl Drop for Connected {
    fn drop(&mut self) {
        lock(&self.channel.viewers).shown.retain(|other| !Arc::ptr_eq(other, &self.viewer));
    }
}

impl Channel {
    pub fn new(namespace: &Namespace, service: &str, observe: fn(&Channel)) -> Self {
        Channel {
            namespace: namespace.clone(),
            service: service.to_owned(),
            observe,
            viewers: Mutex::default(),
            history: Mutex::default(),
        }
    }

    /// Adds a browser, and starts observing for the first one. `None` if there are too many, or if no thread can be
    /// started.
    pub fn connect(self: &Arc<Self>) -> Option<Connected> {
        let mut viewers = lock(&self.viewers);
        if viewers.shown.len() >= MAX_VIEWERS {
            return None;
        }
        let (newest, messages) = watch::channel(Bytes::new());
        let viewer = Arc::new(Viewer {
            newest,
            selection: Mutex::default(),
            is_ready: AtomicBool::new(true),
            is_changed: AtomicBool::new(true),
        });
        viewers.shown.push(Arc::clone(&viewer));
        if !viewers.is_observed {
            let channel = Arc::clone(self);
            let observer =
                thread::Builder::new().name("observer".to_owned()).spawn(move || (channel.observe)(&channel));
            if let Err(error) = observer {
                tracing::warn!(%error, "cannot observe");
                viewers.shown.pop();
                return None;
            }
            viewers.is_observed = true;
        }
        drop(viewers);
        Some(Connected { channel: Arc::clone(self), viewer, messages })
    }

    /// The browsers. If there are none, the observing thread must end, and the next browser starts another one.
    pub fn viewers(&self) -> Vec<Arc<Viewer>> {
        let mut viewers = lock(&self.viewers);
        viewers.is_observed = !viewers.shown.is_empty();
        viewers.shown.clone()
    }

    pub fn history(&self) -> MutexGuard<'_, History> {
        lock(&self.history)
    }
}

/// Ignores poisoning: a value that a panic left half changed is only shown.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
