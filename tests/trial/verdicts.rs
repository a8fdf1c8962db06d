//! The table of trials: every mutant of a good package is refused, goes back by itself, or does no
//! harm; and good packages stay.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use host_sim::packages::PackageBytes;

use super::bench::{End, Outcome, World, observe};
use super::mutants::{Mutant, mutants};

/// A package is harmful if it makes the RMS of the estimation error, its own agent's or that of the
/// others, this much larger than the package before it.
const HARMFUL: f64 = 1.5;

/// Harm up to here is not told apart from chance in a trial of ten seconds: honest packages change
/// the innovation by up to a sixth. A few such packages are confirmed; docs/decisions/0017-trial.md
/// has the counts.
const MARGINAL: f64 = 2.0;
/// The most of them for an agent.
const MARGINAL_COUNT: usize = 3;

/// Time with the package before. \[s\]
const REFERENCE: f64 = 12.0;

fn in_parallel<T: Sync, R: Send>(items: &[T], work: impl Fn(&T) -> R + Sync) -> Vec<R> {
    let next = AtomicUsize::new(0);
    let results = Mutex::new(BTreeMap::new());
    let threads = std::thread::available_parallelism().map_or(1, |n| n.get());
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                loop {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    let Some(item) = items.get(index) else { break };
                    let result = work(item);
                    results.lock().unwrap().insert(index, result);
                }
            });
        }
    });
    results.into_inner().unwrap().into_values().collect()
}

fn worse(found: &Outcome, good: &Outcome) -> f64 {
    let ratios = found.rms.iter().zip(good.rms).map(|(found, good)| found / good);
    ratios.fold(0.0, |worst, ratio| if ratio > worst || ratio.is_nan() { ratio } else { worst })
}

/// What a node found on trial, relative to what it found before.
fn ratios(outcome: &Outcome) -> String {
    let Some(trial) = &outcome.trial else { return String::new() };
    let (Some(found), Some(before)) = (&trial.found, &trial.before) else { return String::new() };
    format!(
        "; innovation x {:.2}, disagreement x {:.2}, effort x {:.2}, broadcasts x {:.2}, faults {:.2} ({:.2})",
        found.innovation_rms / before.innovation_rms,
        found.disagreement_rms / before.disagreement_rms,
        found.effort_rms / before.effort_rms,
        found.broadcasts_per_second / before.broadcasts_per_second,
        found.faults,
        before.faults,
    )
}

/// Counts of a table.
#[derive(Debug, Default)]
struct Counts {
    refused: usize,
    reverted: usize,
    harmless: usize,
    marginal: Vec<String>,
    harmful: Vec<String>,
}

fn judge(world: &World, before: &[PackageBytes], agent: usize, all: &[Mutant]) -> Counts {
    let good = observe(world, before, REFERENCE, agent, None);
    let results = in_parallel(all, |mutant| {
        let package = mutant.parts.seal().map_err(|error| error.to_string())?;
        Ok::<_, String>(observe(world, before, REFERENCE, agent, Some(&package)))
    });
    let mut counts = Counts::default();
    for (mutant, result) in all.iter().zip(results) {
        let name = &mutant.name;
        match result {
            Err(error) => {
                counts.refused += 1;
                println!("{name}: refused: {error}");
            }
            Ok(outcome) => {
                let ratio = worse(&outcome, &good);
                let Outcome { end, seconds, .. } = outcome;
                println!(
                    "{name}: {end:?} after {seconds:.1} s, error x {ratio:.2}{}",
                    ratios(&outcome)
                );
                match end {
                    End::Reverted(_) => counts.reverted += 1,
                    End::Refused => counts.refused += 1,
                    End::Confirmed if ratio <= HARMFUL => counts.harmless += 1,
                    End::Confirmed if ratio <= MARGINAL => {
                        counts.marginal.push(format!("{name}: error x {ratio:.2}"));
                    }
                    _ => counts.harmful.push(format!("{name}: {end:?}, error x {ratio:.2}")),
                }
            }
        }
    }
    counts
}

/// Pushes all changed packages to each agent; returns the counts.
fn table() -> [Counts; 3] {
    let world = World::new("better", 0);
    let before: Vec<_> = world.trained.iter().map(|package| package.renumbered(1)).collect();
    [0, 1, 2].map(|agent| {
        let all = mutants(&world.trained[agent], 2);
        let counts = judge(&world, &before, agent, &all);
        println!("agent {}: {} kinds: {counts:?}", agent + 1, all.len());
        assert!(all.len() >= 200, "{}", all.len());
        counts
    })
}

/// Returns how many packages with a harmful change were pushed, and how many of them stayed in use.
pub(crate) fn harmful_packages() -> (u64, u64) {
    table().iter().fold((0, 0), |(tries, confirmed), counts| {
        let Counts { refused, reverted, marginal, harmful, .. } = counts;
        let tried = refused + reverted + marginal.len() + harmful.len();
        (tries + tried as u64, confirmed + harmful.len() as u64)
    })
}

#[test]
fn harmful_packages_are_refused_or_go_back_by_themselves() {
    for counts in table() {
        assert!(counts.harmful.is_empty(), "{:#?}", counts.harmful);
        assert!(counts.marginal.len() <= MARGINAL_COUNT, "{:#?}", counts.marginal);
    }
}

#[test]
fn packages_trained_again_stay() {
    let world = World::new("better", 0);
    let before: Vec<_> = world.trained.iter().map(|package| package.renumbered(1)).collect();
    let again: Vec<_> = (1..4).map(|seed| World::new("better", seed).trained).collect();
    let pushes: Vec<_> = again
        .iter()
        .flat_map(|packages| packages.iter().enumerate())
        .map(|(agent, package)| (agent, package.renumbered(2)))
        .collect();
    let results = in_parallel(&pushes, |(agent, package)| {
        observe(&world, &before, REFERENCE, *agent, Some(package))
    });
    let mut gone = Vec::new();
    for ((agent, _), outcome) in pushes.iter().zip(&results) {
        let Outcome { end, seconds, .. } = outcome;
        println!("agent {}: {end:?} after {seconds:.1} s{}", agent + 1, ratios(outcome));
        if *end != End::Confirmed {
            gone.push((agent + 1, *end));
        }
    }
    assert!(gone.is_empty(), "{gone:?}");
}
