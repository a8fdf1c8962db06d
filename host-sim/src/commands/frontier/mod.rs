//! `frontier`: error against broadcasts and bytes of several forms of the observer.

mod forms;
mod points;
mod summary;

use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use clap::Args;
use serde::Serialize;

use super::output::FigureFormats;
use super::print_text;
use super::progress::ProgressBars;
use super::run_folder::{FRONTIER, FRONTIER_KIND, RunFolder};
use super::{
    Changes, CommandError, Common, ErrorCode, TableFormat, initial_states, load_scenario,
    print_outcome,
};
use crate::engine::RunError;
use crate::figures::{
    Figure, FrontierFigure, FrontierForm, FrontierPoint, RMSE_LABEL, frontier, write_all,
};
use crate::files::output::{OutputError, write_result};
use crate::interruption::{self, SecondSignal};
use crate::report::latex::latex;
use crate::report::paper::PUBLISHED;
use crate::scenario::{PAPER, Scenario};
use crate::terminal;
use forms::{Form, Forms, Level, Variant};
use points::{Counter, Point, Study, Table};
use summary::{Best, Setting};

/// Arguments of `frontier`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Scenario: a TOML file or the name of a built-in scenario
    scenario: PathBuf,
    #[command(flatten)]
    changes: Changes,
    /// Forms to compare, separated by commas [default: all but paper-model and known-f]
    #[arg(long, value_enum, value_delimiter = ',', value_name = "FORMS")]
    forms: Vec<Form>,
    /// Number of seeds for each setting, starting at --seed
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=10_000))]
    seeds: u64,
    /// Number of initial states of the plant: the scenario's own, and others drawn from the range of its trajectory
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=10_000))]
    initial_states: u64,
    /// Largest RMSE of an agent [default: what the form `paper` reaches as the scenario is; for the
    /// built-in scenario paper, what the paper published]
    #[arg(long, value_name = "ERROR", value_parser = positive)]
    target: Option<f64>,
    /// Output folder for tables and the picture [default: out/NAME-frontier]
    #[arg(long)]
    out: Option<PathBuf>,
    #[command(flatten)]
    figures: FigureFormats,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: TableFormat,
    #[command(flatten)]
    pub(super) common: Common,
}

fn positive(text: &str) -> Result<f64, String> {
    let number: f64 = text.parse().map_err(|_| "not a number".to_owned())?;
    if number > 0.0 && number.is_finite() { Ok(number) } else { Err("not above 0".to_owned()) }
}

#[derive(Serialize)]
struct Report<'a> {
    scenario: &'a str,
    seed: u64,
    seeds: u64,
    initial_states: &'a [Vec<f64>],
    elapsed_s: f64,
    /// Of each agent.
    target: &'a [f64],
    best: &'a [Best],
    points: &'a [Point],
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    let start = Instant::now();
    interruption::listen(SecondSignal::Exit);
    let seed = arguments.common.seed;
    let scenario = load_scenario(&arguments.scenario, &arguments.changes)?.drawn(seed).into_owned();
    let wanted = wanted(arguments, &scenario)?;
    if seed.checked_add(arguments.seeds).is_none() {
        let problem = format!("--seed {seed}: too few seeds remain after it; choose a smaller one");
        return Err(CommandError::usage(problem));
    }
    let out = arguments.out.clone();
    let out = out.unwrap_or_else(|| Path::new("out").join(format!("{}-frontier", scenario.name)));
    let mut planned = vec!["frontier.csv".to_owned(), FRONTIER.to_owned()];
    planned.extend(arguments.figures.names(["frontier"]));
    let folder = RunFolder::claim(&out, &planned)?;
    let study = Study {
        first_seed: seed,
        seeds: arguments.seeds,
        initial_states: initial_states(&scenario, arguments.initial_states, seed)?,
    };
    let file = folder.stage().join("frontier.csv");
    let table = Table::create(&file, scenario.agents.len())
        .map_err(|error| folder.placed(CommandError::from(error)))?;
    let (variants, points) =
        carry_out(&scenario, &wanted, &study, table).map_err(|error| folder.placed(error))?;
    let is_complete = points.len() == variants.len() * study.runs();
    let settings = match is_complete {
        true => Setting::all(&variants, &points, study.runs()),
        false => Vec::new(),
    };
    let (target, target_label) = target(arguments, &scenario, &settings);
    let window = scenario.evaluation.to - scenario.evaluation.from;
    if target.is_empty() && is_complete {
        terminal::warning(
            "a run of the paper's observer has no result, so its largest error cannot be the target; give one with --target",
        );
    }
    let best = match target.is_empty() {
        true => Vec::new(),
        false => summary::best(&settings, &target, &scenario.graph, window),
    };
    let report = Report {
        scenario: &scenario.name,
        seed,
        seeds: arguments.seeds,
        initial_states: &study.initial_states,
        elapsed_s: start.elapsed().as_secs_f64(),
        target: &target,
        best: &best,
        points: &points,
    };
    let picture = picture(&report, &scenario, &settings, target_label);
    write_files(folder.stage(), &report, picture, arguments.figures)
        .map_err(|error| folder.placed(error))?;
    let (files, others) = folder.publish(&scenario, seed)?;
    let outcome = outcome(&points, is_complete);
    match arguments.format {
        TableFormat::Json => print_outcome(&report, outcome),
        TableFormat::Latex => {
            let mut text = String::new();
            if is_complete && !target.is_empty() {
                let title = format!("Fewest broadcasts within {target_label}");
                text += &latex(&title, &summary::table(&best, target.len()));
                text += "% * no setting is within the target; the one with the smallest errors\n\
                         % bound: certified for |e_1| of all agents together; -- without a certificate\n";
                let title = "Time on air and battery life";
                text += &format!("\n{}", latex(title, &summary::radio_table(&best)));
            }
            let printed = print_text(&text);
            outcome.and(printed)
        }
        TableFormat::Text => {
            let mut text = String::new();
            if is_complete {
                text += &summary::text(&best, &target, target_label);
                text += &failures(&settings);
            }
            text += &format!(
                "Written to {}: {}\n{others}\nScenario {}, {} runs, seeds {seed} to {}, initial states: {}, \
                 {:.1} s\n",
                out.display(),
                files.join(", "),
                scenario.name,
                points.len(),
                seed + arguments.seeds - 1,
                study.initial_states.len(),
                report.elapsed_s,
            );
            let printed = print_text(&text);
            outcome.and(printed)
        }
    }
}

