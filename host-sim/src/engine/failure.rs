//! Why a run cannot go on: the cause, and what to do.

use agent_core::Tick;

use super::RunError;
use crate::analysis::StepCheck;
use crate::plant::{ExpressionFault, Stepper};
use crate::scenario::Scenario;

/// If the plant's state is this large, a diverging agent is not the cause.
const RUNAWAY: f64 = 1e6;

/// What to do about an agent that diverged while the state had this norm.
pub(super) fn step_hint(plant_norm: f64, step: &StepCheck) -> String {
    if plant_norm >= RUNAWAY {
        return "the plant runs away: change plant, disturbance or initial state".to_owned();
    }
    let more =
        if step.is_stable() { "; lower time.step, or change [network] or [outer_law]" } else { "" };
    step.describe() + more
}

/// Why the step at `tick` from `before` did not lead to a state that can be measured.
pub(super) fn plant_error(
    scenario: &Scenario,
    plant: &mut Stepper,
    tick: Tick,
    before: &[f64],
) -> RunError {
    let time = &scenario.time;
    let (drift, disturbance) = (&scenario.plant, &scenario.disturbance);
    let fault = plant.fault(drift, disturbance, time.at(tick), time.step_size, before);
    let size = |x: &[f64]| x.iter().fold(0.0f64, |size, x| size.max(x.abs()));
    let runs_away = |fault: &ExpressionFault| {
        // A stage of the integrator may be far beyond the state that it starts from.
        let stage = fault.values.iter().fold(size(before), |size, (_, x)| size.max(x.abs()));
        stage > RUNAWAY * size(&scenario.initial_state).max(1.0)
    };
    match fault {
        // What overflows in a plant that runs away is not the expression's fault.
        Some(fault) if !(fault.expression().overflow && runs_away(fault.expression())) => {
            RunError::Expression(Box::new(fault))
        }
        _ => RunError::PlantDiverged { time: time.at(tick + 1) },
    }
}
