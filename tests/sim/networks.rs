//! Links, sensors, clocks and nodes as they are, in whole runs: what they change, and that nothing else
//! changes.

use std::ops::ControlFlow;

use agent_core::Tick;
use agent_core::agent::exchange::ExchangeParams;
use host_sim::engine::link::{Layered, Lossless};
use host_sim::engine::run_observer::{AgentStart, AgentStep, Switch};
use host_sim::engine::{
    RunObserver, RunObserverError, RunOptions, RunResult, Silent, run, run_observed, run_over,
};
use host_sim::scenario::{
    ClockSettings, Downtime, EdgeSettings, PAPER, Scenario, SensorSettings, Window, built_in,
};
use nalgebra::DMatrix;

const OPTIONS: RunOptions = RunOptions { seed: 0, learning: false, bounds: false };

/// The first seconds of the paper's run, without learning.
fn paper(seconds: f64) -> Scenario {
    let mut scenario = Scenario::parse("paper", PAPER).unwrap();
    scenario.time.duration = seconds;
    scenario.evaluation = Window { from: 0.5 * seconds, to: seconds };
    scenario.learning.clear();
    scenario
}

fn simulate(scenario: &Scenario) -> RunResult {
    run(scenario, OPTIONS, &Silent).unwrap()
}

fn rmse(result: &RunResult) -> Vec<f64> {
    result.agents.iter().map(|agent| agent.rmse().unwrap()).collect()
}

#[test]
fn neutral_models_leave_every_bit_as_it_was() {
    let scenario = paper(4.0);
    let expected = simulate(&scenario);
    // Layers that do nothing.
    let layered = run_over(&scenario, Layered::new(&scenario, 0), OPTIONS, &Silent).unwrap();
    assert_eq!(layered.digest, expected.digest);
    let lossless = run_over(&scenario, Lossless::new(&scenario.graph), OPTIONS, &Silent).unwrap();
    assert_eq!(lossless.digest, expected.digest);
    // A sensor and a clock with models, whose settings do nothing.
    let mut modelled = scenario.clone();
    for agent in &mut modelled.agents {
        agent.sensor = SensorSettings { range: Some([-1e6, 1e6]), ..SensorSettings::default() };
        agent.clock = ClockSettings { offset: 1e-9, ..ClockSettings::default() };
    }
    assert_eq!(simulate(&modelled).digest, expected.digest);
    // An exchange that comes to nothing: events are far more frequent.
    let heartbeat = ExchangeParams {
        heartbeat: 30_000,
        fade_from: 30_000,
        fade_to: 30_000,
        ..ExchangeParams::PAPER
    };
    let watched = Scenario { exchange: heartbeat, ..scenario.clone() };
    assert_eq!(simulate(&watched).digest, expected.digest);
}

#[test]
fn every_frame_is_accounted_for() {
    let mut scenario = paper(4.0);
    scenario.link.edge = EdgeSettings { loss: 0.2, delay: 0.004, ..EdgeSettings::default() };
    let result = simulate(&scenario);
    for (index, agent) in result.agents.iter().enumerate() {
        let traffic = agent.traffic.unwrap();
        let copies = agent.broadcasts() * scenario.graph.neighbours(index).len() as u64;
        let in_transit = copies - traffic.delivered - traffic.lost;
        assert!(in_transit <= 8, "{in_transit} of {copies}");
        let share = traffic.lost as f64 / copies as f64;
        assert!((share - 0.2).abs() < 0.05, "{share}");
        // A frame of the paper's: numbers of 12 bytes, the checksum, and varying counters.
        let length = agent.bytes_sent as f64 / agent.broadcasts() as f64;
        assert!((21.0..=25.0).contains(&length), "{length}");
        // Preamble, delimiter and length field of 6 bytes, at 250 kbit/s.
        let airtime = (8 * (agent.bytes_sent + 6 * agent.broadcasts())) as f64 / 250e3;
        assert!((traffic.airtime - airtime).abs() < 1e-9);
        assert_eq!(agent.frames_refused, 0);
    }
}

