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
use crate::engine::{RunOptions, run};
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
    /// Broadcasts per agent and second. \[1/s\]
    pub(super) rate: Option<f64>,
    /// The ultimate bound without the weight error. \[state unit\]
    pub(super) bound: f64,
}

impl Wanted {
    pub(super) fn is_empty(self) -> bool {
        self.error.is_none() && self.rate.is_none()
    }

    fn error_kept(self, point: &Point) -> bool {
        point.error.is_some_and(|error| self.error.is_none_or(|wanted| error <= wanted))
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
        let rate = self.rate.map(|rate| format!("at most {rate} broadcasts per agent and second"));
        error.into_iter().chain(rate).collect::<Vec<_>>().join(" and ")
    }
}

/// Returns the chosen radius and all runs, by radius.
pub(super) fn search(
    scenario: &Scenario,
    plan: &Plan,
    rho: f64,
    start: f64,
    seed: u64,
    wanted: Wanted,
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
            let (measured, failure) = match result {
                Ok(result) => (Some(result.agents), None),
                Err(error) => (None, Some(error)),
            };
            let error = measured.as_ref().and_then(|agents| {
                let errors: Option<Vec<f64>> = agents.iter().map(|agent| agent.rmse()).collect();
                Some(errors?.into_iter().fold(0.0, f64::max)).filter(|error| error.is_finite())
            });
            let rate = measured.as_ref().map(|agents| {
                let count: u64 = agents.iter().map(|agent| agent.broadcasts()).sum();
                count as f64 / (agents.len() as f64 * scenario.time.duration)
            });
            let bound = certificate.bound;
            (Point { radius, epsilon: certificate.epsilon, error, rate, bound }, failure)
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
        return Err(CommandError::from(error).within("every run of the frontier failed; the last"));
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
            let best = |key: fn(&Point) -> Option<f64>| {
                points.iter().filter_map(key).fold(f64::INFINITY, f64::min)
            };
            let text = format!(
                "scenario {}: no radius gives {}; the smallest error is {}, the lowest rate {}; allow \
                 more, choose a larger gain (a larger k2 in [design], or --objective decay), or train a \
                 better network\n{}",
                scenario.name,
                wanted.in_words(),
                significant(best(|point| point.error), 3),
                significant(best(|point| point.rate), 3),
                table(&points),
            );
            Err(CommandError::new(ErrorCode::NoDesign, text.trim_end()))
        }
    }
}

/// Formats the runs that a radius was chosen from.
pub(super) fn table(points: &[Point]) -> String {
    let headings = [
        ["", "radius"],
        ["", "epsilon"],
        ["largest", "RMSE"],
        ["broadcasts per", "agent and s"],
        ["ultimate", "bound"],
    ];
    let row = |point: &Point| {
        let entries = [Some(point.radius), Some(point.epsilon), point.error, point.rate];
        entries.into_iter().chain([Some(point.bound)]).map(number).collect::<Vec<_>>()
    };
    aligned(&headings, &points.iter().map(row).collect::<Vec<_>>())
}
