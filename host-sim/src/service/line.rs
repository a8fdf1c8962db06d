//! A byte connection to a node, over pipes, a socket or a serial line.
//!
//! No wait exceeds its timeout, however much the other end sends, and every wait ends soon after
//! its [`Stop`] is requested. The receive buffer is bounded.
//!
//! A serial line is opened exclusively: it is locked against other programs that use locks (as all
//! commands here do) and, if the system supports it, against all others.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::{self, Read, Write};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::fs::OpenOptionsExt;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use nix::libc::{O_NOCTTY, O_NONBLOCK};
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};

use crate::stop::Stop;

/// Interval for polling the stop request. \[ms\]
const SLICE: u16 = 100;

/// Size of one read. \[byte\]
const CHUNK: usize = 4096;

/// Limit of the receive buffer while sending. \[byte\]
const RECEIVED_MAX: usize = 1 << 16;

/// A connection over two nonblocking descriptors.
#[derive(Debug)]
pub struct Line {
    input: File,
    output: File,
    received: Vec<u8>,
    /// Ends every wait.
    stop: Arc<Stop>,
    /// How long waits continue after the stop is requested.
    grace: Duration,
    /// For a serial line: its lock and baud rate.
    lock: Option<(File, u32)>,
    /// Whether this is a pair of pipes, which a node closes and reopens on a reset.
    pipes: bool,
    /// `false` while the other end may not have opened its pipe, so that end of file is ignored.
    opened: bool,
}

/// Why sending or receiving failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LineError {
    /// Nothing happened in time.
    #[error("no answer")]
    Silent,
    /// The other end closed the connection.
    #[error("the connection was closed by the other end")]
    Closed,
    /// The stop was requested.
    #[error("interrupted")]
    Interrupted,
    /// The system reported an error.
    #[error(transparent)]
    System(#[from] io::Error),
}

impl Line {
    /// Creates a line over a connected socket; `stop` ends its waits.
    ///
    /// # Errors
    /// The system's error.
    pub fn over_socket(socket: UnixStream, stop: &Arc<Stop>) -> io::Result<Self> {
        socket.set_nonblocking(true)?;
        let output = File::from(OwnedFd::from(socket.try_clone()?));
        Ok(Self::new(File::from(OwnedFd::from(socket)), output, false, stop))
    }

    /// Opens the serial line `path` exclusively, with `baud` bits per second, eight data bits and
    /// no parity.
    ///
    /// # Errors
    /// The system's error; [`io::ErrorKind::ResourceBusy`] if another program uses the line.
    pub fn over_serial(path: &Path, baud: u32, stop: &Arc<Stop>) -> io::Result<Self> {
        // Lock before changing settings, which would disturb another user of the line.
        let lock = OpenOptions::new()
            .read(true)
            .write(true)
            .custom_flags(O_NONBLOCK | O_NOCTTY)
            .open(path)?;
        lock.try_lock().map_err(|error| match error {
            TryLockError::WouldBlock => {
                io::Error::new(io::ErrorKind::ResourceBusy, "another program is using this line")
            }
            TryLockError::Error(error) => error,
        })?;
        let port = serial2::SerialPort::open(path, baud)?;
        port.discard_buffers()?;
        let mut line = Self::over_port(port, stop)?;
        // Best effort: if not supported, the lock still excludes other commands of this program.
        let _ = rustix::termios::ioctl_tiocexcl(&lock);
        line.lock = Some((lock, baud));
        Ok(line)
    }

    /// Creates a line over an open serial port.
    ///
    /// # Errors
    /// The system's error.
    pub fn over_port(port: serial2::SerialPort, stop: &Arc<Stop>) -> io::Result<Self> {
        // `serial2` opens ports in nonblocking mode.
        let descriptor = OwnedFd::from(port);
        let output = File::from(descriptor.try_clone()?);
        Ok(Self::new(File::from(descriptor), output, false, stop))
    }

