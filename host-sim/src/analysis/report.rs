//! The theorems' promises beside what a run measured.

use super::{GainCertificate, TriggerConstants, UltimateBound, minimum_interval};
use crate::engine::RunResult;
use crate::scenario::Scenario;

/// Every check of one run.
#[derive(Clone, Debug)]
pub struct Checks {
    /// Is `K_1` a solution of `BMI`?
    pub gain: GainCertificate,
    /// `phi_1`, `phi_2` and the threshold.
    pub trigger: TriggerConstants,
    /// Theorem 1; `None` where it says nothing (`alpha <= 0`) or nothing was measured.
    pub ultimate_bound: Option<UltimateBoundCheck>,
    /// Theorem 2, for each agent.
    pub agents: Vec<AgentCheck>,
}

/// Theorem 1 against a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UltimateBoundCheck {
    /// The bound.
    pub bound: UltimateBound,
    /// Largest `|e_1(t)|^2` divided by the bound at the same time; the theorem holds if it is
    /// at most 1.
    pub largest_share: f64,
    /// When it occurred. \[s\]
    pub largest_share_at: f64,
    /// Largest `|e_1(t)|` over the evaluation window, against the square root of the ultimate
    /// bound.
    pub ultimate_error: f64,
}

/// Theorem 2 against a run, for one agent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AgentCheck {
    /// Largest rate `e_2i_max` of the hold error that occurred. \[state unit/s\]
    pub hold_error_rate: f64,
    /// The shortest time between broadcasts that the theorem allows. \[s\]
    pub interval_bound: f64,
    /// The shortest that occurred; `None` with fewer than two broadcasts. \[s\]
    pub interval_min: Option<f64>,
}

impl AgentCheck {
    /// Whether the theorem holds.
    #[must_use]
    pub fn holds(&self) -> bool {
        self.interval_min.is_none_or(|interval| interval >= self.interval_bound)
    }
}

impl Checks {
    /// Compares a run of `scenario` that measured its bounds.
    #[must_use]
    pub fn new(scenario: &Scenario, run: &RunResult) -> Self {
        let trigger = TriggerConstants::new(scenario);
        let agents = run.agents.iter().map(|agent| AgentCheck {
            hold_error_rate: agent.hold_error_rate_max,
            interval_bound: minimum_interval(&trigger, agent.hold_error_rate_max),
            interval_min: agent.min_interval(&scenario.time),
        });
        Self {
            gain: GainCertificate::new(scenario),
            trigger,
            ultimate_bound: ultimate_bound(scenario, run),
            agents: agents.collect(),
        }
    }
}

fn ultimate_bound(scenario: &Scenario, run: &RunResult) -> Option<UltimateBoundCheck> {
    let bound = UltimateBound::new(scenario)?;
    let time = &scenario.time;
    let shares = run.stacked_error_squared.iter().zip(0u64..).map(|(squared, tick)| {
        let at = time.at(tick);
        (squared / bound.at(at), at)
    });
    let (largest_share, largest_share_at) =
        shares.reduce(|best, share| if share.0 > best.0 { share } else { best })?;
    let window = time.tick(scenario.evaluation.from)..time.tick(scenario.evaluation.to);
    let evaluated =
        run.stacked_error_squared.iter().zip(0u64..).filter(|(_, t)| window.contains(t));
    let ultimate_error = evaluated.fold(0.0f64, |max, (squared, _)| max.max(*squared)).sqrt();
    Some(UltimateBoundCheck { bound, largest_share, largest_share_at, ultimate_error })
}
