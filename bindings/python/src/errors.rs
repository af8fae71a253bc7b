//! Errors of the engine as Python exceptions.

use endless_gym::pool::{PoolError, SnapshotError};
use endless_gym::service::{ErrorKind, Rejection, ServiceError};
use pyo3::exceptions::{PyConnectionError, PyOSError, PyRuntimeError, PyTimeoutError, PyValueError};
use pyo3::import_exception;
use pyo3::prelude::*;

// Python defines them, since each extension module with environments would define classes of its own.
import_exception!(endless_gym, EngineLost);
import_exception!(endless_gym, TooManyBatchesHeld);

/// The message for environments that have not been reset, in a pool or in an engine.
const NOT_RESET: &str = "the environments have no episodes yet; reset all of them first";

/// The exception for an error of a pool.
pub fn pool(error: PoolError) -> PyErr {
    let text = error.to_string();
    match error {
        PoolError::NotReset => PyRuntimeError::new_err(NOT_RESET),
        PoolError::Threads { .. } | PoolError::BatchTooShort { .. } | PoolError::Panic(_) => {
            PyRuntimeError::new_err(text)
        }
        _ => PyValueError::new_err(text),
    }
}

/// The exception for a snapshot that cannot be taken or used.
pub fn snapshot(error: SnapshotError) -> PyErr {
    let text = error.to_string();
    match error {
        SnapshotError::NotReset => PyRuntimeError::new_err(NOT_RESET),
        SnapshotError::Panic(_) => PyRuntimeError::new_err(text),
        _ => PyValueError::new_err(text),
    }
}

/// The exception for an error of the service.
pub fn service(error: ServiceError) -> PyErr {
    use ServiceError as E;
    let text = match &error {
        // The same messages as for a pool in this process.
        E::Rejected { reason: Rejection::NotReset, .. } => NOT_RESET.to_owned(),
        E::Rejected { reason: Rejection::Panic, .. } => error.to_string(),
        E::Rejected { message, .. } => message.clone(),
        // With the names of the Python methods.
        E::AnswerPending { group } => {
            format!("group {group} has a pending answer; call `recv` before the next request")
        }
        E::NothingSent { .. } | E::NothingPending => {
            let group = if let E::NothingSent { group } = error { group } else { 0 };
            format!("nothing was sent to group {group}; call `send`, `send_reset` or `reset` before `recv`")
        }
        error => error.to_string(),
    };
    match (error.kind(), error) {
        (_, E::Pool(error)) => pool(error),
        (_, E::TooManyBatchesHeld { .. }) => TooManyBatchesHeld::new_err(text),
        (_, E::NamespaceLocked { .. }) | (ErrorKind::TimedOut, _) => PyTimeoutError::new_err(text),
        (_, E::EngineExists { .. } | E::SharedMemoryTooSmall { .. }) => PyRuntimeError::new_err(text),
        (_, E::Rejected { reason: Rejection::NotReset | Rejection::Checkpoint | Rejection::Panic, .. }) => {
            PyRuntimeError::new_err(text)
        }
        (ErrorKind::Lost, _) | (_, E::SpecificationChanged { .. }) => EngineLost::new_err(text),
        (ErrorKind::Unavailable | ErrorKind::InUse, _) => PyConnectionError::new_err(text),
        (ErrorKind::Invalid | ErrorKind::Rejected, _) => PyValueError::new_err(text),
        (ErrorKind::Resources, _) => PyOSError::new_err(text),
        _ => PyRuntimeError::new_err(text),
    }
}

/// The error that every method returns after `close`.
pub fn closed() -> PyErr {
    PyRuntimeError::new_err("the environments are closed")
}
