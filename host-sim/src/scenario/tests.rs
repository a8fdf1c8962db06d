use super::*;
use crate::plant::{Harmonic, Wave};
use crate::training::LevenbergMarquardtSettings;
use agent_core::health::FallBack;
use agent_core::math::activation::Activation;
use nalgebra::{DVector, dmatrix};

fn paper() -> Scenario {
    Scenario::parse("paper.toml", PAPER).unwrap()
}

#[test]
fn reads_every_key_of_the_paper() {
    let scenario = paper();
    assert_eq!(scenario.name, "paper");
    assert_eq!(scenario.plant, Plant::VanDerPol { mu: 0.3 });
    assert_eq!(scenario.initial_state, [5.0, 7.0, 8.0]);
    let harmonic = |component, amplitude, angular_frequency, function| Harmonic {
        component,
        function,
        amplitude,
        angular_frequency,
        phase: 0.0,
        offset: 0.0,
    };
    let disturbance = Disturbance::Harmonic(vec![
        harmonic(0, 0.5, 3.0, Wave::Sin),
        harmonic(1, 0.75, 1.0, Wave::Cos),
        harmonic(2, 1.0, 3.75, Wave::Cos),
    ]);
    assert_eq!(scenario.disturbance, disturbance);
    assert_eq!((scenario.steps(), scenario.dimension()), (40_000, 3));
    assert_eq!(scenario.time.integrator, Integrator::Euler);
    let diagonal = DVector::from_column_slice(&[134.86, 263.23, 263.23]);
    let design = Design {
        gain: DMatrix::from_diagonal(&diagonal),
        k2: 10.0,
        kappa: 1.0,
        rho: 2.0,
        delta: 0.3,
        epsilon: 3000.0,
    };
    assert_eq!(scenario.design, design);
    let network = scenario.network.as_ref().unwrap();
    assert_eq!(network.architecture.parameter_count(), 425);
    assert!(network.architecture.layers().iter().all(|l| l.activation == Activation::Tanh));
    assert_eq!(network.inner, InitialParameters::Constant(0.1));
    assert_eq!(network.outer[..4], [2.51, 4.59, 3.4, -2.44]);
    assert_eq!((network.outer.len(), network.outer[14]), (15, 4.29));
    let outer_law = OuterLaw {
        gain: OuterGain::Scalar(3.0),
        bound: 20.0,
        boundary_layer: 1.0,
        smoothing: 0.1,
        smoothness: 1,
    };
    assert_eq!(network.outer_law, outer_law);
    let adjacency = dmatrix![0.0, 1.0, 1.0; 1.0, 0.0, 0.0; 1.0, 0.0, 0.0];
    assert_eq!(scenario.graph.adjacency(), adjacency);
    assert_eq!(scenario.agents.len(), 3);
    assert_eq!(scenario.agents[1].output_matrix, dmatrix![0.0, 1.0, 0.0]);
    assert_eq!(scenario.agents[2].initial_estimate, [0.0; 3]);
    let [cycle] = scenario.learning.as_slice() else { panic!("one cycle") };
    assert_eq!(cycle.agents, [0, 1, 2]);
    assert_eq!(cycle.collect.ticks(&scenario.time), 10_000..16_000);
    assert_eq!((cycle.apply_at, cycle.recipe.as_str()), (20.0, "better"));
    assert_eq!(scenario.evaluation, Window { from: 20.0, to: 40.0 });
    assert_eq!(
        scenario.record,
        Record { trace_stride: NonZeroU32::new(1), events: true, samples: true }
    );
}

