//! The header of format 2: 128 bytes that say what a package is, and that are signed.
//!
//! | bytes | contents |
//! | --- | --- |
//! | 0..4 | [`MAGIC`](super::MAGIC), 2 |
//! | 4..8, 8..12, 12..16 | agent, epoch, version |
//! | 16..20 | length of the whole package |
//! | 20, 21, 22, 23 | state dimension, network inputs, outputs, inner layers |
//! | 24..40 | width and activation of each layer, zero for those that are not there |
//! | 40..42 | number of neighbours |
//! | 42 | flags: bit 0, the outer weights are replaced on a switch |
//! | 44..48 | step `dt`, binary32 |
//! | 48..52 | CRC-32 of the sections |
//! | 52..84 | digest of the sections: the first 32 bytes of their SHA-512 |
//! | 124..128 | CRC-32 of bytes 0..124, big-endian |
//!
//! All other bytes are zero. A little-endian CRC-32 after the bytes that it covers would leave the
//! CRC-32 of the whole package the same for every header, and nodes tell packages apart by that. The signature block follows, zero if the package is not signed, so that
//! the first [`CHECKED_FIRST`] bytes of a transfer, still in RAM, tell a node whether the package is for it,
//! new, and from its operator, before it erases anything. Cost: two short checksums, and the
//! verification of a signature over 128 bytes.

use super::signature::SIGNATURE_BLOCK_LENGTH;
use super::{Format, OnSwitch, PackageError, Serial};
use crate::AgentId;
use crate::math::activation::Activation;
use crate::observer::network::{Architecture, INNER_LAYERS_MAX, Layer};
use crate::wire::crc::{CHECKSUM_LENGTH, crc32};

/// Length of the header of format 2. \[bytes\]
pub const HEADER2_LENGTH: usize = 128;

/// Number of bytes at the start of a package of format 2 that [`accept_header`](super::accept_header)
/// needs: header and signature block. \[bytes\]
pub const CHECKED_FIRST: usize = HEADER2_LENGTH + SIGNATURE_BLOCK_LENGTH;

/// Length of the digest. \[bytes\]
pub const DIGEST_LENGTH: usize = 32;

/// Where the digest is.
const DIGEST: usize = 52;

/// Bytes of the header that its checksum covers.
const COVERED: usize = HEADER2_LENGTH - CHECKSUM_LENGTH;

/// The flag for [`OnSwitch::Replace`].
const REPLACE: u8 = 1;

/// What the header of a package of format 2 says.
#[derive(Clone, Debug, PartialEq)]
pub struct Header {
    /// The agent that the package is for.
    pub agent: AgentId,
    /// Its epoch and version.
    pub serial: Serial,
    /// Length of the whole package. \[bytes\]
    pub length: u32,
    /// `n`, the dimension of the state.
    pub dimension: usize,
    /// Inputs and inner layers of the network. Its inputs are the state's components, followed by known
    /// inputs of the plant.
    pub architecture: Architecture,
    /// `m`, the number of measured outputs.
    pub outputs: usize,
    /// The number of neighbours.
    pub neighbours: usize,
    /// Whether the adapted outer weights are kept when the package is activated.
    pub outer_weights_on_switch: OnSwitch,
    /// `dt`. \[s\]
    pub step_size: f32,
    /// CRC-32 of the sections.
    pub checksum: u32,
}

impl Header {
    /// Decodes the header at the start of `bytes`, of which it needs [`HEADER2_LENGTH`].
    ///
    /// # Errors
    /// [`PackageError::Length`], [`PackageError::Magic`], [`PackageError::FormatVersion`],
    /// [`PackageError::Checksum`]; [`PackageError::Inputs`], [`PackageError::Network`] or
    /// [`PackageError::Outputs`] for sizes that this crate cannot use; [`PackageError::NotFinite`]
    /// for the step; [`PackageError::Malformed`].
    #[inline(never)]
    pub fn decode(bytes: &[u8]) -> Result<Self, PackageError> {
        Self::parse(bytes, true)
    }

