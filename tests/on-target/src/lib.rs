//! The bit-exactness examination: what `agent-core` computes, hashed, so that a PC, an emulated
//! processor and a chip can be held against the same constants.
//!
//! [`examine`] runs every section and reports its digest beside the golden one of
//! [`golden::DIGESTS`]. Whatever differs in a single bit anywhere, in a sum, a comparison or an
//! encoded frame, changes the digest of its section.
//!
//! | section | what is in it |
//! | --- | --- |
//! | `activations` | every activation: special values, seams, a sweep over all floats |
//! | `network` | the package's network, and one with other widths and activations |
//! | `agent` | an agent as a node runs it: frames, trigger, adaptation, faults, restart |
//! | `package` | acceptance and refusal of a weight package, checksums |
//! | `turn` | a whole node of the firmware template: all that it broadcasts and tells |
//!
//! Inputs come from integers alone, and the weights from a package that the host's training
//! made (`fixtures/agent1.weights`, agent 1 of `host-sim run paper`, seed 0).
//!
//! On the way a [`Meter`] counts the instructions of what a node does again and again; a host has
//! no such counter and passes [`NoMeter`].
#![no_std]
#![forbid(unsafe_code)]

mod activations;
mod agent;
mod digest;
mod draw;
pub mod golden;
mod meter;
mod network;
mod node;
mod package;
mod turn;

pub use meter::{Figure, Figures, Meter, NoMeter, Statistics};

/// The outcome of one section.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Section {
    /// Its name.
    pub name: &'static str,
    /// FNV-1a, 64 bits, of every result in it.
    pub digest: u64,
    /// What the digest has to be.
    pub golden: u64,
}

/// What an examination can fail on before anything has been compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Unusable {
    /// What could not be set up.
    pub what: &'static str,
}

/// Runs every section and shows its outcome to `report`; returns what the meter counted.
///
/// # Errors
/// The embedded package is refused or does not fit: then nothing can be examined.
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
        assert_eq!(wrong, [""; 0], "sections with other digests than the golden ones");
        assert_eq!(sections, golden::DIGESTS.len());
        for (figure, statistics) in outcome.unwrap().iter() {
            assert!(statistics.count > 3, "{} is hardly ever counted", figure.name());
        }
    }
}
