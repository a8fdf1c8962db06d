//! Recognises kinds of files by their content.

use std::fmt;
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// A kind of file. Each format defines its own, next to the code that writes it.
#[derive(Clone, Copy)]
pub struct FileKind {
    /// Its name, with an article: "a weight package".
    pub name: &'static str,
    /// Whether these bytes, the first [`FileKind::BYTES_MAX`] of a file, are of this kind.
    pub recognises: fn(&[u8]) -> bool,
}

impl FileKind {
    /// Number of bytes checked: more than the largest package or network. \[bytes\]
    pub const BYTES_MAX: u64 = 4 << 20;

    /// A file that never replaces another.
    pub const NEW: Self = Self { name: "empty", recognises: |_| false };

    /// A CSV file written by this program, recognised by the name of its first column.
    pub const TABLE: Self = Self {
        name: "a table written by this program",
        recognises: |bytes| {
            let line = bytes.split(|&byte| byte == b'\n').next().unwrap_or_default();
            let columns = line.split(|&byte| byte == b',');
            let first = columns.clone().next().unwrap_or_default().trim_ascii();
            [b"agent".as_slice(), b"time [s]", b"form", b"method", b"seed"].contains(&first)
                && columns.count() > 1
        },
    };

    /// An SVG picture.
    pub const SVG: Self = Self {
        name: "an SVG picture",
        recognises: |bytes| {
            let head = String::from_utf8_lossy(&bytes[..bytes.len().min(1024)]);
            let head = head.trim_start();
            head.starts_with("<svg") || head.starts_with("<?xml") && head.contains("<svg")
        },
    };

    /// A PNG picture.
    pub const PNG: Self =
        Self { name: "a PNG picture", recognises: |bytes| bytes.starts_with(b"\x89PNG\r\n\x1a\n") };

    /// A Parquet file.
    pub const PARQUET: Self =
        Self { name: "a Parquet file", recognises: |bytes| bytes.starts_with(b"PAR1") };

    /// A PDF document.
    pub const PDF: Self =
        Self { name: "a PDF document", recognises: |bytes| bytes.starts_with(b"%PDF-") };

    /// Whether `path` is a regular file with this kind of content; not if it is empty.
    #[must_use]
    pub fn is_at(&self, path: &Path) -> bool {
        path.metadata().is_ok_and(|found| found.is_file() && found.len() > 0) && self.replaces(path)
    }

    /// Whether a regular file can be replaced by one of this kind: it is empty, or of the same
    /// kind.
    #[must_use]
    pub fn replaces(&self, path: &Path) -> bool {
        let mut bytes = Vec::new();
        let read =
            File::open(path).and_then(|file| file.take(Self::BYTES_MAX).read_to_end(&mut bytes));
        read.is_ok() && (bytes.is_empty() || (self.recognises)(&bytes))
    }
}

impl fmt::Debug for FileKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "FileKind({})", self.name)
    }
}
