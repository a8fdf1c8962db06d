//! A minimal model of a node's store, as far as its answers show it.

use agent_core::package::{Capacity, Requirements, Serial, StepRange, accept_header};
use agent_core::service::{Problem, Upload};
use agent_core::store::{HEADER_LENGTH, Slot, StoreError};
use agent_core::wire::crc::crc32;
use host_sim::service::Message;

use super::supply::Supply;
use crate::cosim::loop_node::region;

/// A package that a node has accepted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Package {
    pub(super) version: u32,
    pub(super) checksum: u32,
}

impl Package {
    pub(super) fn new(version: u32, bytes: &[u8]) -> Self {
        Self { version, checksum: crc32(&[bytes]) }
    }
}

/// An unfinished upload.
#[derive(Clone, Debug)]
pub(super) struct Unfinished {
    pub(super) length: u32,
    pub(super) bytes: Vec<u8>,
}

impl Unfinished {
    pub(super) fn received(&self) -> u32 {
        self.bytes.len() as u32
    }
}

/// What a node's store holds.
#[derive(Clone, Debug)]
pub(super) struct Store {
    pub(super) slot: Slot,
    pub(super) in_use: Package,
    /// The highest version that was ever activated.
    highest: u32,
    /// During a trial: what was in use before.
    pub(super) way_back: Option<Package>,
    pub(super) staged: Option<Package>,
    pub(super) upload: Option<Unfinished>,
    /// Number of complete uploads that have been checked.
    pub(super) judged: u64,
}

/// The expected answer, or a refusal by the package's checks.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Answer {
    Exactly(Message<'static>),
    PackageRefused,
}

type Outcome = Result<Message<'static>, StoreError>;

fn answer(outcome: Outcome) -> Answer {
    Answer::Exactly(outcome.unwrap_or_else(|error| Message::Refused(Problem::Store(error))))
}

impl Store {
    /// The state after leaving the factory.
    pub(super) fn new(in_use: Package) -> Self {
        let highest = in_use.version;
        Self {
            slot: Slot::A,
            in_use,
            highest,
            way_back: None,
            staged: None,
            upload: None,
            judged: 0,
        }
    }

    pub(super) fn is_on_trial(&self) -> bool {
        self.way_back.is_some()
    }

    pub(super) fn begin(&mut self, length: u32) -> Answer {
        let maximum = region().layout().slot_length;
        answer(if self.is_on_trial() {
            Err(StoreError::OnTrial)
        } else if length == 0 || length > maximum {
            Err(StoreError::Length { found: length, maximum })
        } else {
            self.upload = Some(Unfinished { length, bytes: Vec::new() });
            Ok(Message::Upload(Upload { received: 0 }))
        })
    }

    pub(super) fn chunk(&mut self, agent: usize, offset: u32, bytes: &[u8]) -> Answer {
        let is_complete =
            |upload: &Unfinished| upload.bytes.len() >= HEADER_LENGTH.min(upload.length as usize);
        let was_complete = self.upload.as_ref().is_some_and(is_complete);
        let outcome = self.chunk_outcome(offset, bytes);
        if let Some(upload) = self.upload.as_ref().filter(|upload| is_complete(upload))
            && outcome.is_ok()
            && !was_complete
        {
            // Before anything is erased.
            let header = &upload.bytes[..HEADER_LENGTH.min(upload.length as usize)];
            if accept_header::<3>(header, &self.requirements(agent)).is_err() {
                self.upload = None;
                return Answer::PackageRefused;
            }
            self.staged = None;
        }
        answer(outcome)
    }

    /// What the firmware requires of a package for `agent`, counted from 0.
    fn requirements(&self, agent: usize) -> Requirements<'static> {
        Requirements {
            public_keys: &[],
            agent: Some(agent as u32 + 1),
            highest: Some(Serial { epoch: 0, version: self.highest }),
            step_range: StepRange::DEFAULT,
            capacity: Capacity {
                features: 8,
                neighbours: 4,
                gain_entries: usize::MAX,
                known_inputs: 0,
            },
        }
    }

    fn chunk_outcome(&mut self, offset: u32, bytes: &[u8]) -> Outcome {
        let upload = self.upload.as_mut().ok_or(StoreError::NoUpload)?;
        let received = upload.received();
        if offset > received {
            return Err(StoreError::Gap { received });
        }
        if offset as usize + bytes.len() > upload.length as usize {
            return Err(StoreError::PastEnd { length: upload.length });
        }
        let known = &upload.bytes[offset as usize..];
        let repeated = known.len().min(bytes.len());
        if known[..repeated] != bytes[..repeated] {
            return Err(StoreError::Conflict { offset });
        }
        upload.bytes.extend_from_slice(&bytes[repeated..]);
        Ok(Message::Upload(Upload { received: upload.received() }))
    }

    /// Accepts only bytes that were made for this agent, above every version that was activated.
    pub(super) fn stage(&mut self, agent: usize, supply: &Supply) -> Answer {
        let Some(upload) = &self.upload else { return answer(Err(StoreError::NoUpload)) };
        let (received, length) = (upload.received(), upload.length);
        if received < length {
            return answer(Err(StoreError::Incomplete { received, length }));
        }
        self.judged += 1;
        match supply.version_of(agent, &upload.bytes) {
            Some(version) if version > self.highest => {
                self.staged = Some(Package::new(version, &upload.bytes));
                self.upload = None;
                Answer::Exactly(Message::Staged { version })
            }
            _ => Answer::PackageRefused,
        }
    }

    pub(super) fn activate(&mut self) -> Answer {
        answer(self.staged.take().ok_or(StoreError::NothingStaged).map(|staged| {
            let version = Some(staged.version);
            self.highest = self.highest.max(staged.version);
            self.way_back = Some(std::mem::replace(&mut self.in_use, staged));
            self.slot = self.slot.other();
            self.upload = None;
            Message::InUse { version }
        }))
    }

    pub(super) fn confirm(&mut self) -> Answer {
        answer(self.way_back.take().ok_or(StoreError::NotOnTrial).map(|_| Message::Done))
    }

    pub(super) fn revert(&mut self) -> Answer {
        answer(self.way_back.take().ok_or(StoreError::NotOnTrial).map(|before| {
            let version = Some(before.version);
            self.in_use = before;
            self.slot = self.slot.other();
            Message::InUse { version }
        }))
    }

    /// The state after a reset: uploads are dropped and trials have failed.
    pub(super) fn reboot(&mut self) {
        self.upload = None;
        if self.is_on_trial() {
            self.revert();
        }
    }
}
