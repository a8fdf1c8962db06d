//! A link that loses, changes or adds frames: invalid frames are rejected and counted, and the run
//! continues.

use std::sync::atomic::{AtomicU64, Ordering};

use agent_core::Tick;
use agent_core::wire::frame::FRAME_LENGTH_MAX;
use host_sim::engine::link::Link;
use host_sim::engine::{RunOptions, RunResult, Silent, run, run_over};
use host_sim::scenario::Scenario;

use crate::sim::scenario_builder::{Described, network, picks};

const OPTIONS: RunOptions = RunOptions { seed: 0, learning: false, bounds: false };

/// The fate of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Fate {
    Arrives,
    Lost,
    /// With a bit flipped: which one, modulo the frame's length.
    Changed(usize),
    /// Delivered after invalid frames and before a copy of itself.
    Accompanied,
}

/// Returns the fate of a frame by receiver, tick and sender: a pure function, so that the run is
/// reproducible.
struct Tampering<'c, F> {
    scenario: &'c Scenario,
    /// Each agent's last broadcast.
    sent: Vec<Option<(Tick, Vec<u8>)>>,
    fate: F,
    /// For each receiver, the number of frames it must reject.
    unusable: &'c [AtomicU64],
}

/// Invalid frames: empty, too short, too long.
fn garbage() -> [Vec<u8>; 3] {
    [Vec::new(), vec![0x5a; 3], vec![0xa5; FRAME_LENGTH_MAX + 1]]
}

impl<F: Fn(usize, Tick, usize) -> Fate + Sync> Link for Tampering<'_, F> {
    fn send(&mut self, sender: usize, tick: Tick, bytes: &[u8]) {
        self.sent[sender] = Some((tick, bytes.to_vec()));
    }

    fn deliver(&self, receiver: usize, tick: Tick, accept: &mut dyn FnMut(&[u8])) {
        for sender in self.scenario.graph.neighbours(receiver).iter().map(|edge| edge.agent) {
            let Some((_, bytes)) = self.sent[sender].as_ref().filter(|(sent, _)| *sent == tick)
            else {
                continue;
            };
            let unusable = match (self.fate)(receiver, tick, sender) {
                Fate::Arrives => {
                    accept(bytes);
                    0
                }
                Fate::Lost => 0,
                Fate::Changed(bit) => {
                    let mut changed = bytes.clone();
                    changed[bit / 8 % bytes.len()] ^= 1 << (bit % 8);
                    accept(&changed);
                    1
                }
                Fate::Accompanied => {
                    garbage().iter().for_each(|bytes| accept(bytes));
                    accept(bytes);
                    accept(bytes);
                    garbage().len() as u64 + 1
                }
            };
            self.unusable[receiver].fetch_add(unusable, Ordering::Relaxed);
        }
    }
}

/// Runs a scenario over such a link and checks that every agent rejected what it must. Also returns
/// the number of rejected frames.
fn run_with(
    scenario: &Scenario,
    fate: impl Fn(usize, Tick, usize) -> Fate + Sync,
) -> (RunResult, u64) {
    let unusable: Vec<_> = scenario.agents.iter().map(|_| AtomicU64::new(0)).collect();
    let sent = vec![None; scenario.agents.len()];
    let link = Tampering { scenario, sent, fate, unusable: &unusable };
    let result = run_over(scenario, link, OPTIONS, &Silent).unwrap();
    let unusable: Vec<_> = unusable.iter().map(|count| count.load(Ordering::Relaxed)).collect();
    let refused: Vec<_> = result.agents.iter().map(|agent| agent.frames_refused).collect();
    assert_eq!(refused, unusable);
    (result, unusable.iter().sum())
}

