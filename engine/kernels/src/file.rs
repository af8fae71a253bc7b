//! Files of agents: the format safetensors with a header and a checksum. "Files of agents" in `docs/train/rust.md` describes them.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::fmt::Write as _;

use safetensors::tensor::{SafeTensorError, SafeTensors, TensorView};
use serde::Deserialize;
use thiserror::Error;

/// Version of the files that [`write()`] makes and [`read()`] accepts.
pub const VERSION: u32 = 2;
/// Entries of the metadata.
const HEADER: &str = "endless";
const CHECKSUM: &str = "crc32";
/// Longest description of the tensors in bytes, far more than a network needs. The format itself allows a million tensors, which take
/// seconds to read.
const MAX_DESCRIPTION: u64 = 4 << 20;

/// The agents whose files the page plays, and what a sentence calls each.
pub const PAGE_AGENTS: [(&str, &str); 6] = [
    ("gru", "A GRU"),
    ("mingru", "A minGRU"),
    ("gated-deltanet", "A Gated DeltaNet"),
    ("mamba2", "A Mamba-2"),
    ("retnet", "A RetNet"),
    ("none", "An agent without memory"),
];

/// Why a file cannot be read; the text says it of the file.
#[derive(Debug, Error)]
#[expect(missing_docs, reason = "the messages say what most fields are")]
pub enum FileError {
    /// The format is another, or a part is missing.
    #[error("is damaged: it must be in the format safetensors: {0}")]
    Format(#[from] SafeTensorError),
    /// There are more tensors than a network has.
    #[error(
        "is damaged, or has far more tensors than a network: their description has {given} bytes of at most {MAX_DESCRIPTION}"
    )]
    Tensors { given: u64 },
    /// The header is not JSON with a version.
    #[error("is damaged: its header cannot be read: {0}")]
    Header(#[from] serde_json::Error),
    /// Another version of this program wrote it.
    #[error("must be of version {VERSION}, got {given}")]
    Version { given: u32 },
    /// A byte has changed since the file was written.
    #[error("is damaged: its checksum differs")]
    Checksum,
}

/// The checked content of a file.
pub struct File<'a> {
    /// The tensors by name.
    pub tensors: SafeTensors<'a>,
    /// The header, JSON text; `None` in files of weights alone.
    pub header: Option<String>,
}

#[derive(Deserialize)]
struct Versioned {
    version: u32,
}

/// Reads a file. Weights of other programs have neither a header nor a checksum. Fails with [`FileError`] if the file
/// is damaged or of another version.
// Inline, so that the page's copy is compiled with the page's options: small instead of fast.
#[inline]
pub fn read(content: &[u8]) -> Result<File<'_>, FileError> {
    match content.first_chunk().map(|length| u64::from_le_bytes(*length)) {
        Some(given) if given > MAX_DESCRIPTION && given <= content.len() as u64 => {
            return Err(FileError::Tensors { given });
        }
        _ => {}
    }
    let tensors = SafeTensors::deserialize(content)?;
    let metadata = SafeTensors::read_metadata(content)?.1;
    let entry = |name| metadata.metadata().as_ref().and_then(|entries| entries.get(name)).cloned();
    let (header, expected) = (entry(HEADER), entry(CHECKSUM));
    if let Some(text) = &header {
        let given = serde_json::from_str::<Versioned>(text)?.version;
        if given != VERSION {
            return Err(FileError::Version { given });
        }
    }
    let sum = || checksum(header.as_deref().unwrap_or_default(), &tensors.tensors());
    if expected.map_or(header.is_some(), |expected| expected != sum()) {
        return Err(FileError::Checksum);
    }
    Ok(File { tensors, header })
}

/// Makes a file with a header, which has the entry `"version"` with [`VERSION`].
///
/// The tensors must have different names. Fails with [`SafeTensorError`] if a view's data do not fit its shape.
pub fn write(header: String, tensors: Vec<(String, TensorView<'_>)>) -> Result<Vec<u8>, SafeTensorError> {
    let sum = checksum(&header, &tensors);
    let metadata = [(HEADER.to_owned(), header), (CHECKSUM.to_owned(), sum)];
    safetensors::serialize(tensors, Some(metadata.into_iter().collect()))
}

#[inline]
fn checksum(header: &str, tensors: &[(String, TensorView<'_>)]) -> String {
    // Less code than sorting, 2 kB of the page.
    let mut names: BinaryHeap<_> = tensors.iter().enumerate().map(|(i, (name, _))| Reverse((name, i))).collect();
    let mut sum = crc32fast::Hasher::new();
    sum.update(header.as_bytes());
    while let Some(Reverse((name, i))) = names.pop() {
        let (mut text, view) = (name.clone(), &tensors[i].1);
        // Writing to a string does not fail.
        let _ = write!(text, " {:?} {:?}", view.dtype(), view.shape());
        sum.update(text.as_bytes());
        sum.update(view.data());
    }
    format!("{:08x}", sum.finalize())
}