    /// Decodes a header; its checksum is compared only if it `is_in_doubt`.
    pub(super) fn parse(bytes: &[u8], is_in_doubt: bool) -> Result<Self, PackageError> {
        let too_short = PackageError::Length { expected: HEADER2_LENGTH, found: bytes.len() };
        match Format::of(bytes)? {
            Format::Two => {}
            format => return Err(PackageError::FormatVersion { found: format.number() }),
        }
        let header = bytes.first_chunk::<HEADER2_LENGTH>().ok_or(too_short)?;
        let (covered, checksum) = header.split_last_chunk::<CHECKSUM_LENGTH>().ok_or(too_short)?;
        if is_in_doubt && crc32(&[covered]) != u32::from_be_bytes(*checksum) {
            return Err(PackageError::Checksum);
        }
        // 13 words before the digest, 8 of it, 10 that are zero, and the checksum.
        let (words, _) = header.as_chunks::<4>();
        let (known, _) = words.split_first_chunk::<13>().ok_or(too_short)?;
        let &[_, agent, epoch, version, length, sizes, a, b, c, d, counts, step, checksum] = known;
        let reserved = covered.get(DIGEST + DIGEST_LENGTH..).unwrap_or_default();
        let [dimension, inputs, outputs, layers] = sizes;
        let [neighbours_low, neighbours_high, flags, zero] = counts;
        if reserved.iter().any(|&byte| byte != 0) || zero != 0 || flags & !REPLACE != 0 {
            return Err(PackageError::Malformed);
        }
        let architecture = architecture(inputs, layers, &[a, b, c, d])?;
        if inputs < dimension {
            let (inputs, dimension) = (inputs.into(), dimension.into());
            return Err(PackageError::Inputs { inputs, dimension });
        }
        if !(1..=dimension).contains(&outputs) {
            return Err(PackageError::Outputs { found: outputs.into() });
        }
        let step_size = f32::from_le_bytes(step);
        if !step_size.is_finite() {
            return Err(PackageError::NotFinite { index: STEP / 4 });
        }
        let number = u32::from_le_bytes;
        Ok(Self {
            agent: number(agent),
            serial: Serial { epoch: number(epoch), version: number(version) },
            length: number(length),
            dimension: dimension.into(),
            architecture,
            outputs: outputs.into(),
            neighbours: u16::from_le_bytes([neighbours_low, neighbours_high]).into(),
            outer_weights_on_switch: match flags {
                0 => OnSwitch::Keep,
                _ => OnSwitch::Replace,
            },
            step_size,
            checksum: number(checksum),
        })
    }

    /// Returns `p`, the number of known inputs.
    #[must_use]
    pub fn known_inputs(&self) -> usize {
        self.architecture.inputs().saturating_sub(self.dimension)
    }

    /// Returns the bytes of a header with this digest; `None` if there are more neighbours than its
    /// field can hold.
    pub(super) fn encode(&self, digest: &[u8; DIGEST_LENGTH]) -> Option<[u8; HEADER2_LENGTH]> {
        let [low, high] = u16::try_from(self.neighbours).ok()?.to_le_bytes();
        // Bounded by the architecture.
        let (dimension, inputs) = (self.dimension as u8, self.architecture.inputs() as u8);
        let (outputs, layers) = (self.outputs as u8, self.architecture.layers().len() as u8);
        let flags = match self.outer_weights_on_switch {
            OnSwitch::Keep => 0,
            OnSwitch::Replace => REPLACE,
        };
        let Serial { epoch, version } = self.serial;
        let start = [
            Format::Two.magic(),
            self.agent.to_le_bytes(),
            epoch.to_le_bytes(),
            version.to_le_bytes(),
            self.length.to_le_bytes(),
            [dimension, inputs, outputs, layers],
        ];
        let layers = self.architecture.layers().iter();
        let layers = layers.flat_map(|layer| [layer.width, layer.activation as u8]);
        let layers = layers.chain(core::iter::repeat(0)).take(2 * INNER_LAYERS_MAX);
        let end =
            [[low, high, flags, 0], self.step_size.to_le_bytes(), self.checksum.to_le_bytes()];
        let bytes = start.as_flattened().iter().copied().chain(layers);
        let bytes = bytes.chain(end.as_flattened().iter().chain(digest).copied());
        let mut header = [0; HEADER2_LENGTH];
        header.iter_mut().zip(bytes).for_each(|(place, byte)| *place = byte);
        seal(&mut header);
        Some(header)
    }
}

