//! The numbers of the network keys in use, and their rotation.
//!
//! A rotation replaces a network key while the network runs. All nodes must have completed a stage
//! before the next one begins:
//!
//! | stage | keys | nodes |
//! | --- | --- | --- |
//! | before | a | send and accept a |
//! | 1 | a, b | send a, accept both |
//! | 2 | b, a | send b, accept both |
//! | 3 | b | send and accept b |

use std::io;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::KeyFolderError;
use crate::files::input::read_limited;
use crate::files::output::{FileKind, write_whole};

/// Size limit of the file. \[byte\]
const FILE_MAX: u64 = 64 << 10;

/// Numbers of the network keys in use, from 1 to 255: one, or two during a rotation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NetworkNumbers {
    sending: u8,
    other: Option<u8>,
}

/// Stage of a rotation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// All nodes use one key: before a rotation, and after its third stage.
    One,
    /// Nodes accept the new key, but still send with the old one: the first stage.
    NewAccepted,
    /// Nodes send with the new key, but still accept the old one: the second stage.
    NewSent,
}

/// The file's content.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Content {
    network_keys: Vec<u8>,
}

impl NetworkNumbers {
    /// The numbers in a new folder.
    pub const FIRST: Self = Self { sending: 1, other: None };

    /// The kind of the file.
    const KIND: FileKind = FileKind {
        name: "a list of network keys",
        recognises: |bytes| str::from_utf8(bytes).is_ok_and(|text| Self::parse(text).is_ok()),
    };

    fn parse(text: &str) -> Result<Self, String> {
        let content: Content =
            toml::from_str(text).map_err(|error| error.message().trim().to_owned())?;
        match *content.network_keys.as_slice() {
            [0] | [0, _] | [_, 0] => Err("network keys are numbered from 1".to_owned()),
            [sending] => Ok(Self { sending, other: None }),
            [first, second] if second == next(first) || first == next(second) => {
                Ok(Self { sending: first, other: Some(second) })
            }
            [first, second] => {
                Err(format!("network keys {first} and {second} are not consecutive"))
            }
            ref other => Err(format!("it lists {} network keys", other.len())),
        }
    }

    /// Reads the file `path`.
    pub(super) fn read(path: &Path) -> Result<Self, KeyFolderError> {
        let bytes = read_limited(path, FILE_MAX)
            .map_err(|error| KeyFolderError::Read { path: path.to_owned(), error })?;
        let wrong = |problem| KeyFolderError::Numbers { path: path.to_owned(), problem };
        let text = str::from_utf8(&bytes).map_err(|_| wrong("not valid UTF-8".to_owned()))?;
        Self::parse(text).map_err(wrong)
    }

    /// Writes the file `path`; the previous one stays if this fails.
    pub(super) fn write(self, path: &Path) -> Result<(), KeyFolderError> {
        let content = Content { network_keys: self.iter().collect() };
        write_whole(path, Self::KIND, |file| {
            let text = toml::to_string(&content).map_err(io::Error::other)?;
            file.write_all(text.as_bytes())
        })?;
        Ok(())
    }

    /// Returns the numbers, the one for sending first.
    pub fn iter(self) -> impl Iterator<Item = u8> {
        std::iter::once(self.sending).chain(self.other)
    }

    /// Returns the stage of the rotation.
    #[must_use]
    pub fn stage(self) -> Stage {
        match self.other {
            None => Stage::One,
            Some(other) if other == next(self.sending) => Stage::NewAccepted,
            Some(_) => Stage::NewSent,
        }
    }

    /// Returns the numbers of the next stage. The number after 255 is 1.
    #[must_use]
    pub fn advanced(self) -> Self {
        let Self { sending, other } = self;
        match (self.stage(), other) {
            (Stage::NewAccepted, Some(new)) => Self { sending: new, other: Some(sending) },
            (Stage::NewSent, _) => Self { sending, other: None },
            _ => Self { sending, other: Some(next(sending)) },
        }
    }
}

fn next(number: u8) -> u8 {
    number.checked_add(1).unwrap_or(1)
}
