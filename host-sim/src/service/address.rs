//! Addresses of nodes.

use std::fmt;
use std::io;
use std::os::unix::fs::FileTypeExt;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rustix::io::{Errno, FdFlags};
use rustix::net::{AddressFamily, SocketAddrUnix, SocketType};

use super::Line;
use crate::stop::Stop;

/// Default baud rate of a serial line. \[bit/s\]
pub const BAUD: u32 = 115_200;

/// How long to wait for a server to accept the connection.
const ACCEPT_TIMEOUT: Duration = Duration::from_secs(3);

/// Connects to a socket. If its backlog is full, waits up to `wait`, unless `stop` is requested.
///
/// # Errors
/// The system's error; [`io::ErrorKind::WouldBlock`] if the backlog is still full.
pub fn connect(path: &Path, wait: Duration, stop: &Stop) -> io::Result<UnixStream> {
    let address = SocketAddrUnix::new(path)?;
    let deadline = Instant::now() + wait;
    loop {
        let socket = rustix::net::socket(AddressFamily::UNIX, SocketType::STREAM, None)?;
        rustix::io::fcntl_setfd(&socket, FdFlags::CLOEXEC)?;
        // A blocking connect could not be interrupted.
        rustix::io::ioctl_fionbio(&socket, true)?;
        match rustix::net::connect(&socket, &address) {
            Ok(()) => return Ok(UnixStream::from(socket)),
            Err(Errno::AGAIN | Errno::INTR)
                if Instant::now() < deadline && !stop.is_requested() =>
            {
                std::thread::sleep(Duration::from_millis(10));
            }
            Err(error) => return Err(error.into()),
        }
    }
}

/// The address of a node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Address {
    /// A Unix socket, as served by co-simulation.
    Socket(PathBuf),
    /// A serial line and its baud rate.
    Serial(PathBuf, u32),
}

/// A node cannot be reached.
#[derive(Debug, thiserror::Error)]
#[error("{address}: {error}; {hint}")]
pub struct AddressError {
    /// The address.
    pub address: Address,
    /// The system's error.
    #[source]
    pub error: io::Error,
    /// What to do.
    hint: String,
}

impl Address {
    /// Connects to the node; the line is usable until `stop` is requested.
    ///
    /// # Errors
    /// The system's error.
    pub fn connect(&self, stop: &Arc<Stop>) -> Result<Line, AddressError> {
        let line = match self {
            Self::Socket(path) => {
                let socket = connect(path, ACCEPT_TIMEOUT, stop);
                socket.and_then(|socket| Line::over_socket(socket, stop))
            }
            Self::Serial(path, baud) => Line::over_serial(path, *baud, stop),
        };
        line.map_err(|error| AddressError { hint: self.hint(&error), address: self.clone(), error })
    }

    fn hint(&self, error: &io::Error) -> String {
        match self {
            Self::Socket(path) => {
                let kind = std::fs::metadata(path).map(|metadata| metadata.file_type());
                let serve = "start `host-sim cosim --serve FOLDER`, or give a socket in that folder";
                match kind {
                    Ok(kind) if kind.is_char_device() => {
                        format!("this is a device; use serial:{}[@BAUD]", path.display())
                    }
                    Ok(kind) if kind.is_dir() => {
                        format!("this is a folder; use {}", path.join("agent-1.sock").display())
                    }
                    Ok(kind) if !kind.is_socket() => format!("this is not a socket; {serve}"),
                    Ok(_) if error.kind() == io::ErrorKind::WouldBlock => {
                        "too many clients are waiting; check that the server is still running"
                            .to_owned()
                    }
                    Ok(_) => format!("nothing is listening on this socket; {serve}"),
                    Err(_) => serve.to_owned(),
                }
            }
            Self::Serial(_, _) if error.kind() == io::ErrorKind::ResourceBusy => {
                "stop the other program, or wait until it has finished".to_owned()
            }
            Self::Serial(_, _) => {
                "check that the board is connected, that no other program is using the line, and that \
                 you have permission to use it (on Linux, the dialout group)"
                    .to_owned()
            }
        }
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Socket(path) => write!(f, "unix:{}", path.display()),
            Self::Serial(path, BAUD) => write!(f, "serial:{}", path.display()),
            Self::Serial(path, baud) => write!(f, "serial:{}@{baud}", path.display()),
        }
    }
}

impl FromStr for Address {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if let Some(line) = text.strip_prefix("serial:") {
            let (path, baud) = match line.rsplit_once('@') {
                None => (line, BAUD),
                Some((path, baud)) => {
                    let baud = baud.parse().ok().filter(|&baud| baud > 0);
                    (path, baud.ok_or("expected a baud rate after @, as in @115200")?)
                }
            };
            if path.is_empty() {
                return Err("expected a device, as in serial:/dev/ttyUSB0".to_owned());
            }
            return Ok(Self::Serial(path.into(), baud));
        }
        let path = text.strip_prefix("unix:").unwrap_or(text);
        if path.is_empty() {
            return Err("expected unix:PATH or serial:/dev/tty...[@BAUD]".to_owned());
        }
        Ok(Self::Socket(path.into()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_round_trip() {
        let socket = |path: &str| Address::Socket(path.into());
        assert_eq!("unix:out/agent-1.sock".parse(), Ok(socket("out/agent-1.sock")));
        assert_eq!("out/agent-1.sock".parse(), Ok(socket("out/agent-1.sock")));
        for (text, baud) in [("serial:/dev/ttyUSB0", BAUD), ("serial:/dev/ttyUSB0@9600", 9600)] {
            let address: Address = text.parse().unwrap();
            assert_eq!(address, Address::Serial("/dev/ttyUSB0".into(), baud));
            assert_eq!(address.to_string(), text);
        }
        for text in ["", "unix:", "serial:", "serial:/dev/ttyS0@fast", "serial:/dev/ttyS0@0"] {
            assert!(text.parse::<Address>().is_err(), "{text}");
        }
    }

    #[test]
    fn a_missing_node_is_reported_with_a_hint() {
        let error = socket_error("no/such.sock");
        assert!(error.starts_with("unix:no/such.sock: ") && error.contains("--serve"), "{error}");
    }

    #[test]
    fn connecting_to_a_full_socket_does_not_block() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("full.sock");
        let listener = rustix::net::socket(AddressFamily::UNIX, SocketType::STREAM, None).unwrap();
        rustix::net::bind(&listener, &SocketAddrUnix::new(&path).unwrap()).unwrap();
        rustix::net::listen(&listener, 1).unwrap();
        // Fill the backlog; its actual size depends on the system.
        let mut held = Vec::new();
        let error = loop {
            match connect(&path, Duration::ZERO, &Stop::default()) {
                Ok(socket) => held.push(socket),
                Err(error) => break error,
            }
            assert!(held.len() < 100);
        };
        assert_eq!(error.kind(), io::ErrorKind::WouldBlock, "{error}");
    }

    fn socket_error(path: &str) -> String {
        Address::Socket(path.into()).connect(&Arc::default()).unwrap_err().to_string()
    }
}
