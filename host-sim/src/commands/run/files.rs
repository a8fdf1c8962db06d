//! The files that `run` writes.

use std::path::Path;

use super::{ReportedRun, results};
use crate::commands::baselines::Baseline;
use crate::commands::output::FigureFormats;
use crate::commands::package_format::PackageFormat;
use crate::commands::run_folder::{PAGE, RESULTS, command_line};
use crate::commands::{CommandError, agent_table, methods, output, report};
use crate::figures::{
    ErrorFigure, EventFigure, StateFigure, error_norms, events, states, write_all,
};
use crate::report::csv::write_innovations;
use crate::report::mcap::write_mcap;
use crate::scenario::Scenario;
use crate::terminal;

/// Returns the names of all files that [`write`] may write.
pub(super) fn planned(scenario: &Scenario, figures: FigureFormats) -> Vec<String> {
    let mut planned = output::planned(scenario, "", true);
    planned.push("agents.csv".to_owned());
    planned.extend(["methods.csv", "innovations.csv", "run.mcap"].map(str::to_owned));
    planned.extend([RESULTS, PAGE].map(str::to_owned));
    planned.extend(figures.names(["errors", "states", "events", "methods"]));
    planned
}

/// What is written, and how.
#[derive(Clone, Copy, Debug)]
pub(super) struct Options {
    pub(super) figures: FigureFormats,
    pub(super) package_format: PackageFormat,
    /// Whether to write a page about all the rest.
    pub(super) has_page: bool,
    /// Whether to write an MCAP recording.
    pub(super) has_mcap: bool,
}

/// Writes all tables, figures and packages to the folder `out`. `text` is that of the scenario.
pub(super) fn write(
    out: &Path,
    options: Options,
    run: &ReportedRun,
    text: &str,
) -> Result<(), CommandError> {
    agent_table::write_csv(&out.join("agents.csv"), &run.agents)?;
    let (tables, figures) = rayon::join(
        || output::tables(out, "", &run.scenario, &run.result),
        || write_figures(out, options.figures, run),
    );
    tables?;
    figures?;
    if run.result.traces.has_innovations() {
        write_innovations(&out.join("innovations.csv"), &run.result.traces)?;
    }
    output::packages(out, options.package_format, &run.scenario, &run.result)?;
    write_methods(out, options.figures, &run.scenario, &run.rows)?;
    results::write(out, run, text)?;
    if options.has_mcap {
        write_mcap(&out.join("run.mcap"), &run.scenario, &run.result)?;
    }
    if options.has_page {
        report::write(&out.join(PAGE), &report::of_folder(out, command_line)?)?;
    }
    Ok(())
}

fn write_methods(
    out: &Path,
    formats: FigureFormats,
    scenario: &Scenario,
    rows: &[methods::Row],
) -> Result<(), CommandError> {
    if rows.is_empty() {
        return Ok(());
    }
    methods::write_csv(&out.join("methods.csv"), rows)?;
    if let Some(picture) = methods::picture(scenario, rows) {
        write_all(out, &[("methods", picture)], formats.wanted())?;
    }
    Ok(())
}

fn write_figures(
    out: &Path,
    formats: FigureFormats,
    run: &ReportedRun,
) -> Result<(), CommandError> {
    let ReportedRun { scenario, result, baselines, .. } = run;
    let markers = output::markers(&result.cycles, &result.trainings);
    let event_ticks = output::events_of(result);
    let window = output::event_window(scenario);
    let (traces, name) = (&result.traces, scenario.name.as_str());
    let mut figures = Vec::new();
    if traces.rows() > 0 && scenario.plant.is_known() {
        let title = format!("{name}: estimation errors");
        let errors = Baseline::ALL.map(|baseline| {
            baselines
                .is_shown(baseline)
                .then(|| baselines.agents(baseline, &result.agents))
                .flatten()
        });
        let references = output::references(scenario, errors);
        let figure = ErrorFigure {
            title: &title,
            traces,
            markers: &markers,
            references: &references,
            error_limit: None,
        };
        figures.push(("errors", error_norms(&figure)));
    }
    if traces.rows() > 0 {
        let truth = output::truth_name(scenario);
        let title = match truth {
            Some(truth) => format!("{name}: {truth} and estimates"),
            None => format!("{name}: estimates"),
        };
        let names = scenario.plant.state_names();
        let figure = StateFigure { title: &title, traces, names: &names, truth };
        figures.push(("states", states(&figure)));
    }
    if scenario.record.events {
        let title = format!("{name}: broadcasts");
        let figure = EventFigure {
            title: &title,
            events: &event_ticks,
            step_size: scenario.time.step_size,
            from: window.from,
            to: window.to,
        };
        figures.push(("events", events(&figure)));
    }
    if figures.is_empty() && formats.has_pdf() {
        terminal::warning(
            "--pdf: there is nothing to draw: neither traces nor broadcasts are recorded ([record])",
        );
    }
    write_all(out, &figures, formats.wanted())?;
    Ok(())
}
