//! Bytes to and from a node, over pipes, a socket or a serial line.
//!
//! Nothing here waits longer than it is told to, and every wait ends when somebody asks for the end
//! ([`crate::interruption`]).

use std::collections::VecDeque;
use std::fs::{File, OpenOptions};
use std::io::{self, Read, Write};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::fs::OpenOptionsExt;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::time::{Duration, Instant};

use nix::libc::O_NONBLOCK;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};

use crate::interruption;

/// Longest wait between two looks at whether somebody asked for the end. \[ms\]
const SLICE: u16 = 100;

/// Most bytes that are read at once.
const CHUNK: usize = 4096;

/// Two descriptors that never block.
#[derive(Debug)]
pub struct Line {
    input: File,
    output: File,
    received: VecDeque<u8>,
    /// Whether this is a pair of pipes, which a node closes and opens again when it resets.
    pipes: bool,
    /// The other end of a pipe may not have opened it yet: then an end of file means nothing.
    opened: bool,
}

/// Why nothing more comes, or nothing can be sent.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LineError {
    /// Nothing happened in time.
    #[error("nothing happens")]
    Silent,
    /// The other end has gone.
    #[error("the connection has been closed at the other end")]
    Closed,
    /// Somebody asked for the end.
    #[error("interrupted")]
    Interrupted,
    /// The system reports an error.
    #[error(transparent)]
    System(#[from] io::Error),
}

impl Line {
    /// The line over a connected socket.
    ///
    /// # Errors
    /// What the system says.
    pub fn over_socket(socket: UnixStream) -> io::Result<Self> {
        socket.set_nonblocking(true)?;
        let output = File::from(OwnedFd::from(socket.try_clone()?));
        Ok(Self::new(File::from(OwnedFd::from(socket)), output, false))
    }

    /// The serial line `path` with `baud` bits per second, eight data bits, no parity.
    ///
    /// # Errors
    /// What the system says.
    pub fn over_serial(path: &Path, baud: u32) -> io::Result<Self> {
        let port = serial2::SerialPort::open(path, baud)?;
        port.discard_buffers()?;
        Self::over_port(port)
    }

    /// The line over an open serial port.
    ///
    /// # Errors
    /// What the system says.
    pub fn over_port(port: serial2::SerialPort) -> io::Result<Self> {
        // The crate opens ports so that they do not block.
        let descriptor = OwnedFd::from(port);
        let output = File::from(descriptor.try_clone()?);
        Ok(Self::new(File::from(descriptor), output, false))
    }

    /// The line over two named pipes: the node reads from `to_node`, and opens it first, and writes
    /// to `from_node`. `alive` says whether it makes sense to wait on.
    ///
    /// # Errors
    /// [`LineError::Silent`] if the node does not open its pipe in time or is not alive.
    pub fn over_pipes(
        to_node: &Path,
        from_node: &Path,
        timeout: Duration,
        mut alive: impl FnMut() -> bool,
    ) -> Result<Self, LineError> {
        let deadline = Instant::now() + timeout;
        let input = OpenOptions::new().read(true).custom_flags(O_NONBLOCK).open(from_node)?;
        let output = loop {
            match OpenOptions::new().write(true).custom_flags(O_NONBLOCK).open(to_node) {
                Ok(output) => break output,
                // Nobody has it open for reading.
                Err(error) if error.raw_os_error() == Some(nix::libc::ENXIO) => {
                    check_interruption()?;
                    if Instant::now() >= deadline || !alive() {
                        return Err(LineError::Silent);
                    }
                    std::thread::sleep(Duration::from_millis(1));
                }
                Err(error) => return Err(error.into()),
            }
        };
        Ok(Self::new(input, output, true))
    }

    fn new(input: File, output: File, pipes: bool) -> Self {
        Self { input, output, received: VecDeque::new(), pipes, opened: !pipes }
    }

    /// The node has said that it resets: that it closes its pipes now is not its end.
    pub fn expect_reset(&mut self) {
        self.opened = !self.pipes;
    }

