//! Chooses the trigger's radius by simulation: errors grow with it, broadcasts become rarer.
//!
//! Each radius has its own tightest constants. Radii a factor of 2 apart are run until they bracket
//! what is wanted, three at a time; then the bracket is divided by 4, twice. Runs are parallel, and
//! the result does not depend on the number of threads.

use std::sync::atomic::AtomicU64;

use rayon::prelude::*;
use serde::Serialize;

use super::apply;
use crate::analysis::design::Plan;
use crate::commands::progress::ProgressBars;
use crate::commands::{CommandError, ErrorCode, SharedProgress};
use crate::engine::statistics::AgentStatistics;
use crate::engine::{RunOptions, RunResult, run};
use crate::number::significant;
use crate::report::columns::aligned;
use crate::report::tables::number;
use crate::scenario::Scenario;

/// Most rounds of three runs until there is a bracket.
const ROUNDS_MAX: usize = 6;
/// Broadcasts per step above which a smaller radius gives no more of them.
const EVERY_STEP: f64 = 0.99;
/// Rounds that divide the bracket by 4.
const DIVISIONS: usize = 2;

/// What the user wants; at least one of them.
#[derive(Clone, Copy, Debug)]
pub(super) struct Wanted {
    /// Largest RMSE of an agent. \[state unit\]
    pub(super) error: Option<f64>,
    /// Largest mean number of broadcasts per agent. \[1/s\]
    pub(super) rate: Option<f64>,
}

/// One run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct Point {
    /// \[state unit\]
    pub(super) radius: f64,
    pub(super) epsilon: f64,
    /// The largest RMSE of an agent; null if the run failed. \[state unit\]
    pub(super) error: Option<f64>,
    /// Broadcasts per agent per second. \[1/s\]
    pub(super) rate: Option<f64>,
    /// The ultimate bound without the weight error. \[state unit\]
    pub(super) bound: f64,
    /// Whether the run says more than an estimate that never moves.
    #[serde(skip)]
    is_useful: bool,
}

impl Wanted {
    pub(super) fn is_empty(self) -> bool {
        self.error.is_none() && self.rate.is_none()
    }

    fn error_kept(self, point: &Point) -> bool {
        let is_kept = |error: f64| self.error.is_none_or(|wanted| error <= wanted);
        point.is_useful && point.error.is_some_and(is_kept)
    }

    fn rate_kept(self, point: &Point) -> bool {
        point.rate.is_some_and(|rate| self.rate.is_none_or(|wanted| rate <= wanted))
    }

    /// Whether the radius is on the side of small radii: with an error to keep, those that keep it;
    /// otherwise those with too many broadcasts.
    fn is_low(self, point: &Point) -> bool {
        match self.error {
            Some(_) => self.error_kept(point),
            None => point.rate.is_some() && !self.rate_kept(point),
        }
    }

    fn in_words(self) -> String {
        let error = self.error.map(|error| format!("an error of at most {error}"));
        let rate = self.rate.map(|rate| format!("at most {rate} broadcasts per agent per second"));
        error.into_iter().chain(rate).collect::<Vec<_>>().join(" and ")
    }

    /// Says what is possible instead, and what to do.
    fn why_not(self, points: &[Point], deviation: f64) -> String {
        let smallest = |key: fn(&Point) -> Option<f64>, of: &dyn Fn(&Point) -> bool| {
            let found = points.iter().filter(|point| of(point)).filter_map(key).reduce(f64::min);
            found.map_or("unknown, since all fail".to_owned(), |found| significant(found, 3))
        };
        let is_useless = |point: &&Point| point.error.is_some() && !point.is_useful;
        let useless = points.iter().filter(is_useless).find(|point| self.rate_kept(point));
        let useless = useless.filter(|_| self.rate.is_some());
        let relation = useless.map_or(String::new(), |point| {
            format!(
                "at a radius of {} the largest RMSE is {}, but the state itself is only {} (RMS) from its mean, so an \
                 estimate that never moves would hardly be worse; ",
                significant(point.radius, 3),
                number(point.error),
                significant(deviation, 3),
            )
        });
        let other = match self.rate {
            Some(_) => "train a better network, or use [observer], which needs fewer broadcasts",
            None => "or train a better network",
        };
        format!(
            "{relation}the smallest error is {}, the lowest rate of a useful radius is {}; allow more, choose a larger \
             gain (a larger k2 in [design]), {other}",
            smallest(|point| point.error, &|_| true),
            smallest(|point| point.rate, &|point| point.is_useful),
        )
    }
}

