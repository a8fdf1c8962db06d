//! The forms of the observer, each with the settings that are varied.
//!
//! | form | observer |
//! | --- | --- |
//! | `paper` | the paper's, as the scenario sets it; epsilon varies |
//! | `paper-model` | the same coupling with samples that evolve by the model, gain 0.9 of the designed one |
//! | `split` | separate gains for the agent's own measurement and towards neighbours, model hold |
//! | `flow` | trees, no disturbance model |
//! | `flow-eso` | trees, a slowly changing disturbance at the roots |
//! | `flow-harmonic` | trees, a slowly changing and an oscillating disturbance |
//! | `periodic` | `flow-eso` with broadcasts at fixed times instead of events, equally often |
//! | `no-network` | trees and a disturbance model alone |
//! | `known-f` | `flow-eso` with the plant's own model in place of the network |
//!
//! For the paper's plant without `[observer]` the settings are those that a study of it found, in the
//! unit of the state. Otherwise they are derived for several requested errors, as a fraction of the
//! state's standard deviation; what `[observer]` sets takes precedence.

use agent_core::observer::field::{Coupling, HoldKind};
use clap::ValueEnum;
use serde::{Serialize, Serializer};

use crate::analysis::TriggerConstants;
use crate::flow::{PlanError, plant_course};
use crate::scenario::{DisturbanceModel, Method, ObserverSettings, PAPER, Scenario, TriggerModel};

/// A form of the observer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, ValueEnum)]
pub(super) enum Form {
    /// The paper's observer
    Paper,
    /// The paper's coupling with samples that evolve by the model; only on request
    PaperModel,
    /// Separate gains for the agent's own measurement and towards neighbours
    Split,
    /// Along trees, without a disturbance model
    Flow,
    /// Along trees, with a slowly changing disturbance
    FlowEso,
    /// Along trees, with a disturbance that also oscillates
    FlowHarmonic,
    /// Like `flow-eso`, but with broadcasts at fixed times, equally often
    Periodic,
    /// Along trees, with a disturbance model instead of the network
    NoNetwork,
    /// Like `flow-eso`, with the plant's own model in place of the network
    KnownF,
}

impl Form {
    /// What is compared by default.
    pub(super) const DEFAULT: [Self; 7] = [
        Self::Paper,
        Self::Split,
        Self::Flow,
        Self::FlowEso,
        Self::FlowHarmonic,
        Self::Periodic,
        Self::NoNetwork,
    ];

    /// Returns its name in results.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Paper => "paper",
            Self::PaperModel => "paper-model",
            Self::Split => "split",
            Self::Flow => "flow",
            Self::FlowEso => "flow-eso",
            Self::FlowHarmonic => "flow-harmonic",
            Self::Periodic => "periodic",
            Self::NoNetwork => "no-network",
            Self::KnownF => "known-f",
        }
    }
}

impl Serialize for Form {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

/// A form with its settings.
#[derive(Clone, Debug)]
pub(super) struct Variant {
    pub(super) form: Form,
    pub(super) level: Level,
    /// Whether these are the scenario's own settings.
    pub(super) is_own: bool,
    pub(super) scenario: Scenario,
}

/// What is varied within a form.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Level {
    /// The largest radius of the trigger. \[state unit\]
    Radius(f64),
    /// The requested error, as a fraction of the state's standard deviation.
    Error(f64),
    /// Time between broadcasts. \[s\]
    Period(f64),
}

/// Epsilon of the paper's trigger, as multiples of the scenario's.
const EPSILONS: [f64; 5] = [0.0625, 0.25, 1.0, 2.25, 4.0];

/// Radii, as multiples of that in `[observer]`.
const RADII: [f64; 5] = [0.25, 0.5, 1.0, 1.5, 2.0];

/// Requested errors, as fractions of the state's standard deviation.
const ERRORS: [f64; 6] = [0.005, 0.01, 0.014, 0.025, 0.05, 0.1];

/// The smallest-trace solution of `BMI` for the paper's network. \[1/s\]
const SMALLEST_TRACE: [f64; 3] = [87.0, 117.65, 117.65];

/// Gain of the agent's own innovation with separate gains. \[1/s\]
const ROOT_GAIN: f64 = 500.0;

/// Largest gain of the agent's own innovation times the step.
const ROOT_GAIN_STEP: f64 = 0.5;

/// A radius at which no trigger fires. \[state unit\]
const OUT_OF_REACH: f64 = 1e6;

