//! `sweep`: runs a scenario with varied keys, seeds and initial states.
//!
//! | file | content |
//! | --- | --- |
//! | `results.csv` | a row for each agent of each run, written while the runs go on |
//! | `scenario.toml`, `sweep.json` | what the results depend on; the same command continues them, or extends them by more seeds and initial states |
//! | `.results-before.csv` | rows of a study that is being extended |
//! | `summary.csv` | mean, median and interval of each cell |
//! | `tradeoff.svg`, `tradeoff.png` | error against broadcasts |
//! | `results.parquet` | with `--parquet`: `results.csv` with types |

mod cells;
mod earlier;
pub(super) mod page;
#[cfg(feature = "parquet")]
mod parquet;
mod picture;
mod report;
mod results;
mod resume;
mod runs;
mod shard;
mod study;
mod summary;
mod vary;

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Args;

use super::output::FigureFormats;
use super::run_folder::{lock, remove_page, remove_result};
use super::scenario_source::load_with_text;
use super::{
    Changes, CommandError, Common, TableFormat, initial_states, print_outcome, print_text,
};
use crate::figures::{tradeoff, write_all};
use crate::files::output::{FileKind, OutputError, make_folder};
use crate::interruption::{self, SecondSignal};
use crate::number::counted;
use crate::report::latex::latex;
use crate::scenario::{Scenario, ScenarioSource, built_in, copied};
use crate::terminal;
use crate::warning::Warning;
use cells::{Cells, Loaded};
use earlier::Earlier;
use report::{Repeat, Report};
use results::Results;
use runs::Runs;
use shard::Shard;
use study::{Found, Study};
use summary::Summary;
use vary::Vary;

/// Title of the table.
const TITLE: &str =
    "Error and broadcasts: median, 2.5th and 97.5th percentile of the runs of each cell";

/// Arguments of `sweep`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Scenario: a TOML file or the name of a built-in scenario
    #[arg(required_unless_present = "summarise")]
    scenario: Option<PathBuf>,
    #[command(flatten)]
    changes: Changes,
    /// Vary a key of the scenario: a list (a,b,c), N numbers (lo:hi:N), or N numbers on a logarithmic
    /// scale (lo:hi:logN); several keys give all combinations
    #[arg(long, value_name = "KEY=SPEC")]
    vary: Vec<Vary>,
    /// Draw N points of a Latin hypercube instead of all combinations; ranges are then lo:hi or
    /// lo:hi:log
    #[arg(long, value_name = "N", requires = "vary", value_parser = clap::value_parser!(u32).range(1..))]
    latin: Option<u32>,
    /// Take the values of keys from a CSV file: its first line has the keys, and each further line has
    /// the values of a cell
    #[arg(long, value_name = "FILE.csv", conflicts_with_all = ["vary", "latin"])]
    points: Option<PathBuf>,
    /// Number of seeds of each cell, starting at --seed
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    seeds: u64,
    /// Number of initial states of the plant: the scenario's own, and others drawn from the range of its trajectory
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    initial_states: u64,
    /// Run one of N parts of the study, such as 1/8; it is written to a folder of its own in the output
    /// folder
    #[arg(long, value_name = "K/N", default_value_t = Shard::WHOLE)]
    shard: Shard,
    /// Output folder [default: out/NAME-sweep]
    #[arg(long)]
    out: Option<PathBuf>,
    /// Run nothing: write summary and picture of results that are already there
    #[arg(
        long, value_name = "RESULTS.csv",
        conflicts_with_all = ["scenario", "set", "vary", "latin", "points", "seeds", "initial_states", "shard"],
    )]
    summarise: Option<PathBuf>,
    /// Write the complete table as results.parquet as well, for pandas, Polars and DuckDB
    #[cfg(feature = "parquet")]
    #[arg(long)]
    parquet: bool,
    #[command(flatten)]
    figures: FigureFormats,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: TableFormat,
    #[command(flatten)]
    pub(super) common: Common,
}

