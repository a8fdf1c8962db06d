//! The memory map as the firmware sees it: the symbols of `memory.x`.

/// The addresses of the symbols that every `memory.x` defines, for [`memory_map!`](crate::memory_map).
#[derive(Clone, Copy, Debug)]
pub struct Symbols {
    /// Start of slot A and slot B.
    pub slots: [usize; 2],
    /// Length of each slot. \[byte\]
    pub slot_length: usize,
    /// Start of the commit area.
    pub commit: usize,
    /// Length of the commit area. \[byte\]
    pub commit_length: usize,
}

/// A region of flash for weight packages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WeightsRegion {
    /// Address of the first byte.
    pub origin: usize,
    /// Length up to the end of the last part. \[byte\]
    pub length: usize,
    /// Positions of the parts, relative to `origin`.
    pub layout: agent_core::store::Layout,
}

impl Symbols {
    /// Returns the region from its first part to the end of its last one.
    #[must_use]
    pub fn region(&self) -> WeightsRegion {
        let Self { slots: [a, b], slot_length, commit, commit_length } = *self;
        let origin = a.min(b).min(commit);
        let end = |start: usize, length: usize| start.wrapping_add(length);
        let length = end(a, slot_length).max(end(b, slot_length)).max(end(commit, commit_length));
        // Addresses have 32 bits on all firmware targets.
        let offset = |address: usize| address.wrapping_sub(origin) as u32;
        WeightsRegion {
            origin,
            length: length.wrapping_sub(origin),
            layout: agent_core::store::Layout {
                slots: [offset(a), offset(b)],
                slot_length: slot_length as u32,
                commit: offset(commit),
                commit_length: commit_length as u32,
            },
        }
    }
}

/// Returns the [`Symbols`] of the `memory.x` that the program is linked with.
///
/// Declares the symbols as external, which requires `unsafe` at the call site; they are never read
/// or written.
#[macro_export]
macro_rules! memory_map {
    () => {{
        // SAFETY: memory.x defines these symbols, and only their addresses are taken.
        unsafe extern "C" {
            safe static _weights_slot_a_origin: u8;
            safe static _weights_slot_a_length: u8;
            safe static _weights_slot_b_origin: u8;
            safe static _weights_commit_origin: u8;
            safe static _weights_commit_length: u8;
        }
        $crate::Symbols {
            slots: [
                (&raw const _weights_slot_a_origin).addr(),
                (&raw const _weights_slot_b_origin).addr(),
            ],
            slot_length: (&raw const _weights_slot_a_length).addr(),
            commit: (&raw const _weights_commit_origin).addr(),
            commit_length: (&raw const _weights_commit_length).addr(),
        }
    }};
}
