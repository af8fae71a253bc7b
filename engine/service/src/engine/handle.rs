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
    stopper: EngineStopper,
    thread: Option<JoinHandle<Result<EngineSummary, ServiceError>>>,
}

/// Asks an engine to stop, for example when a signal comes.
#[derive(Clone, Debug)]
pub struct EngineStopper(Arc<AtomicBool>);

impl EngineStopper {
    /// As [`EngineHandle::stop`].
    pub fn stop(&self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

impl Engine {
    /// Serves requests in threads of this process until [`EngineHandle::stop`] is called.
    ///
    /// # Errors
    ///
    /// [`ServiceError::Pool`] if a thread cannot be started.
    pub fn spawn(mut self) -> Result<EngineHandle, ServiceError> {
        let stopper = EngineStopper(Arc::default());
        let stop = Arc::clone(&stopper.0);
        let thread = Builder::new().name("endless-engine".to_owned()).spawn(move || self.run(&stop));
        let thread = thread.map_err(|source| PoolError::Threads { count: 1, source })?;
        Ok(EngineHandle { stopper, thread: Some(thread) })
    }
}

impl EngineHandle {
    /// Asks the engine to stop, and returns at once. It ends within 0.2 s, or when the last checkpoint is saved.
    pub fn stop(&self) {
        self.stopper.stop();
    }

    /// Stops the engine from another thread while this one waits in [`join`](Self::join).
    pub fn stopper(&self) -> EngineStopper {
        self.stopper.clone()
    }

    /// Whether the engine has ended, because of [`stop`](Self::stop) or an error.
    pub fn is_finished(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// Waits until the engine has ended: after [`stop`](Self::stop), or by an error.
    ///
    /// # Errors
    ///
    /// [`ServiceError::RootRemoved`] within a second after the namespace's directory was removed, since no trainer can find the
    /// engine any more. [`ServiceError::Middleware`] or [`ServiceError::SharedMemoryTooSmall`] if the engine cannot continue.
    /// [`ServiceError::Panic`] if an environment panics; the trainer is told as well. [`ServiceError::Checkpoint`] if the last
    /// checkpoint cannot be saved; earlier failures are logged and tried again later. A trainer's faults are not errors: its
    /// requests are rejected.
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