/// What only some calls write, in the place of those before.
const OPTIONAL: [&str; 2] = ["tradeoff.pdf", "results.parquet"];

impl Arguments {
    /// Checks that the files made of a complete table can be written into `folder`.
    fn check_files(&self, folder: &Path) -> Result<(), CommandError> {
        for format in self.figures.wanted() {
            let (path, kind) = (folder.join(format.file_name("tradeoff")), format.kind());
            if path.exists() && !kind.replaces(&path) {
                return Err(OutputError::OtherInFolder { path, kind: kind.name }.into());
            }
        }
        let (path, kind) = (folder.join(summary::NAME), summary::KIND);
        if path.symlink_metadata().is_ok() && !kind.replaces(&path) {
            return Err(OutputError::OtherInFolder { path, kind: kind.name }.into());
        }
        if folder.join(study::NAME).exists() || kind.is_at(&path) {
            return Ok(());
        }
        // No study has written here: what would be replaced, or removed, is someone else's.
        let made = [
            ("tradeoff.svg", FileKind::SVG),
            ("tradeoff.png", FileKind::PNG),
            ("tradeoff.pdf", FileKind::PDF),
            ("results.parquet", FileKind::PARQUET),
        ];
        let mut made = made.into_iter().map(|(name, kind)| (folder.join(name), kind));
        match made.find(|(path, kind)| kind.is_at(path)) {
            Some((path, _)) => Err(OutputError::NotOurs { path }.into()),
            None => Ok(()),
        }
    }

    /// Refuses formats of what only a complete study has.
    fn check_formats(&self) -> Result<(), CommandError> {
        #[cfg(feature = "parquet")]
        let has_parquet = self.parquet;
        #[cfg(not(feature = "parquet"))]
        let has_parquet = false;
        if !self.shard.is_whole() && (has_parquet || self.figures.has_pdf()) {
            let option = if has_parquet { "--parquet" } else { "--pdf" };
            let problem = format!(
                "{option}: a part of a study has no such file; when all parts are complete, pass the option with \
                 --summarise"
            );
            return Err(CommandError::usage(problem));
        }
        Ok(())
    }
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    match (&arguments.summarise, &arguments.scenario) {
        (Some(results), _) => summarise(arguments, results),
        (None, Some(scenario)) => carry_out(arguments, scenario),
        (None, None) => Err(CommandError::usage("name a scenario")),
    }
}

/// Writes summary and picture of existing results.
fn summarise(arguments: &Arguments, results: &Path) -> Result<(), CommandError> {
    let start = Instant::now();
    let folder = match &arguments.out {
        Some(out) => out.clone(),
        None => results.parent().unwrap_or(Path::new("")).to_owned(),
    };
    let summary = Summary::read(results)?;
    if !folder.as_os_str().is_empty() {
        make_folder(&folder)?;
    }
    let study = Study::of(results.parent().unwrap_or(Path::new("")), &summary);
    let warnings = warn(&summary, study.as_ref().map(|(study, _)| study));
    let written = write_files(&folder, arguments, &summary, results)?;
    let report = Report {
        scenario: None,
        repeat: Repeat::new(study.as_ref().map(|(study, _)| study), &summary),
        keys: &summary.keys,
        cells: summary.cells.len(),
        seed: None,
        seeds: None,
        initial_states: None,
        shard: None,
        runs: summary.runs(),
        runs_before: summary.runs(),
        runs_done: 0,
        elapsed_s: start.elapsed().as_secs_f64(),
        engine_s: 0.0,
        results: results.display().to_string(),
        failed: 0,
        first_failure: None,
        warnings: &warnings,
        summary: &summary.cells,
    };
    match arguments.format {
        TableFormat::Json => print_outcome(&report, Ok(())),
        TableFormat::Latex => print_text(&latex(TITLE, &summary.table(usize::MAX))),
        TableFormat::Text => print_text(&format!(
            "{}\n{} of {}\nWritten to {}: {written}\n{}",
            summary.text(),
            counted(summary.runs(), "run", "runs"),
            results.display(),
            if folder.as_os_str().is_empty() { Path::new(".") } else { &folder }.display(),
            report.repeat.text(),
        )),
    }
}

