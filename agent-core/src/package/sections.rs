//! The typed sections of format 2, and decoding them.
//!
//! A section is a kind (`u16`, little-endian), two zero bytes, the length of its content (`u32`) and
//! the content, followed by zero bytes up to a multiple of four. The numbers of the kinds ascend, so
//! no section is there twice. The highest bit of a kind says whether a reader that does not know the
//! section must refuse the package; it is not part of the number.
//!
//! Invariant: a package whose sections are all known has exactly one byte string.

use super::{
    AgentConfig, NeighbourIds, Package, PackageError, Provenance, TEST_VECTORS_MAX, TrialLimits,
    test_vector_length,
};
use crate::agent::exchange::{self, ExchangeParams};
use crate::agent::region::StateBox;
use crate::math::symmetric::MatrixForm;
use crate::observer::network::InnerNetwork;
use crate::observer::outer_law::OuterLawParams;
use crate::observer::projection::ProjectionParams;
use crate::observer::trigger::TriggerParams;
use crate::package::header::Header;
pub use crate::package::wire::REQUIRED;
use crate::package::wire::{Origin, WORD, take};
use crate::wire::codec;

/// Bytes before the content of a section.
pub(super) const SECTION_HEADER_LENGTH: usize = 8;

/// The kinds of sections that this crate knows. Numbers are never reused.
pub mod kind {
    use super::REQUIRED;

    /// Parameters of the inner network.
    pub const INNER: u16 = REQUIRED | 1;
    /// Initial outer weights.
    pub const OUTER_WEIGHTS: u16 = REQUIRED | 2;
    /// Forms of the gains and smoothness, then `C`, `K_1`, `Gamma`, edge weights and neighbours.
    pub const AGENT: u16 = REQUIRED | 3;
    /// Projection, trigger, and the minimum time between broadcasts.
    pub const CONSTANTS: u16 = REQUIRED | 4;
    /// The box of the training inputs.
    pub const TRAINED_BOX: u16 = REQUIRED | 5;
    /// Test vectors.
    pub const TEST_VECTORS: u16 = REQUIRED | 6;
    /// Limits of the trial.
    pub const TRIAL: u16 = 7;
    /// Origin of the network.
    pub const PROVENANCE: u16 = 8;
    /// Exchange with the neighbours; not there if it is the paper's.
    pub const EXCHANGE: u16 = REQUIRED | 9;
    /// Parameters of the field observer; not there for the paper's observer.
    pub const FIELD: u16 = REQUIRED | 10;
    /// The highest number of a section that this crate knows.
    pub(super) const LAST: u16 = 10;
}

/// `theta_0`, `beta`, `delta`, `phi_1`, `phi_2`, `epsilon / N`, least broadcast interval.
const CONSTANTS: usize = 7;

/// Sections that have not been read yet.
struct Sections<'a> {
    rest: &'a [u8],
    /// The number of the section before; numbers start at 1.
    previous: u16,
}

impl<'a> Sections<'a> {
    /// Returns kind and content of the next section; `None` after the last one.
    fn next(&mut self) -> Result<Option<(u16, &'a [u8])>, PackageError> {
        if self.rest.is_empty() {
            return Ok(None);
        }
        self.split().map(Some).ok_or(PackageError::Malformed)
    }

    fn split(&mut self) -> Option<(u16, &'a [u8])> {
        let (&[low, high, 0, 0, l0, l1, l2, l3], rest) =
            self.rest.split_first_chunk::<SECTION_HEADER_LENGTH>()?
        else {
            return None;
        };
        let kind = u16::from_le_bytes([low, high]);
        let number = kind & !REQUIRED;
        let length = u32::from_le_bytes([l0, l1, l2, l3]) as usize;
        let (content, rest) = rest.split_at_checked(length)?;
        let padding = length.wrapping_neg() % WORD;
        let (padding, rest) = rest.split_at_checked(padding)?;
        let is_valid =
            number > self.previous && !content.is_empty() && padding.iter().all(|&byte| byte == 0);
        (self.rest, self.previous) = (rest, number);
        is_valid.then_some((kind, content))
    }
}

