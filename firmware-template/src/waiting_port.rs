//! Makes a blocking port from a non-blocking one, as a board in the loop needs for its service
//! port.
//!
//! In the loop everything depends on received messages, and the output of a turn must not be lost.
//! Reading therefore waits for the first byte and writing for space, both with [`Clock::rest`].
//! Waiting for the other end is not a failure, so [`Clock::done`] is called meanwhile: a board
//! feeds its watchdog there.

use embedded_io::{ErrorType, Read, ReadReady, Write};

use crate::Clock;

/// The port `P`, which waits by means of the clock `C`.
#[derive(Debug)]
pub struct WaitingPort<P, C> {
    port: P,
    clock: C,
}

impl<P, C: Clock> WaitingPort<P, C> {
    /// Creates a blocking port.
    pub const fn new(port: P, clock: C) -> Self {
        Self { port, clock }
    }

    fn wait(&mut self) {
        self.clock.elapsed();
        self.clock.done();
        self.clock.rest();
    }
}

impl<P: ErrorType, C> ErrorType for WaitingPort<P, C> {
    type Error = P::Error;
}

impl<P: Read + ReadReady, C: Clock> Read for WaitingPort<P, C> {
    /// Waits until a byte has arrived.
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize, P::Error> {
        while !self.port.read_ready()? {
            self.wait();
        }
        self.clock.done();
        self.port.read(buffer)
    }
}

impl<P: Write, C: Clock> Write for WaitingPort<P, C> {
    /// Waits until there is space.
    fn write(&mut self, bytes: &[u8]) -> Result<usize, P::Error> {
        loop {
            match self.port.write(bytes) {
                Ok(0) | Err(_) if !bytes.is_empty() => self.wait(),
                written => return written,
            }
        }
    }

    fn flush(&mut self) -> Result<(), P::Error> {
        self.port.flush()
    }
}

#[cfg(test)]
mod tests {
    extern crate std;

    use std::cell::RefCell;
    use std::vec::Vec;

    use heapless::spsc::Queue;

    use super::*;
    use crate::{QueuedEnd, queued_port};

    /// A clock whose `rest` does the interrupt's work: it takes bytes to send, and the tenth call
    /// delivers received bytes.
    struct Interrupt<'q> {
        end: &'q RefCell<QueuedEnd<'q>>,
        rests: u32,
        fed: u32,
        sent: Vec<u8>,
    }

    impl Clock for Interrupt<'_> {
        fn start(&mut self, _: f32) {}

        fn elapsed(&mut self) -> u32 {
            0
        }

        fn done(&mut self) {
            self.fed += 1;
        }

        fn rest(&mut self) {
            self.rests += 1;
            let mut end = self.end.borrow_mut();
            self.sent.extend(core::iter::from_fn(|| end.take()));
            if self.rests == 10 {
                end.put(7);
            }
        }
    }

    #[test]
    fn nothing_is_lost_and_the_watchdog_is_fed() {
        let mut queues = [const { Queue::<u8, 4>::new() }; 2];
        let [received, to_send] = &mut queues;
        let (port, end) = queued_port(received, to_send, || ());
        let end = RefCell::new(end);
        let clock = Interrupt { end: &end, rests: 0, fed: 0, sent: Vec::new() };
        let mut port = WaitingPort::new(port, clock);
        let bytes: Vec<u8> = (0..23).collect();
        port.write_all(&bytes).unwrap();
        let mut buffer = [0; 8];
        assert_eq!(port.read(&mut buffer), Ok(1));
        assert_eq!(buffer[0], 7);
        assert_eq!(port.clock.sent, bytes);
        assert_eq!((port.clock.rests, port.clock.fed), (10, 11));
    }
}
