//! Reads whole files up to a size limit, because a path may name an endless device.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

/// Returns the content of the file at `path`.
///
/// # Errors
/// Returns the system's error, or [`io::ErrorKind::FileTooLarge`] for more than `limit` bytes.
pub fn read_limited(path: &Path, limit: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    Limited::new(File::open(path)?, limit).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// A reader that fails with [`io::ErrorKind::FileTooLarge`] beyond a limit, where
/// [`Read::take`] would report the end of the input.
#[derive(Debug)]
pub struct Limited<R> {
    inner: R,
    limit: u64,
    left: u64,
}

impl<R: Read> Limited<R> {
    /// Reads up to `limit` bytes of `inner`.
    pub fn new(inner: R, limit: u64) -> Self {
        Self { inner, limit, left: limit }
    }
}

impl<R: Read> Read for Limited<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if buffer.is_empty() {
            return Ok(0);
        }
        // One extra byte distinguishes an input that is too long from one that just fits.
        let most = usize::try_from(self.left.saturating_add(1)).unwrap_or(usize::MAX);
        let most = buffer.len().min(most);
        let length = self.inner.read(&mut buffer[..most])?;
        let left = self.left.checked_sub(length as u64).ok_or_else(|| {
            let problem = format!("larger than {} bytes", self.limit);
            io::Error::new(io::ErrorKind::FileTooLarge, problem)
        })?;
        self.left = left;
        Ok(length)
    }
}

/// Whether an input was rejected for its size.
#[must_use]
pub fn is_too_large(error: &io::Error) -> bool {
    error.kind() == io::ErrorKind::FileTooLarge
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_files_up_to_the_limit() {
        let path = std::env::temp_dir().join(format!("input-file-{}", std::process::id()));
        std::fs::write(&path, b"12345").unwrap();
        assert_eq!(read_limited(&path, 5).unwrap(), b"12345");
        let error = read_limited(&path, 4).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::FileTooLarge);
        assert_eq!(error.to_string(), "larger than 4 bytes");
        std::fs::remove_file(&path).unwrap();
    }

    #[test]
    fn limited_reader_fails_beyond_the_limit() {
        let read = |text: &[u8], limit| {
            let mut bytes = Vec::new();
            let result = Limited::new(text, limit).read_to_end(&mut bytes);
            result.map(|_| bytes).map_err(|error| is_too_large(&error))
        };
        assert_eq!(read(b"12345", 5), Ok(b"12345".to_vec()));
        assert_eq!(read(b"12345", u64::MAX), Ok(b"12345".to_vec()));
        assert_eq!((read(b"", 0), read(b"1", 0)), (Ok(Vec::new()), Err(true)));
    }

    #[cfg(unix)]
    #[test]
    fn a_device_that_never_ends_is_refused() {
        let error = read_limited(Path::new("/dev/zero"), 1000).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::FileTooLarge);
    }
}