#[test]
fn reads_the_papers_recipe_and_fills_in_defaults() {
    let scenario = paper();
    let paper = scenario.recipe("paper").unwrap();
    assert_eq!((paper.smoothing_window, paper.decimation.map(|d| d.get())), (Some(0.0), Some(1)));
    assert_eq!(paper.initial, InitialParameters::Constant(0.1));
    assert_eq!(paper.split, [0.7, 0.15, 0.15]);
    let solver = LevenbergMarquardtSettings {
        epochs_max: 25,
        goal: 1e-2,
        damping_min: 0.0,
        ..LevenbergMarquardtSettings::default()
    };
    assert_eq!(paper.trainer, solver.into());
    let better = scenario.recipe("better").unwrap();
    assert_eq!((paper.normalise, better.normalise), (false, true));
    assert_eq!((paper.switch_in, better.switch_in), (SwitchIn::Always, SwitchIn::Checked));
    assert_eq!(
        (better.smoothing_window, better.decimation.map(|d| d.get())),
        (Some(0.4), Some(20))
    );
    assert_eq!(better.initial, InitialParameters::Glorot);
    assert_eq!((paper.weight_decay, better.weight_decay), (0.0, 1e-4));
    let solver = LevenbergMarquardtSettings { epochs_max: 60, ..Default::default() };
    assert_eq!(better.trainer, solver.into());
    assert_eq!(scenario.recipe("best"), None);
}

/// `1/2 (I (x) K_1) C^T C + 1/2 C^T C (I (x) K_1) + L (x) K_1 >= (k_2 + rho^2/delta) I` (`BMI`).
fn bmi_margin(scenario: &Scenario) -> f64 {
    let (agents, n) = (scenario.agents.len(), scenario.dimension());
    let mut outputs = DMatrix::zeros(agents * n, agents * n);
    for (index, agent) in scenario.agents.iter().enumerate() {
        let block = agent.output_matrix.transpose() * &agent.output_matrix;
        outputs.view_mut((index * n, index * n), (n, n)).copy_from(&block);
    }
    let design = &scenario.design;
    let gains = DMatrix::identity(agents, agents).kronecker(&design.gain);
    let left = (&gains * &outputs + &outputs * &gains) * 0.5
        + scenario.graph.laplacian().kronecker(&design.gain);
    let smallest = left.symmetric_eigenvalues().min();
    smallest - (design.k2 + design.rho * design.rho / design.delta)
}

#[test]
fn built_in_scenarios_satisfy_bmi_and_step_limit() {
    for (name, text) in BUILT_IN {
        let scenario = Scenario::parse(name, text).unwrap();
        assert_eq!(scenario.name, name);
        assert_eq!(built_in(name), Some(text));
        let margin = bmi_margin(&scenario);
        assert!(margin > 0.0, "{name}: K1 violates the matrix inequality by {margin}");
        // Euler's method for the linear part of the observer.
        let largest = scenario.graph.laplacian().symmetric_eigenvalues().max() + 1.0;
        let gain = scenario.design.gain.symmetric_eigenvalues().max();
        let product = scenario.time.step_size * gain * largest;
        assert!(product < 1.1, "{name}: step * gain * eigenvalue is {product}");
    }
    assert_eq!(built_in("none"), None);
    // 36.1356 - 23.3333, from an independent implementation.
    assert!((bmi_margin(&paper()) - (36.13562809126155 - 70.0 / 3.0)).abs() < 1e-9);
}

#[test]
fn expressions_reproduce_the_papers_plant() {
    let (paper, written) = (paper(), Scenario::parse("e", built_in("expressions").unwrap()));
    let written = written.unwrap();
    assert_eq!(written.initial_state, paper.initial_state);
    assert_eq!(written.graph, paper.graph);
    assert_eq!(written.design, paper.design);
    assert_eq!((written.network, written.learning.len()), (None, 0));
    for (time, x) in [(0.0, [5.0, 7.0, 8.0]), (1.25, [-0.3, 2.0, 0.1])] {
        let mut rates = [[f64::NAN; 3]; 4];
        paper.plant.derivative(time, &x, &mut rates[0]);
        written.plant.derivative(time, &x, &mut rates[1]);
        paper.disturbance.evaluate(time, &x, &mut rates[2]);
        written.disturbance.evaluate(time, &x, &mut rates[3]);
        assert_eq!((rates[0], rates[2]), (rates[1], rates[3]));
    }
}

