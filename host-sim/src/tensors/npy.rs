//! The header of a `.npy` array: element type, order and shape.
//!
//! ```text
//! 93 'NUMPY' | major, minor | length of the text, 2 or 4 bytes, little-endian | text
//! ```
//! The text is a Python dictionary with the keys `descr`, `fortran_order` and `shape`. Only this
//! subset of Python is supported; without nesting, no text can exhaust the stack. Source: NumPy's
//! documentation, "NPY format", versions 1.0 to 3.0.

use std::io::{self, Read};

const MAGIC: &[u8; 6] = b"\x93NUMPY";

/// Limit for the length of the text, in bytes: NumPy's own limit for untrusted files.
const TEXT_MAX: usize = 10_000;

/// Array data starts at a multiple of this many bytes (NumPy's `ARRAY_ALIGN`).
const ALIGNMENT: usize = 64;

/// The contents of the text.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Head {
    /// Element type, such as `<f4`.
    pub(super) descr: String,
    /// Whether the first index varies fastest.
    pub(super) fortran_order: bool,
    pub(super) shape: Vec<usize>,
}

impl Head {
    /// Reads a header and leaves `source` at the first element. The error is the reason.
    pub(super) fn read(source: &mut impl Read) -> Result<Self, String> {
        let ended = |error: io::Error| match error.kind() {
            io::ErrorKind::UnexpectedEof => "unexpected end of the header".to_owned(),
            _ => error.to_string(),
        };
        let mut start = [0; 8];
        source.read_exact(&mut start).map_err(ended)?;
        let length = match start {
            [magic @ .., _, _] if magic != *MAGIC => {
                return Err("not a .npy array".to_owned());
            }
            [.., 1, _] => {
                let mut length = [0; 2];
                source.read_exact(&mut length).map_err(ended)?;
                u32::from(u16::from_le_bytes(length))
            }
            [.., 2 | 3, _] => {
                let mut length = [0; 4];
                source.read_exact(&mut length).map_err(ended)?;
                u32::from_le_bytes(length)
            }
            [.., major, minor] => return Err(format!("unknown .npy version {major}.{minor}")),
        };
        let length = usize::try_from(length).unwrap_or(usize::MAX);
        if length > TEXT_MAX {
            return Err(format!("header of {length} bytes exceeds {TEXT_MAX}"));
        }
        let mut text = vec![0; length];
        source.read_exact(&mut text).map_err(ended)?;
        std::str::from_utf8(&text)
            .ok()
            .and_then(|text| Text(text).head())
            .ok_or_else(|| "unsupported header".to_owned())
    }

    /// Returns the bytes of a header, version 1.0, for row-major data.
    pub(super) fn row_major(descr: &str, shape: &[usize]) -> Vec<u8> {
        let extents: Vec<String> = shape.iter().map(usize::to_string).collect();
        // Python writes a tuple of one element with a comma.
        let comma = if shape.len() == 1 { "," } else { "" };
        let shape = extents.join(", ");
        let text =
            format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({shape}{comma}), }}");
        let before = MAGIC.len() + 4;
        // One more byte for the newline.
        let padded = (before + text.len() + 1).next_multiple_of(ALIGNMENT) - before;
        // The dimensions and types written take far less than 65,535 bytes.
        let length = u16::try_from(padded).unwrap_or(u16::MAX);
        let mut head = MAGIC.to_vec();
        head.extend([1, 0]);
        head.extend(length.to_le_bytes());
        head.extend(format!("{text:<width$}\n", width = padded - 1).bytes());
        head
    }
}

/// The rest of the text.
struct Text<'t>(&'t str);

impl<'t> Text<'t> {
    /// Parses the whole dictionary; each key must appear once, in any order.
    fn head(mut self) -> Option<Head> {
        let (mut descr, mut fortran_order, mut shape) = (None, None, None);
        self.symbol("{")?;
        while self.symbol("}").is_none() {
            let key = self.string()?;
            self.symbol(":")?;
            let first = match key {
                "descr" => descr.replace(self.string()?.to_owned()).is_none(),
                "fortran_order" => fortran_order.replace(self.boolean()?).is_none(),
                "shape" => shape.replace(self.tuple()?).is_none(),
                _ => false,
            };
            if !first {
                return None;
            }
            if self.symbol(",").is_none() {
                self.symbol("}")?;
                break;
            }
        }
        let nothing_follows = self.0.trim_ascii().is_empty();
        nothing_follows.then_some(())?;
        Some(Head { descr: descr?, fortran_order: fortran_order?, shape: shape? })
    }

