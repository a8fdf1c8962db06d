//! Sends a weight package to a node: begin, chunks, staging, activation.
//!
//! The bytes are sent unchanged, and the node decides whether they are a valid package. Lost
//! requests are repeated, and an interrupted transfer resumes at the position reported by the node.
//! Before resuming, the last chunk is sent again: if the node detects that the upload was of
//! another package, the transfer starts over.

use std::time::Duration;

use agent_core::service::{CHUNK_LENGTH_MAX, PackageStatus, Problem, Report, Request, Status};
use agent_core::store::StoreError;
use agent_core::wire::crc::crc32;

use super::address::AddressError;
use super::hint::of_refusal;
use super::{Client, LineError, Message, RetryPolicy, ServiceError};
use crate::packages::PackageBytes;
use crate::stop::Stop;

/// Why a push failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PushError {
    /// Communication failed, or the node refused a request.
    #[error(transparent)]
    Service(ServiceError),
    /// The node cannot be reached.
    #[error(transparent)]
    Address(#[from] AddressError),
    /// Another push to the node is in progress.
    #[error(
        "another push to this node is in progress ({0}); wait until it has finished, and push again"
    )]
    Another(StoreError),
    /// The node's flash failed.
    #[error("the node's flash failed: {problem}; {hint}", problem = .0, hint = of_refusal(Problem::Store(*.0)))]
    Flash(StoreError),
    /// A package cannot have this length.
    #[error("not a weight package: {found} bytes; give the path of a weight package")]
    Length {
        /// Its length.
        found: usize,
    },
}

impl From<ServiceError> for PushError {
    fn from(error: ServiceError) -> Self {
        let ServiceError::Refused(Problem::Store(problem)) = error else {
            return Self::Service(error);
        };
        match problem {
            // This client sends all bytes in order, so only another one can cause these.
            StoreError::NoUpload
            | StoreError::Gap { .. }
            | StoreError::PastEnd { .. }
            | StoreError::Conflict { .. }
            | StoreError::Incomplete { .. }
            | StoreError::NothingStaged => Self::Another(problem),
            StoreError::Flash(_)
            | StoreError::Verify { .. }
            | StoreError::Unreadable { .. }
            | StoreError::Damaged => Self::Flash(problem),
            _ => Self::Service(error),
        }
    }
}

impl PushError {
    /// Returns whether reconnecting and resuming may help.
    #[must_use]
    pub fn is_broken_line(&self) -> bool {
        matches!(self, Self::Service(ServiceError::Line(LineError::Closed | LineError::Silent)))
    }
}

/// Progress of a push.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Progress {
    /// The transfer starts or resumes at this byte.
    From(usize),
    /// The node has received this many bytes.
    Received(usize),
    /// The node is verifying the package.
    Verifying,
}

/// Returns the checksum by which a node identifies its package.
#[must_use]
pub fn checksum(package: &[u8]) -> u32 {
    crc32(&[package])
}

/// Number of reconnections, and the pause before each.
const RECONNECTIONS: u32 = 10;
const RECONNECTION_PAUSE: Duration = Duration::from_millis(500);

/// Like [`transfer`], but reconnects with `connect` after a broken connection and resumes, unless
/// `stop` is requested. Also returns the connection.
///
/// # Errors
/// See [`PushError`].
pub fn transfer_over(
    connect: &mut dyn FnMut() -> Result<Client, AddressError>,
    package: &[u8],
    retry_policy: RetryPolicy,
    progress: &mut dyn FnMut(Progress),
    stop: &Stop,
) -> Result<(Client, u32), PushError> {
    let mut client = connect()?;
    let mut left = RECONNECTIONS;
    loop {
        let broken = match transfer(&mut client, package, retry_policy, progress) {
            Err(error) if error.is_broken_line() && left > 0 => error,
            done => return done.map(|version| (client, version)),
        };
        client = loop {
            left -= 1;
            if stop.is_requested() {
                return Err(ServiceError::from(LineError::Interrupted).into());
            }
            std::thread::sleep(RECONNECTION_PAUSE);
            match connect() {
                Ok(client) => break client,
                Err(_) if left == 0 => return Err(broken),
                Err(_) => {}
            }
        };
    }
}

/// Requests the node's status.
///
/// # Errors
/// See [`ServiceError`].
pub fn status(client: &mut Client, retry_policy: RetryPolicy) -> Result<Status, ServiceError> {
    status_and(client, retry_policy, &mut |_| {})
}

