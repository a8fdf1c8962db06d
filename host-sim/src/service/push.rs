//! A weight package into a node: begin, chunks, staging, activation.
//!
//! The bytes are sent as they are; whether they are a package is the node's to say. Whatever is lost
//! on the way is asked for again, and a transfer that was broken off goes on where the node says
//! that it is. Before it does, the last piece that the node has is sent once more: the node
//! notices if it had begun with another package, and then the transfer starts over.

use std::time::Duration;

use agent_core::service::{CHUNK_LENGTH_MAX, PackageStatus, Problem, Request, Status};
use agent_core::store::StoreError;
use agent_core::wire::crc::crc32;

use super::address::AddressError;
use super::hint::of_refusal;
use super::{Client, LineError, Message, RetryPolicy, ServiceError};
use crate::packages::PackageBytes;
use crate::stop::Stop;

/// Why a package is not in use.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PushError {
    /// The node cannot be talked to, or does not do what it is asked.
    #[error(transparent)]
    Service(ServiceError),
    /// The node cannot be reached.
    #[error(transparent)]
    Address(#[from] AddressError),
    /// Another push to the node is under way.
    #[error(
        "another push to this node is under way ({0}); wait until it has ended, and push again"
    )]
    Another(StoreError),
    /// The node's flash does not do what it should.
    #[error("the node's flash fails: {problem}; {hint}", problem = .0, hint = of_refusal(Problem::Store(*.0)))]
    Flash(StoreError),
    /// No node takes a file of this length.
    #[error("not a weight package: {found} bytes; give the path of one")]
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
            // A transfer of ours is sent from its first byte to its last, without a gap.
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
    /// Whether it makes sense to connect again and go on.
    #[must_use]
    pub fn is_broken_line(&self) -> bool {
        matches!(self, Self::Service(ServiceError::Line(LineError::Closed | LineError::Silent)))
    }
}

/// How a push goes on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Progress {
    /// It begins, or goes on from this byte.
    From(usize),
    /// The node has so many bytes.
    Received(usize),
    /// The node verifies it.
    Verifying,
}

/// The checksum by which a node names what it has in use.
#[must_use]
pub fn checksum(package: &[u8]) -> u32 {
    crc32(&[package])
}

/// How often a broken connection is made again, and how long is waited before.
const RECONNECTIONS: u32 = 10;
const RECONNECTION_PAUSE: Duration = Duration::from_millis(500);

/// As [`transfer`], over connections that may break: then `connect` makes another, and the transfer
/// goes on, unless `stop` is requested. Returns the connection, too.
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

/// Asks for the node's status.
///
/// # Errors
/// See [`ServiceError`].
pub fn status(client: &mut Client, retry_policy: RetryPolicy) -> Result<Status, ServiceError> {
    status_and(client, retry_policy, &mut |_| {})
}

/// Asks a node how it is; hands what it tells before its answer to `unasked`: what does not work on
/// its board, and what its sensor and its link have reported.
///
/// # Errors
/// See [`ServiceError`].
pub fn status_and(
    client: &mut Client,
    retry_policy: RetryPolicy,
    unasked: &mut dyn FnMut(&Message<'_>),
) -> Result<Status, ServiceError> {
    client.request(&Request::Query, retry_policy, unasked, "its status", |m| match m {
        Message::Status(status) => Some(*status),
        _ => None,
    })
}

/// Brings the package into the node, from the first byte or from where an earlier transfer ended,
/// and has it verified. Returns its version. What is in use stays in use.
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
            // It was another package, or none that could be gone on with.
            Err(ServiceError::Refused(problem)) if !is_flash(problem) => {}
            done => return Ok(done?),
        }
    }
    client.request(&Request::Begin { length }, retry_policy, &mut |_| {}, UPLOAD, uploaded)?;
    Ok(send_and_stage(client, package, 0, retry_policy, progress)?)
}

/// Whether sending everything again would not help, but wear the flash.
fn is_flash(problem: Problem) -> bool {
    let Problem::Store(error) = problem else { return false };
    matches!(PushError::from(ServiceError::Refused(Problem::Store(error))), PushError::Flash(_))
}

const UPLOAD: &str = "how much it has received";

fn uploaded(message: &Message<'_>) -> Option<u32> {
    match message {
        Message::Upload(upload) => Some(upload.received),
        _ => None,
    }
}

/// Sends what is missing when `received` bytes have been, and has it verified.
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
        // What an earlier chunk brought is no answer to this one.
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
    let expected = "whether it has verified the package";
    match client.request(&Request::Stage, retry_policy, &mut |_| {}, expected, staged) {
        // The answer to the first try may have been lost: then it has been staged, and which version
        // that is, is in the bytes that the node has verified.
        Err(ServiceError::Refused(Problem::Store(StoreError::NoUpload)))
            if status(client, retry_policy)?.staged =>
        {
            Ok(PackageBytes::new(package).map_or(0, |package| package.package().version))
        }
        done => done,
    }
}

/// Lets the node use what it has verified from its next step on, on trial. Returns the version.
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
    let expected = "which package is in use";
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

/// Ends the trial of what is in use: it stays.
///
/// # Errors
/// See [`ServiceError`].
pub fn confirm(client: &mut Client, retry_policy: RetryPolicy) -> Result<(), ServiceError> {
    match client.request(&Request::Confirm, retry_policy, &mut |_| {}, "that it is done", done) {
        // It has confirmed it itself, or the answer to the first try was lost.
        Err(ServiceError::Refused(Problem::Store(StoreError::NotOnTrial))) => Ok(()),
        done => done,
    }
}

/// Whether the answer is that it has been done.
#[must_use]
pub fn done(message: &Message<'_>) -> Option<()> {
    matches!(message, Message::Done).then_some(())
}

/// The package in use, if its bytes are these.
#[must_use]
pub fn in_use(status: &Status, package: &[u8]) -> Option<PackageStatus> {
    status.package.filter(|used| used.checksum == checksum(package))
}