/// Returns the paper's scenario with one piece of text replaced.
fn with(from: &str, to: &str) -> Scenario {
    assert!(PAPER.contains(from), "{from}");
    Scenario::parse("changed.toml", &PAPER.replacen(from, to, 1)).unwrap()
}

#[test]
fn missing_keys_get_defaults() {
    let head = PAPER.split("# --- Results").next().unwrap();
    let scenario = Scenario::parse("short.toml", head).unwrap();
    assert_eq!(scenario.evaluation, paper().evaluation);
    assert_eq!(scenario.record, Record { samples: false, ..paper().record });
    let scenario = with("boundary_layer = 1.0\n", "");
    assert_eq!(scenario.network, paper().network);
    assert_eq!(with("trace_stride = 1\n", "trace_stride = 0\n").record.trace_stride, None);
    assert_eq!(with("agents = [1, 2, 3]\n", "").learning, paper().learning);
}

#[test]
fn accepts_gains_as_numbers_diagonals_or_matrices() {
    let number = with("gain = [134.86, 263.23, 263.23]", "gain = 200");
    assert_eq!(number.design.gain, DMatrix::from_diagonal_element(3, 3, 200.0));
    let rows = "gain = [[2.0, 0.5, 0.0], [0.5, 3.0, 0.0], [0.0, 0.0, 4.0]]";
    let matrix = with("gain = [134.86, 263.23, 263.23]", rows).design.gain;
    assert_eq!(matrix, dmatrix![2.0, 0.5, 0.0; 0.5, 3.0, 0.0; 0.0, 0.0, 4.0]);
    let diagonal = with("gain = 3.0", "gain = [1, 2, 3, 4, 5]").network.unwrap().outer_law.gain;
    assert_eq!(diagonal, OuterGain::Diagonal(vec![1.0, 2.0, 3.0, 4.0, 5.0]));
}

#[test]
fn accepts_graphs_as_edges_or_topologies() {
    let table = &PAPER[PAPER.find("adjacency = [\n").unwrap()..];
    let adjacency = &table[..table.find("\n]\n").unwrap() + 3];
    let graph = |text: &str| with(adjacency, text).graph;
    assert_eq!(graph("edges = [[3, 1], [1, 2, 1]]\n"), paper().graph);
    assert_eq!(graph("topology = \"star\"\n"), paper().graph);
    let pairs = |text: &str| {
        let pair = |e: &crate::graph::Edge| (e.first, e.second, e.weight);
        graph(text).edges().iter().map(pair).collect::<Vec<_>>()
    };
    assert_eq!(pairs("topology = \"path\"\n"), [(0, 1, 1.0), (1, 2, 1.0)]);
    let all = [(0, 1, 0.5), (0, 2, 0.5), (1, 2, 0.5)];
    assert_eq!(pairs("topology = \"ring\"\nweight = 0.5\n"), all);
    assert_eq!(pairs("topology = \"complete\"\nweight = 0.5\n"), all);
    assert_eq!(pairs("edges = [[1, 2, 0.25], [2, 3]]\n"), [(0, 1, 0.25), (1, 2, 1.0)]);
}

#[test]
fn count_replicates_an_agent() {
    let text = built_in("pendulum").unwrap();
    let scenario = Scenario::parse("pendulum", text).unwrap();
    let rows: Vec<_> = scenario.agents.iter().map(|a| a.output_matrix.clone()).collect();
    let (angle, rate) = (dmatrix![1.0, 0.0], dmatrix![0.0, 1.0]);
    assert_eq!(rows, [angle.clone(), angle, rate.clone(), rate]);
    assert_eq!(scenario.graph.edges().len(), 4);
}

#[test]
fn one_agent_needs_no_graph() {
    let text = built_in("expressions").unwrap();
    let one = text.split("[graph]").next().unwrap();
    let text = format!("{one}[[agents]]\noutput_matrix = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n");
    assert_eq!(Scenario::parse("one", &text).unwrap().graph.agents(), 1);
}