/// Requests a node's status, and passes messages before the answer, such as faults of its board and
/// sensor and link errors, to `unsolicited`.
///
/// # Errors
/// See [`ServiceError`].
pub fn status_and(
    client: &mut Client,
    retry_policy: RetryPolicy,
    unsolicited: &mut dyn FnMut(&Message<'_>),
) -> Result<Status, ServiceError> {
    client.request(&Request::Query, retry_policy, unsolicited, "a status", |m| match m {
        Message::Status(status) => Some(*status),
        _ => None,
    })
}

/// Requests a node's report; `None` if its firmware does not know it.
///
/// # Errors
/// See [`ServiceError`].
pub fn report(
    client: &mut Client,
    retry_policy: RetryPolicy,
) -> Result<Option<Report>, ServiceError> {
    let report =
        client.request(&Request::Report, retry_policy, &mut |_| {}, "a report", |m| match m {
            Message::Report(report) => Some(*report),
            _ => None,
        });
    match report {
        Err(ServiceError::Refused(Problem::Unknown)) => Ok(None),
        report => report.map(Some),
    }
}

/// Transfers the package to the node, from the start or from where an earlier transfer ended, and
/// has it verified. Returns its version. The package in use does not change.
///
/// # Errors
/// See [`PushError`].
pub fn transfer(
    client: &mut Client,
    package: &[u8],
    retry_policy: RetryPolicy,
    progress: &mut dyn FnMut(Progress),
) -> Result<u32, PushError> {
    let length = u32::try_from(package.len()).ok().filter(|&length| length > 0);
    let length = length.ok_or(PushError::Length { found: package.len() })?;
    let before = status(client, retry_policy)?;
    let received = before.upload.map_or(0, |upload| upload.received as usize);
    if (1..=package.len()).contains(&received) {
        match send_and_stage(client, package, received, retry_policy, progress) {
            // The upload was of another package, or cannot be resumed.
            Err(ServiceError::Refused(problem)) if !is_flash(problem) => {}
            done => return Ok(done?),
        }
    }
    client.request(&Request::Begin { length }, retry_policy, &mut |_| {}, UPLOAD, uploaded)?;
    Ok(send_and_stage(client, package, 0, retry_policy, progress)?)
}

/// Returns whether the flash failed, in which case sending everything again would only wear it out.
fn is_flash(problem: Problem) -> bool {
    let Problem::Store(error) = problem else { return false };
    matches!(PushError::from(ServiceError::Refused(Problem::Store(error))), PushError::Flash(_))
}

const UPLOAD: &str = "the upload progress";

fn uploaded(message: &Message<'_>) -> Option<u32> {
    match message {
        Message::Upload(upload) => Some(upload.received),
        _ => None,
    }
}

/// Sends the bytes after `received`, and has the package verified.
fn send_and_stage(
    client: &mut Client,
    package: &[u8],
    received: usize,
    retry_policy: RetryPolicy,
    progress: &mut dyn FnMut(Progress),
) -> Result<u32, ServiceError> {
    progress(Progress::From(received));
    let mut offset = received.saturating_sub(CHUNK_LENGTH_MAX);
    while offset < package.len() {
        let end = package.len().min(offset + CHUNK_LENGTH_MAX);
        let chunk = Request::Chunk { offset: offset as u32, bytes: &package[offset..end] };
        // Ignore late answers to earlier chunks.
        let arrived = |m: &Message<'_>| uploaded(m).filter(|&received| received as usize >= end);
        client.request(&chunk, retry_policy, &mut |_| {}, UPLOAD, arrived)?;
        offset = end;
        progress(Progress::Received(end));
    }
    progress(Progress::Verifying);
    let staged = |m: &Message<'_>| match m {
        Message::Staged { version } => Some(*version),
        _ => None,
    };
    let expected = "the result of the verification";
    match client.request(&Request::Stage, retry_policy, &mut |_| {}, expected, staged) {
        // The answer to the first try may have been lost; then the package is staged, and its
        // version is known from the verified bytes.
        Err(ServiceError::Refused(Problem::Store(StoreError::NoUpload)))
            if status(client, retry_policy)?.staged =>
        {
            Ok(PackageBytes::new(package).map_or(0, |package| package.package().version))
        }
        done => done,
    }
}

/// Activates the verified package on trial, from the node's next step on. Returns its version.
///
/// # Errors
/// See [`PushError`].
pub fn activate(
    client: &mut Client,
    package: &[u8],
    retry_policy: RetryPolicy,
) -> Result<u32, PushError> {
    let in_use = |m: &Message<'_>| match m {
        Message::InUse { version } => *version,
        _ => None,
    };
    let expected = "the package in use";
    match client.request(&Request::Activate, retry_policy, &mut |_| {}, expected, in_use) {
        // The answer to the first try may have been lost.
        Err(error @ ServiceError::Refused(Problem::Store(StoreError::NothingStaged))) => {
            match status(client, retry_policy)?.package {
                Some(used) if used.checksum == checksum(package) => Ok(used.version),
                _ => Err(error.into()),
            }
        }
        done => Ok(done?),
    }
}

/// Confirms the package in use, which ends its trial.
///
/// # Errors
/// See [`ServiceError`].
pub fn confirm(client: &mut Client, retry_policy: RetryPolicy) -> Result<(), ServiceError> {
    match client.request(&Request::Confirm, retry_policy, &mut |_| {}, "a confirmation", done) {
        // The node confirmed it itself, or the answer to the first try was lost.
        Err(ServiceError::Refused(Problem::Store(StoreError::NotOnTrial))) => Ok(()),
        done => done,
    }
}

/// Recognises [`Message::Done`].
#[must_use]
pub fn done(message: &Message<'_>) -> Option<()> {
    matches!(message, Message::Done).then_some(())
}

/// Returns the status of the package in use, if it has these bytes.
#[must_use]
pub fn in_use(status: &Status, package: &[u8]) -> Option<PackageStatus> {
    status.package.filter(|used| used.checksum == checksum(package))
}