#[test]
fn corrupt_frames_are_refused_one_by_one() {
    let mut scenario = paper(2.0);
    scenario.link.edge.corrupt = 0.2;
    let result = simulate(&scenario);
    let corrupt = result.layers.iter().find(|layer| layer.layer == "corrupt").unwrap().count;
    let refused: u64 = result.agents.iter().map(|agent| agent.frames_refused).sum();
    assert!(corrupt > 100);
    // The last broadcasts do not arrive within the run.
    assert!((corrupt - 3..=corrupt).contains(&refused), "{refused} of {corrupt}");
}

#[test]
fn the_field_has_the_same_bits_on_any_number_of_threads() {
    let mut scenario = Scenario::parse("deployment", built_in("deployment").unwrap()).unwrap();
    scenario.time.duration = 4.0;
    scenario.evaluation = Window { from: 2.0, to: 4.0 };
    scenario.learning.clear();
    scenario.life[1].window = Window { from: 3.2, to: 3.6 };
    // Enough agents to be stepped in parallel.
    let text = built_in("deployment").unwrap().replace(
        "output_matrix = [[1.0, 0.0, 0.0]]",
        "output_matrix = [[1.0, 0.0, 0.0]]\ncount = 70",
    );
    let mut many = Scenario::parse(
        "many",
        &text.replace("groups = [[1, 2], [3]]", "groups = [[1, 2], [3]]\n"),
    )
    .unwrap();
    many.time.duration = 0.3;
    many.learning.clear();
    many.design.gain *= 0.05;
    many.evaluation = Window { from: 0.1, to: 0.3 };
    many.life =
        vec![Downtime { agent: 5, window: Window { from: 0.1, to: 0.2 }, is_replaced: true }];
    for scenario in [&scenario, &many] {
        let digests = [1, 4].map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| simulate(scenario).digest)
        });
        assert_eq!(digests[0], digests[1]);
    }
    // Another seed, other noise.
    let other = run(&scenario, RunOptions { seed: 1, ..OPTIONS }, &Silent).unwrap();
    assert_ne!(other.digest, simulate(&scenario).digest);
}

#[test]
fn noise_has_the_size_that_the_observer_makes_of_it() {
    let mut scenario = paper(8.0);
    let exact = rmse(&simulate(&scenario));
    for agent in &mut scenario.agents {
        agent.sensor.noise = 0.5;
    }
    let noisy = rmse(&simulate(&scenario));
    // Of its own component, an observer with K dt = 0.13 or 0.26 passes sqrt(K dt / 2) of white noise.
    for (index, (noisy, exact)) in noisy.iter().zip(&exact).enumerate() {
        let added = (noisy * noisy - exact * exact).sqrt();
        assert!((0.08..0.5).contains(&added), "agent {}: {added}", index + 1);
    }
    // A bias of one agent stays.
    let mut scenario = paper(8.0);
    scenario.agents[1].sensor.bias = 1.0;
    let biased = rmse(&simulate(&scenario));
    assert!(biased[1] > 0.4 && biased[1] > 2.0 * exact[1], "{biased:?} {exact:?}");
}

