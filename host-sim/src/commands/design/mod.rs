//! `design`: chooses the gain and the constants of the theorems for a scenario.
//!
//! 1. `K_1` solves `BMI` for the scenario's `k_1` ([`DesignedGain`]).
//! 2. A run with this gain and the requested radius measures `chi_bar_max`, which `rho` must not be below.
//! 3. `k_2`, `kappa`, `delta` and `epsilon` give the tightest bound for it ([`Plan`]).
//! 4. A run with all of them confirms `rho`, or raises it and goes back to step 3.
//!
//! With `--max-error` or `--max-rate`, step 3 includes a search for the radius ([`frontier`]).

mod frontier;
mod text;

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicU64;
use std::time::Instant;

use clap::{Args, ValueEnum};
use serde::Serialize;

use super::error::Reported;
use super::progress::ProgressBars;
use super::scenario_source::load_with_text;
use super::{
    Changes, CommandError, Common, ErrorCode, Format, SharedProgress, print_json, print_text,
    warnings,
};
use crate::analysis::design::{
    Certificate, DesignError, DesignedGain, Knee, Objective, Plan, Shape,
};
use crate::analysis::{StepCheck, TriggerConstants};
use crate::engine::{Progress, RunOptions, RunResult, run};
use crate::files::output::{FileKind, OutputFile};
use crate::number::significant;
use crate::report::checks::ChecksReport;
use crate::report::theorems::Checks;
use crate::scenario::{Record, Scenario};
use crate::warning::Warning;
use frontier::{Point, Wanted};

/// Most runs that confirm `rho`.
const RUNS_MAX: usize = 4;
/// What `rho` is above the measured `chi_bar_max` after it was too small once.
const MARGIN: f64 = 1.02;

/// Arguments of `design`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Scenario: a TOML file or the name of a built-in scenario
    scenario: PathBuf,
    #[command(flatten)]
    changes: Changes,
    /// What the gain is chosen for: smallest trace or smallest spectral norm for the scenario's k1, or
    /// fastest decay with the spectral norm of the scenario's gain
    #[arg(long, value_enum, default_value_t)]
    objective: Goal,
    /// Allow gains between different components of the state: a full symmetric gain instead of a
    /// diagonal one
    #[arg(long)]
    full: bool,
    /// Hold error at which the trigger fires while the consensus term is zero [state unit] [default: the
    /// scenario's]
    #[arg(long, value_name = "R", value_parser = positive)]
    radius: Option<f64>,
    /// By simulation, choose the largest radius for which no agent's RMSE exceeds E [state unit]
    #[arg(long, value_name = "E", value_parser = positive, conflicts_with = "radius")]
    max_error: Option<f64>,
    /// By simulation, choose the smallest radius for which agents broadcast at most RATE times per second
    /// on average [1/s]
    #[arg(long, value_name = "RATE", value_parser = positive, conflicts_with = "radius")]
    max_rate: Option<f64>,
    /// Write a copy of the scenario with the chosen numbers; comments stay
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: Format,
    #[command(flatten)]
    pub(super) common: Common,
}

/// What the gain is chosen for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum Goal {
    /// Smallest trace
    #[default]
    Trace,
    /// Smallest spectral norm
    Norm,
    /// Largest decay rate k1
    Decay,
}

fn positive(text: &str) -> Result<f64, String> {
    let number = text.parse::<f64>().ok().filter(|x| x.is_finite() && *x > 0.0);
    number.ok_or_else(|| "expected a number above 0".to_owned())
}

impl From<Goal> for Objective {
    fn from(goal: Goal) -> Self {
        match goal {
            Goal::Trace => Self::Trace,
            Goal::Norm => Self::Norm,
            Goal::Decay => Self::Decay,
        }
    }
}

impl Reported for DesignError {
    fn code(&self) -> ErrorCode {
        ErrorCode::NoDesign
    }
}

#[derive(Serialize)]
struct Report<'a> {
    scenario: &'a str,
    objective: &'static str,
    full: bool,
    seed: u64,
    elapsed_s: f64,
    gain: Vec<Vec<f64>>,
    trace: f64,
    norm: f64,
    gap: f64,
    eigenvalue_min: f64,
    eigenvalue_uncertainty: f64,
    k1: f64,
    step_max: Option<f64>,
    rho: f64,
    radius: f64,
    kappa: f64,
    k2: f64,
    delta: f64,
    epsilon: f64,
    phi1: f64,
    phi2: f64,
    ultimate_bound_without_weights: f64,
    ultimate_bound: Option<f64>,
    knee: Knee,
    error: Option<f64>,
    state_deviation: f64,
    rate: f64,
    frontier: &'a [Point],
    checks: ChecksReport,
    warnings: &'a [Warning],
}