    /// Creates a line over two named pipes. The node reads from `to_node`, which it opens first,
    /// and writes to `from_node`. Waiting ends once `alive` returns `false`.
    ///
    /// # Errors
    /// [`LineError::Silent`] if the node does not open its pipe in time or is not alive.
    pub fn over_pipes(
        to_node: &Path,
        from_node: &Path,
        timeout: Duration,
        mut alive: impl FnMut() -> bool,
        stop: &Arc<Stop>,
    ) -> Result<Self, LineError> {
        let deadline = Instant::now() + timeout;
        let input = OpenOptions::new().read(true).custom_flags(O_NONBLOCK).open(from_node)?;
        let output = loop {
            match OpenOptions::new().write(true).custom_flags(O_NONBLOCK).open(to_node) {
                Ok(output) => break output,
                // Not yet open for reading.
                Err(error) if error.raw_os_error() == Some(nix::libc::ENXIO) => {
                    if stop.is_requested() {
                        return Err(LineError::Interrupted);
                    }
                    if Instant::now() >= deadline || !alive() {
                        return Err(LineError::Silent);
                    }
                    std::thread::sleep(Duration::from_millis(1));
                }
                Err(error) => return Err(error.into()),
            }
        };
        Ok(Self::new(input, output, true, stop))
    }

    fn new(input: File, output: File, pipes: bool, stop: &Arc<Stop>) -> Self {
        Self {
            input,
            output,
            received: Vec::new(),
            stop: stop.clone(),
            grace: Duration::ZERO,
            lock: None,
            pipes,
            opened: !pipes,
        }
    }

    /// Sets how long waits continue after the stop is requested.
    pub fn set_grace(&mut self, grace: Duration) {
        self.grace = grace;
    }

    /// Returns the baud rate of a serial line.
    #[must_use]
    pub fn baud(&self) -> Option<u32> {
        self.lock.as_ref().map(|(_, baud)| *baud)
    }

    /// Returns the stop request that ends its waits.
    #[must_use]
    pub fn stop(&self) -> &Arc<Stop> {
        &self.stop
    }

    /// Checks for a stop request.
    ///
    /// # Errors
    /// [`LineError::Interrupted`] if the stop is requested and the grace period is over.
    pub(super) fn check_interruption(&self) -> Result<(), LineError> {
        if self.stop.is_requested_for(self.grace) { Err(LineError::Interrupted) } else { Ok(()) }
    }

