//! The file format of an exported agent: magic, version, header length, JSON header, float32 tensors; all
//! little-endian.

use std::collections::HashMap;

use serde::Deserialize;
use serde_json::{Map, Value as Json};
use thiserror::Error;

const MAGIC: &[u8] = b"ENDLAGNT";
const VERSION: u32 = 1;

/// Maximum number of weights; a header with more is invalid.
const MAX_NUMBERS: usize = 16 << 20;

/// A file that is not an agent, or one that cannot act.
#[derive(Debug, Error)]
pub enum AgentFileError {
    #[error("the file must be an exported agent, which starts with `{}`", String::from_utf8_lossy(MAGIC))]
    Magic,
    #[error("an exported agent must be of version {VERSION}, got {given}; export it again")]
    Version { given: u32 },
    #[error("the file of an agent must have {expected} bytes according to its header, got {given}")]
    Length { expected: usize, given: usize },
    #[error("the header of an agent cannot be read: {0}")]
    Header(serde_json::Error),
    #[error("the agent must have a tensor `{name}` of shape {expected}, got {given}")]
    Tensor { name: String, expected: String, given: String },
    #[error("the weights of an agent must be finite, got {given} in `{name}`")]
    NotFinite { name: String, given: f32 },
}

#[derive(Debug, Deserialize)]
pub struct Header {
    pub env: String,
    pub options: Map<String, Json>,
    pub branches: Vec<usize>,
    pub updates: u64,
    pub steps: u64,
    pub evaluation: Vec<Json>,
    tensors: Vec<Shape>,
}

#[derive(Debug, Deserialize)]
struct Shape {
    name: String,
    shape: Vec<usize>,
}

/// The tensors of a file by name.
pub struct Tensors(HashMap<String, (Vec<usize>, Vec<f32>)>);

impl Tensors {
    /// Reads a file.
    pub fn read(file: &[u8]) -> Result<(Header, Self), AgentFileError> {
        let rest = file.strip_prefix(MAGIC).ok_or(AgentFileError::Magic)?;
        let length = |expected| AgentFileError::Length { expected, given: file.len() };
        let number = |rest: &[u8]| -> Result<u32, AgentFileError> {
            let (bytes, _) = rest.split_first_chunk().ok_or_else(|| length(MAGIC.len() + 8))?;
            Ok(u32::from_le_bytes(*bytes))
        };
        let version = number(rest)?;
        if version != VERSION {
            return Err(AgentFileError::Version { given: version });
        }
        let header_bytes = number(&rest[4..])? as usize;
        let start = MAGIC.len() + 8;
        let (text, weights) =
            rest[8..].split_at_checked(header_bytes).ok_or_else(|| length(start.saturating_add(header_bytes)))?;
        let header: Header = serde_json::from_slice(text).map_err(AgentFileError::Header)?;
        let size = |shape: &Shape| shape.shape.iter().try_fold(1_usize, |size, side| size.checked_mul(*side));
        let numbers = header.tensors.iter().try_fold(0_usize, |sum, shape| sum.checked_add(size(shape)?));
        let numbers = numbers.filter(|numbers| *numbers <= MAX_NUMBERS).unwrap_or(MAX_NUMBERS);
        if weights.len() != 4 * numbers {
            return Err(length(start + text.len() + 4 * numbers));
        }
        let mut values =
            weights.chunks_exact(4).map(|bytes| f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]));
        let mut tensors = HashMap::new();
        for shape in &header.tensors {
            let tensor: Vec<f32> = values.by_ref().take(size(shape).unwrap_or(0)).collect();
            if let Some(given) = tensor.iter().find(|value| !value.is_finite()) {
                return Err(AgentFileError::NotFinite { name: shape.name.clone(), given: *given });
            }
            tensors.insert(shape.name.clone(), (shape.shape.clone(), tensor));
        }
        Ok((header, Tensors(tensors)))
    }

    /// Takes a tensor of the given shape, where `None` allows any size of 1 or more. Returns its last size and its
    /// values.
    pub fn take(&mut self, name: &str, shape: &[Option<usize>]) -> Result<(usize, Vec<f32>), AgentFileError> {
        let given = self.0.remove(name);
        let fits = |found: &[usize]| {
            found.len() == shape.len()
                && found.iter().zip(shape).all(|(size, expected)| *size > 0 && expected.is_none_or(|n| n == *size))
        };
        match given {
            Some((found, values)) if fits(&found) => Ok((found.last().copied().unwrap_or(1), values)),
            given => Err(AgentFileError::Tensor {
                name: name.to_owned(),
                expected: format!("{shape:?}").replace("Some(", "").replace(')', "").replace("None", "any"),
                given: given.map_or_else(|| "none".to_owned(), |(found, _)| format!("{found:?}")),
            }),
        }
    }
}
