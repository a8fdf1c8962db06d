//! `check`: design checks of a scenario, without running it.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;

use super::observer_certificate::ObserverPreview;
use super::{
    Changes, CommandError, ErrorCode, Format, load_scenario, print_outcome, print_text, warnings,
};
use crate::engine::{self, RunError};
use crate::number::significant;
use crate::plant::RateFault;
use crate::report::checks::{DesignReport, design_text};
use crate::report::theorems::DesignChecks;
use crate::scenario::{Agent, Scenario};
use crate::warning::Warning;

/// Largest number of steps at which known inputs are evaluated; in a longer run they are evenly spaced.
const TICKS_CHECKED: u64 = 1 << 20;

/// Arguments of `check`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Scenario: a TOML file or the name of a built-in scenario
    scenario: PathBuf,
    #[command(flatten)]
    changes: Changes,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

#[derive(Serialize)]
struct Report<'a> {
    scenario: &'a str,
    agents: usize,
    dimension: usize,
    steps: u64,
    checks: DesignReport,
    #[serde(skip_serializing_if = "Option::is_none")]
    observer: Option<&'a ObserverPreview>,
    warnings: &'a [Warning],
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    let scenario = load_scenario(&arguments.scenario, &arguments.changes)?;
    let design = DesignChecks::new(&scenario);
    let warnings = warnings::before(&scenario, &design);
    let fault = expression_error(&scenario).or_else(|| engine::check_method(&scenario).err());
    let (observer, fault) = match fault.map_or_else(|| ObserverPreview::new(&scenario), Err) {
        Ok(observer) => (observer, None),
        Err(fault) => (None, Some(fault)),
    };
    let outcome = if let Some(error) = fault {
        Err(error.into())
    } else if design.step.is_stable() {
        Ok(())
    } else {
        let name = &scenario.name;
        let problem = format!("scenario {name} would be unstable; see the step above");
        Err(CommandError::new(ErrorCode::Unstable, problem))
    };
    match arguments.format {
        Format::Json => {
            let report = Report {
                scenario: &scenario.name,
                agents: scenario.agents.len(),
                dimension: scenario.dimension(),
                steps: scenario.steps(),
                checks: DesignReport::new(&design),
                observer: observer.as_ref(),
                warnings: &warnings,
            };
            print_outcome(&report, outcome)
        }
        Format::Text => {
            let printed = print_text(&text(&scenario, &design, observer.as_ref(), &warnings));
            outcome.and(printed)
        }
    }
}

/// Returns what is wrong with an expression at the start, or with a known input at a step of the run by an agent's
/// clock.
fn expression_error(scenario: &Scenario) -> Option<RunError> {
    let Scenario { plant, disturbance, initial_state, time, agents, .. } = scenario;
    if let Some(fault) = RateFault::find(plant, disturbance, 0.0, initial_state) {
        return Some(RunError::Expression(Box::new(fault)));
    }
    let names = plant.input_names();
    if names.is_empty() {
        return None;
    }
    // The times of the plant, and those by the clock of the agent that is ahead at the end.
    let clock = |agent: &Agent| {
        let end = agent.clock.offset + (1.0 + 1e-6 * agent.clock.drift) * time.duration;
        (agent.clock.offset, end)
    };
    let clocks = agents.iter().map(clock).enumerate();
    let first = |a: (usize, (f64, f64)), b: (usize, (f64, f64))| if b.1.1 > a.1.1 { b } else { a };
    let (agent, own) = clocks.reduce(first)?;
    let ticks = |(from, to): (f64, f64)| {
        let (from, to) = (time.tick(from), time.tick(to));
        let stride = (to - from).div_ceil(TICKS_CHECKED).max(1) as usize;
        (from..=to).step_by(stride).map(move |tick| time.at(tick))
    };
    ticks((0.0, time.duration)).chain(ticks(own)).find_map(|time| {
        if let Some(fault) = RateFault::of_inputs(plant, time) {
            return Some(RunError::Expression(Box::new(fault)));
        }
        let known = plant.known_inputs(time);
        let input = known.iter().position(|&u| !(u as f32).is_finite())?;
        let (name, value) = (names[input].clone(), known[input]);
        Some(RunError::KnownInput { agent: agent + 1, name, value, time })
    })
}

fn text(
    scenario: &Scenario,
    design: &DesignChecks,
    observer: Option<&ObserverPreview>,
    warnings: &[Warning],
) -> String {
    let mut text = format!(
        "Scenario {}: {} agents, {} state components, {} steps\n",
        scenario.name,
        scenario.agents.len(),
        scenario.dimension(),
        scenario.steps(),
    );
    text += &design_text(design);
    text += match design.covered {
        true => "  together the agents measure the whole state\n",
        false => "  together the agents do NOT measure the whole state\n",
    };
    if !design.departures.is_empty() {
        // Said above.
    } else if !design.gain.holds() {
        text += "  Theorem 1: not applicable, because the gain is not a solution\n";
    } else if let Some(bound) = design.ultimate_bound {
        text += &format!(
            "  Theorem 1, if rho is at least chi_bar_max (which a run estimates): ultimate bound \
             |e_1| <= {}\n",
            significant(bound.ultimate().sqrt(), 4)
        );
    }
    text += &observer.map_or(String::new(), ObserverPreview::text);
    text + &warnings::lines(warnings)
}