#[test]
fn disturbances_add_up_and_are_optional() {
    let first = "{ amplitude = 0.5, angular_frequency = 3.0, function = \"sin\" }";
    let scenario = with(first, &format!("[{first}, {first}]"));
    let mut d = [0.0; 3];
    scenario.disturbance.evaluate(0.5, &[0.0; 3], &mut d);
    assert_eq!(d[0], 2.0 * (0.5 * libm::sin(1.5)));
    let table = &PAPER[PAPER.find("[disturbance]").unwrap()..PAPER.find("[time]").unwrap()];
    assert_eq!(with(table, "").disturbance, Disturbance::None);
    assert_eq!(with(table, "[disturbance]\nmodel = \"none\"\n").disturbance, Disturbance::None);
}

#[test]
fn cycles_of_different_agents_may_overlap() {
    let second = "[[learning]]\nagents = [2]\ncollect_from = 12.0\ncollect_to = 14.0\n\
                  apply_at = 15.0\nrecipe = \"paper\"\n\n# The paper's way of training.";
    let text = PAPER.replacen("agents = [1, 2, 3]", "agents = [1, 3]", 1);
    let text = text.replacen("# The paper's way of training.", second, 1);
    let scenario = Scenario::parse("two.toml", &text).unwrap();
    let agents: Vec<_> = scenario.learning.iter().map(|cycle| cycle.agents.clone()).collect();
    assert_eq!(agents, [vec![0, 2], vec![1]]);
}

/// Returns the health settings of the paper with its commented-out `[health]` table, or with these
/// lines in its place.
fn watched(lines: Option<&str>) -> FallBackAndRest {
    let example = PAPER.split("# [health]\n").nth(1).unwrap();
    let example = example.split("# --- Results").next().unwrap();
    let keys = example.lines().filter_map(|line| line.strip_prefix("# "));
    let keys: Vec<_> = keys.filter(|line| line.contains("_") && line.contains(" = ")).collect();
    assert_eq!(keys.len(), 5, "{keys:?}");
    let lines = lines.map_or_else(|| keys.join("\n"), str::to_owned);
    let settings = with("[evaluation]\n", &format!("[health]\n{lines}\n[evaluation]\n")).health;
    let settings = settings.unwrap();
    (settings.fall_back, settings.plausible_margin, settings.restart_after.map(NonZeroU32::get))
}

type FallBackAndRest = (Option<FallBack>, f32, Option<u32>);

#[test]
fn reads_health_settings_and_fills_in_defaults() {
    assert_eq!(paper().health, None);
    let all = FallBack {
        after: NonZeroU32::new(10).unwrap(),
        return_after: NonZeroU32::new(100).unwrap(),
        outside_box: true,
        projection_active: true,
        diverged: true,
    };
    assert_eq!(watched(None), (Some(all), 10.0, Some(10)));
    assert_eq!(watched(Some("")), (None, 10.0, Some(10)));
    assert_eq!(watched(Some("fall_back_after = 10")), (Some(all), 10.0, Some(10)));
    let chosen = "fall_back_after = 3\nreturn_after = 4\nfall_back_on = [\"projection\"]\n\
                  plausible_margin = 2.5\nrestart_after = 0";
    let fall_back = FallBack {
        after: NonZeroU32::new(3).unwrap(),
        return_after: NonZeroU32::new(4).unwrap(),
        outside_box: false,
        projection_active: true,
        diverged: false,
    };
    assert_eq!(watched(Some(chosen)), (Some(fall_back), 2.5, None));
    let never = chosen.replace("after = 3", "after = 0");
    assert_eq!(watched(Some(&never)), (None, 2.5, None));
}

