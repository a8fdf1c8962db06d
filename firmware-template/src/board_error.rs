//! What goes wrong with a sensor or a link, by kind.
//!
//! A driver's own error says as much as it likes; [`SensorError::kind`] and [`LinkError::kind`] reduce it
//! to what an operator can act on from afar, as `kind` does for the errors of embedded-hal.

use core::convert::Infallible;
use core::fmt::Debug;

use agent_core::wire::cobs::SerialError;
use embedded_hal::{i2c, spi};

/// Why there is no sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum SensorErrorKind {
    /// Nothing acknowledged: a sensor without power, at another address, or not connected.
    NoAnswer,
    /// The transfer failed: a bus that is stuck or disturbed, another master, an overrun.
    Bus,
    /// The sensor has no sample yet.
    NotReady,
    /// The sensor is saturated, or its value is not possible.
    OutOfRange,
    /// Any other reason.
    Other,
}

/// Why a frame is lost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum LinkErrorKind {
    /// The frame could not be handed over: no room in a queue, or no free channel.
    NotSent,
    /// A frame arrived damaged.
    Damaged,
    /// A frame arrived for which there is no room.
    Overflow,
    /// The receiver failed.
    Receiver,
}

/// An error of a [`Sensor`](crate::Sensor).
pub trait SensorError: Debug {
    /// Returns the kind that a node counts it as.
    fn kind(&self) -> SensorErrorKind;
}

/// An error of a [`Link`](crate::Link).
pub trait LinkError: Debug {
    /// Returns the kind as which a node counts it.
    fn kind(&self) -> LinkErrorKind;
}

impl SensorError for SensorErrorKind {
    fn kind(&self) -> SensorErrorKind {
        *self
    }
}

impl LinkError for LinkErrorKind {
    fn kind(&self) -> LinkErrorKind {
        *self
    }
}

impl SensorError for Infallible {
    fn kind(&self) -> SensorErrorKind {
        match *self {}
    }
}

impl LinkError for Infallible {
    fn kind(&self) -> LinkErrorKind {
        match *self {}
    }
}

impl From<i2c::ErrorKind> for SensorErrorKind {
    fn from(kind: i2c::ErrorKind) -> Self {
        match kind {
            i2c::ErrorKind::NoAcknowledge(_) => Self::NoAnswer,
            // HALs report as `Other` that a wait for the bus has ended, and the like.
            _ => Self::Bus,
        }
    }
}

impl From<spi::ErrorKind> for SensorErrorKind {
    /// A device on this bus acknowledges nothing, so all of them are the bus's.
    fn from(_: spi::ErrorKind) -> Self {
        Self::Bus
    }
}

impl From<SerialError> for LinkErrorKind {
    fn from(error: SerialError) -> Self {
        match error {
            SerialError::TooLong => Self::Overflow,
            _ => Self::Damaged,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinds_of_embedded_hal_are_those_that_an_operator_can_act_on() {
        use i2c::{ErrorKind, NoAcknowledgeSource as Source};
        for source in [Source::Address, Source::Data, Source::Unknown] {
            let kind = SensorErrorKind::from(ErrorKind::NoAcknowledge(source));
            assert_eq!(kind, SensorErrorKind::NoAnswer);
        }
        let bus =
            [ErrorKind::Bus, ErrorKind::ArbitrationLoss, ErrorKind::Overrun, ErrorKind::Other];
        assert_eq!(bus.map(SensorErrorKind::from), [SensorErrorKind::Bus; 4]);
        assert_eq!(SensorErrorKind::from(spi::ErrorKind::ModeFault), SensorErrorKind::Bus);
    }

    #[test]
    fn a_message_that_is_too_long_is_an_overflow_and_a_broken_one_is_damaged() {
        let errors = [SerialError::TooLong, SerialError::Incomplete, SerialError::Checksum];
        let kinds = [LinkErrorKind::Overflow, LinkErrorKind::Damaged, LinkErrorKind::Damaged];
        assert_eq!(errors.map(LinkErrorKind::from), kinds);
    }
}
