//! Flash images: a weight package at the address where the firmware looks for it, and for a blank
//! board also its firmware and keys.
//!
//! An image fills one slot of the region that the memory map reserves for weights, and marks this
//! slot as the active one in the commit area:
//!
//! ```text
//! slot          package | 0xFF up to a multiple of 8 bytes        the rest is not part of the image
//! commit area   record  | 0xFF up to its end                      which erases older records
//! ```
//!
//! [`Image::provision`] appends a node's keys to the record; the node's own store writes them, so they
//! are what the node would have recorded. [`Image::with_firmware`] adds the firmware.
//!
//! Only these [`Segment`]s are written, except for padding in two formats:
//!
//! | format | content | padding |
//! | --- | --- | --- |
//! | `hex` | Intel HEX with 32-bit addresses | none: it has gaps |
//! | `uf2` | 512-byte blocks for USB drives | 0xFF up to the end of the package's last erase unit |
//! | `bin` | bytes without addresses | 0xFF between the segments: an image of slot A erases slot B |
//!
//! Invariants, checked for every image regardless of its [`WeightsRegion`]: the segments do not
//! overlap, the package is inside its slot, the firmware is outside the region, and the others are
//! inside. The contents of package and record are not checked.

mod encode;
mod error;
mod firmware;
mod keys;
mod kind;
mod part;
mod ram_flash;
mod tools;
mod uf2;
mod uf2_format;

use std::ops::Range;

pub use encode::{Format, ImageFormat};
pub use error::ImageError;
pub use part::Part;
pub(crate) use ram_flash::RamFlash;
pub use tools::{ToolCommand, ToolUse, commands_for};
pub use uf2::Uf2Family;
pub use uf2_format::UF2_FAMILIES;

use agent_core::store::{Serial, Slot, factory_record};

use crate::memory_map::{ADDRESSES, WeightsRegion};
use crate::packages::PackageBytes;

/// Value of erased flash, for every NOR flash that the store supports.
pub const ERASED: u8 = 0xFF;

/// A package is padded to a multiple of this \[bytes\], the largest write unit of common
/// microcontrollers' flash.
pub const PACKAGE_ALIGNMENT: usize = 8;

/// Name of the firmware's segments.
const FIRMWARE: &str = "the firmware";

/// Name of the journal's segment.
const COMMIT: &str = "the commit area";

/// Bytes and their address.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Segment {
    /// Name, for messages.
    pub name: &'static str,
    /// Address of the first byte.
    pub address: u32,
    /// The bytes, at least one.
    pub bytes: Vec<u8>,
}

impl Segment {
    /// Returns its address range.
    #[must_use]
    pub fn span(&self) -> Range<u64> {
        let start = u64::from(self.address);
        start..start + self.bytes.len() as u64
    }
}

/// The bytes to write and their addresses.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    region: WeightsRegion,
    slot: Slot,
    /// The package, the commit area and any firmware, in order of address.
    segments: Vec<Segment>,
}

impl Image {
    /// Creates an image with `package` in `slot` and `record` at the start of the commit area.
    ///
    /// # Errors
    /// If the package is empty or longer than the slot; if the record is empty, longer than
    /// half of the commit area or not a multiple of [`PACKAGE_ALIGNMENT`]; if a part is outside the region.
    pub fn new(
        region: &WeightsRegion,
        slot: Slot,
        package: &[u8],
        record: &[u8],
    ) -> Result<Self, ImageError> {
        let padded = package.len().next_multiple_of(PACKAGE_ALIGNMENT);
        if package.is_empty() || padded as u64 > region.slot_length.into() {
            return Err(ImageError::PackageLength {
                found: package.len(),
                slot_length: region.slot_length,
            });
        }
        let fits = record.len() as u64 <= u64::from(region.commit_length / 2);
        if record.is_empty() || !record.len().is_multiple_of(PACKAGE_ALIGNMENT) || !fits {
            return Err(ImageError::RecordLength {
                found: record.len(),
                half_length: region.commit_length / 2,
            });
        }
        let filled = |bytes: &[u8], length: usize| {
            let mut filled = bytes.to_vec();
            filled.resize(length, ERASED);
            filled
        };
        let address = match slot {
            Slot::A => region.slot_a,
            Slot::B => region.slot_b,
        };
        let package = Segment { name: "the package", address, bytes: filled(package, padded) };
        let commit = Segment {
            name: COMMIT,
            address: region.commit,
            bytes: filled(record, region.commit_length as usize),
        };
        Self { region: *region, slot, segments: Vec::new() }.with([package, commit])
    }

    /// Adds segments, in order of address.
    fn with(mut self, segments: impl IntoIterator<Item = Segment>) -> Result<Self, ImageError> {
        self.segments.extend(segments);
        self.segments.sort_by_key(|segment| segment.address);
        check(&self.region, &self.segments)?;
        Ok(self)
    }

    /// Creates an image that makes `package`, in `slot`, the active and confirmed one.
    ///
    /// # Errors
    /// Same as [`Self::new`].
    pub fn of_package(
        region: &WeightsRegion,
        slot: Slot,
        package: &PackageBytes,
    ) -> Result<Self, ImageError> {
        let bytes = package.as_bytes();
        let version = package.package().version;
        let serial = Serial { epoch: 0, version };
        Self::new(region, slot, bytes, &factory_record(slot, bytes, Some(serial)))
    }

    /// Returns all segments, in order of address.
    #[must_use]
    pub fn segments(&self) -> &[Segment] {
        &self.segments
    }

    /// Returns the slot that it fills.
    #[must_use]
    pub fn slot(&self) -> Slot {
        self.slot
    }

    /// Returns the region of the weights.
    #[must_use]
    pub fn region(&self) -> &WeightsRegion {
        &self.region
    }

    /// Returns the lowest address of the image, where a `bin` file starts.
    #[must_use]
    pub fn base(&self) -> u32 {
        self.segments[0].address
    }

    /// Returns the gaps between the segments, which a `bin` file fills with blanks.
    pub fn gaps(&self) -> impl Iterator<Item = Range<u64>> {
        self.segments.windows(2).map(|two| two[0].span().end..two[1].span().start)
    }

    /// Whether a `bin` file erases the other slot.
    #[must_use]
    pub fn gap_holds_other_slot(&self) -> bool {
        let other = match self.slot {
            Slot::A => self.region.slot_b,
            Slot::B => self.region.slot_a,
        };
        self.gaps().any(|gap| gap.contains(&other.into()))
    }
}

/// Final check before anything is written: `segments` are in order and disjoint, the firmware is outside
/// the region, and the others are inside.
fn check(region: &WeightsRegion, segments: &[Segment]) -> Result<(), ImageError> {
    let origin = u64::from(region.origin);
    let mut end = 0;
    for segment in segments {
        let Range { start, end: segment_end } = segment.span();
        let is_firmware = segment.name == FIRMWARE;
        let (free_start, free_end) = match is_firmware {
            true if start < origin => (end, origin),
            true => (region.end().max(end), ADDRESSES),
            false => (origin.max(end), region.end()),
        };
        if start < free_start || segment_end > free_end {
            if is_firmware {
                return Err(ImageError::FirmwareOverlaps { start, end: segment_end });
            }
            let name = segment.name;
            return Err(ImageError::Outside {
                name,
                start,
                end: segment_end,
                free_start,
                free_end,
            });
        }
        end = segment_end;
    }
    Ok(())
}
