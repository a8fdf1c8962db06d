//! Requests and their answers.

use agent_core::health::{RevertReason, Trial, Verdict};
use agent_core::package::{Envelope, Package};
use agent_core::service::{Problem, Upload, receive, split_number};
use agent_core::store::{Change, MappedFlash, Slot};
use agent_core::{StateVector, Tick};

use super::limits::take;
use super::load::Verified;
use super::{Due, Event, InUsePackage, Next, Node, Request, Response, respond, respond_to};
use crate::board::Board;

/// Samples in one answer; a laptop asks again for more.
const SAMPLES_AT_ONCE: u8 = 8;

/// The answer to a request, and what to do next.
type Answer<'a> = Result<(Response<'a, &'a [f32]>, Next), Problem>;

impl<
    F: MappedFlash,
    const N: usize,
    const FEATURES: usize,
    const NEIGHBOURS: usize,
    const SAMPLES: usize,
> Node<'_, F, N, FEATURES, NEIGHBOURS, SAMPLES>
{
    /// Carries out a request and answers it. Not inlined, so that its stack is not added to a
    /// turn's.
    #[inline(never)]
    pub(super) fn answer<B: Board>(&mut self, board: &mut B, bytes: &mut [u8]) -> Next {
        let (number, request) = split_number(bytes);
        let start = bytes.len() - request.len();
        self.number = number;
        let answer = bytes
            .get_mut(start..)
            .ok_or(Problem::Unknown)
            .and_then(|bytes| self.guard.open_request(bytes))
            .and_then(|(is_sealed, bytes)| {
                let request = receive::<Request<'_>>(bytes).ok_or(Problem::Unknown)?;
                self.guard.admit(is_sealed, request.is_free())?;
                match request {
                    Request::Samples { from, most } => {
                        let next = self.send_samples(board, from, most);
                        Ok((Response::SamplesEnd { next }, Next::Continue))
                    }
                    Request::StartAt { estimate } => self.start(board, &estimate),
                    request => {
                        self.leave_before(board, &request);
                        self.carry_out(board, &request)
                    }
                }
            });
        match answer {
            Ok((response, next)) => {
                // Before it, so that a laptop that has its answer has heard them.
                if matches!(response, Response::Status(_)) {
                    self.tell_faults(board);
                }
                respond_to(board, number, &response);
                next
            }
            Err(problem) => {
                respond_to(board, number, &Response::Refused(problem));
                Next::Continue
            }
        }
    }

    /// Says farewell if the request makes the chip stall.
    fn leave_before<B: Board>(&mut self, board: &mut B, request: &Request<'_>) {
        self.leave_for(
            board,
            match *request {
                Request::Chunk { offset, bytes } => Change::Bytes { offset, length: bytes.len() },
                Request::Stage if self.store.received().is_some() => Change::Stage,
                Request::Activate if self.store.staged().is_some() => Change::Records(1),
                Request::Confirm | Request::Revert if self.store.is_on_trial() => {
                    Change::Records(1)
                }
                Request::OperatorKeys { .. } => Change::Records(1),
                // Keys and epochs, or all that is to be forgotten.
                Request::Provision { .. } | Request::NetworkKeys { .. } | Request::FactoryReset => {
                    Change::Records(4)
                }
                _ => return,
            },
        );
    }

    fn carry_out<B: Board>(&mut self, board: &mut B, request: &Request<'_>) -> Answer<'static> {
        self.flash_used |= matches!(
            request,
            Request::Begin { .. }
                | Request::Chunk { .. }
                | Request::Stage
                | Request::Activate
                | Request::Confirm
                | Request::Revert
                | Request::Provision { .. }
                | Request::NetworkKeys { .. }
                | Request::OperatorKeys { .. }
        );
        let upload = |received| Ok((Response::Upload(Upload { received }), Next::Continue));
        match *request {
            Request::Query => Ok((Response::Status(self.status()), Next::Continue)),
            Request::Begin { length } => {
                self.store.begin(length)?;
                upload(0)
            }
            Request::Chunk { offset, bytes } => upload(self.take_chunk(board, offset, bytes)?),
            Request::Stage => self.stage(),
            Request::Activate => self.activate(),
            Request::Confirm => {
                self.store.confirm()?;
                self.end(Verdict::Passed);
                Ok((Response::Done, Next::Continue))
            }
            Request::Revert => self.revert(RevertReason::Operator),
            Request::Reset => Ok((Response::Done, Next::Reset)),
            Request::Subscribe(subscription) => {
                self.subscription = subscription;
                Ok((Response::Done, Next::Continue))
            }
            Request::Report => Ok((Response::Report(self.current_report()), Next::Continue)),
            Request::ForgetUnreadable => {
                self.store.forget_unreadable();
                Ok((Response::Done, Next::Continue))
            }
            Request::Session => Ok((Response::Session(self.guard.session()), Next::Continue)),
            Request::Provision { bytes } => {
                self.guard.provision(bytes, &mut self.store, &self.settings)?;
                self.prepare_guard();
                Ok((Response::Done, Next::Continue))
            }
            Request::NetworkKeys { bytes } => {
                self.guard.replace_network_keys(bytes, &mut self.store)?;
                self.prepare_guard();
                Ok((Response::Done, Next::Continue))
            }
            Request::OperatorKeys { bytes } => {
                let in_use = self.in_use.map(|package| package.slot);
                self.guard.replace_operators(bytes, in_use, &mut self.store, &self.settings)?;
                Ok((Response::Done, Next::Continue))
            }
            Request::FactoryReset => {
                let outcome = match self.guard.reset(&mut self.store) {
                    Ok(()) => Response::Done,
                    // Packages may be forgotten already, so it starts again in any case.
                    Err(problem @ Problem::Store(_)) => Response::Refused(problem),
                    Err(problem) => return Err(problem),
                };
                Ok((outcome, Next::Reset))
            }
            Request::Frame { .. } | Request::Tick { .. } => Err(Problem::NotInTheLoop),
            Request::Samples { .. }
            | Request::StartAt { .. }
            | Request::Numbered { .. }
            | Request::Sealed(_) => Err(Problem::Unknown),
        }
    }

    fn stage(&mut self) -> Answer<'static> {
        let package = self.stage_upload()?;
        Ok((Response::Staged { version: package.serial.version }, Next::Continue))
    }

    fn activate(&mut self) -> Answer<'static> {
        if self.store.staged().is_some() {
            take(&mut self.limits.activations, !self.memory.session.is_empty())?;
        }
        let package = self.activate_staged()?;
        let outputs = self.in_use.map(|package| package.outputs);
        self.in_use = self.store.in_use().and_then(|slot| package.in_slot(slot, &self.store));
        let limits = self.settings.trial.tighter(&package.trial);
        let before = self.performance.reference();
        let trial = Trial::new(&limits, before, package.step_size, self.next_tick);
        let is_comparable = outputs.is_none_or(|outputs| outputs == package.outputs);
        self.trial = Some(if is_comparable { trial } else { trial.left_to_operator() });
        self.health.take_tally();
        Ok((Response::InUse { version: Some(package.serial.version) }, Next::Switch))
    }

    /// Returns to what was in use before the package on trial, and keeps why.
    fn revert(&mut self, reason: RevertReason) -> Answer<'static> {
        let slot = self.store.revert(reason.code())?;
        self.end(Verdict::Failed(reason));
        self.in_use = slot.and_then(|slot| self.known_package(slot));
        let version = self.in_use.map(|package| package.serial.version);
        Ok((Response::InUse { version }, Next::Switch))
    }

    /// Returns the properties of a package that has been used. Not inlined, so that its
    /// stack frame does not add to that of a journal write.
    #[inline(never)]
    fn known_package(&self, slot: Slot) -> Option<InUsePackage> {
        let envelope = Envelope::open(self.store.bytes(slot)?).ok()?;
        let package = Package::without_origin(&envelope).ok()?;
        Verified::of(&package, &self.requirements()).in_slot(slot, &self.store)
    }

    /// Restarts from a different estimate and informs the neighbours.
    fn start<B: Board>(&mut self, board: &mut B, estimate: &[f32]) -> Answer<'static> {
        if self.memory.session.is_empty() {
            return Err(Problem::NoPackage);
        }
        let estimate: &[f32; N] = estimate.try_into().map_err(|_| Problem::Estimate)?;
        match self.start_at(board, StateVector::from(*estimate)) {
            Some(true) => Ok((Response::Done, Next::Continue)),
            Some(false) => Err(Problem::Estimate),
            None => Err(Problem::NoPackage),
        }
    }

    /// Sends at most `most` samples from the tick `from` on, and not so many that a step could be late;
    /// returns where to continue.
    fn send_samples<B: Board>(&self, board: &mut B, from: Tick, most: u8) -> Tick {
        let mut next = from;
        let samples = self.memory.samples.samples().filter(|sample| sample.tick >= from);
        for sample in samples.take(usize::from(most.min(SAMPLES_AT_ONCE))) {
            next = sample.tick.saturating_add(1);
            let response = Response::Sample {
                tick: sample.tick,
                estimate: sample.estimate.as_slice(),
                derivative: sample.derivative.as_slice(),
            };
            respond_to(board, self.number, &response);
        }
        next
    }

    /// Confirms the package on trial.
    pub(super) fn confirm<B: Board>(&mut self, board: &mut B, tick: Tick) {
        self.leave_for(board, Change::Records(1));
        // If the journal cannot be written now, a later attempt may succeed.
        if self.store.confirm().is_ok()
            && let Some(package) = &self.in_use
        {
            let event = Event::Confirmed { tick, version: package.serial.version };
            respond(board, &Response::Event(event));
        }
    }

    /// Keeps how the trial ended.
    fn end(&mut self, verdict: Verdict) {
        if let Some(trial) = &mut self.trial {
            trial.end(verdict);
        }
    }

    /// Ends the trial of a package that must not stay in use.
    #[inline(never)]
    pub(super) fn end_trial<B: Board>(&mut self, board: &mut B, tick: Tick, reason: RevertReason) {
        self.leave_for(board, Change::Records(1));
        let failed = self.in_use.map_or(0, |package| package.serial.version);
        // If the journal cannot be written now, a later attempt may succeed.
        if self.revert(reason).is_ok() {
            let event = Event::Reverted { tick, version: failed, reason };
            respond(board, &Response::Event(event));
            self.due = Due::Session;
        }
    }
}
