//! Recognises image files of this program, as opposed to firmware images and packages.

use agent_core::package::Envelope;
use ihex::{Reader, Record};

use super::uf2_format::{BLOCK, PAYLOAD};
use super::{ERASED, ImageFormat, PACKAGE_ALIGNMENT};
use crate::files::output::FileKind;

/// Upper limit for the length of a commit record. \[bytes\]
const RECORD_MAX: usize = 256;

impl ImageFormat {
    /// Returns the kind of its files: those that contain the flash image of a package and nothing
    /// else.
    #[must_use]
    pub fn file_kind(self) -> FileKind {
        match self {
            Self::Bin => {
                FileKind { name: "a flash image of a package (bin)", recognises: is_weights }
            }
            Self::Hex => FileKind {
                name: "a flash image of a package (Intel HEX)",
                recognises: |bytes| hex_data(bytes).is_some_and(|data| is_weights(&data)),
            },
            Self::Uf2(_) => FileKind {
                name: "a flash image of a package (UF2)",
                recognises: |bytes| uf2_data(bytes).is_some_and(|data| is_weights(&data)),
            },
        }
    }
}

/// Whether this is a package with few bytes around it that are not erased. A package file has
/// nothing after the package, and firmware has far more.
fn is_weights(data: &[u8]) -> bool {
    let starts = (0..data.len()).step_by(PACKAGE_ALIGNMENT);
    let mut packages =
        starts.filter_map(|start| Some((start, Envelope::length_in(&data[start..])?)));
    packages.next().is_some_and(|(start, length)| {
        let outside = data[..start].iter().chain(&data[start + length..]);
        let written = outside.filter(|&&byte| byte != ERASED).count();
        length < data.len() && (1..=RECORD_MAX).contains(&written)
    })
}

/// Returns the data of an Intel HEX file, record by record.
fn hex_data(bytes: &[u8]) -> Option<Vec<u8>> {
    let text = std::str::from_utf8(bytes).ok()?;
    let mut data = Vec::new();
    for record in Reader::new(text) {
        if let Record::Data { value, .. } = record.ok()? {
            data.extend(value);
        }
    }
    Some(data)
}

/// Returns the data of a UF2 file, block by block.
fn uf2_data(bytes: &[u8]) -> Option<Vec<u8>> {
    let (blocks, rest) = bytes.as_chunks::<BLOCK>();
    let whole = rest.is_empty() && blocks.iter().all(|block| block.starts_with(b"UF2\n"));
    whole.then(|| blocks.iter().flat_map(|block| &block[32..32 + PAYLOAD]).copied().collect())
}