/// Where the step is.
const STEP: usize = 44;

/// Returns the architecture of these layers, two bytes each; those that are not there are zero.
fn architecture(inputs: u8, count: u8, bytes: &[[u8; 4]; 4]) -> Result<Architecture, PackageError> {
    let (pairs, _) = bytes.as_flattened().as_chunks::<2>();
    let count = usize::from(count);
    let mut layers = heapless::Vec::<Layer, INNER_LAYERS_MAX>::new();
    for (index, &[width, activation]) in pairs.iter().enumerate() {
        if index >= count {
            if [width, activation] != [0, 0] {
                return Err(PackageError::Malformed);
            }
            continue;
        }
        let activation = Activation::ALL.get(usize::from(activation)).copied();
        let activation = activation.ok_or(PackageError::Malformed)?;
        layers.push(Layer { width, activation }).map_err(|_| PackageError::Malformed)?;
    }
    if count > layers.len() {
        use crate::observer::network::NetworkError;
        return Err(PackageError::Network(NetworkError::LayerCount { found: count }));
    }
    Architecture::new(inputs.into(), &layers).map_err(PackageError::Network)
}

/// Writes the checksum at the end of a header.
fn seal(header: &mut [u8; HEADER2_LENGTH]) {
    if let Some((covered, checksum)) = header.split_at_mut_checked(COVERED) {
        let sum = crc32(&[covered]).to_be_bytes();
        checksum.iter_mut().zip(sum).for_each(|(place, byte)| *place = byte);
    }
}

/// Returns the digest in a header.
pub(super) fn digest_in(header: &[u8; HEADER2_LENGTH]) -> Option<&[u8; DIGEST_LENGTH]> {
    header.get(DIGEST..)?.first_chunk()
}

/// Returns the digest of the sections of a package of format 2: the first 32 bytes of their
/// SHA-512 (FIPS 180-4).
// A node without a public key never calls this, so the linker leaves the hash out.
#[must_use]
pub fn digest(sections: &[u8]) -> [u8; DIGEST_LENGTH] {
    let hash = ed25519_compact::sha512::Hash::hash(sections);
    let mut digest = [0; DIGEST_LENGTH];
    digest.iter_mut().zip(hash).for_each(|(place, byte)| *place = byte);
    digest
}

/// Gives an unsigned or signed package of format 2 another epoch and version, in place, and removes
/// its signature, which was for the old ones. Its sections stay as they are, including unknown ones.
///
/// # Errors
/// If `bytes` do not start with the header of a package of format 2.
pub fn set_serial(bytes: &mut [u8], serial: Serial) -> Result<(), PackageError> {
    Header::decode(bytes)?;
    let found = bytes.len();
    let too_short = PackageError::Length { expected: CHECKED_FIRST, found };
    let (header, rest) = bytes.split_first_chunk_mut::<HEADER2_LENGTH>().ok_or(too_short)?;
    let block = rest.first_chunk_mut::<SIGNATURE_BLOCK_LENGTH>().ok_or(too_short)?;
    let numbers = [serial.epoch.to_le_bytes(), serial.version.to_le_bytes()];
    let places = header.iter_mut().skip(EPOCH);
    places.zip(numbers.as_flattened()).for_each(|(place, byte)| *place = *byte);
    seal(header);
    block.fill(0);
    Ok(())
}

/// Where the epoch is, followed by the version.
const EPOCH: usize = 8;
