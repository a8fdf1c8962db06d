//! The operator's key pairs in a key folder, and their rotation.
//!
//! A rotation replaces the key that signs packages. All nodes must have completed a stage before the next
//! one begins:
//!
//! | stage | `operator.pem` | `operator.next.pem` | signs | nodes accept |
//! | --- | --- | --- | --- | --- |
//! | before | a | | a | a |
//! | 1 | a | b | a | a, b |
//! | 2 | a | b | b | a, b |
//! | 3 | b | | b | b |
//!
//! Each key has its public key beside it. Stage 3 renames a to `operator.old.pem`. The file
//! `operator.toml` has the stage; it is missing before the first rotation.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use agent_core::package::signature::PublicKey;
use serde::{Deserialize, Serialize};

use super::{KeyFolderError, OPERATOR, PUBLIC};
use crate::files::input::read_limited;
use crate::files::output::{FileKind, write_whole};
use crate::signing::{OperatorKey, read_public_key};

const STAGE: &str = "operator.toml";
const NEXT: &str = "operator.next.pem";
const NEXT_PUBLIC: &str = "operator.next.pub.pem";
const OLD: &str = "operator.old.pem";
const OLD_PUBLIC: &str = "operator.old.pub.pem";

/// Size limit of the file with the stage. \[byte\]
const FILE_MAX: u64 = 64 << 10;

/// Stage that a rotation of the operator's keys has reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "u8", into = "u8")]
pub enum OperatorStage {
    /// Nodes also accept the next key, which does not sign yet: stage 1.
    NextAccepted,
    /// The next key signs, and nodes still accept both: stage 2.
    NextSigns,
    /// The next key has become the only one: stage 3.
    NextOnly,
}

/// The operator's key pairs in a folder.
#[derive(Clone, Debug)]
pub struct Operators {
    folder: PathBuf,
    stage: Option<OperatorStage>,
}

/// The content of the file with the stage.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Content {
    stage: OperatorStage,
}

impl TryFrom<u8> for OperatorStage {
    type Error = String;

    fn try_from(number: u8) -> Result<Self, String> {
        match number {
            1 => Ok(Self::NextAccepted),
            2 => Ok(Self::NextSigns),
            3 => Ok(Self::NextOnly),
            _ => Err(format!("there is no stage {number}")),
        }
    }
}

impl From<OperatorStage> for u8 {
    fn from(stage: OperatorStage) -> Self {
        match stage {
            OperatorStage::NextAccepted => 1,
            OperatorStage::NextSigns => 2,
            OperatorStage::NextOnly => 3,
        }
    }
}

impl Operators {
    /// The kind of the file with the stage.
    const KIND: FileKind = FileKind {
        name: "the stage of a rotation",
        recognises: |bytes| str::from_utf8(bytes).is_ok_and(|text| parse(text).is_ok()),
    };

    /// A folder without a rotation.
    pub(super) fn new(folder: &Path) -> Self {
        Self { folder: folder.to_owned(), stage: None }
    }

    /// Returns the files that a new folder must not have: they would belong to other keys.
    pub(super) fn files_of_rotation(folder: &Path) -> impl Iterator<Item = PathBuf> {
        [STAGE, NEXT, NEXT_PUBLIC, OLD, OLD_PUBLIC].into_iter().map(|name| folder.join(name))
    }