/// Returns the chosen radius and all runs, by radius. `deviation` is the error of an estimate that stays at the
/// state's mean. \[state unit\]
pub(super) fn search(
    scenario: &Scenario,
    plan: &Plan,
    rho: f64,
    start: f64,
    seed: u64,
    wanted: Wanted,
    deviation: f64,
) -> Result<(f64, Vec<Point>), CommandError> {
    let bars = ProgressBars::new("frontier");
    let done = AtomicU64::new(0);
    let mut points: Vec<Point> = Vec::new();
    let mut last = None;
    let mut next = vec![0.5 * start, start, 2.0 * start];
    let (mut rounds, mut divisions) = (0, 0);
    let step = scenario.time.step_size;
    while !next.is_empty() {
        let total = (points.len() + next.len()) as u64 * scenario.steps();
        let progress = || SharedProgress::new(&bars, &done, total);
        let one = |&radius: &f64| {
            let certificate = plan.certificate(rho, radius);
            let mut changed = scenario.clone();
            apply(&mut changed, &certificate);
            let options = RunOptions { seed, learning: true, bounds: false };
            let result = run(&changed, options, &progress());
            let measured = result.as_ref().ok();
            let worst = measured.and_then(RunResult::largest_rmse);
            let point = Point {
                radius,
                epsilon: certificate.epsilon,
                error: worst.map(|(_, error)| error),
                rate: measured.map(|result| rate(scenario, &result.agents)),
                bound: certificate.bound,
                is_useful: measured.is_some_and(|result| result.useless_estimate().is_none()),
            };
            (point, result.err())
        };
        let found: Vec<_> = next.par_iter().map(one).collect();
        for (point, failure) in found {
            points.push(point);
            last = failure.or(last);
        }
        points.sort_by(|a, b| a.radius.total_cmp(&b.radius));
        // The first radius that is not low, and the one before it.
        let edge = points.iter().position(|point| !wanted.is_low(point));
        next = match edge {
            Some(edge) if edge > 0 => {
                let (low, high) = (points[edge - 1].radius, points[edge].radius);
                divisions += 1;
                let between = |share: f64| low * (high / low).powf(share);
                if divisions > DIVISIONS {
                    Vec::new()
                } else {
                    [0.25, 0.5, 0.75].map(between).into()
                }
            }
            _ if rounds >= ROUNDS_MAX => Vec::new(),
            // A smaller radius changes nothing where agents broadcast in every step already.
            Some(_) if points[0].rate.is_some_and(|rate| rate * step >= EVERY_STEP) => Vec::new(),
            Some(_) => [0.125, 0.25, 0.5].map(|factor| factor * points[0].radius).into(),
            None => {
                let high = points.last().map_or(start, |point| point.radius);
                [2.0, 4.0, 8.0].map(|factor| factor * high).into()
            }
        };
        rounds += 1;
    }
    bars.finish();
    if let (true, Some(error)) = (points.iter().all(|point| point.error.is_none()), last) {
        return Err(CommandError::from(error)
            .within("every run of the frontier failed; the last error was"));
    }
    let mut kept =
        points.iter().filter(|point| wanted.error_kept(point) && wanted.rate_kept(point));
    let chosen = match wanted.error {
        Some(_) => kept.next_back(),
        None => kept.next(),
    };
    match chosen {
        Some(point) => Ok((point.radius, points)),
        None => {
            let text = format!(
                "scenario {}: no useful radius gives {}; {}\n{}",
                scenario.name,
                wanted.in_words(),
                wanted.why_not(&points, deviation),
                table(&points),
            );
            Err(CommandError::new(ErrorCode::NoDesign, text.trim_end()))
        }
    }
}

/// Returns the broadcasts per agent per second of a whole run. \[1/s\]
pub(super) fn rate(scenario: &Scenario, agents: &[AgentStatistics]) -> f64 {
    let count: u64 = agents.iter().map(AgentStatistics::broadcasts).sum();
    count as f64 / (agents.len() as f64 * scenario.time.duration)
}

/// Formats the runs that a radius was chosen from.
pub(super) fn table(points: &[Point]) -> String {
    let headings = [
        ["", "radius"],
        ["", "epsilon"],
        ["largest", "RMSE"],
        ["broadcasts per", "agent per s"],
        ["ultimate", "bound"],
    ];
    let row = |point: &Point| {
        let entries = [Some(point.radius), Some(point.epsilon), point.error, point.rate];
        entries.into_iter().chain([Some(point.bound)]).map(number).collect::<Vec<_>>()
    };
    aligned(&headings, &points.iter().map(row).collect::<Vec<_>>())
}
