//! Films of frames that Python draws.

use std::path::PathBuf;

use endless_gym_cli::film_file::{FilmFile, Shape};
use numpy::{PyReadonlyArray3, PyUntypedArrayMethods};
use pyo3::exceptions::{PyOSError, PyValueError};
use pyo3::prelude::*;

/// Writes frames, uint8 (height, width, 3), as a film with `fps` frames per second.
#[pyfunction]
pub fn write_film(py: Python<'_>, path: PathBuf, frames: &Bound<'_, PyAny>, fps: u16) -> PyResult<()> {
    let failed = |error: String| PyOSError::new_err(error);
    let mut film: Option<(FilmFile, Vec<usize>)> = None;
    for frame in frames.try_iter()? {
        let frame: PyReadonlyArray3<'_, u8> = frame?.extract()?;
        let shape = frame.shape().to_vec();
        if fps == 0 || shape[2] != 3 || shape.contains(&0) || film.as_ref().is_some_and(|(_, first)| *first != shape) {
            let message = "fps must be 1 or more, and all frames uint8 (height, width, 3) of one size";
            return Err(PyValueError::new_err(format!("{message}, got {fps} and {shape:?}")));
        }
        let pixels = frame.as_slice()?.as_chunks().0;
        film = py.detach(|| {
            let write = || {
                let (mut file, shape) = match film {
                    Some(started) => started,
                    None => (FilmFile::create(&path, Shape { size: (shape[1], shape[0]), scale: 1, fps })?, shape),
                };
                file.add(pixels, 1)?;
                Ok(Some((file, shape)))
            };
            write().map_err(|error: Box<dyn std::error::Error>| failed(error.to_string()))
        })?;
    }
    let (film, _) = film.ok_or_else(|| PyValueError::new_err("a film needs at least one frame"))?;
    py.detach(|| film.finish().map_err(|error| failed(error.to_string())))
}
