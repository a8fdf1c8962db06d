//! Codes and file names of the library's errors. No module depends on this one.

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
            Self::Read { path, .. } | Self::Field { path, .. } | Self::Header { path, .. } => {
                owned(path)
            }
        }
    }

    fn line(&self) -> Option<u64> {
        match self {
            Self::Field { line, .. } => Some(*line),
            Self::Read { .. } | Self::Header { .. } => None,
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

#[cfg(unix)]
mod nodes {
    use super::*;
    use crate::cosim::CosimError;
    use crate::cosim::fault::Fault;
    use crate::cosim::firmware::FirmwareError;
    use crate::service::address::AddressError;
    use crate::service::push::PushError;
    use crate::service::record_file::RecordError;
    use crate::service::{Address, LineError, ServiceError};

    impl Reported for CosimError {
        fn code(&self) -> ErrorCode {
            match self {
                Self::NoNetwork { .. }
                | Self::Health { .. }
                | Self::Trigger(_)
                | Self::KeysOverLinks { .. }
                | Self::Life { .. } => ErrorCode::Scenario,
                Self::Interrupted => ErrorCode::Interrupted,
                Self::Run(error) => error.code(),
                Self::Node(error) => match error.fault {
                    Fault::Interrupted => ErrorCode::Interrupted,
                    _ => ErrorCode::Node,
                },
                Self::Occupied { .. } => ErrorCode::OutputRefused,
                Self::Output(error) => error.code(),
                Self::Serve { .. } => ErrorCode::OutputFailed,
            }
        }

        fn file(&self) -> Option<PathBuf> {
            match self {
                Self::Occupied { path, .. } | Self::Serve { path, .. } => owned(path),
                Self::Output(error) => error.file(),
                Self::Run(error) => error.file(),
                _ => None,
            }
        }
    }

    impl Reported for FirmwareError {
        fn code(&self) -> ErrorCode {
            match self {
                Self::NotFound(_) => ErrorCode::Usage,
                Self::Interrupted => ErrorCode::Interrupted,
                Self::Build(_) => ErrorCode::Firmware,
            }
        }
    }

    impl Reported for AddressError {
        fn code(&self) -> ErrorCode {
            ErrorCode::Unreachable
        }

        fn file(&self) -> Option<PathBuf> {
            match &self.address {
                Address::Socket(path) | Address::Serial(path, _) => owned(path),
            }
        }
    }

    impl Reported for ServiceError {
        fn code(&self) -> ErrorCode {
            match self {
                Self::Refused(_) | Self::NotProvisioned => ErrorCode::NodeRefused,
                Self::Proof { .. } => ErrorCode::Key,
                Self::NoEpoch | Self::CounterUsedUp => ErrorCode::Node,
                Self::Random(_) => ErrorCode::Random,
                Self::Line(LineError::Interrupted) => ErrorCode::Interrupted,
                _ => ErrorCode::Unreachable,
            }
        }
    }

    impl Reported for PushError {
        fn code(&self) -> ErrorCode {
            match self {
                Self::Address(error) => error.code(),
                Self::Service(error) => error.code(),
                Self::Another(_) => ErrorCode::AnotherPush,
                Self::Flash(_) => ErrorCode::Node,
                _ => ErrorCode::Package,
            }
        }

        fn file(&self) -> Option<PathBuf> {
            match self {
                Self::Address(error) => error.file(),
                _ => None,
            }
        }
    }

    impl Reported for RecordError {
        fn code(&self) -> ErrorCode {
            match self {
                Self::Output(error) => error.code(),
                Self::Exists { .. } | Self::Other { .. } => ErrorCode::OutputRefused,
            }
        }

        fn file(&self) -> Option<PathBuf> {
            match self {
                Self::Output(error) => error.file(),
                Self::Exists { path } | Self::Other { path, .. } => owned(path),
            }
        }
    }

    #[cfg(test)]
    mod tests {
        use agent_core::service::Problem;

        use super::*;

        #[test]
        fn a_refusal_by_a_node_is_reported_as_refused() {
            let code = |error: ServiceError| {
                let code = error.code();
                (code.as_str(), code.exit())
            };
            assert_eq!(code(ServiceError::Refused(Problem::NoPackage)), ("node-refused", 2));
            assert_eq!(code(LineError::Closed.into()), ("node-unreachable", 1));
        }

        #[test]
        fn cosim_errors_about_a_file_name_the_file() {
            let path = || PathBuf::from("file");
            let output = OutputError::Write { path: path(), error: std::io::Error::other("full") };
            for (error, code) in [
                (CosimError::Output(output), "output-failed"),
                (CosimError::Occupied { path: path(), what: "" }, "output-refused"),
            ] {
                assert_eq!((error.code().as_str(), error.file()), (code, Some(path())));
            }
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
