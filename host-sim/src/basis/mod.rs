//! What the outer weights of a simulated agent combine: the features of its inner network, or a
//! baseline's in their place.
//!
//! | method | features | outer weights |
//! | --- | --- | --- |
//! | observer | the network's | adapt |
//! | `known-f` | `f(t, x)` | the identity, constant |
//! | `regression` | cubic monomials of the scaled state | fitted by least squares; adapt |
//!
//! Known inputs of the plant, if there are any, follow the state in network and monomials; `f` takes them, too.
//!
//! Packages of the baselines carry a placeholder network with the right number of features, so everything
//! else about an agent is the same as with the observer.

mod polynomial;

use std::sync::Arc;

use agent_core::math::activation::Activation;
use agent_core::observer::features::Features;
use agent_core::observer::network::{Architecture, InnerNetwork, Layer, Scratch};
use agent_core::package::Package;

use crate::plant::{DIMENSION_MAX, Plant};
use crate::scenario::{Method, Network, OuterGain, OuterLaw, Scenario};
use crate::training::InitialParameters;
pub use polynomial::Polynomial;

/// A network whose parameters may be those of other agents, too.
pub type SharedNetwork = InnerNetwork<Arc<[f32]>>;

/// What the outer weights combine.
#[derive(Clone, Debug)]
pub enum Basis<'s> {
    /// The inner network.
    Network(SharedNetwork),
    /// The plant's `f`.
    Known(KnownModel<'s>),
    /// Polynomials.
    Polynomial(Polynomial),
}

impl Basis<'_> {
    /// Sets the time at which the plant is evaluated. \[s\]
    #[inline]
    pub fn set_time(&mut self, time: f64) {
        if let Self::Known(model) = self {
            model.time = time;
        }
    }
}

impl Basis<'_> {
    /// Adds `W_hat^T sigma(x)` to `f`, shape `[n]`. `outer_weights` are row-major, shape `[L, n]`.
    pub fn combine(&self, outer_weights: &[f32], x: &[f32], f: &mut [f64]) {
        let mut scratch = Scratch::NEW;
        let Some(features) = self.features(x, &mut scratch) else { return };
        for (feature, row) in features.iter().zip(outer_weights.chunks_exact(f.len().max(1))) {
            for (f, weight) in f.iter_mut().zip(row) {
                *f += f64::from(feature * weight);
            }
        }
    }
}

impl Features for Basis<'_> {
    #[inline]
    fn inputs(&self) -> usize {
        match self {
            Self::Network(network) => network.inputs(),
            Self::Known(model) => model.plant.dimension(),
            Self::Polynomial(polynomial) => polynomial.dimension(),
        }
    }

    #[inline]
    fn count(&self) -> usize {
        match self {
            Self::Network(network) => network.count(),
            Self::Known(model) => model.plant.dimension(),
            Self::Polynomial(polynomial) => polynomial.count(),
        }
    }

    #[inline]
    fn features<'s>(&'s self, x: &[f32], scratch: &'s mut Scratch) -> Option<&'s [f32]> {
        match self {
            Self::Network(network) => network.features(x, scratch),
            Self::Known(model) => model.features(x, scratch.outputs()),
            Self::Polynomial(polynomial) => polynomial.features(x, scratch.outputs()),
        }
    }

    #[inline]
    fn adapts(&self) -> bool {
        !matches!(self, Self::Known(_))
    }
}

/// The plant's drift at a time.
#[derive(Clone, Copy, Debug)]
pub struct KnownModel<'s> {
    plant: &'s Plant,
    time: f64,
}

impl<'s> KnownModel<'s> {
    /// Creates the model at time 0.
    #[must_use]
    pub fn new(plant: &'s Plant) -> Self {
        Self { plant, time: 0.0 }
    }

    fn features<'f>(&self, x: &[f32], outputs: &'f mut [f32]) -> Option<&'f [f32]> {
        let n = self.plant.dimension();
        if x.len() != n {
            return None;
        }
        let (mut state, mut rate) = ([0.0; DIMENSION_MAX], [0.0; DIMENSION_MAX]);
        state.iter_mut().zip(x).for_each(|(state, &x)| *state = f64::from(x));
        self.plant.derivative(self.time, &state[..n], &mut rate[..n]);
        let outputs = outputs.get_mut(..n)?;
        outputs.iter_mut().zip(&rate).for_each(|(output, &rate)| *output = rate as f32);
        Some(outputs)
    }
}

/// A basis in a step, at whose time the plant and its known inputs are evaluated.
#[derive(Clone, Debug)]
pub struct Driven<'s> {
    basis: Basis<'s>,
    /// The known inputs that the basis takes in addition to the state, shape `[p]`.
    known: Vec<f32>,
}

impl<'s> Driven<'s> {
    /// Creates a basis for states with `n` components, at time 0.
    #[must_use]
    pub fn new(basis: Basis<'s>, n: usize) -> Self {
        let known = vec![0.0; basis.inputs().saturating_sub(n)];
        Self { basis, known }
    }