    /// Announces a reset of the node, so that closing its pipes does not count as the end.
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
                Ok(length) => {
                    bytes = &bytes[length..];
                    // The timeout holds for a slow reader, too.
                    if !bytes.is_empty() && Instant::now() >= deadline {
                        return Err(LineError::Silent);
                    }
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    self.wait(PollFlags::POLLOUT, deadline)?;
                    // Keep reading: the node may block until its output is read.
                    if self.received.len() < RECEIVED_MAX {
                        self.read_available()?;
                    }
                }
                Err(error) => self.convert(error)?,
            }
        }
        Ok(())
    }

    /// Receives at least one byte.
    ///
    /// # Errors
    /// See [`LineError`].
    pub fn receive(&mut self, timeout: Duration) -> Result<Vec<u8>, LineError> {
        let deadline = Instant::now() + timeout;
        loop {
            self.read_available()?;
            if !self.received.is_empty() {
                return Ok(std::mem::take(&mut self.received));
            }
            self.wait(PollFlags::POLLIN, deadline)?;
        }
    }

    /// Reads available bytes.
    fn read_available(&mut self) -> Result<(), LineError> {
        let mut buffer = [0; CHUNK];
        match self.input.read(&mut buffer) {
            // The other end has not opened its pipe yet.
            Ok(0) if !self.opened => std::thread::sleep(Duration::from_millis(1)),
            Ok(0) if self.received.is_empty() => return Err(LineError::Closed),
            Ok(length) => {
                self.opened |= length > 0;
                self.received.extend_from_slice(&buffer[..length]);
            }
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
            Err(error) => self.convert(error)?,
        }
        Ok(())
    }

    /// Converts a system error; interrupted calls are ignored.
    fn convert(&self, error: io::Error) -> Result<(), LineError> {
        match error.kind() {
            io::ErrorKind::Interrupted => Ok(()),
            io::ErrorKind::BrokenPipe | io::ErrorKind::ConnectionReset => Err(LineError::Closed),
            // A pseudo-terminal whose other end was closed.
            _ if error.raw_os_error() == Some(nix::libc::EIO) => Err(LineError::Closed),
            _ => Err(error.into()),
        }
    }

    fn wait(&self, what: PollFlags, deadline: Instant) -> Result<(), LineError> {
        loop {
            self.check_interruption()?;
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(LineError::Silent);
            }
            let milliseconds = u16::try_from(left.as_millis()).unwrap_or(SLICE).clamp(1, SLICE);
            let mut descriptors = Vec::with_capacity(2);
            // With a full buffer, leave further bytes in the system.
            if self.received.len() < RECEIVED_MAX {
                descriptors.push(PollFd::new(self.input.as_fd(), PollFlags::POLLIN));
            }
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

impl Drop for Line {
    fn drop(&mut self) {
        if let Some((lock, _)) = &self.lock {
            // Best effort: a disconnected terminal is unlocked anyway.
            let _ = rustix::termios::ioctl_tiocnxcl(lock);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHORT: Duration = Duration::from_millis(20);

    #[test]
    fn a_silent_peer_is_distinguished_from_a_closed_one() {
        let (here, mut there) = UnixStream::pair().unwrap();
        let mut line = Line::over_socket(here, &Arc::default()).unwrap();
        assert!(matches!(line.receive(SHORT), Err(LineError::Silent)));
        there.write_all(b"hello").unwrap();
        assert_eq!(line.receive(SHORT).unwrap(), b"hello");
        drop(there);
        assert!(matches!(line.receive(SHORT), Err(LineError::Closed)));
        assert!(matches!(line.send(b"hello?", SHORT), Err(LineError::Closed)));
    }

    #[test]
    fn sending_to_a_peer_that_does_not_read_times_out() {
        let (here, _there) = UnixStream::pair().unwrap();
        let mut line = Line::over_socket(here, &Arc::default()).unwrap();
        let much = vec![7; 1 << 22];
        assert!(matches!(line.send(&much, SHORT), Err(LineError::Silent)));
    }

    #[test]
    fn the_receive_buffer_is_bounded() {
        let (here, mut there) = UnixStream::pair().unwrap();
        let mut line = Line::over_socket(here, &Arc::default()).unwrap();
        let flood = std::thread::spawn(move || {
            let mut sent = 0;
            while sent < 8 * RECEIVED_MAX && there.write_all(&[7; CHUNK]).is_ok() {
                sent += CHUNK;
            }
        });
        // The peer never reads, so this times out; received bytes are buffered meanwhile.
        assert!(matches!(line.send(&vec![7; 1 << 22], SHORT), Err(LineError::Silent)));
        assert!(line.received.len() < RECEIVED_MAX + CHUNK, "{}", line.received.len());
        drop(line);
        flood.join().unwrap();
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn a_serial_line_belongs_to_one_program_at_a_time() {
        use std::os::fd::AsRawFd;
        let (_master, terminal) = serial2::SerialPort::pair().unwrap();
        // The device name of the terminal, as given to commands.
        let path = format!("/proc/self/fd/{}", terminal.as_raw_fd());
        let path = std::fs::read_link(path).unwrap();
        let first = Line::over_serial(&path, 115_200, &Arc::default()).unwrap();
        let second = Line::over_serial(&path, 115_200, &Arc::default()).unwrap_err();
        assert_eq!(second.kind(), io::ErrorKind::ResourceBusy, "{second}");
        drop(first);
        drop(Line::over_serial(&path, 115_200, &Arc::default()).unwrap());
    }

    #[test]
    fn a_serial_line_carries_bytes_both_ways() {
        let (here, there) = serial2::SerialPort::pair().unwrap();
        let mut line = Line::over_port(here, &Arc::default()).unwrap();
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
