//! The runs of a study, in parallel, each written to `frontier.csv` as soon as those before it are.

use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicU64;
use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;
use serde::Serialize;

use super::forms::{Form, Level, Variant};
use crate::commands::SharedProgress;
use crate::commands::certified;
use crate::commands::initial_states::begun_in;
use crate::commands::progress::ProgressBars;
use crate::commands::radio::Frames;
use crate::engine::{Progress, RunOptions, run};
use crate::files::output::OutputError;
use crate::interruption;
use crate::scenario::Record;

/// One run.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Point {
    pub(super) form: Form,
    /// The largest radius of the trigger. \[state unit\]
    pub(super) radius: Option<f64>,
    /// The requested error that radii and gains are derived from, as a fraction of the state's standard
    /// deviation.
    pub(super) wanted_error: Option<f64>,
    /// Time between broadcasts of the form `periodic`. \[s\]
    pub(super) period: Option<f64>,
    pub(super) seed: u64,
    /// From 1.
    pub(super) initial_state: usize,
    /// Of all agents in the evaluation window.
    pub(super) broadcasts: Option<u64>,
    pub(super) bytes: Option<u64>,
    pub(super) rmse: Vec<Option<f64>>,
    pub(super) certified: bool,
    /// The certified bound on `|e_1|`, all agents stacked. \[state unit\]
    pub(super) bound: Option<f64>,
    /// Why there is no result.
    pub(super) failure: Option<String>,
    /// Frames of each agent in the window.
    #[serde(skip)]
    pub(super) frames: Vec<Frames>,
}

impl Point {
    /// Returns the largest error of an agent, if every agent has one.
    pub(super) fn largest_error(&self) -> Option<f64> {
        let errors: Option<Vec<f64>> = self.rmse.iter().copied().collect();
        errors?.into_iter().reduce(f64::max).filter(|error| error.is_finite())
    }
}

/// What is run with each variant.
#[derive(Clone, Debug)]
pub(super) struct Study {
    pub(super) first_seed: u64,
    pub(super) seeds: u64,
    /// The first one is the scenario's own.
    pub(super) initial_states: Vec<Vec<f64>>,
}

impl Study {
    /// Returns the number of runs of each variant.
    pub(super) fn runs(&self) -> usize {
        self.seeds as usize * self.initial_states.len()
    }

    /// Runs all variants, in parallel; the points are in the order of variants, initial states and
    /// seeds. After an interruption those that have not begun are left out.
    pub(super) fn carry_out(
        &self,
        variants: &[Variant],
        table: &Mutex<Table>,
        progress: &Counter<'_>,
    ) -> Result<Vec<Point>, OutputError> {
        let runs = self.runs();
        let first = lock(table).reserve(variants.len() * runs);
        // Handed out one by one, so that rows are written soon after their runs.
        let mut points: Vec<(usize, Point)> = (0..variants.len() * runs)
            .par_bridge()
            .filter_map(|job| {
                if interruption::requested() {
                    return None;
                }
                let (variant, place) = (&variants[job / runs], job % runs);
                let (state, seed) =
                    (place / self.seeds as usize, self.first_seed + place as u64 % self.seeds);
                let point = self.run(variant, state, seed, &progress.of_one_run());
                Some(lock(table).add(first + job, &point).map(|()| (job, point)))
            })
            .collect::<Result<_, OutputError>>()?;
        points.sort_by_key(|&(job, _)| job);
        Ok(points.into_iter().map(|(_, point)| point).collect())
    }

    fn run(&self, variant: &Variant, state: usize, seed: u64, progress: &dyn Progress) -> Point {
        let mut scenario = begun_in(&variant.scenario, &self.initial_states[state]);
        scenario.record = Record::NOTHING;
        let scenario = scenario.drawn(seed).into_owned();
        let mut point = Point {
            form: variant.form,
            radius: None,
            wanted_error: None,
            period: None,
            seed,
            initial_state: state + 1,
            broadcasts: None,
            bytes: None,
            rmse: vec![None; scenario.agents.len()],
            certified: false,
            bound: None,
            failure: None,
            frames: Vec::new(),
        };
        match variant.level {
            Level::Radius(radius) => point.radius = Some(radius),
            Level::Error(error) => point.wanted_error = Some(error),
            Level::Period(period) => point.period = Some(period),
        }
        let options = RunOptions { seed, learning: true, bounds: false };
        match run(&scenario, options, progress) {
            Ok(result) => {
                let frames = result.agents.iter().map(|agent| Frames {
                    count: agent.broadcasts_evaluated,
                    bytes: agent.bytes_evaluated,
                });
                point.frames = frames.collect();
                point.broadcasts = Some(point.frames.iter().map(|frames| frames.count).sum());
                point.bytes = Some(point.frames.iter().map(|frames| frames.bytes).sum());
                point.rmse = result.agents.iter().map(|agent| agent.rmse()).collect();
                point.bound = certified::bound(&scenario, &result.trainings).ok();
                point.certified = point.bound.is_some();
            }
            Err(error) => {
                progress.step(scenario.steps(), scenario.steps());
                point.failure = Some(error.to_string());
            }
        }
        point
    }
}

