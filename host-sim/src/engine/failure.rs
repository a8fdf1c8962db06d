//! Determines why a run failed, and what to do about it.

use agent_core::Tick;

use super::RunError;
use crate::analysis::StepCheck;
use crate::flow::plant_course;
use crate::learning::trained::TrainedError;
use crate::number::significant;
use crate::plant::{ExpressionFault, Stepper};
use crate::scenario::{Method, Scenario};

/// Norm of the plant's state above which the plant is the cause of a divergence, not the agent.
const RUNAWAY: f64 = 1e6;

/// Samples that are larger than the plant's state by this factor are those of an estimate that diverged.
const FAR: f64 = 1e6;

/// Returns the norm of the plant's state in brackets, if the state is known.
pub(super) fn norm_in_words(plant_norm: f64) -> String {
    if plant_norm.is_nan() {
        String::new()
    } else {
        format!(" (|x_0| = {})", significant(plant_norm, 4))
    }
}

/// Returns a hint for an agent that diverged while the state had this norm.
pub(super) fn step_hint(plant_norm: f64, step: &StepCheck, remedy: &str) -> String {
    if plant_norm >= RUNAWAY {
        return "the plant itself diverges: change plant, disturbance or initial state".to_owned();
    }
    let more = if step.is_stable() { format!("; {remedy}") } else { String::new() };
    step.describe() + &more
}

/// Returns why agent `agent` cannot be trained in `cycle`, both from 1.
pub(super) fn training_error(
    scenario: &Scenario,
    agent: usize,
    cycle: usize,
    error: TrainedError,
) -> RunError {
    let reach = plant_course(scenario).ok().map(|course| course.reach());
    let state = reach.map(|reach| reach.into_iter().fold(0.0, f64::max));
    match error.too_large().zip(state) {
        Some((largest, state)) if largest > FAR * state => {
            RunError::SamplesDiverged { agent, cycle, largest, state, remedy: remedy(scenario) }
        }
        _ => RunError::Training { agent, cycle, error },
    }
}

/// Returns what to do if the errors of a scenario's method grow although its step is short enough.
#[must_use]
pub fn remedy(scenario: &Scenario) -> &'static str {
    match scenario.method {
        Method::Periodic => {
            "so few periodic broadcasts are not enough; that is a result of the comparison, not a fault of the \
             scenario"
        }
        Method::Kalman | Method::ExtendedKalman => "lower kalman.consensus_gain",
        Method::Regression => {
            "lower the gain of [outer_law], or collect samples over a longer window (collect_from and collect_to of [[learning]])"
        }
        // The paper's observer runs at least until the field observer starts.
        Method::Observer | Method::Untrained | Method::NoNetwork | Method::KnownModel
            if scenario.exchange.gap > 1
                && scenario.observer.as_ref().is_none_or(|observer| observer.from > 0.0) =>
        {
            "lower exchange.gap, since the paper's observer needs broadcasts as often as its trigger asks for, \
             or lower design.gain"
        }
        _ if scenario.observer.is_some() => {
            "lower time.step, observer.tree_gain or observer.bandwidth"
        }
        Method::NoNetwork | Method::KnownModel => "lower time.step or design.gain",
        Method::Observer | Method::Untrained if scenario.trigger.departure().is_some() => {
            "broadcast more often (trigger.every), or lower design.gain"
        }
        _ if scenario.network.is_none() => "lower time.step or design.gain",
        Method::Observer | Method::Untrained => {
            "lower time.step or design.gain, or change [network] or [outer_law]"
        }
    }
}

/// Returns why the step at `tick` from `before` led to a state that is not finite.
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
    let diverges = |fault: &ExpressionFault| {
        // An integrator stage may be far away from the state it starts from.
        let stage = fault.values.iter().fold(size(before), |size, (_, x)| size.max(x.abs()));
        stage > RUNAWAY * size(&scenario.initial_state).max(1.0)
    };
    match fault {
        // An overflow in a diverging plant is not the expression's fault.
        Some(fault) if !(fault.expression().overflow && diverges(fault.expression())) => {
            RunError::Expression(Box::new(fault))
        }
        _ => RunError::PlantDiverged { time: time.at(tick + 1) },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::PAPER;

    #[test]
    fn a_gap_that_the_papers_observer_does_not_stand_is_named() {
        let gap = "[exchange]\ngap = 0.01\nheartbeat = 0.2\n\n[evaluation]";
        for (observer, expected) in [
            ("", "exchange.gap"),
            ("[observer]\npreset = \"field\"\nfrom = 20.0\n\n", "exchange.gap"),
            ("[observer]\npreset = \"field\"\n\n", "observer.tree_gain"),
        ] {
            let text = PAPER.replacen("[evaluation]", &format!("{observer}{gap}"), 1);
            let scenario = Scenario::parse("paper.toml", &text).unwrap();
            assert!(remedy(&scenario).contains(expected), "{observer}: {}", remedy(&scenario));
        }
    }
}