    /// Reads which keys the folder has, but not the keys.
    ///
    /// # Errors
    /// [`KeyFolderError::Stage`].
    pub fn read(folder: &Path) -> Result<Self, KeyFolderError> {
        let path = folder.join(STAGE);
        let wrong = |problem| KeyFolderError::Stage { path: path.clone(), problem };
        let stage = match read_limited(&path, FILE_MAX) {
            Ok(bytes) => {
                let text =
                    str::from_utf8(&bytes).map_err(|_| wrong("not valid UTF-8".to_owned()))?;
                Some(parse(text).map_err(wrong)?)
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => None,
            Err(error) => return Err(wrong(format!("cannot be read: {error}"))),
        };
        Ok(Self { folder: folder.to_owned(), stage })
    }

    /// Returns the stage of the last rotation, if there was one.
    #[must_use]
    pub fn stage(&self) -> Option<OperatorStage> {
        self.stage
    }

    /// Returns the file of the private key that signs packages.
    #[must_use]
    pub fn signing_file(&self) -> PathBuf {
        let [signing, _] = self.private_files();
        signing
    }

    /// Returns the files of the private key that signs packages, and of one that nodes may accept for
    /// their first keys: the firmware of a blank node knows only one.
    #[must_use]
    pub fn private_files(&self) -> [PathBuf; 2] {
        let (current, next) = (self.folder.join(OPERATOR), self.folder.join(NEXT));
        match self.stage {
            // The next one is missing while stage 3 is not complete.
            Some(OperatorStage::NextSigns) if next.exists() => [next, current],
            Some(OperatorStage::NextAccepted) => [current, next],
            _ => [current.clone(), current],
        }
    }

    /// Returns the public keys that nodes accept.
    ///
    /// # Errors
    /// If one cannot be read.
    pub fn valid_keys(&self) -> Result<Vec<PublicKey>, KeyFolderError> {
        let mut keys = vec![self.public_key(PUBLIC)?];
        if self.is_overlapping() {
            keys.push(self.public_key(NEXT_PUBLIC)?);
        }
        Ok(keys)
    }

    /// Returns what makes nodes accept these keys, for
    /// [`Request::OperatorKeys`](agent_core::service::Request::OperatorKeys); `None` before the first
    /// rotation, when they have nothing but the key of their firmware.
    ///
    /// # Errors
    /// If a public key cannot be read.
    pub fn for_nodes(&self) -> Result<Option<Vec<u8>>, KeyFolderError> {
        if self.stage.is_none() {
            return Ok(None);
        }
        let is_overlapping = self.is_overlapping();
        let key = self.public_key(if is_overlapping { NEXT_PUBLIC } else { PUBLIC })?;
        Ok(Some([&[is_overlapping.into()][..], key.as_bytes()].concat()))
    }

    /// Advances the rotation by one stage, which is returned; after the last one, another rotation
    /// begins.
    ///
    /// # Errors
    /// If a file cannot be written or renamed. The call can be repeated.
    pub fn advance(&mut self) -> Result<OperatorStage, KeyFolderError> {
        let stage = match self.stage {
            None | Some(OperatorStage::NextOnly) => {
                self.create_next()?;
                OperatorStage::NextAccepted
            }
            Some(OperatorStage::NextAccepted) => OperatorStage::NextSigns,
            Some(OperatorStage::NextSigns) => {
                self.replace(OPERATOR, NEXT, OLD)?;
                self.replace(PUBLIC, NEXT_PUBLIC, OLD_PUBLIC)?;
                OperatorStage::NextOnly
            }
        };
        let written = write_whole(&self.folder.join(STAGE), Self::KIND, |file| {
            let text = toml::to_string(&Content { stage }).map_err(io::Error::other)?;
            file.write_all(text.as_bytes())
        });
        if let Err(error) = written {
            if stage == OperatorStage::NextAccepted {
                self.remove_next();
            }
            return Err(error.into());
        }
        self.stage = Some(stage);
        Ok(stage)
    }

    fn is_overlapping(&self) -> bool {
        let stages = [OperatorStage::NextAccepted, OperatorStage::NextSigns];
        self.stage.is_some_and(|stage| stages.contains(&stage))
    }

    fn public_key(&self, name: &str) -> Result<PublicKey, KeyFolderError> {
        Ok(read_public_key(&self.folder.join(name))?)
    }

    fn create_next(&self) -> Result<(), KeyFolderError> {
        for name in [NEXT, NEXT_PUBLIC, OLD, OLD_PUBLIC] {
            let path = self.folder.join(name);
            if path.symlink_metadata().is_ok() {
                return Err(KeyFolderError::Leftover { path });
            }
        }
        let next = OperatorKey::generate()?;
        let written = next
            .write_new(&self.folder.join(NEXT))
            .and_then(|()| next.write_public(&self.folder.join(NEXT_PUBLIC)));
        Ok(written.inspect_err(|_| self.remove_next())?)
    }

    /// Best effort: the first error is reported.
    fn remove_next(&self) {
        for name in [NEXT, NEXT_PUBLIC] {
            let _ = fs::remove_file(self.folder.join(name));
        }
    }

    /// Renames `current` to `old` and `next` to `current`, where this has not been done yet.
    fn replace(&self, current: &str, next: &str, old: &str) -> Result<(), KeyFolderError> {
        let [current, next, old] = [current, next, old].map(|name| self.folder.join(name));
        let rename = |from: &Path, to: &Path| {
            fs::rename(from, to)
                .map_err(|error| KeyFolderError::Rename { path: from.to_owned(), error })
        };
        if !next.exists() && current.exists() {
            return Ok(());
        }
        if current.exists() {
            if old.symlink_metadata().is_ok() {
                return Err(KeyFolderError::Leftover { path: old });
            }
            rename(&current, &old)?;
        }
        rename(&next, &current)
    }
}

fn parse(text: &str) -> Result<OperatorStage, String> {
    let content: Result<Content, _> = toml::from_str(text);
    content.map(|content| content.stage).map_err(|error| error.message().trim().to_owned())
}