#[test]
fn models_of_links_triggers_and_trainers_are_named() {
    let changed = |from: &str, to: &str| {
        assert!(PAPER.contains(from), "{from}");
        Scenario::parse("mine.toml", &PAPER.replace(from, to))
    };
    let (link, trainer) = ("kind = \"lossless\"", "trainer = \"levenberg-marquardt\"");
    let scenario = changed(&format!("[link]\n{link}\n"), "").unwrap();
    assert!(scenario.link.is_ideal());
    let trigger = "kind = \"event\"";
    let scenario = changed(&format!("[trigger]\n{trigger}\n"), "").unwrap();
    assert_eq!(scenario.trigger, TriggerModel::Event);
    let scenario = changed(trigger, "kind = \"periodic\"\nevery = 10").unwrap();
    let every = NonZeroU32::new(10).unwrap();
    assert_eq!(scenario.trigger, TriggerModel::Periodic { every });
    for (from, to, key, hint) in [
        (link, "kind = \"losless\"", "link.kind", "did you mean \"lossless\""),
        (link, "los = 0.5", "link.los", "did you mean loss?"),
        (trigger, "kind = \"period\"", "trigger.kind", "did you mean \"periodic\""),
        (trigger, "kind = \"event\"\nevery = 3", "trigger.every", "unknown key"),
        (trigger, "kind = \"periodic\"", "trigger.every", "add every = 10"),
        (trigger, "kind = \"periodic\"\nevery = 0", "trigger.every", "an integer >= 1"),
        (trainer, "trainer = \"adam\"", "recipes.paper.trainer", "levenberg-marquardt"),
    ] {
        let error = changed(from, to).unwrap_err();
        let text = error.to_string();
        assert!(error.key.as_deref().is_some_and(|found| found.starts_with(key)), "{text}");
        assert!(text.contains(hint), "{text}");
    }
}

#[test]
fn links_sensors_clocks_and_life_are_read() {
    assert_eq!(paper().departures(), [""; 0]);
    let link = "loss = 0.2\nburst = { to_bad = 0.02, to_good = 0.2 }\ndelay = 0.01\njitter = 0.002\n\
                rate = 250000\nslot = 0.01\nslots = 3\nduty_cycle = 0.1\n\
                [[link.edges]]\nagents = [3, 1]\nfrom = 5\nto = 6\nconnected = false\n\
                [[link.edges]]\nagents = [1, 2]\nfrom = 7\nloss = 0.9\n\
                [[link.partitions]]\ngroups = [[1], [2, 3]]\nfrom = 8\nto = 9\n\
                [sensor]\nnoise = 0.01\nbits = 12\nrange = [-10.0, 10.0]\nperiod = 0.0033\n\
                [clock]\ndrift = 20\n[[life]]\nagent = 2\nfrom = 25\nto = 30\n";
    let text = PAPER
        .replace("kind = \"lossless\"", link)
        .replace(
            "count = 1\n",
            "sensor = { noise = 0.5, drop_out = 0.1 }\nclock = { offset = 1 }\n",
        )
        .replace("initial_state =", "noise = 0.1\ninitial_state =");
    let scenario = Scenario::parse("mine.toml", &text).unwrap();
    let LinkSettings { edge, rules, partitions, medium } = &scenario.link;
    let burst = Some(Burst { to_bad: 0.02, to_good: 0.2 });
    let expected =
        EdgeSettings { loss: 0.2, burst, delay: 0.01, jitter: 0.002, ..EdgeSettings::default() };
    assert_eq!(*edge, expected);
    assert_eq!((rules[0].ends, rules[0].edge.connected), ([2, 0], false));
    // What a rule does not say is as on every edge.
    assert_eq!(rules[1].edge, EdgeSettings { loss: 0.9, ..expected });
    assert_eq!(rules[1].window, Window { from: 7.0, to: 40.0 });
    assert_eq!(partitions[0].group, [1, 2, 2]);
    assert_eq!(medium.map(|medium| (medium.slots, medium.duty_cycle)), Some((3, 0.1)));
    let [first, second, _] = scenario.agents.as_slice() else { panic!("three agents") };
    assert_eq!(
        (first.sensor.noise, first.sensor.drop_out, first.sensor.bits),
        (0.5, 0.1, Some(12))
    );
    assert_eq!((second.sensor.noise, second.sensor.drop_out), (0.01, 0.0));
    assert_eq!((first.clock.offset, first.clock.drift, second.clock.offset), (1.0, 20.0, 0.0));
    assert_eq!(scenario.process_noise, [0.1; 3]);
    let window = Window { from: 25.0, to: 30.0 };
    assert_eq!(scenario.life, [Downtime { agent: 1, window, is_replaced: false }]);
    assert_eq!(scenario.departures().len(), 5);
}

