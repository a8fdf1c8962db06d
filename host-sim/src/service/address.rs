//! Where a node is found.

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

/// Bits per second of a serial line, by default.
pub const BAUD: u32 = 115_200;

/// How long a server may take to accept us. \[s\]
const ADMISSION: Duration = Duration::from_secs(3);

/// Connects to a socket. If so many others wait there that there is no room, this waits so long, unless
/// `stop` is requested.
///
/// # Errors
/// What the system says; [`io::ErrorKind::WouldBlock`] if there is still no room then.
pub fn connect(path: &Path, wait: Duration, stop: &Stop) -> io::Result<UnixStream> {
    let address = SocketAddrUnix::new(path)?;
    let deadline = Instant::now() + wait;
    loop {
        let socket = rustix::net::socket(AddressFamily::UNIX, SocketType::STREAM, None)?;
        rustix::io::fcntl_setfd(&socket, FdFlags::CLOEXEC)?;
        // A connection that waits in the system cannot be interrupted.
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

/// Where a node is found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Address {
    /// A Unix socket, such as the co-simulation offers.
    Socket(PathBuf),
    /// A serial line and its bits per second.
    Serial(PathBuf, u32),
}

/// A node cannot be reached.
#[derive(Debug, thiserror::Error)]
#[error("{address}: {error}; {hint}")]
pub struct AddressError {
    /// Where it should be.
    pub address: Address,
    /// The system's error.
    #[source]
    pub error: io::Error,
    /// What to do about it.
    hint: String,
}

impl Address {
    /// A line to the node, until `stop` is requested.
    ///
    /// # Errors
    /// The system's error.
    pub fn connect(&self, stop: &Arc<Stop>) -> Result<Line, AddressError> {
        let line = match self {
            Self::Socket(path) => {
                let socket = connect(path, ADMISSION, stop);
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
                let serve = "start `host-sim cosim --serve FOLDER`, or name a socket in its folder";
                match kind {
                    Ok(kind) if kind.is_char_device() => {
                        format!("this is a device: write serial:{}[@BAUD]", path.display())
                    }
                    Ok(kind) if kind.is_dir() => {
                        format!("this is a folder: write {}", path.join("agent-1.sock").display())
                    }
                    Ok(kind) if !kind.is_socket() => format!("this is not a socket: {serve}"),
                    Ok(_) if error.kind() == io::ErrorKind::WouldBlock => {
                        "too many clients wait there; check that its process is still running"
                            .to_owned()
                    }
                    Ok(_) => format!("nothing listens at this socket any more: {serve}"),
                    Err(_) => serve.to_owned(),
                }
            }
            Self::Serial(_, _) if error.kind() == io::ErrorKind::ResourceBusy => {
                "end the other program, or wait until it has ended".to_owned()
            }
            Self::Serial(_, _) => {
                "connect the board, and make sure that no other program has the line open and that \
                 you may use it (on Linux, the group dialout)"
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
                    (path, baud.ok_or("write bits per second behind @, as in @115200")?)
                }
            };
            if path.is_empty() {
                return Err("write the line's device, as in serial:/dev/ttyUSB0".to_owned());
            }
            return Ok(Self::Serial(path.into(), baud));
        }
        let path = text.strip_prefix("unix:").unwrap_or(text);
        if path.is_empty() {
            return Err("write unix:PATH or serial:/dev/tty...[@BAUD]".to_owned());
        }
        Ok(Self::Socket(path.into()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read_and_written() {
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
    fn a_node_that_is_not_there_is_reported_with_a_mend() {
        let error = socket_error("no/such.sock");
        assert!(error.starts_with("unix:no/such.sock: ") && error.contains("--serve"), "{error}");
    }

    #[test]
    fn a_socket_that_lets_nobody_in_does_not_hold_us() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("full.sock");
        let listener = rustix::net::socket(AddressFamily::UNIX, SocketType::STREAM, None).unwrap();
        rustix::net::bind(&listener, &SocketAddrUnix::new(&path).unwrap()).unwrap();
        rustix::net::listen(&listener, 1).unwrap();
        // As many as there is room for, whatever the system makes of the 1.
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
