//! Codes and file names of errors about nodes.

use std::path::PathBuf;

use crate::cosim::CosimError;
use crate::cosim::fault::Fault;
use crate::cosim::firmware::FirmwareError;
use crate::error::{ErrorCode, Reported};
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
            Self::Occupied { path, .. } | Self::Serve { path, .. } => Some(path.clone()),
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
            Address::Socket(path) | Address::Serial(path, _) => Some(path.clone()),
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
            Self::Exists { path } | Self::Other { path, .. } => Some(path.clone()),
        }
    }
}

#[cfg(test)]
mod tests {
    use agent_core::service::Problem;

    use super::*;
    use crate::files::output::OutputError;

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