/// The contents of the sections that are present; the others are empty.
#[derive(Default)]
struct Contents<'a> {
    inner: &'a [f32],
    outer_weights: &'a [f32],
    agent: &'a [f32],
    constants: &'a [f32],
    trained_box: &'a [f32],
    test_vectors: &'a [f32],
    trial: Option<TrialLimits>,
    exchange: &'a [f32],
    field: &'a [f32],
    /// Undecoded.
    provenance: Option<&'a [u8]>,
}

impl<'a> Contents<'a> {
    fn read(body: &'a [u8]) -> Result<Self, PackageError> {
        let mut sections = Sections { rest: body, previous: 0 };
        let mut found = Self::default();
        while let Some((kind, content)) = sections.next()? {
            let place = match kind {
                kind::INNER => &mut found.inner,
                kind::OUTER_WEIGHTS => &mut found.outer_weights,
                kind::AGENT => &mut found.agent,
                kind::CONSTANTS => &mut found.constants,
                kind::TRAINED_BOX => &mut found.trained_box,
                kind::TEST_VECTORS => &mut found.test_vectors,
                kind::TRIAL => {
                    found.trial = Some(codec::whole(content).ok_or(PackageError::Malformed)?);
                    continue;
                }
                kind::EXCHANGE if exchange::ENABLED => &mut found.exchange,
                kind::FIELD if cfg!(feature = "field") => &mut found.field,
                kind::PROVENANCE => {
                    found.provenance = Some(content);
                    continue;
                }
                unknown if unknown & REQUIRED == 0 && unknown > kind::LAST => continue,
                kind => return Err(PackageError::UnknownSection { kind }),
            };
            if !content.len().is_multiple_of(WORD) {
                return Err(PackageError::Malformed);
            }
            *place = bytemuck::try_cast_slice(content).map_err(|_| PackageError::Alignment)?;
        }
        Ok(found)
    }
}

/// Checks that section `kind` has as many words as expected.
#[inline(never)]
fn expect(kind: u16, expected: usize, found: usize) -> Result<(), PackageError> {
    if expected == found {
        Ok(())
    } else {
        Err(PackageError::SectionLength { kind, expected, found })
    }
}

/// Checks that the numbers of section `kind` are finite.
#[inline(never)]
fn finite(kind: u16, numbers: &[f32]) -> Result<(), PackageError> {
    match numbers.iter().position(|number| !number.is_finite()) {
        Some(index) => Err(PackageError::SectionNotFinite { kind, index }),
        None => Ok(()),
    }
}

/// Decodes the sections in `body`, with the sizes in `header`.
#[inline(always)] // One copy for each way to read the origin.
pub(super) fn decode<'a>(
    header: &Header,
    body: &'a [u8],
    origin: Origin,
) -> Result<Package<'a>, PackageError> {
    let sections = Contents::read(body)?;
    let architecture = header.architecture.clone();
    let (n, features) = (header.dimension, architecture.features());
    let inputs = architecture.inputs();
    let vector_length = test_vector_length(inputs, features, n).max(1);
    let test_vectors = sections.test_vectors.len() / vector_length;
    if test_vectors > TEST_VECTORS_MAX {
        return Err(PackageError::TestVectors { found: test_vectors });
    }
    for (kind, expected, numbers) in [
        (kind::INNER, architecture.parameter_count(), sections.inner),
        (kind::OUTER_WEIGHTS, features * n, sections.outer_weights),
        (kind::CONSTANTS, CONSTANTS, sections.constants),
        (kind::TRAINED_BOX, 2 * inputs, sections.trained_box),
        (kind::TEST_VECTORS, test_vectors * vector_length, sections.test_vectors),
    ] {
        expect(kind, expected, numbers.len())?;
        finite(kind, numbers)?;
    }
    let provenance = match sections.provenance.map(|content| origin.take(content)) {
        None => Provenance::NONE,
        // An unknown one is written as no section.
        Some(Some((Provenance::NONE, []))) if matches!(origin, Origin::Decoded) => {
            return Err(PackageError::Malformed);
        }
        Some(Some((provenance, []))) => provenance,
        _ => return Err(PackageError::Malformed),
    };
    if provenance.errors.is_some_and(|errors| !errors.is_finite()) {
        return Err(PackageError::TrainingErrorNotFinite);
    }
    if sections.trial.is_some_and(|limits| !limits.is_finite()) {
        return Err(PackageError::TrialLimitNotFinite);
    }
    let mut node = agent_config(header, sections.agent, sections.constants)?;
    if !sections.exchange.is_empty() {
        node.exchange = exchange_params(sections.exchange)?;
    }
    node.field = sections.field;
    let (low, high) = sections.trained_box.split_at_checked(inputs).unwrap_or_default();
    Ok(Package {
        epoch: header.serial.epoch,
        version: header.serial.version,
        replaces: None,
        known_inputs: header.known_inputs(),
        outer_weights_on_switch: header.outer_weights_on_switch,
        network: InnerNetwork::verified(architecture, sections.inner),
        outer_weights: sections.outer_weights,
        node,
        broadcast_interval_min: sections.constants.last().copied().unwrap_or(0.0),
        trained_box: StateBox { low, high },
        trial: sections.trial,
        provenance,
        test_vectors: sections.test_vectors,
    })
}

