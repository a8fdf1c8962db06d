//! Warnings about a scenario, a training or a run, with advice.
//!
//! Scripts can rely on a warning's code; the text is for people and may change. `docs/json.md`
//! explains each code.

use std::fmt;

use serde::{Serialize, Serializer};

/// What a warning is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[non_exhaustive]
pub enum WarningCode {
    /// Together, the agents do not measure the whole state.
    StateNotCovered,
    /// `K_1` does not satisfy `BMI` with this `k_1`.
    GainNotASolution,
    /// `rho` is below the estimate of `chi_bar_max`.
    RhoTooSmall,
    /// The step is too long for the observer's error dynamics.
    UnstableStep,
    /// The error grows without bound.
    UnstableRun,
    /// An agent broadcast in more than a quarter of the steps.
    FrequentBroadcasts,
    /// The evaluation window begins before the last switch of a network.
    WindowBeforeSwitch,
    /// `[health]` without a trained network.
    HealthUntrained,
    /// The outer weights limit what the network can learn: they are all zero (for one component or
    /// for all), or all rows are equal.
    OuterWeights,
    /// An input varies by no more than rounding, so it gets no weight.
    ConstantInput,
    /// Single precision leaves few digits of an input's variation.
    InputResolution,
    /// The trained network explains none of the targets' variance.
    ExplainsNothing,
    /// The trained network is worse than a constant on the validation samples.
    WorseThanConstant,
    /// The smoothing window is longer than the period of the signal.
    LongSmoothing,
    /// Fewer training values than parameters.
    FewSamples,
    /// A trained network, or the field observer, was not switched in.
    NotSwitchedIn,
    /// The baseline run failed.
    BaselineFailed,
    /// The samples were recorded with a different scenario.
    OtherScenario,
    /// Samples are closer together than steps of the scenario.
    DenseSamples,
    /// Trained networks are not written as packages, which cannot carry the scenario's trigger.
    SimulationOnly,
    /// Extrapolating late samples may be unstable: they are averaged over too short a time.
    ShortSmoothing,
    /// The package's limits for its trial do not fit into its format.
    TrialLimitsDropped,
    /// Samples are to evolve as a shared network says, but agents have networks of their own.
    DifferentNetworks,
    /// A known input that nothing uses.
    UnusedInput,
    /// The error of an agent is not below that of an estimate that stays at the state's mean.
    UselessEstimate,
    /// Fitted polynomials were used outside the range of their samples.
    Extrapolation,
    /// The table of a study lacks runs.
    IncompleteStudy,
    /// All cells of a study have the same results.
    WithoutEffect,
    /// All runs of a cell have the same results.
    WithoutSpread,
}

impl WarningCode {
    /// Every code.
    pub const ALL: [Self; 29] = [
        Self::StateNotCovered,
        Self::GainNotASolution,
        Self::RhoTooSmall,
        Self::UnstableStep,
        Self::UnstableRun,
        Self::FrequentBroadcasts,
        Self::WindowBeforeSwitch,
        Self::HealthUntrained,
        Self::OuterWeights,
        Self::ConstantInput,
        Self::InputResolution,
        Self::ExplainsNothing,
        Self::WorseThanConstant,
        Self::LongSmoothing,
        Self::FewSamples,
        Self::NotSwitchedIn,
        Self::BaselineFailed,
        Self::OtherScenario,
        Self::DenseSamples,
        Self::SimulationOnly,
        Self::ShortSmoothing,
        Self::TrialLimitsDropped,
        Self::DifferentNetworks,
        Self::UnusedInput,
        Self::UselessEstimate,
        Self::Extrapolation,
        Self::IncompleteStudy,
        Self::WithoutEffect,
        Self::WithoutSpread,
    ];

    /// Returns the code as it appears in JSON.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::StateNotCovered => "state-not-covered",
            Self::GainNotASolution => "gain-not-a-solution",
            Self::RhoTooSmall => "rho-too-small",
            Self::UnstableStep => "unstable-step",
            Self::UnstableRun => "unstable-run",
            Self::FrequentBroadcasts => "frequent-broadcasts",
            Self::WindowBeforeSwitch => "window-before-switch",
            Self::HealthUntrained => "health-untrained",
            Self::OuterWeights => "outer-weights",
            Self::ConstantInput => "constant-input",
            Self::InputResolution => "input-resolution",
            Self::ExplainsNothing => "explains-nothing",
            Self::WorseThanConstant => "worse-than-constant",
            Self::LongSmoothing => "long-smoothing",
            Self::FewSamples => "few-samples",
            Self::NotSwitchedIn => "not-switched-in",
            Self::BaselineFailed => "baseline-failed",
            Self::OtherScenario => "other-scenario",
            Self::DenseSamples => "dense-samples",
            Self::SimulationOnly => "simulation-only",
            Self::ShortSmoothing => "short-smoothing",
            Self::TrialLimitsDropped => "trial-limits-dropped",
            Self::DifferentNetworks => "different-networks",
            Self::UnusedInput => "unused-input",
            Self::UselessEstimate => "useless-estimate",
            Self::Extrapolation => "extrapolation",
            Self::IncompleteStudy => "incomplete-study",
            Self::WithoutEffect => "without-effect",
            Self::WithoutSpread => "without-spread",
        }
    }
}

impl Serialize for WarningCode {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.as_str())
    }
}

/// One warning.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Warning {
    /// What it is about.
    pub code: WarningCode,
    /// What is wrong, where, and what to do.
    pub text: String,
}

impl Warning {
    /// Creates a warning.
    #[must_use]
    pub fn new(code: WarningCode, text: impl Into<String>) -> Self {
        Self { code, text: text.into() }
    }
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}
