//! Codes and file names of the library's errors. No module depends on this one.

#[cfg(unix)]
mod nodes;

use std::path::{Path, PathBuf};

use crate::engine::RunError;
use crate::error::{ErrorCode, Reported};
use crate::figures::FigureError;
use crate::files::output::OutputError;
use crate::flash::FlashError;
use crate::image::ImageError;
use crate::keys::KeyFolderError;
use crate::learning::trained::TrainedError;
use crate::memory_map::MemoryMapError;
use crate::packages::{DraftError, PackageFileError, RecordingError};
use crate::page::TableError;
use crate::scenario::{ScenarioError, SimulationOnly};
use crate::signing::KeyFileError;
use crate::tensors::{TensorError, TensorProblem};

fn owned(path: &Path) -> Option<PathBuf> {
    Some(path.to_owned())
}

impl Reported for ScenarioError {
    fn code(&self) -> ErrorCode {
        ErrorCode::Scenario
    }

    fn file(&self) -> Option<PathBuf> {
        Some(PathBuf::from(&self.file))
    }

    fn line(&self) -> Option<u64> {
        self.line.map(|line| line as u64)
    }
}

impl Reported for SimulationOnly {
    fn code(&self) -> ErrorCode {
        ErrorCode::Scenario
    }
}

impl Reported for TableError {
    fn code(&self) -> ErrorCode {
        ErrorCode::Results
    }

    fn file(&self) -> Option<PathBuf> {
        match self {
            Self::Read { path, .. } | Self::Field { path, .. } | Self::Kind { path, .. } => {
                owned(path)
            }
        }
    }

    fn line(&self) -> Option<u64> {
        match self {
            Self::Field { line, .. } => Some(*line),
            Self::Read { .. } | Self::Kind { .. } => None,
        }
    }
}

impl Reported for MemoryMapError {
    fn code(&self) -> ErrorCode {
        ErrorCode::MemoryMap
    }

    fn file(&self) -> Option<PathBuf> {
        Some(PathBuf::from(&self.file))
    }

    fn line(&self) -> Option<u64> {
        self.line.map(|line| line as u64)
    }
}

impl Reported for RecordingError {
    fn code(&self) -> ErrorCode {
        ErrorCode::Samples
    }

    fn file(&self) -> Option<PathBuf> {
        owned(&self.path)
    }

    fn line(&self) -> Option<u64> {
        self.line
    }
}

impl Reported for PackageFileError {
    fn code(&self) -> ErrorCode {
        ErrorCode::Package
    }

    fn file(&self) -> Option<PathBuf> {
        match self {
            Self::Read { path, .. } | Self::TooLong { path } | Self::Package { path, .. } => {
                owned(path)
            }
        }
    }
}

impl Reported for DraftError {
    fn code(&self) -> ErrorCode {
        ErrorCode::Network
    }
}

impl Reported for TrainedError {
    fn code(&self) -> ErrorCode {
        match self {
            Self::Draft(error) | Self::Size { error, .. } => error.code(),
            _ => ErrorCode::Training,
        }
    }
}

impl Reported for KeyFileError {
    fn code(&self) -> ErrorCode {
        match self {
            Self::Random(_) => ErrorCode::Random,
            Self::Exists { .. } => ErrorCode::OutputRefused,
            Self::Write { .. } => ErrorCode::OutputFailed,
            Self::WritePublic(error) => error.code(),
            _ => ErrorCode::Key,
        }
    }

    fn file(&self) -> Option<PathBuf> {
        self.path().and_then(owned)
    }
}

impl Reported for KeyFolderError {
    fn code(&self) -> ErrorCode {
        match self {
            Self::Key(error) => error.code(),
            Self::Exists { .. } | Self::Leftover { .. } => ErrorCode::OutputRefused,
            Self::Create { .. } | Self::Rename { .. } => ErrorCode::OutputFailed,
            Self::Write(error) => error.code(),
            _ => ErrorCode::Key,
        }
    }

    fn file(&self) -> Option<PathBuf> {
        self.path().and_then(owned)
    }
}

impl Reported for TensorError {
    fn code(&self) -> ErrorCode {
        match &self.problem {
            TensorProblem::Write(_) => ErrorCode::OutputFailed,
            TensorProblem::Refused(error) => error.code(),
            _ => ErrorCode::Network,
        }
    }

    fn file(&self) -> Option<PathBuf> {
        owned(&self.path)
    }
}

impl Reported for ImageError {
    fn code(&self) -> ErrorCode {
        ErrorCode::Image
    }
}

impl Reported for FlashError {
    fn code(&self) -> ErrorCode {
        match self {
            Self::NotInstalled { .. } => ErrorCode::ProbeRs,
            Self::TemporaryFile { .. } => ErrorCode::OutputFailed,
            Self::Interrupted { .. } => ErrorCode::Interrupted,
            _ => ErrorCode::Flash,
        }
    }

    fn file(&self) -> Option<PathBuf> {
        match self {
            Self::NotInstalled { program: path }
            | Self::Start { program: path, .. }
            | Self::TemporaryFile { path, .. } => owned(path),
            _ => None,
        }
    }
}

impl Reported for OutputError {
    fn code(&self) -> ErrorCode {
        if self.is_refusal() { ErrorCode::OutputRefused } else { ErrorCode::OutputFailed }
    }

    fn file(&self) -> Option<PathBuf> {
        owned(self.path())
    }
}

impl Reported for FigureError {
    fn code(&self) -> ErrorCode {
        match self {
            Self::Write(error) => error.code(),
            _ => ErrorCode::Figure,
        }
    }

    fn file(&self) -> Option<PathBuf> {
        match self {
            Self::Write(error) => error.file(),
            Self::Render { path, .. } => owned(path),
        }
    }
}

impl Reported for RunError {
    fn code(&self) -> ErrorCode {
        match self {
            Self::Refused { .. }
            | Self::PackageNode { .. }
            | Self::PackageInputs { .. }
            | Self::PackageLayers { .. }
            | Self::PackageWithoutNetwork { .. } => ErrorCode::PackageRefused,
            Self::PlantDiverged { .. } => ErrorCode::Diverged,
            Self::Expression(_) => ErrorCode::Expression,
            Self::Training { .. } => ErrorCode::Training,
            Self::Interrupted => ErrorCode::Interrupted,
            _ => ErrorCode::Run,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn write_errors_and_refusals_have_different_codes_for_every_source() {
        let path = || PathBuf::from("file");
        let full = || std::io::Error::other("full");
        let write = || OutputError::Write { path: path(), error: full() };
        let other = || OutputError::OtherKind { path: path(), kind: "a package" };
        let tensors = |problem: TensorProblem| TensorError { path: path(), problem };
        let failed: [&dyn Reported; 5] = [
            &write(),
            &FigureError::Write(write()),
            &KeyFileError::WritePublic(write()),
            &tensors(TensorProblem::Write(full())),
            &FlashError::TemporaryFile { path: path(), error: full() },
        ];
        for error in failed {
            assert_eq!((error.code().as_str(), error.code().exit()), ("output-failed", 1));
            assert_eq!(error.file(), Some(path()));
        }
        let refused: [&dyn Reported; 2] = [&other(), &KeyFileError::WritePublic(other())];
        for error in refused {
            assert_eq!((error.code().as_str(), error.code().exit()), ("output-refused", 2));
        }
    }
}
