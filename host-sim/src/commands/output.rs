//! The files a run writes.

use std::path::Path;

use clap::Args;

use super::CommandError;
use super::baselines::Baseline;
use super::package_format::PackageFormat;
use crate::engine::statistics::AgentStatistics;
use crate::engine::{RunResult, TrainingRecord};
use crate::figures::{FigureFormat, Marker, Reference};
use crate::files::output::OutputError;
use crate::packages::recording::SampleLabels;
use crate::report::csv::{EpochRow, write_epochs, write_events, write_traces};
use crate::scenario::{LearningCycle, Scenario, Window};

/// Length of the event figure's window, as in the paper. \[steps\]
const EVENT_WINDOW: f64 = 500.0;

/// Returns the names of all files that [`tables`], with this suffix, and [`packages`] may write.
pub(super) fn planned(scenario: &Scenario, suffix: &str, learning: bool) -> Vec<String> {
    let mut names: Vec<_> =
        ["traces", "events", "training"].map(|stem| format!("{stem}{suffix}.csv")).into();
    let again = scenario.learning.last().into_iter();
    let again = again.flat_map(|last| std::iter::repeat_n(last, scenario.relearnings_max()));
    let cycles = scenario.learning.iter().chain(again).zip(1..).filter(|_| learning);
    for (agent, cycle) in
        cycles.flat_map(|(cycle, number)| cycle.agents.iter().map(move |agent| (agent + 1, number)))
    {
        names.extend([package_name(agent, cycle), samples_name(agent, cycle)]);
    }
    names
}

/// Returns the file name of the package that an agent was trained for in a cycle, both from 1.
pub(super) fn package_name(agent: usize, cycle: usize) -> String {
    format!("agent{agent}_cycle{cycle}.weights")
}

/// Returns the file name of the samples of that training.
fn samples_name(agent: usize, cycle: usize) -> String {
    format!("agent{agent}_cycle{cycle}_samples.csv")
}

/// The argument about the format of figures.
#[derive(Clone, Copy, Debug, Args)]
pub(super) struct FigureFormats {
    /// Write each figure as PDF as well, with embedded fonts
    #[arg(long)]
    pdf: bool,
}

impl FigureFormats {
    /// Whether PDF is wanted.
    pub(super) fn has_pdf(self) -> bool {
        self.pdf
    }

    /// Returns the formats to write.
    pub(super) fn wanted(self) -> &'static [FigureFormat] {
        if self.pdf { &FigureFormat::ALL } else { &FigureFormat::DEFAULT }
    }

    /// Returns the file names of figures with these stems.
    pub(super) fn names<'s>(self, stems: impl IntoIterator<Item = &'s str>) -> Vec<String> {
        let names = |stem| self.wanted().iter().map(move |format| format.file_name(stem));
        stems.into_iter().flat_map(names).collect()
    }
}

/// Writes the recorded traces, broadcast times and training of a run as `NAMEsuffix.csv` in
/// `folder`.
pub(super) fn tables(
    folder: &Path,
    suffix: &str,
    scenario: &Scenario,
    run: &RunResult,
) -> Result<(), CommandError> {
    let name = |stem: &str| format!("{stem}{suffix}.csv");
    let traces = || -> Result<(), OutputError> {
        if run.traces.rows() == 0 {
            return Ok(());
        }
        let names = scenario.plant.state_names();
        write_traces(&folder.join(name("traces")), &run.traces, &names)
    };
    let events = || -> Result<(), OutputError> {
        if !scenario.record.events {
            return Ok(());
        }
        let step_size = scenario.time.step_size;
        write_events(&folder.join(name("events")), &events_of(run), step_size)
    };
    let (traces, events) = rayon::join(traces, events);
    traces?;
    events?;
    if !run.trainings.is_empty() {
        write_epochs(&folder.join(name("training")), &epochs(run))?;
    }
    Ok(())
}

