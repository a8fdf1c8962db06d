//! A client's session with a provisioned node.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use agent_core::service::{Problem, Request, Session, split_number, split_seal};
use agent_core::wire::cobs::SerialError;

use super::sealing::Sealing;
use super::{Client, Numbering, ServiceError, decode, name};
use crate::keys::PortKeys;
use crate::service::Message;

impl Client {
    /// Seals requests with these keys from now on, if the node is provisioned.
    pub fn set_keys(&mut self, keys: PortKeys) {
        self.sealing = Some(Sealing::new(keys));
    }

    /// Returns the keys, if there are any.
    #[must_use]
    pub fn keys(&self) -> Option<&PortKeys> {
        self.sealing.as_ref().map(Sealing::keys)
    }

    /// Returns whether requests to the node are sealed: there are keys, and it is provisioned.
    ///
    /// # Errors
    /// See [`ServiceError`]: the node may have to be asked for its session.
    pub fn seals(&mut self, timeout: Duration) -> Result<bool, ServiceError> {
        self.find_session(&Request::Confirm, timeout)?;
        Ok(self.sealing.as_ref().is_some_and(Sealing::is_provisioned))
    }

    /// Asks for the session again before the next sealed request.
    pub fn forget_session(&mut self) {
        if let Some(sealing) = &mut self.sealing {
            sealing.forget();
        }
    }

    /// Decrypts a request, without its number, that another client has sealed for this node. `None`
    /// if it is not sealed, or the node would not accept the seal, except for a counter that has been
    /// used.
    ///
    /// # Errors
    /// [`ServiceError::Line`]: the node may have to be asked for its session.
    pub fn open(
        &mut self,
        request: &[u8],
        timeout: Duration,
    ) -> Result<Option<Vec<u8>>, ServiceError> {
        let (Some(seal), sealed) = split_seal(request) else { return Ok(None) };
        let open = |client: &Self| client.sealing.as_ref()?.open(&seal, sealed.to_vec());
        if let Some(opened) = open(self) {
            return Ok(Some(opened));
        }
        if self.sealing.is_none() {
            return Ok(None);
        }
        // The session may be another one by now.
        match self.ask_session(timeout) {
            Err(error @ ServiceError::Line(_)) => Err(error),
            _ => Ok(open(self)),
        }
    }

    /// Asks the node for its session if this request needs it.
    pub(super) fn find_session(
        &mut self,
        request: &Request<'_>,
        timeout: Duration,
    ) -> Result<(), ServiceError> {
        match &self.sealing {
            Some(sealing) if sealing.needs_session() && Sealing::applies_to(request) => {
                self.ask_session(timeout)
            }
            _ => Ok(()),
        }
    }

    /// Asks the node for its session. Other messages stay to be read.
    fn ask_session(&mut self, timeout: Duration) -> Result<(), ServiceError> {
        let mut kept = VecDeque::new();
        let session = self.await_session(timeout, &mut kept);
        kept.append(&mut self.pending);
        self.pending = kept;
        let session = session?;
        match &mut self.sealing {
            Some(sealing) => sealing.begin(session.as_ref()),
            None => Ok(()),
        }
    }

    fn await_session(
        &mut self,
        timeout: Duration,
        kept: &mut VecDeque<Result<Vec<u8>, SerialError>>,
    ) -> Result<Option<Session>, ServiceError> {
        if self.numbering == Numbering::Unknown {
            // Firmware from before sessions.
            return Ok(None);
        }
        let number = self.next_number();
        self.queue(number, &Request::Session);
        self.flush(timeout)?;
        let deadline = Instant::now() + timeout;
        loop {
            let next = self.next_until(deadline)?;
            let Ok(bytes) = &next else { continue };
            let (found, message) = split_number(bytes);
            if found == number {
                self.numbering = Numbering::Understood;
                match decode(message)? {
                    Message::Session(session) => return Ok(session),
                    Message::Refused(Problem::Unknown) => return Ok(None),
                    Message::Refused(problem) => return Err(ServiceError::Refused(problem)),
                    message => {
                        let found = name(&message);
                        return Err(ServiceError::Unexpected { found, expected: "a session" });
                    }
                }
            }
            let refused = || matches!(decode(message), Ok(Message::Refused(Problem::Unknown)));
            if found.is_none() && self.numbering == Numbering::Untried && refused() {
                self.numbering = Numbering::Unknown;
                return Ok(None);
            }
            if found.is_none() {
                kept.push_back(next);
            }
        }
    }

    /// Notices that a session has ended: the node has restarted, or has refused a seal.
    pub(super) fn notice(&mut self, message: &[u8]) {
        let (_, message) = split_number(message);
        let ended = match message {
            [1, ..] => true,
            [6, ..] => {
                matches!(decode(message), Ok(Message::Refused(Problem::Seal | Problem::NotSealed)))
            }
            _ => false,
        };
        if ended {
            self.forget_session();
        }
    }
}
