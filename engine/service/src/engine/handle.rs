//! An engine in threads of this process.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{Builder, JoinHandle};

use endless_gym_core::pool::PoolError;

use crate::engine::serving::Engine;
use crate::engine::status_writer::EngineSummary;
use crate::error::ServiceError;

/// An engine that serves in threads of this process. Dropping it stops the engine and waits until it has ended.
#[derive(Debug)]
pub struct EngineHandle {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<Result<EngineSummary, ServiceError>>>,
}

impl Engine {
    /// Serves requests in threads of this process until [`EngineHandle::stop`] is called.
    ///
    /// # Errors
    ///
    /// [`ServiceError::Pool`] if a thread cannot be started.
    pub fn spawn(mut self) -> Result<EngineHandle, ServiceError> {
        let stop = Arc::new(AtomicBool::new(false));
        let flag = Arc::clone(&stop);
        let thread = Builder::new().name("endless-engine".to_owned()).spawn(move || self.run(&flag));
        let thread = thread.map_err(|source| PoolError::Threads { count: 1, source })?;
        Ok(EngineHandle { stop, thread: Some(thread) })
    }
}

impl EngineHandle {
    /// Asks the engine to stop, and returns at once. It ends within 0.2 s, or when the last checkpoint is saved.
    pub fn stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    /// Whether the engine has ended, because of [`stop`](Self::stop) or an error.
    pub fn is_finished(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// Waits until the engine has ended: after [`stop`](Self::stop), or by an error.
    ///
    /// # Errors
    ///
    /// Those of [`Engine::run`].
    ///
    /// # Panics
    ///
    /// If the engine's thread panicked, with the same panic.
    pub fn join(mut self) -> Result<EngineSummary, ServiceError> {
        let thread = self.thread.take().expect("only `join`, which takes the handle, and `drop` take the thread");
        thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    }
}

impl Drop for EngineHandle {
    fn drop(&mut self) {
        self.stop();
        // An error or a panic has nobody to go to.
        let _ = self.thread.take().map(JoinHandle::join);
    }
}