/// Writes the package of every training, if nodes support the scenario's trigger, and its training
/// samples, if recorded.
pub(super) fn packages(
    folder: &Path,
    format: PackageFormat,
    scenario: &Scenario,
    run: &RunResult,
) -> Result<(), CommandError> {
    let for_nodes = scenario.check_for_nodes().is_ok();
    for training in &run.trainings {
        if for_nodes {
            let name = package_name(training.agent, training.cycle);
            format.apply(&training.package, Path::new(&name))?.save(&folder.join(name))?;
        }
        if let Some(recording) = &training.recording {
            let name = samples_name(training.agent, training.cycle);
            let inputs = scenario.plant.input_names();
            let (agent, step) = (training.agent, scenario.time.step_size);
            let labels = SampleLabels { agent, step, inputs: &inputs };
            recording.save_labelled(&folder.join(name), Some(&labels))?;
        }
    }
    Ok(())
}

/// Returns what the plant's own state is called in figures; `None` if it is not known.
pub(super) fn truth_name(scenario: &Scenario) -> Option<&'static str> {
    match scenario.plant.recording() {
        None => Some("true state"),
        Some(recorded) => recorded.has_reference().then_some("reference"),
    }
}

/// Returns the ticks of all broadcasts, one entry per agent.
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

/// Returns markers for the start and end of each cycle's collection and for each switch that took
/// place, in ascending order and without duplicates.
pub(super) fn markers(
    cycles: &[LearningCycle],
    trainings: &[TrainingRecord],
) -> Vec<Marker<'static>> {
    let switched =
        |cycle| trainings.iter().any(|training| training.cycle == cycle && training.switched_in);
    markers_of(cycles, switched)
}

/// Returns the markers; `switched` returns whether a cycle, from 1, switched a network in.
fn markers_of(cycles: &[LearningCycle], switched: impl Fn(usize) -> bool) -> Vec<Marker<'static>> {
    let mut times: Vec<(f64, Marker<'static>)> = Vec::new();
    for (cycle, LearningCycle { collect, apply_at, .. }) in (1..).zip(cycles) {
        let switch = (*apply_at, Marker::apply(*apply_at, "apply"));
        for (time, marker) in [
            (collect.from, Marker::collection_start(collect.from, "collect")),
            (collect.to, Marker::collection_end(collect.to, "train")),
        ]
        .into_iter()
        .chain(switched(cycle).then_some(switch))
        {
            if !times.iter().any(|(_, known)| *known == marker) {
                times.push((time, marker));
            }
        }
    }
    times.sort_by(|(a, _), (b, _)| a.total_cmp(b));
    times.into_iter().map(|(_, marker)| marker).collect()
}

/// Returns the errors of baselines over the evaluation window, in the order of [`Baseline::ALL`],
/// for an error figure.
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

/// Returns the window of the event figure: around the first switch, or around the start of the
/// evaluation if there is none.
pub(super) fn event_window(scenario: &Scenario) -> Window {
    let centre = scenario.learning.first().map_or(scenario.evaluation.from, |c| c.apply_at);
    let length = (EVENT_WINDOW * scenario.time.step_size).min(scenario.time.duration);
    let from = (centre - 0.5 * length).clamp(0.0, scenario.time.duration - length);
    Window { from, to: from + length }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::PAPER;

    #[test]
    fn only_a_switch_that_took_place_is_marked() {
        let scenario = Scenario::parse("paper.toml", PAPER).unwrap();
        let cycle = &scenario.learning[0];
        let collection = [
            Marker::collection_start(cycle.collect.from, "collect"),
            Marker::collection_end(cycle.collect.to, "train"),
        ];
        assert_eq!(markers_of(&scenario.learning, |_| false), collection);
        let switch = Marker::apply(cycle.apply_at, "apply");
        assert_eq!(
            markers_of(&scenario.learning, |cycle| cycle == 1),
            [&collection[..], &[switch]].concat()
        );
    }
}
