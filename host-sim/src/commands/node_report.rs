//! A node's report: how its package performs, its trial, and its resets, as text and JSON.

use agent_core::health::{RevertReason, Verdict};
use agent_core::service::{
    LastRevert, PanicPlace, Performance, Report, ResetCause, Session, TrialReport,
};
use serde::Serialize;

use super::board_report::StatusReport;
use super::node_keys::KeysReport;

/// A node's status and report, for JSON.
#[derive(Serialize)]
pub(super) struct NodeReport<'a> {
    #[serde(flatten)]
    status: &'a StatusReport<'a>,
    version: Option<u32>,
    epoch: Option<u32>,
    innovation_rms: Option<f32>,
    disagreement_rms: Option<f32>,
    effort_rms: Option<f32>,
    broadcasts_per_second: Option<f32>,
    trial: Option<Trial>,
    last_revert: Option<Reverted>,
    boots: Option<u32>,
    reset_cause: &'static str,
    panic: Option<String>,
    stalled_ticks: Option<u32>,
    /// Names of the health counters that have reached their limit.
    health_saturated: Vec<&'static str>,
    keys: KeysReport,
}

#[derive(Serialize)]
struct Trial {
    good_seconds: f32,
    needed_seconds: f32,
    deadline_seconds: f32,
    verdict: &'static str,
    reason: Option<&'static str>,
    found: Option<Performance>,
    before: Option<Performance>,
}

#[derive(Serialize)]
struct Reverted {
    version: u32,
    epoch: u32,
    reason: &'static str,
}

impl<'a> NodeReport<'a> {
    /// Joins a status with the report, `None` from firmware that has none, and with the session, `None`
    /// from a node without keys.
    pub(super) fn new(
        status: &'a StatusReport<'a>,
        report: Option<&Report>,
        session: Option<&Session>,
    ) -> Self {
        let performance = report.and_then(|report| report.performance);
        Self {
            version: status.status().package.map(|package| package.version),
            epoch: report.and_then(|report| report.epoch),
            innovation_rms: performance.map(|found| found.innovation_rms),
            disagreement_rms: performance.map(|found| found.disagreement_rms),
            effort_rms: performance.map(|found| found.effort_rms),
            broadcasts_per_second: performance.map(|found| found.broadcasts_per_second),
            trial: report.and_then(|report| report.trial).as_ref().map(Trial::from),
            last_revert: report.and_then(|report| report.last_revert).map(|last| Reverted {
                version: last.version,
                epoch: last.epoch,
                reason: last.reason.name(),
            }),
            boots: report.and_then(|report| report.boots),
            reset_cause: report.map_or(ResetCause::Unknown, |report| report.reset_cause).name(),
            panic: report.and_then(|report| report.panic).as_ref().map(place),
            stalled_ticks: report.map(|report| report.stalled_ticks),
            health_saturated: status.status().health.saturated().collect(),
            keys: KeysReport::new(session),
            status,
        }
    }
}

impl From<&TrialReport> for Trial {
    fn from(trial: &TrialReport) -> Self {
        let (verdict, reason) = match trial.verdict {
            Verdict::Running => ("running", None),
            Verdict::AwaitsOperator => ("awaits_operator", None),
            Verdict::Passed => ("confirmed", None),
            Verdict::Failed(reason) => ("reverted", Some(reason.name())),
        };
        Self {
            good_seconds: trial.good_seconds,
            needed_seconds: trial.needed_seconds,
            deadline_seconds: trial.deadline_seconds,
            verdict,
            reason,
            found: trial.found,
            before: trial.before,
        }
    }
}

/// Formats a report as lines to append to a status.
pub(super) fn text(report: &Report) -> String {
    let mut text = String::new();
    if let Some(found) = &report.performance {
        text += &format!("  {}\n", performance(found));
    }
    if let Some(trial) = &report.trial {
        let TrialReport { good_seconds, needed_seconds, deadline_seconds, verdict, .. } = trial;
        text += &match verdict {
            Verdict::Running => format!(
                "  trial: {good_seconds:.1} s of {needed_seconds:.1} s without problems, decision \
                 due within {deadline_seconds:.1} s\n"
            ),
            Verdict::AwaitsOperator => format!(
                "  trial: nothing to compare the package with, or an output matrix that differs from the previous one; \
                 confirm it within {deadline_seconds:.1} s of its activation with `host-sim node ENDPOINT confirm`\n"
            ),
            Verdict::Passed => "  last trial: confirmed\n".to_owned(),
            Verdict::Failed(_) => String::new(),
        };
        for (name, found) in [("on trial", &trial.found), ("before", &trial.before)] {
            if let Some(found) = found {
                text += &format!("    {name}: {}\n", performance(found));
            }
        }
    }
    if let Some(LastRevert { version, epoch, reason }) = report.last_revert {
        text += &format!(
            "  version {version} of package epoch {epoch} was rolled back: {}\n",
            reason_text(reason)
        );
    }
    let boots = report.boots.map_or(String::new(), |boots| format!(", start {boots}"));
    let cause = match report.reset_cause {
        ResetCause::Unknown => "not known to the board",
        ResetCause::PowerOn => "power-on",
        ResetCause::BrownOut => "low supply voltage",
        ResetCause::Pin => "reset pin",
        ResetCause::Watchdog => "watchdog: due work was not done",
        ResetCause::Software => "the firmware's own request",
        ResetCause::Panic => "a panic or fault in the firmware",
    };
    text += &format!("  last reset: {cause}{boots}\n");
    if let Some(panic) = &report.panic {
        text += &format!("  the firmware panicked at {}\n", place(panic));
    }
    if report.stalled_ticks > 0 {
        text +=
            &format!("  ticks missed while flash was being written: {}\n", report.stalled_ticks);
    }
    text
}

fn performance(found: &Performance) -> String {
    format!(
        "innovation {:.3e} (RMS), disagreement with the neighbours {:.3e} (RMS), {:.1} broadcasts/s",
        found.innovation_rms, found.disagreement_rms, found.broadcasts_per_second
    )
}

fn place(panic: &PanicPlace) -> String {
    let file = String::from_utf8_lossy(&panic.file);
    format!("{}:{}", file.trim_end_matches('\0'), panic.line)
}

/// Explains why a package was rolled back.
pub(super) fn reason_text(reason: RevertReason) -> &'static str {
    match reason {
        RevertReason::Operator => "the operator asked for it",
        RevertReason::Reset => "the node was reset during its trial",
        RevertReason::Restarts => "the agent restarted too often",
        RevertReason::Overflows => "too many steps would have overflowed",
        RevertReason::SkippedTicks => "too many ticks were skipped",
        RevertReason::Innovation => "its innovation was too large",
        RevertReason::Disagreement => "its estimate was too far from those of the neighbours",
        RevertReason::Broadcasts => "it broadcast too often",
        RevertReason::Faults => "too many of its steps were faulty",
        RevertReason::Measurements => "there were too few measurements to judge it by",
        RevertReason::NotConfirmed => {
            "there was nothing to compare it with, or it has a different output matrix, and it was not \
             confirmed in time"
        }
        RevertReason::Unusable => "no agent could be built from it",
        RevertReason::Effort => {
            "the feedback had to correct too much of what its network predicted"
        }
    }
}