/// Returns a pseudorandom number for a frame.
fn mixed(receiver: usize, tick: Tick, sender: usize) -> usize {
    let seed = (tick << 24) ^ ((receiver as u64) << 8) ^ sender as u64;
    let mixed = seed.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    ((mixed ^ (mixed >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 33) as usize
}

/// Three agents on a ring with a network; each measures one component of three.
fn ring() -> Scenario {
    let agents = (0..3).map(|component| (picks(3, [component]), 1));
    let mut scenario_builder = Described::linear(3, "ring", agents);
    scenario_builder.network = network(&[(5, "tanh"), (4, "tanh")], "2.0");
    scenario_builder.scenario()
}

fn estimates(result: &RunResult, agent: usize) -> Vec<u32> {
    let rows = (0..result.traces.rows()).flat_map(|row| result.traces.estimate(row, agent));
    rows.map(|estimate| estimate.to_bits()).collect()
}

fn largest_rmse(result: &RunResult) -> f64 {
    result.agents.iter().filter_map(|agent| agent.rmse()).fold(0.0, f64::max)
}

#[test]
fn transparent_link_changes_nothing() {
    let scenario = ring();
    let (found, refused) = run_with(&scenario, |_, _, _| Fate::Arrives);
    let expected = run(&scenario, OPTIONS, &Silent).unwrap();
    assert_eq!((found.digest, refused), (expected.digest, 0));
    assert_eq!(found.traces, expected.traces);
}

#[test]
fn corrupted_frames_are_rejected_and_the_run_continues() {
    let scenario = ring();
    let (lossless, _) = run_with(&scenario, |_, _, _| Fate::Arrives);
    let (found, refused) =
        run_with(&scenario, |receiver, tick, sender| match mixed(receiver, tick, sender) {
            number if number % 5 == 0 => Fate::Changed(number / 5),
            _ => Fate::Arrives,
        });
    let heard: u64 = 2 * found.agents.iter().map(|agent| agent.broadcasts()).sum::<u64>();
    println!("{refused} of {heard} frames changed and refused");
    println!("largest RMSE {:.4}, lossless {:.4}", largest_rmse(&found), largest_rmse(&lossless));
    assert!(refused * 10 > heard && refused * 10 < heard * 3);
    assert_ne!(found.digest, lossless.digest);
    // Every agent still estimates what it does not measure; |e_1i| starts at sqrt(3).
    assert!(largest_rmse(&found) < 0.2);
}

#[test]
fn corrupted_frames_act_like_lost_ones() {
    let scenario = ring();
    let chosen = |receiver, tick, sender| mixed(receiver, tick, sender).is_multiple_of(3);
    let (changed, refused) = run_with(&scenario, |receiver, tick, sender| {
        if chosen(receiver, tick, sender) { Fate::Changed(tick as usize) } else { Fate::Arrives }
    });
    let (lost, none) = run_with(&scenario, |receiver, tick, sender| {
        if chosen(receiver, tick, sender) { Fate::Lost } else { Fate::Arrives }
    });
    assert!(refused > 100 && none == 0, "{refused}");
    assert_eq!(changed.digest, lost.digest);
    assert_eq!(changed.traces, lost.traces);
}

#[test]
fn garbage_and_copies_among_the_frames_change_nothing() {
    let scenario = ring();
    let (lossless, _) = run_with(&scenario, |_, _, _| Fate::Arrives);
    let (found, refused) = run_with(&scenario, |_, _, _| Fate::Accompanied);
    let heard: u64 = 2 * found.agents.iter().map(|agent| agent.broadcasts()).sum::<u64>();
    assert_eq!(found.digest, lossless.digest);
    assert_eq!(found.traces, lossless.traces);
    // Broadcasts in the last step are not received.
    let expected = 4 * heard;
    assert!(refused <= expected && refused + 4 * 6 >= expected, "{refused} of {expected}");
}

#[test]
fn agents_without_frames_use_feedback_only() {
    let scenario = ring();
    let (result, refused) = run_with(&scenario, |_, _, _| Fate::Lost);
    assert_eq!(refused, 0);
    for index in 0..3 {
        let mut alone = Described::linear(3, "ring", [(picks(3, [index]), 1)]);
        alone.graph.clear();
        alone.network = network(&[(5, "tanh"), (4, "tanh")], "2.0");
        let alone = run(&alone.scenario(), OPTIONS, &Silent).unwrap();
        assert!(estimates(&result, index) == estimates(&alone, 0), "agent {}", index + 1);
        // It does not measure two of three components, which start at 1.
        assert!(result.agents[index].rmse().unwrap() > 0.5);
    }
}

#[test]
fn a_partition_heals() {
    let mut scenario = ring();
    scenario.evaluation.from = 2.5;
    let (lossless, _) = run_with(&scenario, |_, _, _| Fate::Arrives);
    // Agent 3 (index 2) is disconnected for a second.
    let cut = |receiver: usize, tick: Tick, sender: usize| {
        let involved = receiver == 2 || sender == 2;
        if involved && (1_000..2_000).contains(&tick) { Fate::Lost } else { Fate::Arrives }
    };
    let (healed, _) = run_with(&scenario, cut);
    let error = |result: &RunResult, tick| result.traces.error(tick, 2);
    println!(
        "|e_13| at 1 s, 2 s and 3 s: {:.4}, {:.4}, {:.4}",
        error(&healed, 1_000),
        error(&healed, 2_000),
        error(&healed, 3_000),
    );
    assert_eq!(error(&healed, 1_000), error(&lossless, 1_000));
    assert!(error(&healed, 2_000) > 3.0 * error(&lossless, 2_000));
    assert!(largest_rmse(&healed) < 1.2 * largest_rmse(&lossless));
}

#[test]
fn losses_are_deterministic_on_any_number_of_threads() {
    let mut scenario_builder =
        Described::linear(2, "ring", [(picks(2, [0]), 40), (picks(2, 0..2), 40)]);
    scenario_builder.duration = 0.5;
    let scenario = scenario_builder.scenario();
    let lossy = |receiver, tick, sender| match mixed(receiver, tick, sender) {
        number if number.is_multiple_of(4) => Fate::Lost,
        number if number % 4 == 1 => Fate::Changed(number / 4),
        _ => Fate::Arrives,
    };
    let on_threads = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| run_with(&scenario, lossy))
    };
    let (expected, refused) = on_threads(1);
    assert!(refused > 0);
    for threads in [2, 3] {
        let (found, also_refused) = on_threads(threads);
        assert_eq!((found.digest, also_refused), (expected.digest, refused), "{threads} threads");
        assert_eq!(found.traces, expected.traces);
    }
}
