//! Compares the theorems' bounds with the measurements of a run.
//!
//! A theorem applies only if its premises hold. If one fails, the check names it and the theorem is
//! "not applicable", whatever the result of the run.
//!
//! * Both: agents use the event trigger; links, sensors and clocks are ideal, and agents always up
//!   ([`Scenario::departures`]).
//! * Theorem 1: `k_2 > 1/kappa`; `K_1` solves `BMI`; `rho >= chi_bar_max`, which the run estimates
//!   ([`LumpedUncertainty`]).
//! * Theorem 2: a bound on the rate of the hold error. The rate is measured along the run, so there
//!   is no other premise; but the allowed interval can be tested only if it is at least one step
//!   long, because broadcasts happen between steps.
//!
//! An agent that restarted did not follow the dynamics of either theorem.

use crate::analysis::{
    GainCertificate, LumpedUncertainty, StepCheck, TriggerConstants, UltimateBound,
    minimum_interval, outputs_determine_state,
};
use crate::engine::RunResult;
use crate::engine::bounds::{BoundShare, Growth};
use crate::engine::statistics::AgentStatistics;
use crate::number::significant;
use crate::scenario::{Scenario, TriggerModel};

/// The checks that do not need a run.
#[derive(Clone, Debug, PartialEq)]
pub struct DesignChecks {
    /// Whether `K_1` is a solution of `BMI`.
    pub gain: GainCertificate,
    /// When agents broadcast.
    pub trigger: TriggerModel,
    /// What the theorems do not allow for, apart from the trigger.
    pub departures: Vec<&'static str>,
    /// `phi_1`, `phi_2` and the threshold; `None` if agents do not use the event trigger.
    pub trigger_constants: Option<TriggerConstants>,
    /// Whether the step is short enough for the observer.
    pub step: StepCheck,
    /// Whether the agents together measure the whole state.
    pub covered: bool,
    /// Theorem 1's bound; `None` if `k_2 <= 1/kappa`, or if agents do not use the event trigger.
    pub ultimate_bound: Option<UltimateBound>,
}

impl DesignChecks {
    /// Checks a scenario.
    #[must_use]
    pub fn new(scenario: &Scenario) -> Self {
        Self {
            gain: GainCertificate::new(scenario),
            trigger: scenario.trigger,
            departures: scenario.departures(),
            trigger_constants: match scenario.trigger.departure() {
                None => Some(TriggerConstants::new(scenario)),
                Some(_) => None,
            },
            step: StepCheck::new(scenario),
            covered: outputs_determine_state(scenario),
            ultimate_bound: UltimateBound::new(scenario),
        }
    }

    /// Returns the premises of both theorems that the scenario breaks.
    fn broken_premises(&self) -> Option<Status> {
        let trigger = self.trigger.departure().map(|model| {
            format!("agents broadcast {model}, not by the event trigger that the theorem assumes")
        });
        let others = self.departures.iter().map(|&clause| clause.to_owned());
        let clauses: Vec<_> = trigger.into_iter().chain(others).collect();
        (!clauses.is_empty()).then(|| Status::NotApplicable(clauses.join("; ")))
    }

    /// Returns the result for `K_1` as one sentence without a full stop, the same in every report.
    #[must_use]
    pub fn gain_in_words(&self) -> String {
        let gain = &self.gain;
        let mut words = format!(
            "lambda_min = {} 1/s (+- {}), requires k1 = {} 1/s: {}",
            significant(gain.eigenvalue_min, 6),
            significant(gain.uncertainty, 1),
            significant(gain.k1, 6),
            gain.advice().unwrap_or_else(|| "a solution".to_owned()),
        );
        if let Some(factor) = gain.factor() {
            let scaled = StepCheck {
                eigenvalue_max: factor * self.step.eigenvalue_max,
                largest_stable_step: self.step.largest_stable_step.map(|step| step / factor),
                ..self.step
            };
            if let (false, Some(step)) = (scaled.is_stable(), scaled.largest_stable_step) {
                words += &format!(", and set time.step below {} s", significant(0.99 * step, 2));
            }
        }
        words
    }
}

/// All checks of a run.
#[derive(Clone, Debug, PartialEq)]
pub struct Checks {
    /// The checks that do not need a run.
    pub design: DesignChecks,
    /// Theorem 1.
    pub theorem1: UltimateBoundCheck,
    /// Theorem 2 for each agent.
    pub theorem2: Vec<AgentCheck>,
    /// The error over time; `None` if it was not measured.
    pub growth: Option<Growth>,
}

/// The verdict on a theorem.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Status {
    /// The run stayed within its bound.
    Kept,
    /// The run violated its bound.
    Broken,
    /// The theorem does not apply to the run, because this premise fails.
    NotApplicable(String),
}

impl Status {
    /// Returns the status as it appears in JSON.
    #[must_use]
    pub fn as_str(&self) -> &'static str {
        match self {
            Self::Kept => "kept",
            Self::Broken => "broken",
            Self::NotApplicable(_) => "not_applicable",
        }
    }

    /// Returns the premise that fails.
    #[must_use]
    pub fn premise(&self) -> Option<&str> {
        match self {
            Self::NotApplicable(premise) => Some(premise),
            _ => None,
        }
    }

    fn kept(holds: bool) -> Self {
        if holds { Self::Kept } else { Self::Broken }
    }
}