/// Where the settings of a scenario's forms come from.
pub(super) struct Forms<'s> {
    scenario: &'s Scenario,
    observer: ObserverSettings,
    /// Whether they are those of the study.
    is_study: bool,
    /// Largest diagonal gain of the paper's coupling. \[1/s\]
    gain: Vec<f64>,
    deviation: Vec<f64>,
}

impl<'s> Forms<'s> {
    /// Prepares the forms of a scenario.
    ///
    /// # Errors
    /// If the plant has no finite trajectory.
    pub(super) fn new(scenario: &'s Scenario) -> Result<Self, PlanError> {
        let last = scenario.learning.iter().map(|cycle| cycle.apply_at);
        let last = last.filter(|&time| time <= scenario.evaluation.from).reduce(f64::max);
        let is_paper = is_papers_plant(scenario);
        let gain = match is_paper {
            true => SMALLEST_TRACE.to_vec(),
            false => scenario.design.gain.diagonal().iter().copied().collect(),
        };
        let observer = scenario.observer.clone();
        Ok(Self {
            scenario,
            is_study: is_paper && observer.is_none(),
            observer: observer.unwrap_or_else(|| ObserverSettings::derived(last.unwrap_or(0.0))),
            gain,
            deviation: plant_course(scenario)?.deviation(),
        })
    }

    /// Returns the variants of a form; none for `periodic`, which follows another form.
    pub(super) fn variants(&self, form: Form) -> Vec<Variant> {
        match form {
            Form::Paper => EPSILONS.into_iter().map(|factor| self.paper(factor)).collect(),
            Form::Periodic => Vec::new(),
            Form::PaperModel => self.held(form, &[0.03, 0.045, 0.05, 0.055]),
            Form::Split => self.held(form, &[0.03, 0.045, 0.06, 0.07]),
            Form::Flow => self.trees(form, &[0.02, 0.035, 0.05, 0.065, 0.08, 0.095]),
            Form::FlowEso => self.trees(form, &[0.01, 0.02, 0.04, 0.06, 0.08, 0.1, 0.12]),
            Form::KnownF => self.trees(form, &[0.01, 0.02, 0.04, 0.06, 0.08, 0.1, 0.12]),
            Form::FlowHarmonic => self.trees(form, &[0.01, 0.02, 0.04, 0.06, 0.08, 0.1, 0.12]),
            Form::NoNetwork => self.trees(form, &[0.02, 0.04, 0.06, 0.08, 0.1]),
        }
    }

    /// Returns a variant of `flow-eso` that broadcasts every `every` steps and at no other time.
    pub(super) fn periodic(&self, of: &Variant, every: u32) -> Variant {
        let mut variant = of.clone();
        variant.form = Form::Periodic;
        variant.level = Level::Period(self.scenario.time.at(every.into()));
        variant.is_own = false;
        if let Some(observer) = &mut variant.scenario.observer {
            observer.radius = Some(vec![OUT_OF_REACH; self.scenario.dimension()]);
        }
        let exchange = &mut variant.scenario.exchange;
        exchange.heartbeat = every;
        exchange.gap = exchange.gap.min(every);
        variant
    }

    /// Returns the paper's observer with this multiple of epsilon.
    fn paper(&self, factor: f64) -> Variant {
        let mut scenario = self.scenario.clone();
        scenario.observer = None;
        scenario.trigger = TriggerModel::Event;
        scenario.design.epsilon *= factor;
        let radius = TriggerConstants::new(&scenario).radius();
        Variant { form: Form::Paper, level: Level::Radius(radius), is_own: factor == 1.0, scenario }
    }

    /// Returns variants with the paper's graph coupling.
    fn held(&self, form: Form, radii: &[f64]) -> Vec<Variant> {
        let step = self.scenario.time.step_size;
        let share = if form == Form::Split { 0.5 } else { 0.9 };
        let tree: Vec<f64> = self.gain.iter().map(|gain| share * gain).collect();
        let root = match form {
            Form::Split => vec![ROOT_GAIN.min(ROOT_GAIN_STEP / step); tree.len()],
            _ => tree.clone(),
        };
        let observer = ObserverSettings {
            coupling: Coupling::Held,
            hold: Some(self.observer.hold.unwrap_or(HoldKind::Model)),
            adapts: self.observer.network,
            root_gain: Some(self.observer.root_gain.clone().unwrap_or(root)),
            tree_gain: Some(self.observer.tree_gain.clone().unwrap_or(tree)),
            disturbance: DisturbanceModel::None,
            ..self.observer.clone()
        };
        if self.is_study || observer.radius.is_some() {
            return self.over_radii(form, &observer, radii);
        }
        // This coupling takes no settings from a requested error: the rule for the radius is applied
        // here, component by component.
        let variant = |error: f64| {
            let radius = self.deviation.iter().map(|unit| 1.5 * error * unit).collect();
            let observer = ObserverSettings { error, radius: Some(radius), ..observer.clone() };
            self.variant(form, Level::Error(error), observer)
        };
        ERRORS.into_iter().map(variant).collect()
    }

