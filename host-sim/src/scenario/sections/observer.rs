//! `[observer]`: the field observer in place of the paper's.

use agent_core::NODE_DIMENSION_MAX;
use agent_core::agent::exchange::ExchangeParams;
use agent_core::observer::field::{Coupling, HoldKind};

use super::run::check_before_end;
use crate::number::significant;
use crate::scenario::Time;
use crate::scenario::error::ScenarioError;
use crate::scenario::reader::{STATE, Table, Value};

/// The field observer. What is `None` is derived from the plant's own trajectory; see
/// `docs/field-observer.md`.
#[derive(Clone, Debug, PartialEq)]
pub struct ObserverSettings {
    /// When agents switch to it. \[s\]
    pub from: f64,
    /// The requested error, as a fraction of the state's standard deviation.
    pub error: f64,
    /// How agents are coupled.
    pub coupling: Coupling,
    /// How samples evolve between broadcasts.
    pub hold: Option<HoldKind>,
    /// Whether the network is used once it is trained.
    pub network: bool,
    /// Whether the outer weights adapt.
    pub adapts: bool,
    /// Gain of the agent's own innovation, one for each direction. \[1/s\]
    pub root_gain: Option<Vec<f64>>,
    /// Gain towards neighbours' samples, one for each direction. \[1/s\]
    pub tree_gain: Option<Vec<f64>>,
    /// Radius of the trigger, one for each direction. \[unit of `xi`\]
    pub radius: Option<Vec<f64>>,
    /// The disturbance model of the agents that measure a direction.
    pub disturbance: DisturbanceModel,
    /// Largest disturbance estimate, one for each direction. \[unit of `xi`/s\]
    pub clip: Option<Vec<f64>>,
    /// Decay of announced biases. \[1/s\]
    pub bias_decay: Option<f64>,
    /// Whether frames carry numbers in half precision.
    pub is_half: bool,
    /// Share of the radius at which a relay passes on its parent's sample.
    pub relay_share: f64,
    /// Age of a parent's sample at which another parent is followed; 0 for never. \[s\]
    pub timeout: f64,
    /// The exchange of the preset "robust", from the switch on; the scenario's if `None`.
    pub exchange: Option<ExchangeParams>,
}

/// What agents assume of the disturbance of a direction that they measure.
#[derive(Clone, Debug, PartialEq)]
pub enum DisturbanceModel {
    /// Nothing.
    None,
    /// It changes slowly.
    Bias {
        /// `omega_b`; derived if `None`. \[rad/s\]
        bandwidth: Option<f64>,
    },
    /// It changes slowly and oscillates.
    Harmonic {
        /// `omega_b`. \[rad/s\]
        bandwidth: f64,
        /// `omega_h`. \[rad/s\]
        harmonic_bandwidth: f64,
        /// Square root of the density of noise on the state itself. \[1/s\]
        process: f64,
        /// The frequency in each direction, 0 for none; found while learning if `None`. \[rad/s\]
        frequencies: Option<Vec<f64>>,
    },
}

impl ObserverSettings {
    /// Returns the settings of an empty `[observer]` in a scenario with a network, from a time on
    /// \[s\].
    #[must_use]
    pub fn derived(from: f64) -> Self {
        Self {
            from,
            error: ERROR,
            coupling: Coupling::Trees,
            hold: None,
            network: true,
            adapts: false,
            root_gain: None,
            tree_gain: None,
            radius: None,
            disturbance: DisturbanceModel::Bias { bandwidth: None },
            clip: None,
            bias_decay: None,
            is_half: false,
            relay_share: RELAY_SHARE,
            timeout: 0.0,
            exchange: None,
        }
    }

    /// Whether gains and radii are all given, so that nothing has to be derived.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        let root = self.root_gain.is_some()
            || matches!(
                self.disturbance,
                DisturbanceModel::Harmonic { .. } | DisturbanceModel::Bias { bandwidth: Some(_) }
            );
        let clip = self.clip.is_some() || self.disturbance == DisturbanceModel::None;
        root && clip && self.tree_gain.is_some() && self.radius.is_some()
    }

    /// Whether directions have the state's units: they are scaled by the data only if radii are
    /// derived.
    #[must_use]
    pub fn is_in_state_units(&self) -> bool {
        self.radius.is_some()
    }
}

