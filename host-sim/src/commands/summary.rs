//! What a person reads on the terminal after a run.

use std::fmt::{self, Write};

use serde::Serialize;

use crate::analysis::Checks;
use crate::packages::quality::Quality;
use crate::training::StopReason;

/// Up to this many agents have a line each.
const LINES: usize = 12;

/// Share of the smoothed targets' variance that a network explains, in text and JSON.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct ExplainedVariance {
    training: Option<f64>,
    validation: Option<f64>,
    /// In the last 15 % of the samples' time.
    last: Option<f64>,
}

impl ExplainedVariance {
    pub(super) fn of(quality: &Quality) -> Self {
        Self {
            training: quality.training.explained,
            validation: quality.validation.and_then(|fit| fit.explained),
            last: quality.last,
        }
    }
}

impl fmt::Display for ExplainedVariance {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let percent = |share: Option<f64>| match share {
            Some(share) => format!("{:.1} %", 100.0 * share),
            None => "none".to_owned(),
        };
        let [training, validation, last] = [self.training, self.validation, self.last].map(percent);
        write!(f, "training {training}, validation {validation}, last 15 % in time {last}")
    }
}

/// What ended a training.
pub(super) fn reason(stop: StopReason) -> &'static str {
    match stop {
        StopReason::Goal => "its goal",
        StopReason::Epochs => "the number of epochs",
        StopReason::Gradient => "a vanishing gradient",
        StopReason::DampingMax => "the largest damping",
        StopReason::Validation => "failures of validation",
        StopReason::Callback => "request",
        StopReason::NotFinite => "an error that is not finite",
    }
}

/// What the theory promised and what the run did.
pub(super) fn checks(checks: &Checks) -> String {
    let mut text = String::from("Checks against the theory\n");
    let gain = &checks.gain;
    let verdict = if gain.holds() { "a solution" } else { "NOT a solution; raise design.gain" };
    // Writing into a string cannot fail.
    let _ = writeln!(
        text,
        "  K1 in the matrix inequality: lambda_min = {:.4} 1/s, needs k1 = {:.4} 1/s: {verdict}",
        gain.eigenvalue_min, gain.k1,
    );
    let trigger = &checks.trigger;
    let _ = writeln!(
        text,
        "  trigger: phi1 = {:.3} 1/s, phi2 = {:.6} 1/s; with z = 0 it fires at |e_2| = {:.7}",
        trigger.phi1,
        trigger.phi2,
        trigger.radius(),
    );
    match &checks.ultimate_bound {
        Some(check) => {
            let _ = writeln!(
                text,
                "  Theorem 1: |e_1|^2 took at most {:.2} % of its bound (at t = {:.3} s): {}; \
                 ultimately |e_1| <= {:.4}, bound {:.1}",
                100.0 * check.largest_share,
                check.largest_share_at,
                kept(check.largest_share <= 1.0),
                check.ultimate_error,
                check.bound.ultimate().sqrt(),
            );
        }
        None => text.push_str("  Theorem 1: says nothing, since k2 <= 1/kappa\n"),
    }
    let broken = checks.agents.iter().filter(|agent| !agent.holds()).count();
    for (index, agent) in checks.agents.iter().enumerate().take(LINES) {
        let shortest = agent.interval_min.map_or("none".to_owned(), |i| format!("{i:.4} s"));
        let _ = writeln!(
            text,
            "  Theorem 2, agent {}: shortest interval {shortest}, bound {:.6} s: {}",
            index + 1,
            agent.interval_bound,
            kept(agent.holds()),
        );
    }
    if checks.agents.len() > LINES {
        let _ = writeln!(
            text,
            "  Theorem 2, all {} agents: {}",
            checks.agents.len(),
            if broken == 0 { "kept".to_owned() } else { format!("BROKEN by {broken}") },
        );
    }
    text.push('\n');
    text
}

fn kept(holds: bool) -> &'static str {
    if holds { "kept" } else { "BROKEN" }
}
