//! `method` and `[kalman]`.

use crate::plant::Plant;
use crate::scenario::error::ScenarioError;
use crate::scenario::reader::Table;

/// How agents estimate the state: the observer, or something to compare it with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Method {
    /// The observer that the scenario describes.
    #[default]
    Observer,
    /// The observer without a network: feedback and consensus alone.
    NoNetwork,
    /// The observer with its initial network, of which only the outer weights adapt.
    Untrained,
    /// The observer, which broadcasts at fixed times instead of at events, equally often on average.
    Periodic,
    /// The observer with cubic polynomials of the state in place of the network, fitted by least
    /// squares to the samples that the network is trained on.
    Regression,
    /// The observer with the plant's `f` in place of the network.
    KnownModel,
    /// An event-triggered consensus Kalman filter, with `f` linearised at the plant's mean state.
    Kalman,
    /// An event-triggered consensus Kalman filter, with `f` linearised at the estimate.
    ExtendedKalman,
}

impl Method {
    /// All methods with their names.
    pub const NAMES: [(&'static str, Self); 8] = [
        ("observer", Self::Observer),
        ("no-network", Self::NoNetwork),
        ("untrained", Self::Untrained),
        ("periodic", Self::Periodic),
        ("regression", Self::Regression),
        ("known-f", Self::KnownModel),
        ("kalman", Self::Kalman),
        ("extended-kalman", Self::ExtendedKalman),
    ];

    /// Returns its name in scenarios and results.
    #[must_use]
    pub fn name(self) -> &'static str {
        let named = Self::NAMES.iter().find(|(_, method)| *method == self);
        named.map_or("observer", |(name, _)| name)
    }

    /// Returns what it knows of the plant that the observer does not, or what it goes without.
    #[must_use]
    pub fn knows(self) -> &'static str {
        match self {
            Self::Observer => "samples of its own estimates",
            Self::NoNetwork => "nothing of f",
            Self::Untrained => "nothing about f until it adapts",
            Self::Periodic => "samples of its own estimates, and how often the observer broadcasts",
            Self::Regression => "samples of its own estimates",
            Self::KnownModel => "f exactly, not the disturbance",
            Self::Kalman => "f near the mean state; the size of the disturbance and the noise",
            Self::ExtendedKalman => "f exactly; the size of the disturbance and the noise",
        }
    }

    /// Returns how many runs it takes: fixed times are chosen after a run at events.
    #[must_use]
    pub fn runs(self) -> u64 {
        if self == Self::Periodic { 2 } else { 1 }
    }

    /// Whether it evaluates `f`.
    #[must_use]
    pub fn knows_f(self) -> bool {
        self.is_kalman() || self == Self::KnownModel
    }

    /// Whether it is a Kalman filter, which runs without the agents' core.
    #[must_use]
    pub fn is_kalman(self) -> bool {
        matches!(self, Self::Kalman | Self::ExtendedKalman)
    }
}

/// Settings of the Kalman filters; `None` is derived from the scenario.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct KalmanSettings {
    /// Intensity of the noise that stands for the disturbance. \[state unit/sqrt(s)\]
    pub process_noise: Option<f64>,
    /// Standard deviation of a measurement. \[output unit\]
    pub measurement_noise: Option<f64>,
    /// Gain of the consensus term relative to the covariance. \[1/s\]
    pub consensus_gain: Option<f64>,
    /// Radius of the trigger. \[state unit\]
    pub radius: Option<f64>,
}

pub(in crate::scenario) fn method(
    root: &Table<'_>,
    has_network: bool,
    learns: bool,
    plant: &Plant,
) -> Result<Method, ScenarioError> {
    let Some(value) = root.get("method", "\"observer\"") else { return Ok(Method::default()) };
    let method = value.choice(&Method::NAMES)?;
    if matches!(method, Method::Regression | Method::Untrained) && !has_network {
        return Err(value.error(
            "there is no network to compare with",
            "add [network] and [outer_law], or choose another method",
        ));
    }
    if method == Method::Regression && !learns {
        return Err(value.error(
            "there is no learning cycle whose samples it could fit",
            "add [[learning]], or choose another method",
        ));
    }
    if method.knows_f() && plant.recording().is_some() {
        return Err(value.error(
            "a recording does not define f",
            "choose a method that does not know it, such as no-network",
        ));
    }
    Ok(method)
}

pub(in crate::scenario) fn kalman(root: &Table<'_>) -> Result<KalmanSettings, ScenarioError> {
    let Some(table) = root.get_table("kalman")? else { return Ok(KalmanSettings::default()) };
    table.only(&["process_noise", "measurement_noise", "consensus_gain", "radius"])?;
    let positive = |key: &str, example: &str| {
        table.get(key, example).map(|value| value.positive()).transpose()
    };
    let consensus = table.get("consensus_gain", "10.0").map(|value| value.not_negative());
    let radius = table.get("radius", "0.05").map(|value| value.not_negative());
    Ok(KalmanSettings {
        process_noise: positive("process_noise", "1.0")?,
        measurement_noise: positive("measurement_noise", "0.01")?,
        consensus_gain: consensus.transpose()?,
        radius: radius.transpose()?,
    })
}
