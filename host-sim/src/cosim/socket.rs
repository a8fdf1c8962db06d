//! A node's listening socket, which never replaces other files and is removed on drop.

use std::fs::Metadata;
use std::io::ErrorKind;
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::CosimError;
use crate::service::address::connect;
use crate::stop::Stop;

/// A listening socket. Dropping it removes its file, unless that has been replaced.
#[derive(Debug)]
pub(super) struct Socket {
    path: PathBuf,
    listener: UnixListener,
    /// Device and inode of the file, which identify it.
    identity: Option<(u64, u64)>,
}

impl Socket {
    /// Checks that a socket can be created here. Returns whether a stale one must be removed first.
    ///
    /// # Errors
    /// [`CosimError::Occupied`] if the path is taken.
    pub(super) fn check(path: &Path) -> Result<bool, CosimError> {
        let occupied = |what| CosimError::Occupied { path: path.to_owned(), what };
        // Links are not followed: their targets belong to someone else.
        let metadata = match std::fs::symlink_metadata(path) {
            Ok(metadata) => metadata,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(false),
            Err(error) => return Err(CosimError::Serve { path: path.to_owned(), error }),
        };
        if !metadata.file_type().is_socket() {
            return Err(occupied("not a socket"));
        }
        match connect(path, Duration::ZERO, &Stop::default()) {
            // Left behind by a killed run.
            Err(error) if error.kind() == ErrorKind::ConnectionRefused => Ok(true),
            _ => Err(occupied("another program is listening on this socket")),
        }
    }

    /// Creates the socket.
    ///
    /// # Errors
    /// Same as [`Socket::check`], and the system's errors.
    pub(super) fn bind(path: PathBuf) -> Result<Self, CosimError> {
        let stale = Self::check(&path)?;
        let bound = || {
            if stale {
                std::fs::remove_file(&path)?;
            }
            let listener = UnixListener::bind(&path)?;
            listener.set_nonblocking(true)?;
            Ok(listener)
        };
        match bound() {
            Ok(listener) => {
                let identity = std::fs::symlink_metadata(&path).ok().map(|m| identity(&m));
                Ok(Self { path, listener, identity })
            }
            Err(error) => Err(CosimError::Serve { path, error }),
        }
    }

    /// Accepts the next waiting client.
    pub(super) fn accept(&self) -> Option<UnixStream> {
        self.listener.accept().ok().map(|(socket, _)| socket)
    }
}

fn identity(metadata: &Metadata) -> (u64, u64) {
    (metadata.dev(), metadata.ino())
}

impl Drop for Socket {
    fn drop(&mut self) {
        let there = std::fs::symlink_metadata(&self.path).ok().map(|m| identity(&m));
        if there.is_some() && there == self.identity {
            // Best effort: the run is over.
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_stale_socket_is_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        std::fs::write(path("file"), "precious").unwrap();
        std::os::unix::fs::symlink(path("file"), path("link")).unwrap();
        std::fs::create_dir(path("folder")).unwrap();
        for name in ["file", "link", "folder"] {
            let error = Socket::bind(path(name)).unwrap_err().to_string();
            assert!(error.contains("not a socket; refusing to replace it"), "{error}");
        }
        assert_eq!(std::fs::read(path("link")).unwrap(), b"precious");

        let live = UnixListener::bind(path("live")).unwrap();
        let error = Socket::bind(path("live")).unwrap_err().to_string();
        assert!(error.contains("another program is listening on this socket"), "{error}");
        drop(live);
        // No process is listening now, as after a killed run.
        let ours = Socket::bind(path("live")).unwrap();
        assert!(UnixStream::connect(path("live")).is_ok() && ours.accept().is_some());
        drop(ours);
        assert!(!path("live").exists());
    }

    #[test]
    fn a_file_that_replaced_the_socket_is_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("agent-1.sock");
        let ours = Socket::bind(path.clone()).unwrap();
        std::fs::remove_file(&path).unwrap();
        std::fs::write(&path, "precious").unwrap();
        drop(ours);
        assert_eq!(std::fs::read(&path).unwrap(), b"precious");
    }
}