/// Theorem 1 compared with a run.
#[derive(Clone, Debug, PartialEq)]
pub struct UltimateBoundCheck {
    /// The verdict.
    pub status: Status,
    /// `rho`. \[state unit/s\]
    pub rho: f64,
    /// The required size of `rho`; `None` if it was not measured.
    pub lumped: Option<LumpedUncertainty>,
    /// The error relative to the bound; `None` if there is no bound, or it was not measured.
    pub share: Option<BoundShare>,
}

/// Theorem 2 compared with a run, for one agent.
#[derive(Clone, Debug, PartialEq)]
pub struct AgentCheck {
    /// The verdict.
    pub status: Status,
    /// Largest measured rate `e_2i_max` of the hold error. \[state unit/s\]
    pub hold_error_rate: f64,
    /// The shortest time between broadcasts that the theorem allows; `None` if the hold error did
    /// not change. \[s\]
    pub interval_bound: Option<f64>,
    /// The shortest measured time; `None` with fewer than two broadcasts. \[s\]
    pub interval_min: Option<f64>,
}

impl Checks {
    /// Compares a run of `scenario` with the theorems.
    #[must_use]
    pub fn new(scenario: &Scenario, run: &RunResult) -> Self {
        Self::of(DesignChecks::new(scenario), scenario, run)
    }

    /// Like [`Self::new`], with the checks that do not need a run already done.
    #[must_use]
    pub fn of(design: DesignChecks, scenario: &Scenario, run: &RunResult) -> Self {
        let bounds = run.bounds.as_ref();
        let step_size = scenario.time.step_size;
        let broken = design.broken_premises();
        let agents = run.agents.iter().map(|agent| {
            let rate = agent.hold_error_rate_max;
            let bound = design.trigger_constants.map(|trigger| minimum_interval(&trigger, rate));
            let bound = bound.filter(|bound| bound.is_finite());
            let shortest = agent.min_interval(&scenario.time);
            let status = match bound {
                _ if bounds.is_none() => not_measured(),
                _ if restarts(agent) > 0 => Status::NotApplicable("the agent restarted".to_owned()),
                None => Status::NotApplicable("the hold error did not change".to_owned()),
                Some(bound) if bound < step_size => Status::NotApplicable(format!(
                    "not testable at this step: its bound, {} s, is below one step",
                    significant(bound, 3)
                )),
                Some(bound) => Status::kept(shortest.is_none_or(|interval| interval >= bound)),
            };
            AgentCheck {
                status: broken.clone().unwrap_or(status),
                hold_error_rate: rate,
                interval_bound: bound,
                interval_min: shortest,
            }
        });
        let theorem2: Vec<_> = agents.collect();
        let lumped = bounds.map(|bounds| LumpedUncertainty::new(scenario, &bounds.lumped));
        let share = bounds.and_then(|bounds| bounds.ultimate);
        let restarted = run.agents.iter().filter(|agent| restarts(agent) > 0).count();
        let status = match restarted {
            0 => ultimate_status(&design, scenario, lumped, share),
            1 => Status::NotApplicable("an agent restarted".to_owned()),
            count => Status::NotApplicable(format!("{count} agents restarted")),
        };
        let rho = scenario.design.rho;
        let status = broken.unwrap_or(status);
        let theorem1 = UltimateBoundCheck { status, rho, lumped, share };
        Self { design, theorem1, theorem2, growth: bounds.map(|bounds| bounds.growth) }
    }

    /// Returns the verdict on Theorem 2 for all agents: broken if broken for any; otherwise kept if
    /// kept for any.
    #[must_use]
    pub fn theorem2_status(&self) -> Status {
        let statuses = || self.theorem2.iter().map(|agent| &agent.status);
        statuses()
            .find(|status| **status == Status::Broken)
            .or_else(|| statuses().find(|status| **status == Status::Kept))
            .or_else(|| statuses().next())
            .cloned()
            .unwrap_or_else(not_measured)
    }

    /// Returns whether the error grew without bound.
    #[must_use]
    pub fn unbounded(&self) -> bool {
        self.growth.is_some_and(|growth| growth.without_bound(self.design.step.is_stable()))
    }
}

fn restarts(agent: &AgentStatistics) -> u32 {
    agent.health.map_or(0, |health| health.restarts)
}

fn not_measured() -> Status {
    Status::NotApplicable("not measured in this run".to_owned())
}

fn ultimate_status(
    design: &DesignChecks,
    scenario: &Scenario,
    lumped: Option<LumpedUncertainty>,
    share: Option<BoundShare>,
) -> Status {
    let rho = scenario.design.rho;
    let (Some(bound), Some(lumped)) = (share, lumped) else {
        return match design.ultimate_bound {
            None => Status::NotApplicable("k2 is not above 1/kappa".to_owned()),
            Some(_) => not_measured(),
        };
    };
    if !design.gain.holds() {
        return Status::NotApplicable("K1 is not a solution of the matrix inequality".to_owned());
    }
    if rho < lumped.estimate {
        return Status::NotApplicable(format!(
            "rho = {rho} is below chi_bar_max, about {}",
            significant(lumped.estimate, 3)
        ));
    }
    Status::kept(bound.largest <= 1.0)
}