    /// Returns variants along trees.
    fn trees(&self, form: Form, radii: &[f64]) -> Vec<Variant> {
        let mut observer = ObserverSettings { coupling: Coupling::Trees, ..self.observer.clone() };
        let given = observer.disturbance.clone();
        observer.disturbance = match (form, given) {
            (Form::Flow, _) => DisturbanceModel::None,
            (Form::FlowHarmonic, given @ DisturbanceModel::Harmonic { .. }) => given,
            (Form::FlowHarmonic, _) => DisturbanceModel::Harmonic {
                bandwidth: 45.0,
                harmonic_bandwidth: 45.0,
                process: 100.0,
                frequencies: None,
            },
            (_, given @ DisturbanceModel::Bias { bandwidth: Some(_) }) => given,
            _ => DisturbanceModel::Bias { bandwidth: self.is_study.then_some(80.0) },
        };
        if form == Form::NoNetwork {
            observer.network = false;
            observer.hold = Some(HoldKind::Rate);
        }
        if !self.is_study {
            return match observer.radius {
                Some(_) => self.over_radii(form, &observer, radii),
                None => {
                    let variant = |error| {
                        let observer = ObserverSettings { error, ..observer.clone() };
                        self.variant(form, Level::Error(error), observer)
                    };
                    ERRORS.into_iter().map(variant).collect()
                }
            };
        }
        let n = self.scenario.dimension();
        // Three times the disturbance; without a network, the plant's own rates as well.
        let (tree, clip) = match form {
            Form::Flow => (200.0, 3.0),
            Form::NoNetwork => (100.0, 30.0),
            _ => (100.0, 3.0),
        };
        if form == Form::Flow {
            observer.root_gain = Some(vec![ROOT_GAIN; n]);
        }
        observer.hold.get_or_insert(HoldKind::Model);
        observer.tree_gain = Some(vec![tree; n]);
        observer.clip = Some(vec![clip; n]);
        self.over_radii(form, &observer, radii)
    }

    /// Returns a variant for each radius: multiples of those in `[observer]`, or these of the study.
    fn over_radii(&self, form: Form, observer: &ObserverSettings, study: &[f64]) -> Vec<Variant> {
        let n = self.scenario.dimension();
        let radii: Vec<Vec<f64>> = match &observer.radius {
            Some(own) => {
                RADII.iter().map(|factor| own.iter().map(|r| factor * r).collect()).collect()
            }
            None => study.iter().map(|&radius| vec![radius; n]).collect(),
        };
        let variant = |radius: Vec<f64>| {
            let largest = radius.iter().copied().fold(0.0, f64::max);
            let observer = ObserverSettings { radius: Some(radius), ..observer.clone() };
            self.variant(form, Level::Radius(largest), observer)
        };
        radii.into_iter().map(variant).collect()
    }

    fn variant(&self, form: Form, level: Level, observer: ObserverSettings) -> Variant {
        let mut scenario = self.scenario.clone();
        scenario.trigger = TriggerModel::Event;
        for cycle in &mut scenario.learning {
            cycle.is_shared = true;
        }
        scenario.observer = Some(observer);
        if form == Form::KnownF {
            scenario.method = Method::KnownModel;
        }
        Variant { form, level, is_own: false, scenario }
    }
}

/// Whether plant, disturbance, graph and outputs are those of the paper.
fn is_papers_plant(scenario: &Scenario) -> bool {
    let Ok(paper) = Scenario::parse("paper.toml", PAPER) else { return false };
    let outputs = |scenario: &Scenario| -> Vec<_> {
        scenario.agents.iter().map(|agent| agent.output_matrix.clone()).collect()
    };
    scenario.plant == paper.plant
        && scenario.disturbance == paper.disturbance
        && scenario.graph.edges() == paper.graph.edges()
        && outputs(scenario) == outputs(&paper)
}