#[test]
fn impossible_links_sensors_clocks_and_lives_are_refused() {
    let with = |tables: &str| {
        let text = PAPER.replace("[link]\nkind = \"lossless\"\n", "") + tables;
        Scenario::parse("mine.toml", &text).unwrap_err().to_string()
    };
    for (tables, expected) in [
        ("[link]\nloss = 1.5", "link.loss: is 1.5, expected a probability, 0 to 1"),
        ("[link]\nloss = \"a\"", "link.loss: is a string, expected a number"),
        ("[link]\nburst = { to_bad = 0.1 }", "link.burst.to_good: missing"),
        ("[link]\nburst = { to_bad = 0.1, to_good = 0.0 }", "so that the burst ends"),
        ("[link]\ndelay = -1.0", "link.delay: is -1.0, expected 0 to 3600 seconds"),
        ("[link]\njitter = 0.01", "link.jitter: is 0.01, above the delay, 0"),
        ("[link]\nslot = 0.01", "link.slot: needs a shared medium"),
        ("[link]\nrate = 0.0", "link.rate: is 0.0, expected a number above 0"),
        ("[link]\nrate = 1e5\nslots = 2", "link.slots: needs the length of a slot"),
        ("[link]\nrate = 1e5\nduty_cycle = 2.0", "above 0 and at most 1"),
        ("[[link.edges]]\nagents = [2, 3]", "names agents 2 and 3, which have no edge"),
        ("[[link.edges]]\nagents = [1]", "does not name two agents"),
        ("[[link.edges]]\nagents = [1, 4]", "is 4, expected an integer from 1 to 3"),
        ("[[link.edges]]\nagents = [1, 2]\nfrom = 50", "is 50, after the end of the run"),
        ("[[link.edges]]\nagents = [1, 2]\nfrom = 9\nto = 8", "contains no step"),
        ("[[link.partitions]]\ngroups = [[1, 2], [2]]", "agent 2 is in two groups"),
        ("[[link.partitions]]\ngroups = [[1, 2, 3]]", "contains all agents in one group"),
        ("[sensor]\nnoise = -0.1", "sensor.noise: is -0.1, expected a number >= 0"),
        ("[sensor]\nbits = 12", "sensor.bits: needs a range"),
        ("[sensor]\nrange = [1.0, 1.0]", "sensor.range: its second value is not above the first"),
        ("[sensor]\nrange = [1.0]", "sensor.range: has 1 entry, expected 2"),
        ("[sensor]\nnoize = 0.1", "did you mean noise?"),
        ("[clock]\ndrift = 1e6", "clock.drift: is 1e6, expected -100000 to 100000 ppm"),
        ("[clock]\nmissed = -0.1", "clock.missed: is -0.1, expected a probability"),
        ("[[life]]\nagent = 4\nfrom = 1", "life[1].agent: is 4"),
        ("[[life]]\nfrom = 1", "life[1].agent: missing"),
        (
            "[[life]]\nagent = 1\nfrom = 1\nto = 3\n[[life]]\nagent = 1\nfrom = 2\nto = 4",
            "agent 1 is already down from 1 to 3",
        ),
    ] {
        let text = with(tables);
        assert!(text.contains(expected), "{tables}: {text}");
        // Every error names a line and a way out.
        assert!(text.starts_with("mine.toml:") && text.contains("; "), "{text}");
    }
}