/// Returns the forms to compare: those asked for, and those that they are compared with.
fn wanted(arguments: &Arguments, scenario: &Scenario) -> Result<Vec<Form>, CommandError> {
    let mut forms = arguments.forms.clone();
    if forms.contains(&Form::KnownF) && scenario.plant.recording().is_some() {
        let problem = "--forms known-f: a recording does not define f; leave it out";
        return Err(CommandError::usage(problem));
    }
    if forms.is_empty() {
        forms = Form::DEFAULT.to_vec();
    }
    if scenario.network.is_none()
        && let Some(form) = forms.iter().find(|&&form| form != Form::Paper)
    {
        let problem = format!(
            "scenario {}: the form {} needs [network], because a weight package carries the settings of its observer; \
             add [network], or choose --forms paper",
            scenario.name,
            form.name()
        );
        return Err(CommandError::new(ErrorCode::Scenario, problem).about(&arguments.scenario));
    }
    let needs_paper = arguments.target.is_none() && !is_built_in_paper(scenario);
    forms.extend(needs_paper.then_some(Form::Paper));
    forms.extend(forms.contains(&Form::Periodic).then_some(Form::FlowEso));
    forms.sort();
    forms.dedup();
    Ok(forms)
}

fn is_built_in_paper(scenario: &Scenario) -> bool {
    Scenario::parse("paper.toml", PAPER).is_ok_and(|paper| paper.hash == scenario.hash)
}

/// Returns the scenario's initial state, and others.
fn initial_states(
    scenario: &Scenario,
    count: u64,
    seed: u64,
) -> Result<Vec<Vec<f64>>, CommandError> {
    let mut states = vec![scenario.initial_state.clone()];
    states.extend(initial_states::others(scenario, count, seed)?);
    Ok(states)
}

/// Runs all forms; returns their variants and points in the same order, `periodic` last.
fn carry_out(
    scenario: &Scenario,
    wanted: &[Form],
    study: &Study,
    table: Table,
) -> Result<(Vec<Variant>, Vec<Point>), CommandError> {
    let forms = Forms::new(scenario).map_err(RunError::Observer)?;
    let mut variants: Vec<Variant> = wanted.iter().flat_map(|&form| forms.variants(form)).collect();
    let is_eso = |variant: &&Variant| variant.form == Form::FlowEso;
    let repeated = match wanted.contains(&Form::Periodic) {
        true => variants.iter().filter(is_eso).count(),
        false => 0,
    };
    let bars = ProgressBars::new("simulating");
    let total = (variants.len() + repeated) * study.runs();
    let counter = Counter::new(&bars, total as u64 * scenario.steps());
    let table = Mutex::new(table);
    let mut points = study.carry_out(&variants, &table, &counter)?;
    if repeated > 0 && points.len() == variants.len() * study.runs() {
        let settings = Setting::all(&variants, &points, study.runs());
        let ticks = scenario.evaluation.ticks(&scenario.time);
        let steps = ((ticks.end - ticks.start) * scenario.agents.len() as u64) as f64;
        let periodic = settings.iter().zip(&variants).filter(|(_, variant)| is_eso(variant));
        let periodic = periodic.filter_map(|(setting, variant)| {
            let broadcasts = setting.counts(|point| point.broadcasts)?.median;
            let every = (steps / broadcasts.max(1.0)).round().max(1.0);
            Some(forms.periodic(variant, every as u32))
        });
        let periodic: Vec<Variant> = periodic.collect();
        points.extend(study.carry_out(&periodic, &table, &counter)?);
        variants.extend(periodic);
    }
    bars.finish();
    table.into_inner().unwrap_or_else(PoisonError::into_inner).finish()?;
    Ok((variants, points))
}

