//! A serial port driven by its interrupt.
//!
//! ```text
//!           interrupt                             node
//! receiver ----------> QueuedEnd --[ queue ]--> QueuedPort ----> SerialLink, service port
//! sender   <----------           <-[ queue ]--            <----
//! ```
//!
//! Bytes received during a step wait in one queue and bytes to send in the other, so that neither
//! direction delays a step. If a queue is full, bytes are lost: messages have a checksum, so a
//! damaged message is refused as a whole. A queue of length `C` holds `C - 1` bytes; between two
//! steps up to `baud rate / 10 * period` bytes can arrive.
//!
//! Memory: 24 bytes, plus the queues, which the board provides.

use embedded_io::{Error, ErrorKind, ErrorType, Read, ReadReady, Write};
use heapless::spsc::{Consumer, Producer, Queue};

/// The node's end.
pub struct QueuedPort<'queue> {
    received: Consumer<'queue, u8>,
    to_send: Producer<'queue, u8>,
    wake: fn(),
}

/// The interrupt's end.
pub struct QueuedEnd<'queue> {
    received: Producer<'queue, u8>,
    to_send: Consumer<'queue, u8>,
}

/// Creates both ends, with one queue per direction. `wake` is called when there is something to
/// send, typically to pend the interrupt.
pub fn queued_port<'queue, const RECEIVED: usize, const TO_SEND: usize>(
    received: &'queue mut Queue<u8, RECEIVED>,
    to_send: &'queue mut Queue<u8, TO_SEND>,
    wake: fn(),
) -> (QueuedPort<'queue>, QueuedEnd<'queue>) {
    let (received_in, received) = received.split();
    let (to_send, to_send_out) = to_send.split();
    let end = QueuedEnd { received: received_in, to_send: to_send_out };
    (QueuedPort { received, to_send, wake }, end)
}

impl QueuedEnd<'_> {
    /// Queues a received byte; it is lost if the queue is full.
    pub fn put(&mut self, byte: u8) {
        let _ = self.received.enqueue(byte);
    }

    /// Returns whether there is no byte to send.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        !self.to_send.ready()
    }

    /// Returns the next byte to send.
    pub fn take(&mut self) -> Option<u8> {
        self.to_send.dequeue()
    }
}

/// The queue of bytes to send is full.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Full;

impl core::fmt::Display for Full {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("the send queue is full")
    }
}

impl core::error::Error for Full {}

impl Error for Full {
    fn kind(&self) -> ErrorKind {
        ErrorKind::OutOfMemory
    }
}

impl ErrorType for QueuedPort<'_> {
    type Error = Full;
}

impl ReadReady for QueuedPort<'_> {
    fn read_ready(&mut self) -> Result<bool, Full> {
        Ok(self.received.ready())
    }
}

impl Read for QueuedPort<'_> {
    /// Never blocks: 0 if nothing has arrived.
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Full> {
        let mut length = 0;
        for place in buffer {
            let Some(byte) = self.received.dequeue() else { break };
            *place = byte;
            length += 1;
        }
        Ok(length)
    }
}

impl Write for QueuedPort<'_> {
    /// Never blocks: an error if the queue is full.
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Full> {
        let queued = bytes.iter().map_while(|&byte| self.to_send.enqueue(byte).ok()).count();
        if queued > 0 {
            (self.wake)();
        }
        if queued == 0 && !bytes.is_empty() { Err(Full) } else { Ok(queued) }
    }

    /// Queued bytes are sent by the interrupt.
    fn flush(&mut self) -> Result<(), Full> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use core::sync::atomic::{AtomicU32, Ordering};

    use super::*;
    use crate::{Link, SerialLink};

    #[test]
    fn a_frame_crosses_from_one_node_to_the_other() {
        static WOKEN: AtomicU32 = AtomicU32::new(0);
        let wake = || {
            WOKEN.fetch_add(1, Ordering::Relaxed);
        };
        let mut queues = [const { Queue::<u8, 64>::new() }; 4];
        let [a, b, c, d] = &mut queues;
        let ((here, mut here_end), (there, mut there_end)) =
            (queued_port(a, b, wake), queued_port(c, d, wake));
        let (mut here, mut there) = (SerialLink::new(here), SerialLink::new(there));

        here.send(&[1, 0, 3]).expect("the queue has room");
        assert!(WOKEN.load(Ordering::Relaxed) > 0);
        let mut buffer = [0; 8];
        assert_eq!(there.poll(&mut buffer), Ok(None));
        while let Some(byte) = here_end.take() {
            there_end.put(byte);
        }
        assert_eq!(there.poll(&mut buffer), Ok(Some(&[1, 0, 3][..])));
        assert_eq!(there.poll(&mut buffer), Ok(None));
    }

    #[test]
    fn overflow_is_lost_and_reported() {
        let mut queues = [const { Queue::<u8, 4>::new() }; 2];
        let [received, to_send] = &mut queues;
        let (mut port, mut end) = queued_port(received, to_send, || ());
        assert_eq!(port.write(&[1, 2, 3, 4]), Ok(3));
        assert_eq!(port.write(&[4]), Err(Full));
        assert_eq!(port.write(&[]), Ok(0));
        assert_eq!(port.write_all(&[4]), Err(Full));
        assert_eq!(
            (end.take(), end.take(), end.take(), end.take()),
            (Some(1), Some(2), Some(3), None)
        );

        (1..=4).for_each(|byte| end.put(byte));
        let mut buffer = [0; 8];
        assert_eq!(port.read_ready(), Ok(true));
        assert_eq!(port.read(&mut buffer), Ok(3));
        assert_eq!(buffer[..3], [1, 2, 3]);
        assert_eq!(port.read_ready(), Ok(false));
        assert_eq!(port.read(&mut buffer), Ok(0));
    }
}
