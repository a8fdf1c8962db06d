//! Checks against the theory, as text and for JSON.

use std::fmt::Write;

use serde::Serialize;

use super::theorems::{AgentCheck, Checks, DesignChecks, Status};
use crate::number::significant;

/// Number of agents listed individually.
const LINES: usize = 12;

/// Formats the checks that do not need a run, line by line.
#[must_use]
pub fn design_text(design: &DesignChecks) -> String {
    let trigger = match (&design.trigger_constants, design.trigger.departure()) {
        (_, Some(model)) => {
            format!("agents broadcast {model}, so Theorems 1 and 2 do not apply")
        }
        (Some(trigger), None) => format!(
            "phi1 = {} 1/s, phi2 = {} 1/s; with z = 0 it fires at |e_2| = {}",
            significant(trigger.phi1, 7),
            significant(trigger.phi2, 5),
            significant(trigger.radius(), 5),
        ),
        (None, None) => String::new(),
    };
    let step = design.step.describe();
    let mut text = if design.step.is_used {
        let gain = design.gain_in_words();
        format!("  K1 in the matrix inequality: {gain}\n  step: {step}\n  trigger: {trigger}\n")
    } else {
        format!("  K1 and the event trigger: not in use\n  step: {step}\n")
    };
    if !design.departures.is_empty() {
        text += "  Theorems 1 and 2: not applicable, because\n";
        text.extend(design.departures.iter().map(|clause| format!("    - {clause}\n")));
    }
    text
}

/// Formats all checks of a run, with a heading.
#[must_use]
pub fn text(checks: &Checks) -> String {
    let mut text = String::from("Checks against the theory\n");
    text += &design_text(&checks.design);
    if !checks.design.departures.is_empty() {
        text.push('\n');
        return text;
    }
    text += &theorem1(checks);
    for (index, agent) in checks.theorem2.iter().enumerate().take(LINES) {
        let shortest = agent
            .interval_min
            .map_or("none".to_owned(), |time| format!("{} s", significant(time, 3)));
        let bound = match agent.interval_bound {
            Some(bound) if agent.status.premise().is_none() => {
                format!(", bound {} s", significant(bound, 3))
            }
            _ => String::new(),
        };
        // Writing into a string cannot fail.
        let _ = writeln!(
            text,
            "  Theorem 2, agent {}: {}; shortest interval {shortest}{bound}",
            index + 1,
            in_words(&agent.status),
        );
    }
    if checks.theorem2.len() > LINES {
        let all = checks.theorem2.len();
        let count = |wanted: &str| {
            checks.theorem2.iter().filter(|agent| agent.status.as_str() == wanted).count()
        };
        let _ = writeln!(
            text,
            "  Theorem 2, all {all} agents: kept by {}, broken by {}, not applicable to {}",
            count("kept"),
            count("broken"),
            count("not_applicable"),
        );
    }
    text.push('\n');
    text
}

fn in_words(status: &Status) -> String {
    match status {
        Status::Kept => "kept".to_owned(),
        Status::Broken => "BROKEN".to_owned(),
        Status::NotApplicable(premise) if premise.starts_with("not ") => premise.clone(),
        Status::NotApplicable(premise) => format!("not applicable: {premise}"),
    }
}

fn theorem1(checks: &Checks) -> String {
    let theorem = &checks.theorem1;
    let mut text = format!("  Theorem 1: {}\n", in_words(&theorem.status));
    if let Some(share) = &theorem.share {
        // At t = 0 the bound equals the error if there is no network.
        let from_start = share.bound.weight_error > 0.0;
        let (part, when) = if from_start {
            (share.largest, format!("at most (at t = {} s)", significant(share.largest_at, 4)))
        } else {
            (share.largest_evaluated, "at most in the evaluation window".to_owned())
        };
        // Writing into a string cannot fail.
        let _ = writeln!(
            text,
            "    |e_1|^2 reached {} % of its bound {when}; ultimately |e_1| <= {}, bound {}",
            significant(100.0 * part, 3),
            significant(share.error_evaluated, 4),
            significant(share.bound.ultimate().sqrt(), 4),
        );
    }
    if let Some(lumped) = &theorem.lumped {
        let _ = writeln!(
            text,
            "    rho = {}, must reach chi_bar_max: about {} for the best W_0 found, at least {} for any \
             (evaluated at {} steps); the disturbance alone, stacked over the agents: {}",
            theorem.rho,
            significant(lumped.estimate, 4),
            significant(lumped.at_least, 4),
            lumped.samples,
            significant(lumped.disturbance, 4),
        );
    }
    text
}

