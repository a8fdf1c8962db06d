//! Determines what is at an output path.

use std::fs::{self, File, Metadata, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};

use super::{FileKind, OutputError};

/// The destination of the bytes.
#[derive(Debug)]
pub(super) enum Place {
    /// A regular file at this path, which may not exist yet; not a link.
    File(PathBuf),
    /// This device, pipe or standard stream.
    Stream(File),
}

/// Maximum number of links in a chain, as in Linux.
const LINKS_MAX: usize = 40;

/// Resolves the destination of `path`.
pub(super) fn find(path: &Path) -> Result<Place, OutputError> {
    let failed = |error| OutputError::of(path, error);
    if let Some(stream) = standard_stream(path).map_err(failed)? {
        return Ok(Place::Stream(stream));
    }
    match fs::metadata(path) {
        Ok(found) if found.is_file() => {}
        Ok(found) => return Ok(Place::Stream(special(path, &found)?)),
        // A link to a missing file, or nothing.
        Err(error) if error.kind() == io::ErrorKind::NotFound => {}
        Err(error) => return Err(failed(error)),
    }
    let mut place = path.to_owned();
    for _ in 0..LINKS_MAX {
        match fs::read_link(&place) {
            Ok(target) => place = place.parent().unwrap_or(Path::new("")).join(target),
            Err(_) => return Ok(Place::File(place)),
        }
    }
    Err(failed(io::Error::other("too many levels of links")))
}

/// Returns the standard stream that `path` names. Opening the path would start at byte 0 again.
#[cfg(unix)]
fn standard_stream(path: &Path) -> io::Result<Option<File>> {
    use std::os::fd::AsFd;
    #[expect(clippy::disallowed_methods, reason = "writes a file to a stream")]
    let stream = match path.to_str() {
        Some("/dev/stdout" | "/dev/fd/1" | "/proc/self/fd/1") => {
            io::stdout().as_fd().try_clone_to_owned()?
        }
        Some("/dev/stderr" | "/dev/fd/2" | "/proc/self/fd/2") => {
            io::stderr().as_fd().try_clone_to_owned()?
        }
        _ => return Ok(None),
    };
    Ok(Some(File::from(stream)))
}

#[cfg(not(unix))]
fn standard_stream(_: &Path) -> io::Result<Option<File>> {
    Ok(None)
}

/// Opens a path that exists and is not a regular file.
#[cfg(unix)]
fn special(path: &Path, found: &Metadata) -> Result<File, OutputError> {
    use std::os::unix::fs::FileTypeExt;
    let kind = found.file_type();
    let what = if kind.is_dir() {
        "a folder"
    } else if kind.is_socket() {
        "a socket"
    } else if kind.is_block_device() {
        "a disk"
    } else {
        let opened = if kind.is_fifo() { open_pipe(path) } else { open_existing(path, 0) };
        return opened.map_err(|error| match error.raw_os_error() {
            Some(NO_READER) => OutputError::NoReader { path: path.to_owned() },
            _ => OutputError::Write { path: path.to_owned(), error },
        });
    };
    Err(OutputError::NotAFile { path: path.to_owned(), what })
}

#[cfg(not(unix))]
fn special(path: &Path, _: &Metadata) -> Result<File, OutputError> {
    Err(OutputError::NotAFile { path: path.to_owned(), what: "a folder" })
}

/// Error of a pipe without a reader.
#[cfg(unix)]
const NO_READER: i32 = nix::errno::Errno::ENXIO as i32;

/// Opens a named pipe as soon as there is a reader; a plain open would wait forever.
#[cfg(unix)]
fn open_pipe(path: &Path) -> io::Result<File> {
    use nix::fcntl::{FcntlArg, OFlag, fcntl};
    use std::time::{Duration, Instant};
    // A reader started together with this command is ready by then.
    let deadline = Instant::now() + Duration::from_secs(1);
    loop {
        match open_existing(path, OFlag::O_NONBLOCK.bits()) {
            Err(error) if error.raw_os_error() == Some(NO_READER) && Instant::now() < deadline => {
                std::thread::sleep(Duration::from_millis(5));
            }
            opened => {
                let file = opened?;
                // From here on, writes wait for a slow reader.
                fcntl(&file, FcntlArg::F_SETFL(OFlag::empty()))?;
                return Ok(file);
            }
        }
    }
}

#[cfg(unix)]
fn open_existing(path: &Path, flags: i32) -> io::Result<File> {
    use std::os::unix::fs::OpenOptionsExt;
    OpenOptions::new().write(true).custom_flags(flags).open(path)
}

/// Returns the metadata of the file to be replaced, if there is one; it must be of the same kind
/// and writable. `path` is the name used in errors.
pub(super) fn check(
    path: &Path,
    place: &Path,
    kind: FileKind,
) -> Result<Option<Metadata>, OutputError> {
    let failed = |error| OutputError::of(path, error);
    let found = match fs::symlink_metadata(place) {
        Ok(found) => found,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(failed(error)),
    };
    if !found.is_file() {
        let what = "no longer a file";
        return Err(OutputError::NotAFile { path: path.to_owned(), what });
    }
    if !kind.replaces(place) {
        return Err(OutputError::OtherKind { path: path.to_owned(), kind: kind.name });
    }
    // A read-only file stays unchanged even if its folder is writable.
    OpenOptions::new().append(true).open(place).map_err(failed)?;
    Ok(Some(found))
}

/// Returns the mode of a file, on systems that have modes.
#[cfg(unix)]
pub(super) fn mode(found: &Metadata) -> u32 {
    std::os::unix::fs::PermissionsExt::mode(&found.permissions())
}

#[cfg(not(unix))]
pub(super) fn mode(_: &Metadata) -> u32 {
    0
}

/// Copies owner and mode of the previous file to `file`.
#[cfg(unix)]
pub(super) fn copy_attributes(file: &File, before: &Metadata) -> io::Result<()> {
    use std::os::unix::fs::{MetadataExt, fchown};
    let own = file.metadata()?;
    let owner = (own.uid() != before.uid()).then_some(before.uid());
    let group = (own.gid() != before.gid()).then_some(before.gid());
    if owner.is_some() || group.is_some() {
        fchown(file, owner, group)?;
    }
    // After the owner, because changing the owner clears special bits.
    file.set_permissions(before.permissions())
}

#[cfg(not(unix))]
pub(super) fn copy_attributes(file: &File, before: &Metadata) -> io::Result<()> {
    file.set_permissions(before.permissions())
}