/// Decodes the exchange, whose words are integers.
fn exchange_params(words: &[f32]) -> Result<ExchangeParams, PackageError> {
    expect(kind::EXCHANGE, ExchangeParams::COUNT, words.len())?;
    let words = bytemuck::try_cast_slice(words).map_err(|_| PackageError::Alignment)?;
    let words = words.first_chunk().ok_or(PackageError::Malformed)?;
    match ExchangeParams::from_words(words) {
        // The paper's is written without a section.
        ExchangeParams::PAPER => Err(PackageError::Malformed),
        exchange => Ok(exchange),
    }
}

/// Decodes the sections of the agent, of which `constants` have been checked.
fn agent_config<'a>(
    header: &Header,
    agent: &'a [f32],
    constants: &[f32],
) -> Result<AgentConfig<'a>, PackageError> {
    let (n, features) = (header.dimension, header.architecture.features());
    let missing = PackageError::SectionLength { kind: kind::AGENT, expected: 1, found: 0 };
    let (forms, mut numbers) = agent.split_first().ok_or(missing)?;
    let [gain, outer_gain, smoothness, 0] = forms.to_bits().to_le_bytes() else {
        return Err(PackageError::Malformed);
    };
    let form = |number: u8| {
        MatrixForm::ALL.get(usize::from(number)).copied().ok_or(PackageError::Malformed)
    };
    let (gain, outer_gain) = (form(gain)?, form(outer_gain)?);
    let output_matrix = header.outputs * n;
    let (gains, outer_gains) = (gain.count(n), outer_gain.count(features));
    let count = output_matrix + gains + outer_gains + header.neighbours;
    expect(kind::AGENT, 1 + count + header.neighbours, agent.len())?;
    let numbers = &mut numbers;
    finite(kind::AGENT, numbers.get(..count).unwrap_or_default())?;
    let &[
        radius,
        boundary_layer,
        smoothing,
        hold_error_weight,
        consensus_weight,
        threshold,
        _interval_min,
    ] = constants.first_chunk::<CONSTANTS>().unwrap_or(&[0.0; CONSTANTS]);
    // The order in which the numbers follow each other.
    let output_matrix = take(numbers, output_matrix);
    let gain = gain.matrix(take(numbers, gains));
    let outer_gain = outer_gain.matrix(take(numbers, outer_gains));
    let edge_weights = take(numbers, header.neighbours);
    let neighbours = bytemuck::try_cast_slice(take(numbers, header.neighbours))
        .map_err(|_| PackageError::Alignment)?;
    Ok(AgentConfig {
        agent: header.agent,
        output_matrix,
        gain,
        outer_law: OuterLawParams {
            gain: outer_gain,
            projection: ProjectionParams { radius, boundary_layer, smoothing, smoothness },
        },
        edge_weights,
        neighbours: NeighbourIds::new(neighbours),
        trigger: TriggerParams { hold_error_weight, consensus_weight, threshold },
        step_size: header.step_size,
        exchange: ExchangeParams::PAPER,
        field: &[],
    })
}