    /// Continues at `time` \[s\].
    #[inline]
    pub fn set_time(&mut self, plant: &Plant, time: f64) {
        self.basis.set_time(time);
        if !self.known.is_empty() {
            let known = plant.known_inputs(time);
            self.known.iter_mut().zip(known.iter()).for_each(|(own, &u)| *own = u as f32);
        }
    }

    /// Whether a known input has no value that the basis can take.
    #[inline]
    #[must_use]
    pub fn lacks_input(&self) -> bool {
        !self.known.iter().all(|u| u.is_finite())
    }

    /// Returns the polynomial, if that is what the outer weights combine, and the known inputs.
    #[must_use]
    pub fn polynomial(&self) -> Option<(&Polynomial, &[f32])> {
        match &self.basis {
            Basis::Polynomial(polynomial) => Some((polynomial, &self.known)),
            _ => None,
        }
    }

    /// Returns the network, if that is what the outer weights combine.
    #[inline]
    #[must_use]
    pub fn network(&self) -> Option<&SharedNetwork> {
        match &self.basis {
            Basis::Network(network) => Some(network),
            _ => None,
        }
    }
}

impl Features for Driven<'_> {
    #[inline]
    fn inputs(&self) -> usize {
        self.basis.inputs() - self.known.len()
    }

    #[inline]
    fn count(&self) -> usize {
        self.basis.count()
    }

    #[inline]
    fn features<'s>(&'s self, x: &[f32], scratch: &'s mut Scratch) -> Option<&'s [f32]> {
        if self.known.is_empty() {
            return self.basis.features(x, scratch);
        }
        let mut inputs = [0.0; DIMENSION_MAX];
        let (states, known) = inputs.get_mut(..x.len() + self.known.len())?.split_at_mut(x.len());
        states.copy_from_slice(x);
        known.copy_from_slice(&self.known);
        let count = x.len() + self.known.len();
        self.basis.features(inputs.get(..count)?, scratch)
    }

    #[inline]
    fn adapts(&self) -> bool {
        self.basis.adapts()
    }
}

/// Returns what an agent with this package combines, if the scenario's method has something other than
/// the package's network.
#[must_use]
pub fn substitute<'s>(scenario: &'s Scenario, package: &Package<'_>) -> Option<Basis<'s>> {
    match scenario.method {
        Method::KnownModel => Some(Basis::Known(KnownModel::new(&scenario.plant))),
        Method::Regression => {
            let region = &package.trained_box;
            Some(Basis::Polynomial(Polynomial::new(region.low, region.high)))
        }
        _ => None,
    }
}

/// Bound of the outer weights that replaces the scenario's for fitted polynomials: their coefficients are
/// not those of a network.
const POLYNOMIAL_BOUND: f64 = 1e4;

/// Returns the network that stands in packages for the features of the scenario's method: as many
/// features, and the outer weights to start with. `None` if the method uses the scenario's own network.
///
/// # Panics
/// If the plant has more states and inputs than an architecture has inputs, which a loaded scenario excludes.
#[must_use]
pub fn placeholder(scenario: &Scenario) -> Option<Network> {
    let n = scenario.dimension();
    let mut inputs = n;
    let (features, outer, outer_law) = match scenario.method {
        Method::KnownModel => {
            let outer = (0..n * n).map(|place| if place % (n + 1) == 0 { 1.0 } else { 0.0 });
            (n, outer.collect(), law(OuterGain::Scalar(1.0), 2.0 * n as f64))
        }
        Method::Regression => {
            inputs += scenario.plant.input_names().len();
            let features = polynomial::count(inputs);
            let gain = match scenario.network.as_ref().map(|network| &network.outer_law.gain) {
                Some(OuterGain::Scalar(gain)) => *gain,
                Some(OuterGain::Diagonal(diagonal)) => mean(diagonal.iter()),
                Some(OuterGain::Full(gain)) => mean(gain.diagonal().iter()),
                None => 1.0,
            };
            let outer = vec![0.0; features * n];
            (features, outer, law(OuterGain::Scalar(gain), POLYNOMIAL_BOUND))
        }
        _ => return None,
    };
    let layer = Layer { width: features as u8, activation: Activation::Tanh };
    let architecture =
        Architecture::new(inputs, &[layer]).expect("a plant's number of inputs and 64 features");
    Some(Network { architecture, inner: InitialParameters::Constant(0.0), outer, outer_law })
}

fn mean<'v>(values: impl ExactSizeIterator<Item = &'v f64>) -> f64 {
    let count = values.len().max(1) as f64;
    values.fold(0.0, |sum, value| sum + value) / count
}

fn law(gain: OuterGain, bound: f64) -> OuterLaw {
    OuterLaw { gain, bound, boundary_layer: 1.0, smoothing: 0.1, smoothness: 1 }
}