#[test]
fn an_agent_without_measurements_follows_its_neighbours() {
    let mut scenario = paper(8.0);
    scenario.agents[2].sensor.drop_out = 1.0;
    // Agent 1 measures z as well, so that it is known to the network.
    scenario.agents[0].output_matrix =
        DMatrix::from_row_slice(2, 3, &[1.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
    let result = simulate(&scenario);
    let errors = rmse(&result);
    assert!(errors[2] < 0.6, "{errors:?}");
}

#[test]
fn a_node_that_was_down_is_back_at_once_and_its_neighbours_forget_it_meanwhile() {
    let down = Window { from: 2.0, to: 4.0 };
    let life = vec![Downtime { agent: 1, window: down, is_replaced: false }];
    let mut scenario = Scenario { life, ..paper(6.0) };
    let held = simulate(&scenario);
    let events = &held.agents[1].events;
    assert!(
        !events.iter().any(|tick| (2_000..4_000).contains(tick)),
        "it broadcasts while it is down"
    );
    // It boots at 4 s and announces itself.
    assert!(events.contains(&4_000));
    scenario.exchange =
        ExchangeParams { heartbeat: 20, fade_from: 50, fade_to: 100, ..ExchangeParams::PAPER };
    let forgotten = simulate(&scenario);
    let error = |result: &RunResult, from: usize, to: usize, agent| {
        let errors: Vec<f64> = (from..to).map(|row| result.traces.error(row, agent)).collect();
        errors.iter().copied().fold(0.0, f64::max)
    };
    // y moves by several units a second, so the last sample of it is soon far away.
    let (with, without) = (error(&held, 2_100, 4_000, 0), error(&forgotten, 2_100, 4_000, 0));
    assert!(without < 0.75 * with, "{without} of {with}");
    for agent in 0..3 {
        let (before, after) =
            (error(&forgotten, 1_500, 2_000, agent), error(&forgotten, 5_000, 6_000, agent));
        assert!(after < 1.5 * before + 0.1, "agent {}: {before}, then {after}", agent + 1);
    }
}

#[test]
fn a_late_joiner_says_nothing_before_and_a_stopped_agent_nothing_after() {
    let window = |from, to| Window { from, to };
    let life = vec![
        Downtime { agent: 2, window: window(0.0, 1.0), is_replaced: false },
        Downtime { agent: 0, window: window(1.5, 2.0), is_replaced: false },
    ];
    let result = simulate(&Scenario { life, ..paper(2.0) });
    assert_eq!(result.agents[2].events.first(), Some(&1_000));
    assert!(result.agents[0].events.iter().all(|&tick| tick < 1_500));
    // The errors of an agent that is down are not its own.
    assert!(result.agents[0].max_error().unwrap() < 20.0);
}

/// Three seconds with a short training that is applied at 1 s, and these tables.
fn early_learning(tables: &str) -> Scenario {
    let mut text = format!("{PAPER}\n{tables}");
    for (from, to) in [
        ("collect_from = 10.0", "collect_from = 0.2"),
        ("collect_to = 16.0", "collect_to = 0.8"),
        ("apply_at = 20.0", "apply_at = 1.0"),
        ("epochs = 60", "epochs = 4"),
        ("smoothing_window = 0.4", "smoothing_window = 0.02\nswitch_in = \"always\""),
        ("decimation = 20", "decimation = 2"),
    ] {
        assert!(text.contains(from), "{from}");
        text = text.replace(from, to);
    }
    let learns = Scenario::parse("early", &text).unwrap();
    let Scenario { learning, recipes, observer, .. } = learns;
    Scenario { learning, recipes, observer, ..paper(3.0) }
}

/// A run of that with one agent down for some time.
fn learning_while_down(agent: usize, window: Window, is_replaced: bool) -> RunResult {
    let life = vec![Downtime { agent, window, is_replaced }];
    let scenario = Scenario { life, ..early_learning("") };
    run(&scenario, RunOptions { learning: true, ..OPTIONS }, &Silent).unwrap()
}

/// Notes the number of samples with which the network of each package was trained that is switched in, with the
/// tick and the agent.
#[derive(Default)]
struct Switches(Vec<(Tick, usize, u32)>);

impl RunObserver for Switches {
    fn begin(&mut self, _: &[AgentStart<'_>]) -> Result<(), RunObserverError> {
        Ok(())
    }

    fn before_step(
        &mut self,
        tick: Tick,
        switches: &mut Vec<Switch>,
    ) -> Result<ControlFlow<()>, RunObserverError> {
        self.0.extend(
            switches.iter().map(|s| (tick, s.agent, s.package.package().provenance.samples)),
        );
        Ok(ControlFlow::Continue(()))
    }

    fn after_step(&mut self, _: Tick, _: &[Option<AgentStep<'_>>]) -> Result<(), RunObserverError> {
        Ok(())
    }
}

#[test]
fn a_network_that_was_missed_does_not_come_with_the_field_observer() {
    let window = Window { from: 0.9, to: 1.1 };
    let life = vec![Downtime { agent: 1, window, is_replaced: false }];
    let scenario = Scenario { life, ..early_learning("[observer]\nfrom = 1.5\n") };
    let mut switches = Switches::default();
    let options = RunOptions { learning: true, ..OPTIONS };
    let result = run_observed(&scenario, &mut switches, options, &Silent).unwrap();
    assert_eq!(result.missed.len(), 1, "{:?}", result.missed);
    let trained: Vec<_> = switches.0.iter().map(|&(tick, agent, n)| (tick, agent, n > 0)).collect();
    let expected =
        [(1_000, 0, true), (1_000, 2, true), (1_500, 0, true), (1_500, 1, false), (1_500, 2, true)];
    assert_eq!(trained, expected);
}

#[test]
fn a_replaced_node_has_the_first_package_again() {
    let down = Window { from: 1.5, to: 1.6 };
    let with = |is_replaced| learning_while_down(0, down, is_replaced).digest;
    assert_ne!(with(true), with(false));
}

#[test]
fn an_agent_that_is_down_misses_its_training_and_says_so() {
    let trained = |window| {
        let result = learning_while_down(1, window, false);
        (result.trainings.iter().map(|t| t.agent).collect::<Vec<_>>(), result.missed)
    };
    let (agents, missed) = trained(Window { from: 0.1, to: 0.9 });
    assert_eq!(agents, [1, 3]);
    assert_eq!(missed.len(), 1);
    assert!(missed[0].starts_with("agent 2, cycle 1: no samples"), "{missed:?}");
    let (agents, missed) = trained(Window { from: 0.9, to: 1.1 });
    assert_eq!(agents, [1, 2, 3]);
    assert!(missed[0].starts_with("agent 2 is down when"), "{missed:?}");
    let (agents, missed) = trained(Window { from: 0.4, to: 0.5 });
    assert_eq!((agents, missed), (vec![1, 2, 3], Vec::new()));
}

#[test]
fn repetitions_heartbeats_and_compensation_earn_their_broadcasts() {
    let link = |edge| {
        let mut scenario = paper(12.0);
        scenario.link.edge = edge;
        scenario
    };
    let lossy = link(EdgeSettings { loss: 0.3, ..EdgeSettings::default() });
    let repeated = Scenario {
        exchange: ExchangeParams { heartbeat: 20, repeat: 2, ..ExchangeParams::PAPER },
        ..lossy.clone()
    };
    let late = link(EdgeSettings { delay: 0.01, ..EdgeSettings::default() });
    let compensated = Scenario {
        exchange: ExchangeParams { delay: 10, smoothing: 32, ..ExchangeParams::PAPER },
        ..late.clone()
    };
    for (plain, better) in [(lossy, repeated), (late, compensated)] {
        let (plain, better) = (rmse(&simulate(&plain)), rmse(&simulate(&better)));
        for (plain, better) in plain.iter().zip(&better) {
            assert!(better < plain, "{better} instead of {plain}");
        }
    }
}

#[test]
fn a_clock_that_is_ahead_or_drifts_changes_ticks_only() {
    let mut scenario = paper(3.0);
    let expected = rmse(&simulate(&scenario));
    scenario.agents[1].clock =
        ClockSettings { offset: 100.0, drift: 80.0, ..ClockSettings::default() };
    scenario.agents[2].clock = ClockSettings { drift: -80.0, ..ClockSettings::default() };
    let result = simulate(&scenario);
    for (found, expected) in rmse(&result).iter().zip(&expected) {
        assert!((found / expected - 1.0).abs() < 0.1, "{found}, {expected}");
    }
}
