//! Logs of the native module through Python's `logging`, under the logger `endless_gym`.
//!
//! An event may come from a thread for which another thread waits while it holds the interpreter's lock. Events are therefore
//! buffered, and the next call that holds the lock passes them to Python.

use std::collections::VecDeque;
use std::fmt::{Debug, Write};
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::sync::{Mutex, Once, PoisonError};

use pyo3::prelude::*;
use tracing::field::{Field, Visit};
use tracing::level_filters::LevelFilter;
use tracing::subscriber::Interest;
use tracing::{Event, Level, Metadata, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::layer::{Context, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;

/// Levels of `logging`, and the corresponding levels of `tracing`.
const LEVELS: [(u8, Level); 4] = [(40, Level::ERROR), (30, Level::WARN), (20, Level::INFO), (10, Level::DEBUG)];

/// Maximum number of buffered events. Python fetches them often; newer ones beyond this number are dropped.
const CAPACITY: usize = 1000;

/// The level of Python's logger when it was last read. Events below it cost one comparison.
static LOWEST: AtomicU8 = AtomicU8::new(u8::MAX);

static WAITING: AtomicBool = AtomicBool::new(false);
static EVENTS: Mutex<VecDeque<(u8, String)>> = Mutex::new(VecDeque::new());

/// Adopts the level of Python's logger, and starts buffering events. Called when connecting.
pub fn start(py: Python<'_>) -> PyResult<()> {
    static START: Once = Once::new();
    // An error means that the process already has another subscriber.
    START.call_once(|| drop(tracing_subscriber::registry().with(Forward).try_init()));
    let level: u64 = logger(py)?.call_method0("getEffectiveLevel")?.extract()?;
    LOWEST.store(u8::try_from(level).unwrap_or(u8::MAX), Ordering::Relaxed);
    Ok(())
}

/// Passes the buffered events to Python.
pub fn flush(py: Python<'_>) -> PyResult<()> {
    if !WAITING.swap(false, Ordering::Relaxed) {
        return Ok(());
    }
    let events = std::mem::take(&mut *EVENTS.lock().unwrap_or_else(PoisonError::into_inner));
    let logger = logger(py)?;
    for (level, text) in events {
        logger.call_method1("log", (level, "%s", text))?;
    }
    Ok(())
}

fn logger(py: Python<'_>) -> PyResult<Bound<'_, PyAny>> {
    py.import("logging")?.call_method1("getLogger", ("endless_gym",))
}

/// Buffers events for Python.
struct Forward;

impl<S: Subscriber> Layer<S> for Forward {
    fn register_callsite(&self, _metadata: &'static Metadata<'static>) -> Interest {
        // The level of Python's logger may change.
        Interest::sometimes()
    }

    fn enabled(&self, metadata: &Metadata<'_>, _context: Context<'_, S>) -> bool {
        level(metadata) >= LOWEST.load(Ordering::Relaxed) && metadata.target().starts_with("endless_gym")
    }

    fn max_level_hint(&self) -> Option<LevelFilter> {
        Some(LevelFilter::DEBUG)
    }

    fn on_event(&self, event: &Event<'_>, _context: Context<'_, S>) {
        let mut text = Text::default();
        event.record(&mut text);
        let mut events = EVENTS.lock().unwrap_or_else(PoisonError::into_inner);
        if events.len() < CAPACITY {
            events.push_back((level(event.metadata()), text.message + &text.fields));
            WAITING.store(true, Ordering::Relaxed);
        }
    }
}

/// The level of `logging`; 0 for a level that it does not have.
fn level(metadata: &Metadata<'_>) -> u8 {
    LEVELS.iter().find(|(_, level)| level == metadata.level()).map_or(0, |(number, _)| *number)
}

/// The message of an event, and its fields as ` name=value`.
#[derive(Default)]
struct Text {
    message: String,
    fields: String,
}

impl Visit for Text {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        // Writing to a string does not fail.
        let _ = match field.name() {
            "message" => write!(self.message, "{value:?}"),
            name => write!(self.fields, " {name}={value:?}"),
        };
    }
}
