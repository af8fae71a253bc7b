//! The engine's errors as Python's exceptions.

use endless_gym::pool::{PoolError, SnapshotError};
use endless_gym::service::{Rejection, ServiceError};
use pyo3::create_exception;
use pyo3::exceptions::{PyBufferError, PyConnectionError, PyOSError, PyRuntimeError, PyTimeoutError, PyValueError};
use pyo3::prelude::*;

create_exception!(endless_gym, EngineLost, PyConnectionError, "The engine has ended, or was replaced by another one.");
create_exception!(
    endless_gym,
    TooManyBatchesHeld,
    PyBufferError,
    "All batches that the engine can lend are held by arrays of this process."
);

/// The exception for an error of a pool.
pub fn pool(error: PoolError) -> PyErr {
    let text = error.to_string();
    match error {
        PoolError::NotReset | PoolError::Threads { .. } | PoolError::BatchTooShort { .. } => {
            PyRuntimeError::new_err(text)
        }
        _ => PyValueError::new_err(text),
    }
}

/// The exception for a snapshot that cannot be taken or used.
pub fn snapshot(error: SnapshotError) -> PyErr {
    let text = error.to_string();
    match error {
        SnapshotError::NotReset => PyRuntimeError::new_err(text),
        _ => PyValueError::new_err(text),
    }
}

/// The exception for an error of the service.
pub fn service(error: ServiceError) -> PyErr {
    use ServiceError as E;
    if let E::Pool(error) = error {
        return pool(error);
    }
    let text = error.to_string();
    match error {
        E::EngineLost { .. } | E::EngineRestarted { .. } | E::SpecificationChanged { .. } => EngineLost::new_err(text),
        E::TooManyBatchesHeld { .. } => TooManyBatchesHeld::new_err(text),
        E::UnknownEngine { .. } | E::TrainerExists { .. } | E::TooManyObservers { .. } => {
            PyConnectionError::new_err(text)
        }
        E::Rejected { reason: Rejection::NotReset, .. } => PyRuntimeError::new_err(text),
        E::TimedOut { .. } => PyTimeoutError::new_err(text),
        E::InvalidName { .. }
        | E::InvalidTimeout { .. }
        | E::NoSuchGroup { .. }
        | E::Action(_)
        | E::ResetCount { .. }
        | E::OptionsTooLong { .. }
        | E::SnapshotTooLong { .. }
        | E::Rejected { .. } => PyValueError::new_err(text),
        E::Root { .. } => PyOSError::new_err(text),
        _ => PyRuntimeError::new_err(text),
    }
}