/// Prints and returns what a reader of the summary has to know.
fn warn(summary: &Summary, study: Option<&Study>) -> Vec<Warning> {
    let all = study.map(|study| (study.runs, study.cells));
    let warnings = summary.remarks(all);
    warnings.iter().for_each(terminal::warning);
    warnings
}

fn carry_out(arguments: &Arguments, path: &Path) -> Result<(), CommandError> {
    let start = Instant::now();
    arguments.check_formats()?;
    interruption::listen(SecondSignal::Exit);
    let (base, text) = load_with_text(path, &arguments.changes)?;
    let cells = cells(arguments)?;
    let out = arguments.out.clone();
    let out = out.unwrap_or_else(|| Path::new("out").join(format!("{}-sweep", base.name)));
    let folder = match arguments.shard.is_whole() {
        true => out.clone(),
        false => out.join(arguments.shard.folder()),
    };
    let source = ScenarioSource { name: path.display().to_string(), text: text.clone() };
    let command = command(arguments, &again(path, &folder));
    let (study, runs) = plan(arguments, &base, &source, &cells, command)?;
    make_folder(&folder)?;
    let _lock = lock(&folder)?;
    let file = folder.join(results::NAME);
    if resume::is_foreign(&file) && !folder.join(study::NAME).exists() {
        let kind = results::KIND.name;
        return Err(OutputError::OtherInFolder { path: file, kind }.into());
    }
    arguments.check_files(&folder)?;
    let copy = copied(&path.display().to_string(), &text, &folder);
    let found = study.find(&folder, &copy)?;
    if found == Found::Smaller {
        Earlier::set_aside(&folder, &runs)?;
        summary::remove(&folder)?;
        remove_derived(&folder, &["tradeoff.svg", "tradeoff.png"])?;
        remove_derived(&folder, &OPTIONAL)?;
    }
    if found != Found::Same {
        study.write(&folder, &copy)?;
    }
    let earlier = Earlier::read(&folder, &runs)?;
    let part = arguments.shard.of(total(arguments, &cells)?);
    let (opened, written_before) = resume::open(&file, part.start, &runs)?;
    let next = part.start + written_before;
    let before = written_before + runs.known_from(next, &earlier);
    remove_page(&folder)?;
    let outcome = runs.carry_out(next, Results::new(&file, opened, next), &earlier)?;
    let is_complete = outcome.left == 0;
    if is_complete {
        Earlier::remove(&folder)?;
    }
    let mut written = vec![results::NAME.to_owned()];
    let mut summary = Summary {
        keys: cells.keys.clone(),
        is_recorded: runs.is_recorded(),
        cells: Vec::new(),
        digest: String::new(),
    };
    let mut warnings = Vec::new();
    if arguments.shard.is_whole() && is_complete {
        summary = Summary::read(&file)?;
        warnings = warn(&summary, Some(&study));
        written.push(write_files(&folder, arguments, &summary, &file)?);
    }
    let first_failure = outcome.first_failure.as_ref();
    let first_failure =
        first_failure.map(|(run, reason)| format!("{}: {reason}", runs.name(*run, &cells.keys)));
    let report = Report {
        scenario: Some(&base.name),
        repeat: Repeat::new(Some(&study), &summary),
        keys: &cells.keys,
        cells: cells.rows.len(),
        seed: Some(study.seed),
        seeds: Some(study.seeds),
        initial_states: Some(study.initial_states),
        shard: Some(&study.shard),
        runs: study.runs,
        runs_before: before,
        runs_done: outcome.done,
        elapsed_s: start.elapsed().as_secs_f64(),
        engine_s: outcome.in_runs.as_secs_f64(),
        results: file.display().to_string(),
        failed: outcome.failed,
        first_failure: first_failure.as_deref(),
        warnings: &warnings,
        summary: &summary.cells,
    };
    let result = report::outcome(&study, &outcome, before, &file, &summary);
    match arguments.format {
        TableFormat::Json => print_outcome(&report, result),
        TableFormat::Latex => {
            let table = latex(TITLE, &summary.table(usize::MAX));
            let printed = if summary.cells.is_empty() { Ok(()) } else { print_text(&table) };
            result.and(printed)
        }
        TableFormat::Text => {
            let mut text = String::new();
            if !summary.cells.is_empty() {
                text += &format!("{}\n", summary.text());
            }
            if let Some(first) = &first_failure {
                let failed = counted(outcome.failed, "run", "runs");
                text += &format!("{failed} failed; the first: {first}\n");
            }
            if before == study.runs {
                text += "All runs were already complete\n";
            } else if before > 0 {
                text += &format!(
                    "Continued after {before} of {}\n",
                    counted(study.runs, "run", "runs")
                );
            }
            text += &format!("Written to {}: {}\n", folder.display(), written.join(", "));
            if !arguments.shard.is_whole() {
                text += &report::how_to_merge(&out);
            }
            text += &format!(
                "Scenario {}, {}, {} of {}, {:.1} s\n",
                base.name,
                counted(cells.rows.len() as u64, "cell", "cells"),
                before + outcome.done,
                counted(study.runs, "run", "runs"),
                report.elapsed_s
            );
            text += &report.repeat.text();
            let printed = print_text(&text);
            result.and(printed)
        }
    }
}