/// The checks that do not need a run, for JSON.
#[derive(Clone, Debug, Serialize)]
pub struct DesignReport {
    eigenvalue_min: f64,
    eigenvalue_uncertainty: f64,
    k1: f64,
    solution: bool,
    /// Factor that makes the gain a solution; null if it already is one or no factor helps.
    gain_factor: Option<f64>,
    /// Null if agents do not use the event trigger, like the two below.
    phi1: Option<f64>,
    phi2: Option<f64>,
    /// Hold error at which the trigger fires with z = 0.
    trigger_radius: Option<f64>,
    state_covered: bool,
    step: f64,
    largest_stable_step: Option<f64>,
    /// Limit of Theorem 1's bound on `|e_1|`.
    ultimate_bound: Option<f64>,
}

impl DesignReport {
    /// Creates the report of these checks.
    #[must_use]
    pub fn new(design: &DesignChecks) -> Self {
        let (gain, trigger) = (&design.gain, &design.trigger_constants);
        Self {
            eigenvalue_min: gain.eigenvalue_min,
            eigenvalue_uncertainty: gain.uncertainty,
            k1: gain.k1,
            solution: gain.holds(),
            gain_factor: gain.factor(),
            phi1: trigger.map(|trigger| trigger.phi1),
            phi2: trigger.map(|trigger| trigger.phi2),
            trigger_radius: trigger.map(|trigger| trigger.radius()),
            state_covered: design.covered,
            step: design.step.step_size,
            largest_stable_step: design.step.largest_stable_step,
            ultimate_bound: design
                .ultimate_bound
                .filter(|_| design.gain.holds())
                .map(|bound| bound.ultimate().sqrt()),
        }
    }
}

/// All checks of a run, for JSON.
#[derive(Clone, Debug, Serialize)]
pub struct ChecksReport {
    #[serde(flatten)]
    design: DesignReport,
    theorem1: Theorem1Report,
    theorem2: Theorem2Report,
}

#[derive(Clone, Debug, Serialize)]
struct Theorem1Report {
    status: &'static str,
    premise: Option<String>,
    rho: f64,
    chi_bar_max: Option<f64>,
    chi_bar_max_at_least: Option<f64>,
    disturbance_max: Option<f64>,
    largest_share: Option<f64>,
    largest_share_time: Option<f64>,
    largest_share_evaluated: Option<f64>,
    error_evaluated: Option<f64>,
    ultimate_bound: Option<f64>,
}

#[derive(Clone, Debug, Serialize)]
struct Theorem2Report {
    status: &'static str,
    premise: Option<String>,
    agents: Vec<Theorem2Agent>,
}

#[derive(Clone, Debug, Serialize)]
struct Theorem2Agent {
    agent: usize,
    status: &'static str,
    premise: Option<String>,
    hold_error_rate: f64,
    interval_bound: Option<f64>,
    interval_min: Option<f64>,
}

impl ChecksReport {
    /// Creates the report of these checks.
    #[must_use]
    pub fn new(checks: &Checks) -> Self {
        let premise = |status: &Status| status.premise().map(str::to_owned);
        let (first, lumped) = (&checks.theorem1, checks.theorem1.lumped);
        let share = first.share;
        let second = checks.theorem2_status();
        let agent = |(index, agent): (usize, &AgentCheck)| Theorem2Agent {
            agent: index + 1,
            status: agent.status.as_str(),
            premise: premise(&agent.status),
            hold_error_rate: agent.hold_error_rate,
            interval_bound: agent.interval_bound,
            interval_min: agent.interval_min,
        };
        Self {
            design: DesignReport::new(&checks.design),
            theorem1: Theorem1Report {
                status: first.status.as_str(),
                premise: premise(&first.status),
                rho: first.rho,
                chi_bar_max: lumped.map(|lumped| lumped.estimate),
                chi_bar_max_at_least: lumped.map(|lumped| lumped.at_least),
                disturbance_max: lumped.map(|lumped| lumped.disturbance),
                largest_share: share.map(|share| share.largest),
                largest_share_time: share.map(|share| share.largest_at),
                largest_share_evaluated: share.map(|share| share.largest_evaluated),
                error_evaluated: share.map(|share| share.error_evaluated),
                ultimate_bound: share.map(|share| share.bound.ultimate().sqrt()),
            },
            theorem2: Theorem2Report {
                status: second.as_str(),
                premise: premise(&second),
                agents: checks.theorem2.iter().enumerate().map(agent).collect(),
            },
        }
    }
}
