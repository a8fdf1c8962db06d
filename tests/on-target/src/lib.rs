//! The bit-exactness examination: hashes the results of `agent-core`, so that a PC, an emulated
//! processor and a chip can be compared with the same constants.
//!
//! [`examine`] runs every section and reports its digest together with the golden one of
//! [`golden::DIGESTS`]. A difference in a single bit of a sum, a comparison or an encoded frame
//! changes the digest of its section.
//!
//! | section | contents |
//! | --- | --- |
//! | `activations` | every activation: special values, seams, a sweep over all floats |
//! | `network` | the package's network, and one with other widths and activations |
//! | `agent` | an agent as a node runs it: frames, trigger, adaptation, faults, restart |
//! | `package` | acceptance and refusal of a weight package, checksums |
//! | `keys` | authentic frames and sealed requests |
//! | `turn` | a whole node of the firmware template: all its broadcasts and messages |
//!
//! Two parts are programs of their own: [`flood`] (feature `flood`): how late the steps of a flooded node
//! are, and `field` (feature `field`): how long a step of the field observer takes.
//!
//! All inputs are derived from integers, and the weights from a package trained on the host
//! (`fixtures/agent1.weights`, agent 1 of `host-sim run paper`, seed 0).
//!
//! A [`Meter`] counts the instructions of a node's frequent operations; a host has no such counter
//! and passes [`NoMeter`].
#![no_std]
#![forbid(unsafe_code)]

mod activations;
mod agent;
mod digest;
mod draw;
#[cfg(feature = "field")]
pub mod field;
pub mod flood;
pub mod golden;
mod keys;
mod meter;
mod network;
mod node;
mod package;
mod turn;

pub use meter::{Figure, Figures, Meter, NoMeter, Statistics};

/// The result of one section.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Section {
    /// Its name.
    pub name: &'static str,
    /// FNV-1a, 64 bits, of every result in it.
    pub digest: u64,
    /// The expected digest.
    pub golden: u64,
}

/// Why the examination cannot be run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Unusable {
    /// The part that could not be set up.
    pub what: &'static str,
}

/// Runs every section and passes its result to `report`; returns the instruction counts.
///
/// # Errors
/// The embedded package is refused or does not match: then nothing can be examined.
pub fn examine(
    meter: &mut impl Meter,
    mut report: impl FnMut(&Section),
) -> Result<Figures, Unusable> {
    let mut figures = Figures::NONE;
    for (name, golden) in golden::DIGESTS {
        let digest = match name {
            "activations" => activations::digest(),
            "network" => network::digest(meter, &mut figures)?,
            "agent" => agent::digest(meter, &mut figures)?,
            "package" => package::digest(meter, &mut figures)?,
            "keys" => keys::digest(meter, &mut figures)?,
            _ => turn::digest(meter, &mut figures)?,
        };
        report(&Section { name, digest, golden });
    }
    Ok(figures)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_host_computes_the_golden_digests() {
        extern crate std;
        let mut sections = 0;
        let mut wrong = std::vec::Vec::new();
        let outcome = examine(&mut NoMeter, |section| {
            sections += 1;
            if section.digest != section.golden {
                wrong.push(std::format!("{} {:#018x}", section.name, section.digest));
            }
        });
        assert_eq!(wrong, [""; 0], "sections whose digests differ from the golden ones");
        assert_eq!(sections, golden::DIGESTS.len());
        for (figure, statistics) in outcome.unwrap().iter() {
            let is_apart = matches!(figure, Figure::Flood | Figure::FieldRate | Figure::FieldModel);
            assert!(statistics.count > 3 || is_apart, "{} is rarely counted", figure.name());
        }
    }

    #[cfg(feature = "field")]
    #[test]
    fn the_field_observer_takes_its_steps() {
        let figures = field::field(&mut NoMeter).unwrap();
        for wanted in [Figure::FieldRate, Figure::FieldModel] {
            let found = figures.iter().find(|(figure, _)| *figure == wanted);
            assert!(found.is_some_and(|(_, statistics)| statistics.count > 50));
        }
    }

    #[test]
    fn a_flooded_node_goes_on() {
        let figures = flood::flood(&mut NoMeter).unwrap();
        let flooded = figures.iter().find(|(figure, _)| *figure == Figure::Flood);
        assert!(flooded.is_some_and(|(_, statistics)| statistics.count > 400));
    }
}