/// The numbers that were chosen, and the run that confirms them.
struct Designed {
    gain: DesignedGain,
    step: StepCheck,
    certificate: Certificate,
    knee: Knee,
    /// The largest RMSE of an agent in the confirming run. \[state unit\]
    error: Option<f64>,
    /// See [`RunResult::state_deviation`]. \[state unit\]
    state_deviation: f64,
    /// Broadcasts per agent per second in the confirming run. \[1/s\]
    rate: f64,
    frontier: Vec<Point>,
    checks: Checks,
    warnings: Vec<Warning>,
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    let format = arguments.format;
    let start = Instant::now();
    let (scenario, source) = load_with_text(&arguments.scenario, &arguments.changes)?;
    let scenario = scenario.drawn(arguments.common.seed).into_owned();
    if scenario.plant.recording().is_some() {
        let name = &scenario.name;
        return Err(CommandError::usage(format!(
            "scenario {name}: its plant is a recording, whose f and d are not known, so there are no constants \
             to design; use [observer], which is set from the reference, or design for a model of the plant"
        )));
    }
    let out = arguments.out.as_deref().map(|path| prepare(path, &scenario)).transpose()?;
    let designed = design(&scenario, arguments)?;
    if let (Some(out), Some(path)) = (out, &arguments.out) {
        write(out, path, &source, &designed)?;
    }
    let (gain, certificate) = (&designed.gain, &designed.certificate);
    match format {
        Format::Json => print_json(&Report {
            scenario: &scenario.name,
            objective: name(arguments.objective),
            full: arguments.full,
            seed: arguments.common.seed,
            elapsed_s: start.elapsed().as_secs_f64(),
            gain: rows(gain),
            trace: gain.trace(),
            norm: gain.norm(),
            gap: gain.gap,
            eigenvalue_min: gain.certificate.eigenvalue_min,
            eigenvalue_uncertainty: gain.certificate.uncertainty,
            k1: certificate.k1,
            step_max: designed.step.largest_stable_step,
            rho: certificate.rho,
            radius: certificate.radius,
            kappa: certificate.kappa,
            k2: certificate.k2,
            delta: certificate.delta,
            epsilon: certificate.epsilon,
            phi1: certificate.phi1,
            phi2: certificate.phi2,
            ultimate_bound_without_weights: certificate.bound,
            ultimate_bound: designed
                .checks
                .design
                .ultimate_bound
                .map(|bound| bound.ultimate().sqrt()),
            knee: designed.knee,
            error: designed.error,
            state_deviation: designed.state_deviation,
            rate: designed.rate,
            frontier: &designed.frontier,
            checks: ChecksReport::new(&designed.checks),
            warnings: &designed.warnings,
        }),
        Format::Text => {
            warnings::print(&designed.warnings);
            let mut text = text::of(&scenario, &designed);
            if let Some(out) = &arguments.out {
                text += &format!("Written to {}\n", out.display());
            }
            let seconds = start.elapsed().as_secs_f64();
            text += &format!("Seed {}, {seconds:.2} s\n", arguments.common.seed);
            print_text(&text)
        }
    }
}

fn name(goal: Goal) -> &'static str {
    match goal {
        Goal::Trace => "trace",
        Goal::Norm => "norm",
        Goal::Decay => "decay",
    }
}

fn rows(gain: &DesignedGain) -> Vec<Vec<f64>> {
    gain.gain.row_iter().map(|row| row.iter().copied().collect()).collect()
}

/// Chooses all numbers.
fn design(scenario: &Scenario, arguments: &Arguments) -> Result<Designed, CommandError> {
    if let Some(model) = scenario.trigger.departure() {
        let text = format!(
            "scenario {}: agents broadcast {model}, not by the event trigger that is to be designed; \
             remove [trigger], or write kind = \"event\"",
            scenario.name
        );
        return Err(CommandError::new(ErrorCode::Scenario, text).about(&arguments.scenario));
    }
    let wanted = Wanted { error: arguments.max_error, rate: arguments.max_rate };
    if scenario.observer.is_some() && !wanted.is_empty() {
        let text = format!(
            "scenario {}: --max-error and --max-rate choose the radius of the paper's trigger, which agents with \
             [observer] do not use; set observer.error or observer.radius, as `host-sim frontier` finds them, or \
             remove [observer]",
            scenario.name
        );
        return Err(CommandError::new(ErrorCode::Scenario, text).about(&arguments.scenario));
    }
    let gain = solve(scenario, arguments)?;
    let seed = arguments.common.seed;
    let radius = arguments.radius.unwrap_or_else(|| TriggerConstants::new(scenario).radius());
    let mut changed = Scenario { record: Record::NOTHING, ..scenario.clone() };
    changed.design.gain.clone_from(&gain.gain);
    let step = StepCheck::new(&changed);
    if !step.is_stable() {
        let text = format!(
            "with the designed gain {}; a smaller k1 = k2 + rho^2/delta in [design] needs a smaller gain",
            step.describe()
        );
        return Err(CommandError::new(ErrorCode::Unstable, text).about(&arguments.scenario));
    }
    let plan = Plan::new(&changed, gain.k1());
    // The first run: the scenario's own rho until one is measured.
    apply(&mut changed, &plan.certificate(scenario.design.rho, radius));
    let measured = measure(&changed, seed, "first run")?;
    let chi = chi_bar_max(&measured.1);
    let mut rho = round_up(if chi > 0.0 { chi } else { scenario.design.rho });
    let (radius, frontier) = if wanted.is_empty() {
        (radius, Vec::new())
    } else {
        frontier::search(&changed, &plan, rho, radius, seed, wanted, measured.0.state_deviation)?
    };
    for _ in 1..RUNS_MAX {
        let certificate = plan.certificate(rho, radius);
        apply(&mut changed, &certificate);
        let (result, checks) = measure(&changed, seed, "confirming")?;
        let found = chi_bar_max(&checks);
        if found <= rho {
            let warnings = found_warnings(&changed, &result, &checks);
            let knee = plan.knee(rho);
            let error = result.largest_rmse().map(|(_, error)| error);
            let state_deviation = result.state_deviation;
            let rate = frontier::rate(scenario, &result.agents);
            return Ok(Designed {
                gain,
                step,
                certificate,
                knee,
                error,
                state_deviation,
                rate,
                frontier,
                checks,
                warnings,
            });
        }
        rho = round_up(found * MARGIN);
    }
    let text = format!(
        "scenario {}: no rho bounds the run that it leads to: each run needs a larger one, finally {}; choose a \
         smaller --radius, or a larger k2 in [design]",
        scenario.name,
        significant(rho, 3)
    );
    Err(CommandError::new(ErrorCode::NoDesign, text).about(&arguments.scenario))
}

