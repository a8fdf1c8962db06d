//! The runs of a study, in parallel.
//!
//! Each thread takes the next run as soon as it is done with one, and carries it out alone: runs do
//! not share work, so threads do not wait for each other. Only where there are fewer runs than
//! threads do several threads share a run. Results depend on neither.

use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use super::cells::Cell;
use super::earlier::Earlier;
use super::results::{self, CellRows, Results};
use super::resume::Expected;
use crate::commands::initial_states::begun_in;
use crate::commands::progress::ProgressBars;
use crate::commands::{CommandError, ErrorCode, SharedProgress};
use crate::engine::{Progress, RunOptions, RunResult, run};
use crate::interruption;

/// The runs of one part of a study. Runs are numbered through the whole study, from 0, in the order of
/// cells, seeds and initial states.
#[derive(Debug)]
pub(super) struct Runs {
    /// The cells of this part.
    cells: Vec<(Cell, CellRows)>,
    /// Number of the first of them.
    first_cell: u64,
    first_seed: u64,
    seeds: u64,
    /// Initial states besides the scenario's own.
    other_states: Vec<Vec<f64>>,
    range: Range<u64>,
    header: Option<String>,
    /// Whether the study uses a recording.
    is_recorded: bool,
}

/// One run.
struct Job<'r> {
    cell: &'r Cell,
    rows: &'r CellRows,
    seed: u64,
    /// From 0, which is the scenario's own.
    state: u64,
}

impl Job<'_> {
    /// Returns the number of steps to simulate.
    fn steps(&self) -> u64 {
        self.cell.scenario.steps() * self.cell.scenario.method.runs()
    }
}

/// What was done.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Outcome {
    /// Number of runs.
    pub(super) done: u64,
    /// Number of runs that are not in the table yet.
    pub(super) left: u64,
    /// Number of runs without a result.
    pub(super) failed: u64,
    /// Number of the first failed run, and why it failed.
    pub(super) first_failure: Option<(u64, String)>,
    /// Time that threads spent in runs, added up.
    pub(super) in_runs: Duration,
}

impl Runs {
    /// Returns the numbers of the cells that runs in `range` belong to.
    pub(super) fn cells_of(range: &Range<u64>, seeds: u64, states: u64) -> Range<usize> {
        let each = seeds * states;
        if range.is_empty() {
            return 0..0;
        }
        let cell = |run: u64| usize::try_from(run / each).unwrap_or(usize::MAX);
        cell(range.start)..cell(range.end - 1) + 1
    }

    /// `cells` are those of [`Runs::cells_of`].
    pub(super) fn new(
        cells: Vec<Cell>,
        (first_seed, seeds): (u64, u64),
        other_states: Vec<Vec<f64>>,
        range: Range<u64>,
        (header, is_recorded): (Option<String>, bool),
    ) -> Self {
        let first_cell = range.start / (seeds * (1 + other_states.len() as u64));
        let with_rows = |cell: Cell| {
            let rows = CellRows::new(&cell, is_recorded);
            (cell, rows)
        };
        let cells = cells.into_iter().map(with_rows).collect();
        Self { cells, first_cell, first_seed, seeds, other_states, range, header, is_recorded }
    }

    /// Whether the study uses a recording.
    pub(super) fn is_recorded(&self) -> bool {
        self.is_recorded
    }

    fn states(&self) -> u64 {
        1 + self.other_states.len() as u64
    }

    fn job(&self, run: u64) -> Option<Job<'_>> {
        if !self.range.contains(&run) {
            return None;
        }
        let each = self.seeds * self.states();
        let (cell, place) = (run / each - self.first_cell, run % each);
        let (cell, rows) = self.cells.get(usize::try_from(cell).ok()?)?;
        let (seed, state) = (self.first_seed + place / self.states(), place % self.states());
        Some(Job { cell, rows, seed, state })
    }

    /// Returns what a run is, in words.
    pub(super) fn name(&self, run: u64, keys: &[String]) -> String {
        let Some(job) = self.job(run) else { return String::new() };
        let values = keys.iter().zip(&job.cell.values);
        let mut words: Vec<String> =
            values.map(|(key, value)| format!("{key} = {value}")).collect();
        words.push(format!("seed {}", job.seed));
        if self.states() > 1 {
            words.push(format!("initial state {}", job.state + 1));
        }
        words.join(", ")
    }

    /// Returns the rows of a run that are known from before, if they are.
    fn known(&self, run: u64, earlier: &Earlier) -> Option<String> {
        if earlier.is_empty() { None } else { earlier.rows(&self.rows(run)?) }
    }

    /// Returns the number of runs from `next` on whose rows are known from before.
    pub(super) fn known_from(&self, next: u64, earlier: &Earlier) -> u64 {
        (next..self.range.end).filter(|&run| self.known(run, earlier).is_some()).count() as u64
    }

    /// Executes the runs from `next` onwards, except those in `earlier`, and adds the rows of all to
    /// `results`. After an interruption no further run is started.
    pub(super) fn carry_out(
        &self,
        next: u64,
        results: Results,
        earlier: &Earlier,
    ) -> Result<Outcome, CommandError> {
        let known = self.known_from(next, earlier);
        let left = self.range.end.saturating_sub(next).saturating_sub(known);
        let threads = rayon::current_num_threads();
        let workers = usize::try_from(left).unwrap_or(usize::MAX).clamp(1, threads);
        let bars = ProgressBars::new("simulating");
        let steps = |run: u64| match self.known(run, earlier) {
            Some(_) => 0,
            None => self.job(run).map_or(0, |job| job.steps()),
        };
        let steps = (next..self.range.end).map(steps).sum();
        let shared = Shared {
            runs: self,
            earlier,
            next: AtomicU64::new(next),
            results: Mutex::new((results, Outcome::default(), None)),
            bars: &bars,
            steps_done: AtomicU64::new(0),
            steps,
        };
        std::thread::scope(|scope| {
            for number in 0..workers {
                let (shared, threads) = (&shared, threads / workers);
                std::thread::Builder::new()
                    .name(format!("sweep-{number}"))
                    .spawn_scoped(scope, move || shared.work(threads.max(1)))
                    .map_err(|_| no_threads(workers))?;
            }
            Ok::<(), CommandError>(())
        })?;
        bars.finish();
        let (results, mut outcome, error) =
            shared.results.into_inner().unwrap_or_else(PoisonError::into_inner);
        outcome.left = self.range.end - results.next();
        outcome.done = results.next() - next - (known - self.known_from(results.next(), earlier));
        error.map_or(Ok(outcome), Err)
    }
}