/// Returns the target of each agent, and what it is; none if it is the error of the paper's observer, one of whose
/// runs has no result.
fn target(
    arguments: &Arguments,
    scenario: &Scenario,
    settings: &[Setting<'_>],
) -> (Vec<f64>, &'static str) {
    let agents = scenario.agents.len();
    if let Some(target) = arguments.target {
        return (vec![target; agents], "the target");
    }
    if is_built_in_paper(scenario) {
        return (PUBLISHED.iter().map(|row| row.rmse_with).collect(), "the paper's Table 1");
    }
    let own = settings.iter().find(|setting| setting.is_own);
    let target =
        own.and_then(|own| own.errors()).map_or(Vec::new(), |errors| vec![errors.max; agents]);
    (target, "the largest error of the paper's observer")
}

fn write_files(
    folder: &Path,
    report: &Report<'_>,
    picture: Option<Figure>,
    formats: FigureFormats,
) -> Result<(), CommandError> {
    let path = folder.join(FRONTIER);
    let json = serde_json::to_vec(report)
        .map_err(std::io::Error::from)
        .map_err(|error| OutputError::Write { path: path.clone(), error })?;
    write_result(&path, FRONTIER_KIND, |file| {
        file.write_all(&json)?;
        file.write_all(b"\n")
    })?;
    if let Some(picture) = picture {
        write_all(folder, &[("frontier", picture)], formats.wanted())?;
    }
    Ok(())
}

/// Draws error against broadcasts of the settings, if any of them has results.
fn picture(
    report: &Report<'_>,
    scenario: &Scenario,
    settings: &[Setting<'_>],
    target_label: &str,
) -> Option<Figure> {
    let mut forms: Vec<FrontierForm<'_>> = Vec::new();
    for setting in settings {
        let (Some(broadcasts), Some(errors)) = (setting.counts(|p| p.broadcasts), setting.errors())
        else {
            continue;
        };
        let point = FrontierPoint {
            broadcasts: [broadcasts.min, broadcasts.median, broadcasts.max],
            error: [errors.min, errors.median, errors.max],
            is_certified: setting.is_certified(),
            is_own: setting.is_own,
        };
        let name = setting.form.name();
        match forms.last_mut().filter(|form| form.name == name) {
            Some(form) => form.points.push(point),
            None => forms.push(FrontierForm { name, points: vec![point] }),
        }
    }
    if forms.is_empty() || report.target.is_empty() {
        return None;
    }
    let extreme =
        |start: f64, pick: fn(f64, f64) -> f64| report.target.iter().copied().fold(start, pick);
    let runs = report.seeds as usize * report.initial_states.len();
    let each = if runs == 1 { "one run".to_owned() } else { format!("{runs} runs") };
    let title = format!("{}: error against broadcasts, {each} each", scenario.name);
    let window = scenario.evaluation;
    let broadcasts_label =
        format!("broadcasts of all agents, t in [{}, {}] s", window.from, window.to);
    Some(frontier(&FrontierFigure {
        title: &title,
        broadcasts_label: &broadcasts_label,
        error_label: RMSE_LABEL,
        forms,
        target: (extreme(f64::INFINITY, f64::min), extreme(0.0, f64::max)),
        target_label,
        has_certificates: true,
        own_label: "paper's observer as set",
    }))
}

/// Lists the settings with runs that failed, with the first reason.
fn failures(settings: &[Setting<'_>]) -> String {
    let line = |setting: &Setting<'_>| {
        let failed = || setting.points.iter().filter_map(|point| point.failure.as_deref());
        let first = failed().next()?;
        let level = match setting.level {
            Level::Radius(radius) => format!("radius {radius:.3}"),
            Level::Error(error) => format!("error {error:.3}"),
            Level::Period(period) => format!("period {period:.3} s"),
        };
        let (count, all) = (failed().count(), setting.points.len());
        Some(format!("{}, {level}: {count} of {all} runs failed: {first}\n", setting.form.name()))
    };
    let lines: String = settings.iter().filter_map(line).collect();
    if lines.is_empty() { lines } else { lines + "\n" }
}

fn outcome(points: &[Point], is_complete: bool) -> Result<(), CommandError> {
    if !is_complete {
        let text = format!(
            "interrupted after {} runs; frontier.csv and frontier.json hold their results",
            points.len()
        );
        return Err(CommandError::new(ErrorCode::Interrupted, text));
    }
    match points.iter().find_map(|point| point.failure.as_deref()) {
        Some(first) if points.iter().all(|point| point.failure.is_some()) => {
            Err(CommandError::new(ErrorCode::Run, format!("every run failed; the first: {first}")))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests;