fn cells(arguments: &Arguments) -> Result<Cells, CommandError> {
    let cells = match (&arguments.points, arguments.latin) {
        (Some(path), _) => Cells::points(path),
        (None, Some(count)) => Cells::latin(&arguments.vary, count as usize, arguments.common.seed),
        (None, None) => Cells::grid(&arguments.vary),
    }?;
    for change in &cells.changes(0)? {
        if let Some(set) = arguments.changes.set.iter().find(|set| set.is_about_same_key(change)) {
            let problem = format!("{set}: the key is also varied; leave out one of the two");
            return Err(CommandError::usage(problem));
        }
    }
    Ok(cells)
}

/// Returns the name by which a scenario can be read again: of one from a pipe, its copy in the study's `folder`.
fn again(path: &Path, folder: &Path) -> String {
    let is_stream = ["/dev/stdin", "/dev/fd", "/proc"].iter().any(|root| path.starts_with(root));
    let is_pipe = fs::metadata(path).is_ok_and(|found| !found.is_file() && !found.is_dir());
    let name = path.display().to_string();
    if built_in(&name).is_none() && (is_stream || is_pipe) {
        return folder.join(study::SCENARIO).display().to_string();
    }
    name
}

/// Returns the command that repeats the study, without its output folder and number of threads.
fn command(arguments: &Arguments, scenario: &str) -> Vec<String> {
    let mut words = vec!["host-sim".to_owned(), "sweep".to_owned(), scenario.to_owned()];
    let mut option = |name: &str, value: String| words.extend([name.to_owned(), value]);
    for change in &arguments.changes.set {
        option("--set", change.argument());
    }
    for vary in &arguments.vary {
        option("--vary", vary.text.clone());
    }
    if let Some(count) = arguments.latin {
        option("--latin", count.to_string());
    }
    if let Some(points) = &arguments.points {
        option("--points", points.display().to_string());
    }
    option("--seed", arguments.common.seed.to_string());
    option("--seeds", arguments.seeds.to_string());
    option("--initial-states", arguments.initial_states.to_string());
    if !arguments.shard.is_whole() {
        option(Study::SHARD, arguments.shard.to_string());
    }
    words
}