    /// Sends all of `bytes`.
    ///
    /// # Errors
    /// See [`LineError`].
    pub fn send(&mut self, mut bytes: &[u8], timeout: Duration) -> Result<(), LineError> {
        let deadline = Instant::now() + timeout;
        while !bytes.is_empty() {
            match self.output.write(bytes) {
                Ok(length) => bytes = &bytes[length..],
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    self.wait(PollFlags::POLLOUT, deadline)?;
                    // A node that waits for us to read would never read.
                    self.read_available()?;
                }
                Err(error) => self.broken(error)?,
            }
        }
        Ok(())
    }

    /// The next bytes, at least one.
    ///
    /// # Errors
    /// See [`LineError`].
    pub fn receive(&mut self, timeout: Duration) -> Result<Vec<u8>, LineError> {
        let deadline = Instant::now() + timeout;
        loop {
            self.read_available()?;
            if !self.received.is_empty() {
                return Ok(std::mem::take(&mut self.received).into());
            }
            self.wait(PollFlags::POLLIN, deadline)?;
        }
    }

    /// Takes what is there.
    fn read_available(&mut self) -> Result<(), LineError> {
        let mut buffer = [0; CHUNK];
        match self.input.read(&mut buffer) {
            // A pipe is open from the first byte on.
            Ok(0) if !self.opened => std::thread::sleep(Duration::from_millis(1)),
            Ok(0) if self.received.is_empty() => return Err(LineError::Closed),
            Ok(length) => {
                self.opened |= length > 0;
                self.received.extend(&buffer[..length]);
            }
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
            Err(error) => self.broken(error)?,
        }
        Ok(())
    }

    /// What an error means, unless it means nothing.
    fn broken(&self, error: io::Error) -> Result<(), LineError> {
        match error.kind() {
            io::ErrorKind::Interrupted => Ok(()),
            io::ErrorKind::BrokenPipe | io::ErrorKind::ConnectionReset => Err(LineError::Closed),
            // What a pseudo-terminal says when its other end has gone.
            _ if error.raw_os_error() == Some(nix::libc::EIO) => Err(LineError::Closed),
            _ => Err(error.into()),
        }
    }

    fn wait(&self, what: PollFlags, deadline: Instant) -> Result<(), LineError> {
        loop {
            check_interruption()?;
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(LineError::Silent);
            }
            let milliseconds = u16::try_from(left.as_millis()).unwrap_or(SLICE).clamp(1, SLICE);
            let mut descriptors = vec![PollFd::new(self.input.as_fd(), PollFlags::POLLIN)];
            if what.contains(PollFlags::POLLOUT) {
                descriptors.push(PollFd::new(self.output.as_fd(), what));
            }
            match poll(&mut descriptors, PollTimeout::from(milliseconds)) {
                Ok(0) | Err(nix::errno::Errno::EINTR) => {}
                Ok(_) => return Ok(()),
                Err(error) => return Err(io::Error::from(error).into()),
            }
        }
    }
}

fn check_interruption() -> Result<(), LineError> {
    if interruption::requested() { Err(LineError::Interrupted) } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHORT: Duration = Duration::from_millis(20);

    #[test]
    fn a_silent_peer_and_a_gone_one_are_told_apart() {
        let (here, mut there) = UnixStream::pair().unwrap();
        let mut line = Line::over_socket(here).unwrap();
        assert!(matches!(line.receive(SHORT), Err(LineError::Silent)));
        there.write_all(b"hello").unwrap();
        assert_eq!(line.receive(SHORT).unwrap(), b"hello");
        drop(there);
        assert!(matches!(line.receive(SHORT), Err(LineError::Closed)));
        assert!(matches!(line.send(b"anybody?", SHORT), Err(LineError::Closed)));
    }

    #[test]
    fn a_peer_that_does_not_read_ends_the_wait() {
        let (here, _there) = UnixStream::pair().unwrap();
        let mut line = Line::over_socket(here).unwrap();
        let much = vec![7; 1 << 22];
        assert!(matches!(line.send(&much, SHORT), Err(LineError::Silent)));
    }

    #[test]
    fn a_serial_line_carries_bytes_both_ways() {
        let (here, there) = serial2::SerialPort::pair().unwrap();
        let mut line = Line::over_port(here).unwrap();
        line.send(&[1, 0, 17, 19, 255], SHORT).unwrap();
        let mut buffer = [0; 5];
        there.read_exact(&mut buffer).unwrap();
        assert_eq!(buffer, [1, 0, 17, 19, 255]);
        there.write_all(&[13, 10, 3]).unwrap();
        let mut received = Vec::new();
        while received.len() < 3 {
            received.extend(line.receive(SHORT).unwrap());
        }
        assert_eq!(received, [13, 10, 3]);
    }
}
