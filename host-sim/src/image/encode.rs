//! Encodes images as files.

use std::path::Path;

use ihex::Record;

use super::uf2::{self, Uf2Family};
use super::{ERASED, Image, ImageError, Segment};

/// A file format, as named on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Bytes without addresses; gaps between the segments are filled with blanks.
    Bin,
    /// Intel HEX.
    Hex,
    /// Blocks for the USB drive of a bootloader; requires the chip's family.
    Uf2,
}

impl Format {
    /// Returns the format for the extension of a file name.
    #[must_use]
    pub fn of_file(path: &Path) -> Option<Self> {
        let ending = path.extension()?.to_str()?.to_ascii_lowercase();
        match ending.as_str() {
            "bin" => Some(Self::Bin),
            "hex" | "ihex" => Some(Self::Hex),
            "uf2" => Some(Self::Uf2),
            _ => None,
        }
    }

    /// Returns the format with its chip family, which only UF2 uses.
    ///
    /// # Errors
    /// If the format is UF2 and there is no family.
    pub fn with_family(self, family: Option<Uf2Family>) -> Result<ImageFormat, ImageError> {
        match self {
            Self::Bin => Ok(ImageFormat::Bin),
            Self::Hex => Ok(ImageFormat::Hex),
            Self::Uf2 => family.map(ImageFormat::Uf2).ok_or(ImageError::FamilyMissing),
        }
    }
}

/// A format with all its parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImageFormat {
    /// Bytes without addresses.
    Bin,
    /// Intel HEX.
    Hex,
    /// UF2 blocks for this family of chips.
    Uf2(Uf2Family),
}

/// Data bytes per record of Intel HEX, as most tools write.
const RECORD: usize = 16;

/// Maximum length of an image including blanks: more than any node's flash for weights. \[bytes\]
const LENGTH_MAX: u64 = 256 << 20;

/// Range of addresses that share an upper half.
const HALF: u64 = 1 << 16;

impl Image {
    /// Encodes the image as the content of a file.
    ///
    /// # Errors
    /// If the format is UF2 and a part of the memory map is not a multiple of its blocks, or if the
    /// file would be very long and mostly blank.
    pub fn encode(&self, format: ImageFormat) -> Result<Vec<u8>, ImageError> {
        let unit = match format {
            ImageFormat::Uf2(_) => u64::from(self.region().erase_size),
            ImageFormat::Bin | ImageFormat::Hex => 1,
        };
        let mut spans = self.segments.iter().map(Segment::span);
        let length = match format {
            ImageFormat::Bin => {
                spans.next_back().map_or(0, |last| last.end) - u64::from(self.base())
            }
            _ => spans.map(|span| (span.end - span.start).next_multiple_of(unit)).sum(),
        };
        if length > LENGTH_MAX {
            return Err(ImageError::TooLong { length });
        }
        match format {
            ImageFormat::Bin => Ok(self.bin()),
            ImageFormat::Hex => self.hex(),
            ImageFormat::Uf2(family) => uf2::encode(self, family),
        }
    }

    fn bin(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        for segment in &self.segments {
            bytes.resize((segment.address - self.base()) as usize, ERASED);
            bytes.extend(&segment.bytes);
        }
        bytes
    }

    fn hex(&self) -> Result<Vec<u8>, ImageError> {
        let mut records = Vec::new();
        let mut upper = None;
        for segment in &self.segments {
            let mut rest = segment.bytes.as_slice();
            let mut address = segment.span().start;
            while !rest.is_empty() {
                let (high, low) = ((address / HALF) as u16, (address % HALF) as u16);
                if upper.replace(high) != Some(high) {
                    records.push(Record::ExtendedLinearAddress(high));
                }
                // A record does not cross into the next upper half, because readers disagree on
                // what that means.
                let (now, later) =
                    rest.split_at(rest.len().min(RECORD).min((HALF - u64::from(low)) as usize));
                records.push(Record::Data { offset: low, value: now.to_vec() });
                address += now.len() as u64;
                rest = later;
            }
        }
        records.push(Record::EndOfFile);
        ihex::create_object_file_representation(&records)
            .map(String::into_bytes)
            .map_err(|error| ImageError::Hex(error.to_string()))
    }
}
