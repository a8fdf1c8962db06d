//! The files that a run leaves behind.

use std::path::Path;

use super::CommandError;
use super::baselines::Baseline;
use crate::engine::RunResult;
use crate::engine::statistics::AgentStatistics;
use crate::figures::{Marker, Reference};
use crate::output_file::OutputError;
use crate::report::csv::{EpochRow, write_epochs, write_events, write_traces};
use crate::scenario::{LearningCycle, Scenario, Window};

/// Length of the window that an event figure shows, in steps: as many as the paper's.
const EVENT_WINDOW: f64 = 500.0;

/// Writes traces, broadcast times and training of a run as `NAMEsuffix.csv` in `folder`, as far
/// as they were recorded; returns the names of the files.
pub(super) fn tables(
    folder: &Path,
    suffix: &str,
    scenario: &Scenario,
    run: &RunResult,
) -> Result<Vec<String>, CommandError> {
    let name = |stem: &str| format!("{stem}{suffix}.csv");
    let traces = || -> Result<_, OutputError> {
        if run.traces.rows() == 0 {
            return Ok(None);
        }
        let names = scenario.plant.state_names();
        write_traces(&folder.join(name("traces")), &run.traces, &names)?;
        Ok(Some(name("traces")))
    };
    let events = || -> Result<_, OutputError> {
        if !scenario.record.events {
            return Ok(None);
        }
        let step_size = scenario.time.step_size;
        write_events(&folder.join(name("events")), &events_of(run), step_size)?;
        Ok(Some(name("events")))
    };
    let (traces, events) = rayon::join(traces, events);
    let mut names: Vec<String> = [traces?, events?].into_iter().flatten().collect();
    if !run.trainings.is_empty() {
        write_epochs(&folder.join(name("training")), &epochs(run))?;
        names.push(name("training"));
    }
    Ok(names)
}

/// Writes the package of every training and, where they were recorded, the samples that it was
/// trained on; returns the names of the files.
pub(super) fn packages(folder: &Path, run: &RunResult) -> Result<Vec<String>, CommandError> {
    let mut names = Vec::new();
    for training in &run.trainings {
        let stem = format!("agent{}_cycle{}", training.agent, training.cycle);
        let package = format!("{stem}.weights");
        training.package.save(&folder.join(&package))?;
        names.push(package);
        if let Some(recording) = &training.recording {
            let samples = format!("{stem}_samples.csv");
            recording.save(&folder.join(&samples))?;
            names.push(samples);
        }
    }
    Ok(names)
}

/// Ticks of all broadcasts, an entry for each agent.
pub(super) fn events_of(run: &RunResult) -> Vec<&[u64]> {
    run.agents.iter().map(|agent| agent.events.as_slice()).collect()
}

fn epochs(run: &RunResult) -> Vec<EpochRow> {
    let rows = run.trainings.iter().flat_map(|training| {
        training.report.epochs.iter().map(|epoch| EpochRow {
            agent: training.agent,
            cycle: training.cycle,
            epoch: epoch.epoch,
            train_mse: epoch.train,
            validation_mse: epoch.validation,
            test_mse: epoch.test,
            damping: epoch.damping,
            gradient_norm: epoch.gradient_norm,
        })
    });
    rows.collect()
}

/// Marks beginning and end of collection and the switch of every cycle, in ascending order;
/// agents that learn at the same times share their marks.
pub(super) fn markers(scenario: &Scenario) -> Vec<Marker<'static>> {
    let mut times: Vec<(f64, Marker<'static>)> = Vec::new();
    for LearningCycle { collect, apply_at, .. } in &scenario.learning {
        for (time, marker) in [
            (collect.from, Marker::collection_start(collect.from, "collect")),
            (collect.to, Marker::collection_end(collect.to, "train")),
            (*apply_at, Marker::apply(*apply_at, "apply")),
        ] {
            if !times.iter().any(|(_, known)| *known == marker) {
                times.push((time, marker));
            }
        }
    }
    times.sort_by(|(a, _), (b, _)| a.total_cmp(b));
    times.into_iter().map(|(_, marker)| marker).collect()
}

/// Errors of baselines, in the order of [`Baseline::ALL`], as an error figure shows them: over the
/// evaluation window.
pub(super) fn references(
    scenario: &Scenario,
    baselines: [Option<&[AgentStatistics]>; 2],
) -> Vec<Reference<'static>> {
    let window = scenario.evaluation;
    let references = Baseline::ALL.into_iter().zip(baselines).filter_map(|(baseline, agents)| {
        let errors = agents?.iter().map(AgentStatistics::rmse).collect();
        Some(Reference { label: baseline.name(), from: window.from, to: window.to, errors })
    });
    references.collect()
}

/// The window that the event figure shows: around the first switch, or where the evaluation
/// begins.
pub(super) fn event_window(scenario: &Scenario) -> Window {
    let centre = scenario.learning.first().map_or(scenario.evaluation.from, |c| c.apply_at);
    let length = (EVENT_WINDOW * scenario.time.step_size).min(scenario.time.duration);
    let from = (centre - 0.5 * length).clamp(0.0, scenario.time.duration - length);
    Window { from, to: from + length }
}
