//! The inner network and the outer weights.

use agent_core::StateVector;
use agent_core::math::activation::Activation;
use agent_core::observer::network::{Architecture, InnerNetwork, Layer, Scratch};
use agent_core::observer::outer_law::OuterWeights;

use crate::Unusable;
use crate::digest::Digest;
use crate::draw::Draw;
use crate::meter::{Figure, Figures, Meter};
use crate::node::{FEATURES, N};
use crate::package;

/// Inputs of the package's network.
const INPUTS: u32 = 200;

/// A network of other widths: blocks of every size, with remainders.
const WIDTHS: [(u8, Activation); 4] = [
    (7, Activation::Logistic),
    (29, Activation::Tanh),
    (3, Activation::Gaussian),
    (18, Activation::Tanh),
];

/// Number of parameters of that network with four inputs.
const PARAMETERS: usize = 5 * 7 + 8 * 29 + 30 * 3 + 4 * 18;

/// Not inlined, so that its instructions are those on a node.
#[inline(never)]
fn forward(
    network: &InnerNetwork<&[f32]>,
    outer_weights: &OuterWeights<N, FEATURES>,
    x: &StateVector<N>,
    scratch: &mut Scratch,
    output: &mut StateVector<N>,
) -> bool {
    let Some(features) = network.features(x.as_slice(), scratch) else { return false };
    *output = outer_weights.combine(features);
    true
}

#[inline(never)]
pub(crate) fn digest(meter: &mut impl Meter, figures: &mut Figures) -> Result<u64, Unusable> {
    let mut digest = Digest::NEW;
    let mut scratch = Scratch::NEW;
    paper_sized(meter, figures, &mut scratch, &mut digest)?;
    odd_sized(&mut scratch, &mut digest)?;
    Ok(digest.finish())
}

fn paper_sized(
    meter: &mut impl Meter,
    figures: &mut Figures,
    scratch: &mut Scratch,
    digest: &mut Digest,
) -> Result<(), Unusable> {
    let package = package::package(scratch)?;
    let outer_weights = OuterWeights::new(package.outer_weights, &package.node.outer_law)
        .map_err(|_| Unusable { what: "the package's outer weights are invalid" })?;
    let mut draw = Draw::new(0x0bad_5eed);
    for _ in 0..INPUTS {
        let x = StateVector::from([draw.float(3), draw.float(8), draw.float(1)]);
        let mut output = StateVector::zeros();
        let (evaluated, instructions) =
            meter.count(|| forward(&package.network, &outer_weights, &x, scratch, &mut output));
        figures.add(Figure::Forward, instructions);
        digest.number(evaluated.into());
        if let Some(features) = package.network.features(x.as_slice(), scratch) {
            digest.floats(features);
        }
        digest.floats(&output);
    }
    Ok(())
}

fn odd_sized(scratch: &mut Scratch, digest: &mut Digest) -> Result<(), Unusable> {
    let mut draw = Draw::new(0x0dd5_12e5);
    let mut parameters = [0.0f32; PARAMETERS];
    parameters.fill_with(|| draw.float(1));
    let layers = WIDTHS.map(|(width, activation)| Layer { width, activation });
    let network = Architecture::new(4, &layers)
        .and_then(|architecture| InnerNetwork::new(architecture, parameters))
        .map_err(|_| Unusable { what: "the network of odd widths is refused" })?;
    for _ in 0..20 {
        let x = [draw.float(2), draw.float(2), draw.float(2), draw.float(2)];
        if let Some(features) = network.features(&x, scratch) {
            digest.floats(features);
        }
    }
    Ok(())
}
