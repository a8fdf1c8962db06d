//! A new pair of keys in two files.

use std::path::{Path, PathBuf};

use super::OperatorKey;
use crate::error::ErrorReport;
use crate::files::output::{FileKind, OutputFile};

/// A new pair of keys.
#[derive(Debug)]
pub struct KeyPair {
    /// The private key.
    pub key: OperatorKey,
    /// Its file.
    pub private: PathBuf,
    /// The file of the public key.
    pub public: PathBuf,
}

impl KeyPair {
    /// Generates a pair and writes it to the files `name` with the endings `.key` and `.pub`: both or neither.
    ///
    /// # Errors
    /// If one of them exists or cannot be written.
    pub fn write(name: &Path) -> Result<Self, ErrorReport> {
        let with_ending = |ending: &str| {
            let mut file = name.to_owned().into_os_string();
            file.push(ending);
            PathBuf::from(file)
        };
        let (private, public) = (with_ending(".key"), with_ending(".pub"));
        if public.symlink_metadata().is_ok() {
            let problem = format!("{}: already exists", public.display());
            let text = problem + "; choose another name, or move it away";
            return Err(ErrorReport::usage(text).about(&public));
        }
        drop(OutputFile::prepare(&public, FileKind::NEW).map_err(|error| ErrorReport::of(&error))?);
        let key = OperatorKey::generate().map_err(|error| ErrorReport::of(&error))?;
        key.write_new(&private).map_err(|error| ErrorReport::of(&error))?;
        if let Err(error) = key.write_public(&public) {
            // Best effort: the first error is reported.
            let _ = std::fs::remove_file(&private);
            return Err(ErrorReport::of(&error));
        }
        Ok(Self { key, private, public })
    }
}