/// Counts the steps of all runs.
pub(super) struct Counter<'b> {
    bars: &'b ProgressBars,
    done: AtomicU64,
    total: u64,
}

impl<'b> Counter<'b> {
    pub(super) fn new(bars: &'b ProgressBars, total: u64) -> Self {
        Self { bars, done: AtomicU64::new(0), total }
    }

    fn of_one_run(&self) -> SharedProgress<'_> {
        SharedProgress::new(self.bars, &self.done, self.total)
    }
}

fn lock(table: &Mutex<Table>) -> std::sync::MutexGuard<'_, Table> {
    table.lock().unwrap_or_else(PoisonError::into_inner)
}

/// `frontier.csv` in progress: a row for each point, in order.
pub(super) struct Table {
    path: PathBuf,
    writer: csv::Writer<File>,
    /// Number of rows written, and of rows expected.
    written: usize,
    expected: usize,
    waiting: BTreeMap<usize, Vec<String>>,
}

impl Table {
    /// Creates the file, for this many agents.
    pub(super) fn create(path: &Path, agents: usize) -> Result<Self, OutputError> {
        let failed = |error: io::Error| OutputError::Write { path: path.to_owned(), error };
        let file = File::create(path).map_err(failed)?;
        let mut writer = csv::Writer::from_writer(file);
        let fixed = [
            "form",
            "radius [state unit]",
            "wanted_error",
            "period [s]",
            "seed",
            "initial_state",
            "broadcasts",
            "bytes",
            "certified",
            "bound [state unit]",
            "failure",
        ];
        let errors = (1..=agents).map(|agent| format!("rmse_{agent} [state unit]"));
        let header = fixed.into_iter().map(str::to_owned).chain(errors);
        writer.write_record(header).map_err(|error| failed(error.into()))?;
        let (path, waiting) = (path.to_owned(), BTreeMap::new());
        Ok(Self { path, writer, written: 0, expected: 0, waiting })
    }

    /// Makes room for rows; returns the number of the first one.
    fn reserve(&mut self, rows: usize) -> usize {
        self.expected += rows;
        self.expected - rows
    }

    fn add(&mut self, number: usize, point: &Point) -> Result<(), OutputError> {
        self.waiting.insert(number, fields(point));
        let mut written = || -> io::Result<()> {
            while let Some(row) = self.waiting.remove(&self.written) {
                self.writer.write_record(row)?;
                self.written += 1;
            }
            self.writer.flush()
        };
        written().map_err(|error| OutputError::Write { path: self.path.clone(), error })
    }

    /// Writes the rows that wait for others, which an interruption left out.
    pub(super) fn finish(mut self) -> Result<(), OutputError> {
        let mut write = || -> io::Result<()> {
            for row in std::mem::take(&mut self.waiting).into_values() {
                self.writer.write_record(row)?;
            }
            self.writer.flush()
        };
        write().map_err(|error| OutputError::Write { path: self.path.clone(), error })
    }
}

fn fields(point: &Point) -> Vec<String> {
    let optional = |value: Option<f64>| {
        value.map_or(String::new(), |value| ryu::Buffer::new().format(value).to_owned())
    };
    let count = |value: Option<u64>| value.map_or(String::new(), |value| value.to_string());
    let mut fields = vec![
        point.form.name().to_owned(),
        optional(point.radius),
        optional(point.wanted_error),
        optional(point.period),
        point.seed.to_string(),
        point.initial_state.to_string(),
        count(point.broadcasts),
        count(point.bytes),
        point.certified.to_string(),
        optional(point.bound),
        point.failure.clone().unwrap_or_default(),
    ];
    fields.extend(point.rmse.iter().map(|&error| optional(error)));
    fields
}