impl Expected for Runs {
    fn header(&self) -> Option<String> {
        self.header.clone()
    }

    fn measured(&self) -> usize {
        results::measured(self.is_recorded)
    }

    fn rows(&self, run: u64) -> Option<Vec<String>> {
        let Job { rows, seed, state, .. } = self.job(run)?;
        let start = |agent: usize| rows.start_of_row(seed, state + 1, agent);
        Some((1..=rows.agents).map(start).collect())
    }
}

/// What the threads share.
struct Shared<'r> {
    runs: &'r Runs,
    earlier: &'r Earlier,
    next: AtomicU64,
    /// With the first error, which ends the work of all threads.
    results: Mutex<(Results, Outcome, Option<CommandError>)>,
    bars: &'r ProgressBars,
    steps_done: AtomicU64,
    steps: u64,
}

impl Shared<'_> {
    /// Carries out runs until none is left.
    fn work(&self, threads: usize) {
        match rayon::ThreadPoolBuilder::new().num_threads(threads).build() {
            Ok(pool) => pool.install(|| while self.one_run() {}),
            Err(_) => self.fail(no_threads(threads)),
        }
    }

    /// Carries out the next run, if there is one.
    fn one_run(&self) -> bool {
        if interruption::requested() || self.lock().2.is_some() {
            return false;
        }
        let number = self.next.fetch_add(1, Ordering::Relaxed);
        let Some(job) = self.runs.job(number) else { return false };
        if let Some(rows) = self.runs.known(number, self.earlier) {
            return self.add(number, rows, |_| {});
        }
        let progress = SharedProgress::new(self.bars, &self.steps_done, self.steps);
        let options = RunOptions { seed: job.seed, learning: true, bounds: false };
        let start = Instant::now();
        let result = match job.state.checked_sub(1) {
            None => run(&job.cell.scenario, options, &progress),
            Some(other) => {
                let state = &self.runs.other_states[other as usize];
                run(&begun_in(&job.cell.scenario, state), options, &progress)
            }
        };
        let took = start.elapsed();
        let steps = job.cell.scenario.steps();
        progress.step(steps, steps);
        let excessive = result.as_ref().ok().and_then(RunResult::excessive_error);
        let agents = result.as_ref().ok().filter(|_| excessive.is_none());
        let agents = agents.map(|result| result.agents.as_slice());
        let rows = job.rows.run(job.seed, job.state + 1, agents);
        let reason = match &result {
            Err(error) => Some(error.to_string()),
            Ok(_) if rows.ends_with(",true\n") => Some(match excessive {
                Some(error) if error.is_finite() => format!("an error of {error:.1e}"),
                _ => "errors are not finite".to_owned(),
            }),
            Ok(_) => None,
        };
        self.add(number, rows, |outcome| {
            outcome.in_runs += took;
            if let Some(reason) = reason {
                outcome.failed += 1;
                if outcome.first_failure.as_ref().is_none_or(|(first, _)| number < *first) {
                    outcome.first_failure = Some((number, reason));
                }
            }
        })
    }

    /// Adds the rows of a run; `false` if they cannot be written.
    fn add(&self, number: u64, rows: String, count: impl FnOnce(&mut Outcome)) -> bool {
        let mut shared = self.lock();
        let (results, outcome, failed) = &mut *shared;
        count(outcome);
        match results.add(number, rows) {
            Ok(()) => true,
            Err(error) => {
                failed.get_or_insert_with(|| error.into());
                false
            }
        }
    }

    fn fail(&self, error: CommandError) {
        self.lock().2.get_or_insert(error);
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, (Results, Outcome, Option<CommandError>)> {
        self.results.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn no_threads(threads: usize) -> CommandError {
    let text = format!("cannot start {threads} threads; choose fewer with --threads");
    CommandError::new(ErrorCode::Threads, text)
}