/// Returns the number of runs of the whole study.
fn total(arguments: &Arguments, cells: &Cells) -> Result<u64, CommandError> {
    let each = arguments.seeds.checked_mul(arguments.initial_states);
    each.and_then(|each| each.checked_mul(cells.rows.len() as u64))
        .ok_or_else(|| CommandError::usage("too many runs; choose fewer seeds or initial states"))
}

/// Checks all cells and prepares the runs of this part.
fn plan(
    arguments: &Arguments,
    base: &Scenario,
    source: &ScenarioSource,
    cells: &Cells,
    command: Vec<String>,
) -> Result<(Study, Runs), CommandError> {
    let (seed, seeds, states) = (arguments.common.seed, arguments.seeds, arguments.initial_states);
    if seed.checked_add(seeds).is_none() {
        let problem = format!("--seed {seed}: too few seeds remain after it; choose a smaller one");
        return Err(CommandError::usage(problem));
    }
    let part = arguments.shard.of(total(arguments, cells)?);
    let others = initial_states::others(&base.drawn(seed), states, seed)?;
    let dimension = (states > 1).then(|| base.dimension());
    let wanted = Runs::cells_of(&part, seeds, states);
    let Loaded { cells: own, is_recorded, hash } = cells.load(source, wanted, dimension)?;
    if is_recorded && states > 1 {
        return Err(initial_states::recorded());
    }
    let header = arguments.shard.is_first().then(|| results::header(&cells.keys, is_recorded));
    let study = Study {
        host_sim: env!("CARGO_PKG_VERSION").to_owned(),
        scenario: base.name.clone(),
        scenario_hash: format!("{:#018x}", base.hash),
        keys: cells.keys.clone(),
        cells: cells.rows.len(),
        cells_hash: format!("{hash:#018x}"),
        seed,
        seeds,
        initial_states: states,
        shard: arguments.shard.to_string(),
        runs: part.end - part.start,
        command,
    };
    Ok((study, Runs::new(own, (seed, seeds), others, part, (header, is_recorded))))
}

/// Removes files that were made of a table that changes.
fn remove_derived(folder: &Path, names: &[&str]) -> Result<(), OutputError> {
    names.iter().map(|name| folder.join(name)).try_for_each(|path| {
        remove_result(&path).map_err(|error| OutputError::Write { path, error })
    })
}

/// Writes what is made of a complete table, `summary.csv` and the picture; returns their names.
fn write_files(
    folder: &Path,
    arguments: &Arguments,
    summary: &Summary,
    #[cfg_attr(not(feature = "parquet"), allow(unused_variables))] results: &Path,
) -> Result<String, CommandError> {
    arguments.check_files(folder)?;
    // Left by a call that wrote them; now they would not fit the table.
    remove_derived(folder, &OPTIONAL)?;
    summary.write(folder)?;
    let mut names = vec![summary::NAME.to_owned()];
    let cells = counted(summary.cells.len() as u64, "cell", "cells");
    let runs = counted(summary.runs(), "run", "runs");
    let error = if summary.has_errors() { "Error" } else { "Innovation" };
    let title = format!("{error} against broadcasts: {cells}, {runs}");
    if let Some(figure) = picture::tradeoff(title, summary) {
        let formats = arguments.figures;
        write_all(folder, &[("tradeoff", tradeoff(&figure))], formats.wanted())?;
        names.extend(formats.names(["tradeoff"]));
    }
    #[cfg(feature = "parquet")]
    if arguments.parquet {
        parquet::write(folder, results)?;
        names.push(parquet::NAME.to_owned());
    }
    Ok(names.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scenario_from_a_pipe_is_read_again_from_its_copy() {
        let again = |path: &str| again(Path::new(path), Path::new("out/study"));
        for pipe in ["/dev/stdin", "/dev/fd/63", "/proc/self/fd/0"] {
            assert_eq!(again(pipe), "out/study/scenario.toml");
        }
        for name in ["paper", "mine.toml", "/dev/shm/mine.toml", "."] {
            assert_eq!(again(name), name);
        }
    }
}