/// Default of `error`: the paper's own error, in standard deviations of its state.
const ERROR: f64 = 0.014;

/// Default of `relay_share`.
const RELAY_SHARE: f64 = 0.9;

#[derive(Clone, Copy, PartialEq)]
enum Preset {
    Paper,
    Field,
    Robust,
}

const KEYS: [&str; 17] = [
    "preset",
    "from",
    "error",
    "coupling",
    "hold",
    "network",
    "adapts",
    "root_gain",
    "tree_gain",
    "radius",
    "disturbance",
    "bandwidth",
    "harmonic_bandwidth",
    "process",
    "frequencies",
    "clip",
    "bias_decay",
];

/// Reads `[observer]` for a state of dimension `n`; `None` for the paper's observer. The second value
/// says whether the exchange of the preset "robust" is asked for.
pub(in crate::scenario) fn observer(
    root: &Table<'_>,
    time: &Time,
    n: usize,
    has_network: bool,
) -> Result<(Option<ObserverSettings>, bool), ScenarioError> {
    let Some(table) = root.get_table("observer")? else { return Ok((None, false)) };
    let known: Vec<&str> =
        KEYS.iter().copied().chain(["precision", "relay_share", "timeout"]).collect();
    table.only(&known)?;
    let presets = [("paper", Preset::Paper), ("field", Preset::Field), ("robust", Preset::Robust)];
    let preset = table
        .get("preset", "\"field\"")
        .map_or(Ok(Preset::Field), |value| value.choice(&presets))?;
    if preset == Preset::Paper {
        let mut others = known.iter().filter(|&&key| key != "preset");
        if let Some(value) = others.find_map(|key| table.get(key, "")) {
            let hint = "remove it, or use preset = \"field\"";
            return Err(value.error("has no effect with preset = \"paper\"", hint));
        }
        return Ok((None, false));
    }
    if n > NODE_DIMENSION_MAX {
        let problem = format!(
            "the state has {n} components, and frames of the field observer at most {NODE_DIMENSION_MAX}"
        );
        return Err(table.error(problem, "use preset = \"paper\", or fewer components"));
    }
    let from = table.get("from", "20.0").map_or(Ok(0.0), |value| {
        let from = value.not_negative()?;
        check_before_end(&value, from, time)?;
        Ok(from)
    })?;
    let couplings =
        [("held", Coupling::Held), ("current", Coupling::Current), ("trees", Coupling::Trees)];
    let coupling = table
        .get("coupling", "\"trees\"")
        .map_or(Ok(Coupling::Trees), |value| value.choice(&couplings))?;
    let holds =
        [("zero-order", HoldKind::ZeroOrder), ("rate", HoldKind::Rate), ("model", HoldKind::Model)];
    let hold = table.get("hold", "\"rate\"").map(|value| value.choice(&holds)).transpose()?;
    let network = match table.get("network", "true") {
        Some(value) => {
            let network = value.boolean()?;
            if network && !has_network {
                return Err(value.error("there is no network", "add a [network] table"));
            }
            network
        }
        None => has_network,
    };
    let per_direction = |key: &str, example: &str| {
        table.get(key, example).map(|value| positives(&value, n)).transpose()
    };
    let gain = |key: &str, example: &str| {
        let gains = per_direction(key, example)?;
        let unstable = |gain: &&f64| **gain * time.step_size >= 2.0;
        match (table.get(key, example), gains.iter().flatten().find(unstable)) {
            (Some(value), Some(gain)) => Err(value.error(
                format_args!("{gain} 1/s is unstable at steps of {} s", time.step_size),
                format_args!("use a gain below {}", significant(2.0 / time.step_size, 4)),
            )),
            _ => Ok(gains),
        }
    };
    let root_gain = gain("root_gain", "113.0")?;
    let tree_gain = match coupling {
        // Their rules have a limit of their own.
        Coupling::Trees => per_direction("tree_gain", "100.0")?,
        _ => gain("tree_gain", "100.0")?,
    };
    let positive =
        |key: &str, example: &str| table.get(key, example).map(|v| v.positive()).transpose();
    let radius = per_direction("radius", "0.06")?;
    if let (Some(value), Some([first, others @ ..])) =
        (table.get("radius", "0.06"), radius.as_deref())
        && coupling != Coupling::Trees
        && others.iter().any(|other| other != first)
    {
        let problem = "has several radii, but without trees, one trigger covers all directions";
        return Err(value.error(problem, "write one number, or set coupling = \"trees\""));
    }
    let settings = ObserverSettings {
        from,
        error: positive("error", "0.014")?.unwrap_or(ERROR),
        coupling,
        hold,
        network,
        adapts: table
            .get("adapts", "false")
            .map_or(Ok(coupling != Coupling::Trees), |value| value.boolean())?,
        root_gain,
        tree_gain,
        radius,
        disturbance: disturbance(&table, coupling, n)?,
        clip: per_direction("clip", "3.0")?,
        bias_decay: table.get("bias_decay", "1.0").map(|value| value.not_negative()).transpose()?,
        is_half: table.get("precision", "16").map_or(Ok(false), |value| {
            match value.integer(16..=32)? {
                16 => Ok(true),
                32 => Ok(false),
                _ => Err(value.wrong("is neither 16 nor 32")),
            }
        })?,
        relay_share: table.get("relay_share", "0.9").map_or(Ok(RELAY_SHARE), |value| {
            value.number_in("a number above 0 and up to 1", |share| share > 0.0 && share <= 1.0)
        })?,
        timeout: table.get("timeout", "1.0").map_or(Ok(0.0), |value| value.not_negative())?,
        exchange: None,
    };
    if coupling != Coupling::Trees {
        for (key, value) in [("root_gain", &settings.root_gain), ("tree_gain", &settings.tree_gain)]
        {
            if value.is_none() {
                return Err(table.missing(
                    key,
                    format!(
                        "add {key} = 100.0; gains are derived automatically only with coupling = \"trees\""
                    ),
                ));
            }
        }
    }
    Ok((Some(settings), preset == Preset::Robust))
}