    /// Consumes `symbol` and the blanks before it.
    fn symbol(&mut self, symbol: &str) -> Option<()> {
        self.0 = self.0.trim_ascii_start().strip_prefix(symbol)?;
        Some(())
    }

    fn string(&mut self) -> Option<&'t str> {
        let quote = ["'", "\""].into_iter().find(|quote| self.symbol(quote).is_some())?;
        let (string, rest) = self.0.split_once(quote)?;
        self.0 = rest;
        (!string.contains('\\')).then_some(string)
    }

    fn boolean(&mut self) -> Option<bool> {
        if self.symbol("True").is_some() {
            Some(true)
        } else {
            self.symbol("False").map(|()| false)
        }
    }

    fn tuple(&mut self) -> Option<Vec<usize>> {
        let mut extents = Vec::new();
        self.symbol("(")?;
        while self.symbol(")").is_none() {
            let digits = self.0.trim_ascii_start();
            let end = digits.find(|c: char| !c.is_ascii_digit())?;
            extents.push(digits[..end].parse().ok()?);
            self.0 = &digits[end..];
            if self.symbol(",").is_none() {
                self.symbol(")")?;
                break;
            }
        }
        Some(extents)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with_text(text: &str) -> Vec<u8> {
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((text.len() as u16).to_le_bytes());
        bytes.extend(text.bytes());
        bytes
    }

    #[test]
    fn reads_headers_of_numpy_and_other_writers() {
        for (text, shape, fortran_order) in [
            ("{'descr': '<f4', 'fortran_order': False, 'shape': (3, 4), }   \n", vec![3, 4], false),
            ("{\"shape\":(3,),\"fortran_order\":True,\"descr\":\"<f4\"}", vec![3], true),
            ("{'shape': (), 'descr': '<f4', 'fortran_order': False}", vec![], false),
        ] {
            let head = Head::read(&mut with_text(text).as_slice()).unwrap();
            assert_eq!(head, Head { descr: "<f4".to_owned(), fortran_order, shape }, "{text}");
        }
    }

    #[test]
    fn written_headers_are_aligned_and_read_back() {
        for shape in [&[][..], &[7], &[12, 64], &[1, 2, 3]] {
            let bytes = Head::row_major("<f4", shape);
            assert_eq!(bytes.len() % ALIGNMENT, 0);
            assert_eq!(bytes.last(), Some(&b'\n'));
            let mut rest = bytes.as_slice();
            let head = Head::read(&mut rest).unwrap();
            assert!(rest.is_empty());
            assert_eq!((head.descr.as_str(), head.shape.as_slice()), ("<f4", shape));
            assert!(!head.fortran_order);
        }
    }

    #[test]
    fn rejects_other_python_expressions() {
        let nested = "(".repeat(9_000);
        for text in [
            "",
            "{}",
            "{'descr': '<f4', 'fortran_order': False}",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (3, 4), } x",
            "{'descr': '<f4', 'descr': '<f4', 'fortran_order': False, 'shape': (3, 4)}",
            "{'descr': '<f4', 'fortran_order': 0, 'shape': (3, 4)}",
            "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (3, 4)}",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (-3, 4)}",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (3 4)}",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (99999999999999999999, 4)}",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (3, 4",
            "{'descr': '<f4', 'fortran_order': False, 'shape': 3, 'more': 1}",
            &format!("{{'shape': {nested}"),
        ] {
            let reason = Head::read(&mut with_text(text).as_slice()).unwrap_err();
            assert_eq!(reason, "unsupported header", "{text}");
        }
    }

    #[test]
    fn rejects_oversized_and_truncated_headers() {
        let mut bytes = b"\x93NUMPY\x02\x00".to_vec();
        bytes.extend(u32::MAX.to_le_bytes());
        let reason = Head::read(&mut bytes.as_slice()).unwrap_err();
        assert!(reason.contains("4294967295 bytes exceeds 10000"), "{reason}");
        for (bytes, expected) in [
            (&b"\x93NUMPY\x01\x00\x40"[..], "unexpected end of the header"),
            (b"\x93NUMPY\x01\x00\x40\x00{", "unexpected end of the header"),
            (b"\x93NUMPX\x01\x00\x40\x00", "not a .npy array"),
            (b"\x93NUMPY\x07\x01\x40\x00", "unknown .npy version 7.1"),
        ] {
            assert_eq!(Head::read(&mut &bytes[..]).unwrap_err(), expected);
        }
    }
}