/// Solves for the gain, with progress on a terminal.
fn solve(scenario: &Scenario, arguments: &Arguments) -> Result<DesignedGain, CommandError> {
    let shape = if arguments.full { Shape::Full } else { Shape::Diagonal };
    let constants = &scenario.design;
    let k1 = constants.k2 + constants.rho * constants.rho / constants.delta;
    let bars = ProgressBars::endless("solving");
    let report = |round: usize, _gap: f64| bars.step(round as u64, 0);
    let gain = DesignedGain::new(scenario, arguments.objective.into(), shape, k1, &report);
    bars.finish();
    gain.map_err(|error| CommandError::from(error).about(&arguments.scenario))
}

/// Replaces the constants of a scenario.
fn apply(scenario: &mut Scenario, certificate: &Certificate) {
    let design = &mut scenario.design;
    (design.rho, design.k2, design.kappa) = (certificate.rho, certificate.k2, certificate.kappa);
    (design.delta, design.epsilon) = (certificate.delta, certificate.epsilon);
}

/// Runs a scenario and checks it against the theorems.
fn measure(
    scenario: &Scenario,
    seed: u64,
    what: &str,
) -> Result<(RunResult, Checks), CommandError> {
    let bars = ProgressBars::new(what);
    let done = AtomicU64::new(0);
    let progress = SharedProgress::new(&bars, &done, scenario.steps());
    let options = RunOptions { seed, learning: true, bounds: true };
    let result = run(scenario, options, &progress);
    bars.finish();
    let result = result.map_err(|error| CommandError::from(error).within(what))?;
    let checks = Checks::new(scenario, &result);
    Ok((result, checks))
}

fn chi_bar_max(checks: &Checks) -> f64 {
    checks.theorem1.lumped.map_or(0.0, |lumped| lumped.estimate)
}

/// Rounds up to three digits.
fn round_up(x: f64) -> f64 {
    let rounded = |x: f64| significant(x, 3).parse().unwrap_or(x);
    if rounded(x) >= x { rounded(x) } else { rounded(x * 1.005) }
}

fn found_warnings(scenario: &Scenario, result: &RunResult, checks: &Checks) -> Vec<Warning> {
    let mut warnings = warnings::before(scenario, &checks.design);
    let after = warnings::after(scenario, result, checks, &warnings);
    warnings.extend(after);
    warnings
}

/// A scenario, recognised by its required tables.
const SCENARIO: FileKind = FileKind {
    name: "a scenario",
    recognises: |bytes| {
        let text = String::from_utf8_lossy(bytes);
        let has = |start: &str| text.lines().any(|line| line.trim_start().starts_with(start));
        has("[design]") && has("[plant]")
    },
};

fn prepare(path: &Path, scenario: &Scenario) -> Result<OutputFile, CommandError> {
    if std::fs::canonicalize(path).is_ok_and(|path| path.is_dir()) {
        let text = format!(
            "{}: is a folder; choose a file name, such as {}",
            path.display(),
            path.join(format!("{}.toml", scenario.name)).display()
        );
        return Err(CommandError::new(ErrorCode::OutputRefused, text).about(path));
    }
    Ok(OutputFile::prepare(path, SCENARIO)?)
}

/// Writes the scenario with the chosen numbers in place of its own.
fn write(
    out: OutputFile,
    path: &Path,
    source: &str,
    designed: &Designed,
) -> Result<(), CommandError> {
    let edited = text::edited(source, designed).ok_or_else(|| {
        let text = format!("{}: the scenario's [design] table cannot be edited", path.display());
        CommandError::new(ErrorCode::Scenario, text).about(path)
    })?;
    // What was written is what was designed.
    Scenario::parse(&path.display().to_string(), &edited)?;
    Ok(out.write(|file| file.write_all(edited.as_bytes()))?)
}
