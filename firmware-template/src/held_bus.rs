//! Frees an I2C bus that a device holds.
//!
//! A device that was interrupted while it sent a 0, by a reset of the processor or by a disturbed
//! clock, keeps pulling the data line low until it has been clocked through the rest of its byte. No
//! master can send a start condition meanwhile. Nine clocks end any byte and its acknowledgement, and
//! a stop condition ends the transfer (NXP UM10204, 3.1.16).
//!
//! Cost: at most eleven periods of the bus. Invariant: with the data line high, nothing is sent but the
//! stop condition, which no device minds.

use embedded_hal::delay::DelayNs;
use embedded_hal::digital::{InputPin, OutputPin};
use embedded_hal::i2c::{Error as _, ErrorKind, ErrorType, I2c, Operation};

/// Half a clock period at 100 kHz, which every device supports. \[ns\]
const HALF_PERIOD: u32 = 5_000;

/// Clocks of a byte and its acknowledgement.
const CLOCKS: u32 = 9;

/// Frees the bus if a device holds it; returns whether its data line is high at the end. Both pins are
/// open-drain outputs, with the lines' pull-ups.
///
/// # Errors
/// A pin that cannot be read or set.
pub fn free_bus<C, D, E>(clock: &mut C, data: &mut D, delay: &mut impl DelayNs) -> Result<bool, E>
where
    C: OutputPin<Error = E>,
    D: OutputPin<Error = E> + InputPin,
{
    data.set_high()?;
    clock.set_high()?;
    delay.delay_ns(HALF_PERIOD);
    for _ in 0..CLOCKS {
        if data.is_high()? {
            break;
        }
        clock.set_low()?;
        delay.delay_ns(HALF_PERIOD);
        clock.set_high()?;
        delay.delay_ns(HALF_PERIOD);
    }
    // A stop condition: the data line rises while the clock is high.
    clock.set_low()?;
    data.set_low()?;
    delay.delay_ns(HALF_PERIOD);
    clock.set_high()?;
    delay.delay_ns(HALF_PERIOD);
    data.set_high()?;
    delay.delay_ns(HALF_PERIOD);
    data.is_high()
}

/// An I2C bus that is freed after every error that a held line can cause.
///
/// `free` gets the driver. It takes the pins from it, or around it, calls [`free_bus`], and sets the
/// driver up again.
#[derive(Debug)]
pub struct FreedBus<B, F> {
    bus: B,
    free: F,
}

impl<B, F: FnMut(&mut B)> FreedBus<B, F> {
    /// Creates a bus that `free` frees.
    pub const fn new(bus: B, free: F) -> Self {
        Self { bus, free }
    }
}

impl<B: ErrorType, F> ErrorType for FreedBus<B, F> {
    type Error = B::Error;
}

impl<B: I2c, F: FnMut(&mut B)> I2c for FreedBus<B, F> {
    fn transaction(
        &mut self,
        address: u8,
        operations: &mut [Operation<'_>],
    ) -> Result<(), B::Error> {
        let done = self.bus.transaction(address, operations);
        if let Err(error) = &done {
            match error.kind() {
                // The device is not there, or not ready: nothing holds the bus.
                ErrorKind::NoAcknowledge(_) | ErrorKind::Overrun => {}
                // What a driver calls a timeout is among the others.
                _ => (self.free)(&mut self.bus),
            }
        }
        done
    }
}

#[cfg(test)]
mod tests {
    extern crate std;

    use embedded_hal::i2c::NoAcknowledgeSource;
    use embedded_hal_mock::eh1::delay::NoopDelay;
    use embedded_hal_mock::eh1::digital::{
        Mock as Pin, State::High, State::Low, Transaction as Edge,
    };

    use super::*;

    /// Frees a bus whose data line goes high after `held` clocks; returns the result.
    fn freed(held: usize) -> bool {
        let mut clock = std::vec![Edge::set(High)];
        let mut data = std::vec![Edge::set(High)];
        for done in 0..9 {
            data.push(Edge::get(if done < held { Low } else { High }));
            if done >= held {
                break;
            }
            clock.extend([Edge::set(Low), Edge::set(High)]);
        }
        clock.extend([Edge::set(Low), Edge::set(High)]);
        let is_free = held <= 9;
        data.extend([Edge::set(Low), Edge::set(High)]);
        data.push(Edge::get(if is_free { High } else { Low }));
        let (mut clock, mut data) = (Pin::new(&clock), Pin::new(&data));
        let result = free_bus(&mut clock, &mut data, &mut NoopDelay::new()).unwrap();
        clock.done();
        data.done();
        result
    }

    #[test]
    fn a_held_bus_gets_the_clocks_that_it_needs_and_a_stop() {
        for held in 0..=9 {
            assert!(freed(held), "{held}");
        }
        // A short circuit.
        assert!(!freed(10));
    }

    /// A bus whose transfers all fail.
    struct Failing(ErrorKind);

    impl ErrorType for Failing {
        type Error = ErrorKind;
    }

    impl I2c for Failing {
        fn transaction(&mut self, _: u8, _: &mut [Operation<'_>]) -> Result<(), ErrorKind> {
            Err(self.0)
        }
    }

    #[test]
    fn only_errors_of_a_held_line_free_the_bus() {
        for (error, frees) in [
            (ErrorKind::NoAcknowledge(NoAcknowledgeSource::Address), 0),
            (ErrorKind::Overrun, 0),
            (ErrorKind::Bus, 1),
            (ErrorKind::ArbitrationLoss, 1),
            (ErrorKind::Other, 1),
        ] {
            let mut count = 0;
            let mut bus = FreedBus::new(Failing(error), |_: &mut Failing| count += 1);
            assert_eq!(bus.write(7, &[1]), Err(error));
            assert_eq!(count, frees, "{error:?}");
        }
    }
}
