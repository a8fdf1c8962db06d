//! The field observer's parameters as words of a package, in the order of the structures here.

use nalgebra::SMatrix;

use super::disturbance::Model;
use super::{Coupling, Direction, FieldParams, HoldKind, Options};
use crate::StateVector;
use crate::math::parameter::{ParameterError, finite};

/// Words before the matrices.
const HEAD: usize = 5;

/// Words of a direction.
const DIRECTION: usize = 11;

/// Stands for no output, parent or spare.
const NONE: u8 = u8::MAX;

/// Returns the number of words for a state of this dimension.
#[must_use]
pub const fn words_length(dimension: usize) -> usize {
    HEAD + 2 * dimension * dimension + 2 * dimension + DIRECTION * dimension
}

/// The words of one direction.
pub type DirectionWords = [f32; DIRECTION];

/// The parameters as words: `bytes` of flags, digest, time-out, kept bias, relay share; `T` and its
/// inverse, row by row; limits; directions.
#[derive(Clone, Copy, Debug)]
pub struct FieldWords<'a>(pub &'a [f32]);

impl Direction {
    /// Returns the direction's words.
    #[must_use]
    pub fn words(&self) -> DirectionWords {
        let place = |place: Option<u8>| place.unwrap_or(NONE);
        let roles = [
            place(self.output),
            place(self.parent),
            place(self.spare),
            u8::from(self.is_announced),
        ];
        let Model { bias_gain, cosine_gain, sine_gain, rotation_cosine, rotation_sine, clip } =
            self.model;
        [
            f32::from_bits(u32::from_le_bytes(roles)),
            self.scale,
            self.root_gain,
            self.tree_gain,
            self.radius,
            bias_gain,
            cosine_gain,
            sine_gain,
            rotation_cosine,
            rotation_sine,
            clip,
        ]
    }

    fn from_words(words: &DirectionWords) -> Option<Self> {
        let &[
            roles,
            scale,
            root_gain,
            tree_gain,
            radius,
            bias_gain,
            cosine_gain,
            sine_gain,
            rotation_cosine,
            rotation_sine,
            clip,
        ] = words;
        let [output, parent, spare, is_announced] = roles.to_bits().to_le_bytes();
        let place = |place: u8| (place != NONE).then_some(place);
        let is_announced = match is_announced {
            0 => false,
            1 => true,
            _ => return None,
        };
        Some(Self {
            output: place(output),
            parent: place(parent),
            spare: place(spare),
            is_announced,
            scale,
            root_gain,
            tree_gain,
            radius,
            model: Model {
                bias_gain,
                cosine_gain,
                sine_gain,
                rotation_cosine,
                rotation_sine,
                clip,
            },
        })
    }
}

impl<const N: usize> FieldParams<N> {
    /// Decodes the parameters; the numbers are not checked against each other.
    ///
    /// # Errors
    /// A wrong number of words, an unknown flag, or a number that is not finite.
    pub fn from_words(FieldWords(words): FieldWords<'_>) -> Result<Self, ParameterError> {
        const PARAMETER: &str = "field";
        let (expected, found) = (words_length(N), words.len());
        let length = ParameterError::Length { parameter: PARAMETER, expected, found };
        if expected != found {
            return Err(length);
        }
        let (&[flags, digest, timeout, bias_kept, relay_share], rest) =
            words.split_first_chunk::<HEAD>().ok_or(length)?;
        let [hold, coupling, flags, 0] = flags.to_bits().to_le_bytes() else {
            return Err(length);
        };
        let hold = *HoldKind::ALL.get(usize::from(hold)).ok_or(length)?;
        let coupling = *Coupling::ALL.get(usize::from(coupling)).ok_or(length)?;
        let digest = u16::try_from(digest.to_bits()).map_err(|_| length)?;
        if flags > 0b1111 {
            return Err(length);
        }
        let (transform, rest) = rest.split_at_checked(N * N).ok_or(length)?;
        let (inverse, rest) = rest.split_at_checked(N * N).ok_or(length)?;
        let (low, rest) = rest.split_first_chunk::<N>().ok_or(length)?;
        let (high, rest) = rest.split_first_chunk::<N>().ok_or(length)?;
        let mut directions = [Direction::NONE; N];
        for (direction, words) in directions.iter_mut().zip(rest.as_chunks().0) {
            *direction = Direction::from_words(words).ok_or(length)?;
            let [_, numbers @ ..] = words;
            finite(PARAMETER, numbers)?;
        }
        for numbers in [&[bias_kept, relay_share][..], transform, inverse, low, high] {
            finite(PARAMETER, numbers)?;
        }
        let options = Options {
            digest,
            hold,
            coupling,
            uses_network: flags & 1 != 0,
            adapts: flags & 2 != 0,
            has_harmonics: flags & 4 != 0,
            is_half: flags & 8 != 0,
            timeout: timeout.to_bits(),
            bias_kept,
            relay_share,
        };
        Ok(Self {
            options,
            transform: from_rows(transform),
            inverse: from_rows(inverse),
            low: StateVector::from(*low),
            high: StateVector::from(*high),
            directions,
        })
    }
}

impl Options {
    /// Returns the words before the matrices.
    #[must_use]
    pub fn words(&self) -> [f32; HEAD] {
        let flags = u8::from(self.uses_network)
            | u8::from(self.adapts) << 1
            | u8::from(self.has_harmonics) << 2
            | u8::from(self.is_half) << 3;
        let kinds = [self.hold as u8, self.coupling as u8, flags, 0];
        [
            f32::from_bits(u32::from_le_bytes(kinds)),
            f32::from_bits(self.digest.into()),
            f32::from_bits(self.timeout),
            self.bias_kept,
            self.relay_share,
        ]
    }
}

impl Direction {
    /// A direction that the agent neither measures nor follows.
    pub const NONE: Self = Self {
        output: None,
        parent: None,
        spare: None,
        is_announced: false,
        scale: 1.0,
        root_gain: 0.0,
        tree_gain: 0.0,
        radius: 1.0,
        model: Model::NONE,
    };
}

/// Returns the matrix with these entries, row by row.
fn from_rows<const N: usize>(entries: &[f32]) -> SMatrix<f32, N, N> {
    let mut matrix = SMatrix::zeros();
    for (column, place) in matrix.data.0.iter_mut().enumerate() {
        for (place, &entry) in place.iter_mut().zip(entries.iter().skip(column).step_by(N)) {
            *place = entry;
        }
    }
    matrix
}
