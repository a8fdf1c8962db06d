//! Tables that a user gives, as text: endless and binary files are refused before they are parsed.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use super::input::Limited;

/// Maximum size of a file. \[byte\]
const FILE_MAX: u64 = 4 << 30;

/// Maximum length read from a pipe or device, which may be endless: millions of rows. \[byte\]
const STREAM_MAX: u64 = 256 << 20;

/// Maximum length of a line. \[byte\]
pub const LINE_MAX: usize = 1 << 20;

/// Number of bytes in which the header line must end.
const HEAD: usize = LINE_MAX;

/// A problem and a hint.
pub type Refusal = (String, String);

/// Returns the beginning of the file at `path`, and a reader of the whole file.
///
/// # Errors
/// The system's error. The reader fails with [`io::ErrorKind::FileTooLarge`] at a line or a file that is too long.
pub fn open(path: &Path) -> io::Result<(Vec<u8>, impl Read)> {
    let mut file = File::open(path)?;
    let limit = if file.metadata()?.is_file() { FILE_MAX } else { STREAM_MAX };
    let mut head = Vec::new();
    file.by_ref().take(HEAD as u64).read_to_end(&mut head)?;
    Ok((head.clone(), content(head, file, limit)))
}

/// Returns a reader of a whole file whose `head` has been read, up to `limit` bytes.
fn content(head: Vec<u8>, rest: impl Read, limit: u64) -> impl Read {
    let inner = Limited::new(io::Cursor::new(head).chain(rest), limit);
    ShortLines { inner, length: 0 }
}

/// A reader that fails at a line that is too long, before a parser buffers it.
struct ShortLines<R> {
    inner: R,
    /// Bytes since the last line end.
    length: usize,
}

impl<R: Read> Read for ShortLines<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.inner.read(buffer)?;
        for line in buffer[..read].split_inclusive(|byte| matches!(byte, b'\n' | b'\r')) {
            self.length += line.len();
            if self.length > LINE_MAX {
                let problem = format!("line longer than {} MiB", LINE_MAX >> 20);
                return Err(io::Error::new(io::ErrorKind::FileTooLarge, problem));
            }
            if line.ends_with(b"\n") || line.ends_with(b"\r") {
                self.length = 0;
            }
        }
        Ok(read)
    }
}

/// Refuses a file whose first bytes are not text.
///
/// # Errors
/// What the file is instead, and what to do.
pub fn check_text(head: &[u8]) -> Result<(), Refusal> {
    let refused = |problem: &str, hint: &str| Err((problem.to_owned(), hint.to_owned()));
    const EXPORT: &str = "export the table as CSV";
    let known: [(&[u8], &str, &str); 10] = [
        (&[0x1F, 0x8B], "is compressed (gzip)", "`gunzip FILE` unpacks it"),
        (&[0x28, 0xB5, 0x2F, 0xFD], "is compressed (zstd)", "`unzstd FILE` unpacks it"),
        (b"BZh", "is compressed (bzip2)", "`bunzip2 FILE` unpacks it"),
        (b"\xFD7zXZ", "is compressed (xz)", "`unxz FILE` unpacks it"),
        (b"PK\x03\x04", "is a zip archive, like .xlsx, .ods and .npz files", EXPORT),
        (b"\xD0\xCF\x11\xE0", "is an old Excel file", EXPORT),
        (b"PAR1", "is a Parquet file", EXPORT),
        (b"\x89HDF", "is an HDF5 file", EXPORT),
        (b"MATLAB 5.0", "is a MATLAB file", "export it with writetable in MATLAB"),
        (b"SQLite format", "is a database", EXPORT),
    ];
    for (magic, problem, hint) in known {
        if head.starts_with(magic) {
            return refused(problem, hint);
        }
    }
    if head.is_empty() {
        return refused("is empty", "give a file with a header and rows");
    }
    let zeros = |odd: usize| head.iter().skip(odd).step_by(2).filter(|&&byte| byte == 0).count();
    let (even, odd, pairs) = (zeros(0), zeros(1), head.len() / 2);
    let utf16 = head.starts_with(&[0xFF, 0xFE]) || head.starts_with(&[0xFE, 0xFF]);
    if utf16 || (even == 0 && odd * 2 > pairs) || (odd == 0 && even * 2 > pairs) {
        return refused("is UTF-16", "save it as UTF-8");
    }
    if head.contains(&0) {
        return refused("is binary data, not text", "give a CSV file");
    }
    let text = head.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(head).trim_ascii_start();
    match text.first() {
        Some(b'<') => refused("is an HTML or XML page", "download the CSV file itself"),
        Some(b'{' | b'[') => refused("is JSON", "write the table as CSV"),
        _ if head.len() == HEAD && !head.iter().any(|byte| matches!(byte, b'\n' | b'\r')) => {
            refused("has no line end in its first MiB", "write one line per row")
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Repeats the same bytes forever.
    struct Endless(&'static [u8], usize);

    impl Read for Endless {
        fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
            for byte in &mut *buffer {
                *byte = self.0[self.1 % self.0.len()];
                self.1 += 1;
            }
            Ok(buffer.len())
        }
    }

    #[test]
    fn endless_files_and_lines_are_refused() {
        for (text, problem) in [
            (&b"1,2,3\r\n"[..], "larger than 3000000 bytes"),
            (b"1,2,3,", "line longer than 1 MiB"),
        ] {
            let mut bytes = Vec::new();
            let mut reader = content(b"time,xhat1,dxhat1\n".to_vec(), Endless(text, 0), 3_000_000);
            let error = reader.read_to_end(&mut bytes).unwrap_err();
            assert_eq!((error.kind(), &*error.to_string()), (io::ErrorKind::FileTooLarge, problem));
            assert!(bytes.len() <= 3_000_000, "{}", bytes.len());
        }
    }
}