fn disturbance(
    table: &Table<'_>,
    coupling: Coupling,
    n: usize,
) -> Result<DisturbanceModel, ScenarioError> {
    #[derive(Clone, Copy)]
    enum Kind {
        None,
        Bias,
        Harmonic,
    }
    let kinds = [("none", Kind::None), ("bias", Kind::Bias), ("harmonic", Kind::Harmonic)];
    let kind = match table.get("disturbance", "\"bias\"") {
        Some(value) => value.choice(&kinds)?,
        None if coupling == Coupling::Trees => Kind::Bias,
        None => Kind::None,
    };
    let bandwidth = table.get("bandwidth", "80.0").map(|value| value.positive()).transpose()?;
    let number = |key: &str, example: &str, default: f64| {
        table.get(key, example).map_or(Ok(default), |value| value.positive())
    };
    Ok(match kind {
        Kind::None => DisturbanceModel::None,
        Kind::Bias => DisturbanceModel::Bias { bandwidth },
        Kind::Harmonic => DisturbanceModel::Harmonic {
            bandwidth: bandwidth.unwrap_or(45.0),
            harmonic_bandwidth: number("harmonic_bandwidth", "45.0", 45.0)?,
            process: table.get("process", "100.0").map_or(Ok(100.0), |v| v.not_negative())?,
            frequencies: table
                .get("frequencies", "[3.0, 0.0]")
                .map(|value| {
                    let hint = "write the frequency of each direction, 0 for none";
                    value
                        .list(hint)?
                        .iter()
                        .map(Value::not_negative)
                        .collect::<Result<Vec<_>, _>>()?;
                    value.numbers_of(n, STATE)
                })
                .transpose()?,
        },
    })
}

/// Reads a number above 0 for all directions, or one for each.
fn positives(value: &Value<'_>, n: usize) -> Result<Vec<f64>, ScenarioError> {
    if !value.is_list() {
        return Ok(vec![value.positive()?; n]);
    }
    value.list("use numbers above 0")?.iter().try_for_each(|v| v.positive().map(|_| ()))?;
    value.numbers_of(n, STATE)
}
