//! Examines a sample file before it is parsed: its kind, and the separator of its columns.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use crate::files::input::Limited;

/// Maximum size of a file. \[byte\]
const FILE_MAX: u64 = 4 << 30;

/// Maximum length read from a pipe or device, which may be endless: millions of samples. \[byte\]
const STREAM_MAX: u64 = 256 << 20;

/// Maximum length of a line. \[byte\]
const LINE_MAX: usize = 1 << 20;

/// Number of bytes in which the header line must end.
const HEAD: usize = 64 << 10;

/// A problem and a hint.
pub(super) type Refusal = (String, String);

/// Returns the beginning of the file at `path`, and a reader of the whole file.
pub(super) fn open(path: &Path) -> io::Result<(Vec<u8>, impl Read)> {
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
pub(super) fn check_text(head: &[u8]) -> Result<(), Refusal> {
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
        return refused("is empty", "give a file with a header and samples");
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
        Some(b'{' | b'[') => refused("is JSON", "write the samples as CSV"),
        _ if head.len() == HEAD && !head.iter().any(|byte| matches!(byte, b'\n' | b'\r')) => {
            refused("has no line end in its first 64 KiB", "write one line per sample")
        }
        _ => Ok(()),
    }
}

/// Returns the first line that is neither blank nor a comment.
pub(super) fn first_line(head: &[u8]) -> String {
    let text = head.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(head);
    let lines = text.split(|byte| matches!(byte, b'\n' | b'\r')).map(<[u8]>::trim_ascii);
    let first = lines.into_iter().find(|line| !line.is_empty() && !line.starts_with(b"#"));
    String::from_utf8_lossy(first.unwrap_or_default()).into_owned()
}

/// Returns the separator of a header with at least three columns.
///
/// # Errors
/// If columns are separated by spaces, which is not supported.
pub(super) fn delimiter(header: &str) -> Result<u8, Refusal> {
    let columns = |delimiter: u8| {
        let mut reader = csv::ReaderBuilder::new()
            .has_headers(false)
            .delimiter(delimiter)
            .from_reader(header.as_bytes());
        reader.records().next().and_then(Result::ok).map_or(0, |record| record.len())
    };
    // A unit or note may contain a comma, so the separator with the most columns is chosen.
    let best = [b',', b';', b'\t', b'|'].into_iter().max_by_key(|&d| (columns(d), d == b','));
    match best.filter(|&delimiter| columns(delimiter) >= 3) {
        Some(delimiter) => Ok(delimiter),
        None if header.split_whitespace().count() >= 3 => Err((
            "columns are separated by spaces".to_owned(),
            "separate columns with commas, semicolons or tabs".to_owned(),
        )),
        // The missing columns are reported by name later.
        None => Ok(b','),
    }
}

/// Returns the line, from 1, of the record that follows `byte`, on `line`, after blank lines and
/// comments. Returns `line` if the file cannot be read a second time.
pub(super) fn line_of(path: &Path, byte: u64, line: u64) -> u64 {
    let blanks = || -> io::Result<u64> {
        // Opening a named pipe again would wait for another writer.
        if !std::fs::metadata(path)?.is_file() {
            return Ok(0);
        }
        let mut file = File::open(path)?;
        file.seek(SeekFrom::Start(byte))?;
        let mut reader = BufReader::new(file);
        let (mut blanks, mut after_return, mut in_comment) = (0, false, false);
        loop {
            let Some(&next) = reader.fill_buf()?.first() else { return Ok(blanks) };
            match next {
                b'\r' => blanks += 1,
                b'\n' => blanks += u64::from(!after_return),
                b'#' => in_comment = true,
                _ if in_comment => {}
                _ => return Ok(blanks),
            }
            in_comment &= !matches!(next, b'\r' | b'\n');
            after_return = next == b'\r';
            reader.consume(1);
        }
    };
    line + blanks().unwrap_or(0)
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
