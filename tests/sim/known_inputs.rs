//! Known inputs of the plant: in its equations, in networks, in samples, and from a recording.

use std::fs;

use host_sim::engine::{RunOptions, RunResult, Silent, run};
use host_sim::scenario::Scenario;

use crate::cli::command_line::{Folder, object, texts};

/// A driven oscillator whose drive is most of its acceleration.
const DRIVEN: &str = r#"
name = "driven"

[plant]
model = "expressions"
states = ["x", "v"]
parameters = { w = 2.0 }
inputs = { u = "4*sin(w*t) + 3*cos(3.1*t)", k = "1 + 0.5*sin(0.7*t)" }
derivative = ["v", "-k*x - 0.4*v + u"]
initial_state = [1.0, 0.0]

[time]
duration = 24.0
step = 0.002

[design]
gain = [60.0, 60.0]
k2 = 5.0
kappa = 1.0
rho = 1.0
delta = 0.2
epsilon = 40.0

[network]
layers = [{ nodes = 10, activation = "tanh" }]
inner = { random = "glorot" }
outer = { random = 5.0 }

[outer_law]
gain = 0.5
bound = 60.0

[graph]
edges = [[1, 2]]

[[agents]]
output_matrix = [[1.0, 0.0]]
initial_estimate = [0.5, 0.5]

[[agents]]
output_matrix = [[0.0, 1.0]]
initial_estimate = [0.5, 0.5]

[[learning]]
collect_from = 2.0
collect_to = 12.0
stride = 2
apply_at = 13.0
recipe = "smooth"

[recipes.smooth]
smoothing_window = 0.1
decimation = 4
initial = { random = "glorot" }
epochs = 80
switch_in = "always"

[evaluation]
from = 14.0
to = 24.0

[record]
trace_stride = 1
events = true
samples = true
"#;

/// The same plant with the inputs written into its equations, where agents do not know them.
fn hidden() -> String {
    let (before, rest) = DRIVEN.split_once("inputs = ").unwrap();
    let (_, after) = rest.split_once('\n').unwrap();
    let text = format!("{before}{after}");
    text.replace("-k*x", "-(1 + 0.5*sin(0.7*t))*x")
        .replace("+ u\"", "+ (4*sin(w*t) + 3*cos(3.1*t))\"")
}

fn parsed(text: &str) -> Scenario {
    Scenario::parse("driven.toml", text).unwrap_or_else(|error| panic!("{error}"))
}

fn result(scenario: &Scenario) -> RunResult {
    let options = RunOptions { seed: 0, learning: true, bounds: true };
    run(scenario, options, &Silent).unwrap_or_else(|error| panic!("{error}"))
}

fn broadcasts(result: &RunResult) -> u64 {
    result.agents.iter().map(|agent| agent.broadcasts_evaluated).sum()
}

#[test]
fn the_plant_takes_its_inputs_at_every_time_of_a_step() {
    let without_network = |text: &str| {
        let mut scenario = parsed(text);
        (scenario.network, scenario.learning) = (None, Vec::new());
        scenario.time.integrator = host_sim::plant::Integrator::Rk4;
        result(&scenario)
    };
    let (known, hidden) = (without_network(DRIVEN), without_network(&hidden()));
    assert_eq!(known.digest, hidden.digest);
}

#[test]
fn a_network_learns_what_known_inputs_do() {
    let (known, hidden) = (result(&parsed(DRIVEN)), result(&parsed(&hidden())));
    for agent in 0..2 {
        let explained = |result: &RunResult| {
            let training = &result.trainings[agent];
            training.quality.test.and_then(|fit| fit.explained).unwrap()
        };
        let [known, hidden] = [explained(&known), explained(&hidden)];
        // The forced motion itself tells something about the drive.
        assert!(known > 0.95 && 1.0 - known < 0.6 * (1.0 - hidden), "{agent}: {known}, {hidden}");
    }
    let rmse = |result: &RunResult| result.agents[0].rmse().unwrap();
    assert!(rmse(&known) < 0.5 * rmse(&hidden), "{} and {}", rmse(&known), rmse(&hidden));
    let package = known.trainings[0].package.package();
    assert_eq!((package.dimension(), package.known_inputs), (2, 2));
    // The box of the inputs follows that of the state, in file order.
    let high = &package.trained_box.high[2..];
    assert!((6.0..7.0).contains(&high[0]) && (1.4..1.6).contains(&high[1]), "{high:?}");
}

#[test]
fn samples_have_a_column_for_each_known_input() {
    let folder = Folder::new("samples-with-inputs");
    folder.write("driven.toml", DRIVEN);
    folder.succeed("run driven.toml --out out --baselines none");
    let text = fs::read_to_string(folder.path("out/agent1_cycle1_samples.csv")).unwrap();
    let lines: Vec<&str> = text.lines().filter(|line| !line.starts_with('#')).collect();
    assert!(lines[0].starts_with(
        "time [s],xhat1 [state unit],xhat2 [state unit],input.u [input unit],input.k [input unit],dxhat1"
    ));
    assert!(
        lines[0].ends_with(",agent,step [s]") && lines[1].ends_with(",1,0.002"),
        "{}",
        lines[1]
    );
    let plant = parsed(DRIVEN).plant;
    for line in [lines[1], lines[2], lines[lines.len() - 2]] {
        let cells: Vec<f64> = line.split(',').take(5).map(|cell| cell.parse().unwrap()).collect();
        let expected = plant.known_inputs(cells[0]);
        assert!((cells[3] - expected[0]).abs() < 1e-6 && (cells[4] - expected[1]).abs() < 1e-6);
    }
    // Nodes know no inputs, so there are no packages for them.
    assert!(!folder.path("out/agent1_cycle1.weights").exists());
}

#[test]
fn inputs_of_a_recording_are_those_of_the_plant() {
    let folder = Folder::new("recorded-inputs");
    folder.write("driven.toml", DRIVEN);
    folder.succeed("run driven.toml --out simulated --baselines none");
    let simulated = parsed(DRIVEN);
    let traces = fs::read_to_string(folder.path("simulated/traces.csv")).unwrap();
    let mut table = String::new();
    for (index, line) in traces.lines().enumerate() {
        if index == 0 {
            table += &format!("{line},u,k\n");
            continue;
        }
        let known = simulated.plant.known_inputs(simulated.time.at(index as u64 - 1));
        table += &format!("{line},{:?},{:?}\n", known[0], known[1]);
    }
    folder.write("experiment.csv", &table);
    let (before, rest) = DRIVEN.split_once("[plant]").unwrap();
    let (_, after) = rest.split_once("[time]").unwrap();
    let plant = "[plant]\nmodel = \"recording\"\nfile = \"experiment.csv\"\n\
                 states = [\"x\", \"v\"]\ntime = \"time [s]\"\ninputs = [\"u\", \"k\"]\n\
                 reference = [\"x [state unit]\", \"v [state unit]\"]\n\n[time]";
    folder.write("recorded.toml", &format!("{before}{plant}{after}"));
    let recorded = Scenario::load(&folder.path("recorded.toml")).unwrap();
    assert_eq!(recorded.plant.input_names(), ["u", "k"]);
    let (recorded, simulated) = (result(&recorded), result(&simulated));
    assert_eq!(recorded.digest, simulated.digest);
    // An empty cell is an error, since an input is always known.
    folder.write("experiment.csv", &table.replacen(",1.0\n", ",\n", 1));
    let error = Scenario::load(&folder.path("recorded.toml")).unwrap_err();
    assert_eq!(error.key.as_deref(), Some("plant.inputs[2]"), "{error}");
    assert!(error.problem.contains("line 2 of the file has no number there"), "{error}");
}

#[test]
fn inputs_are_not_what_agents_estimate() {
    let folder = Folder::new("inputs-that-are-not");
    folder.write("experiment.csv", "t,x,y,u\n0,1,1,0\n1,2,2,1\n2,3,3,1\n");
    let scenario = |inputs: &str| {
        format!(
            "name = \"own\"\n[plant]\nmodel = \"recording\"\nfile = \"experiment.csv\"\n\
             states = [\"x\"]\nreference = [\"x\"]\ninputs = {inputs}\n[time]\nduration = 2.0\n\
             step = 0.5\n[design]\ngain = [1.0]\nk2 = 2.0\nkappa = 1.0\nrho = 1.0\ndelta = 1.0\n\
             epsilon = 1.0\n[[agents]]\noutput_matrix = [[1.0]]\n\
             measured = [\"y\"]\n"
        )
    };
    for (inputs, key, problem) in [
        ("[\"u\", \"u\"]", "plant.inputs[2]", "the column `u` is listed twice"),
        ("[\"x\"]", "plant.inputs[1]", "the column `x` is the reference of a state"),
        ("[\"y\"]", "agents[1].measured", "the column `y` is a known input of all agents"),
    ] {
        folder.write("own.toml", &scenario(inputs));
        let error = Scenario::load(&folder.path("own.toml")).unwrap_err();
        assert_eq!((error.key.as_deref(), &*error.problem), (Some(key), problem), "{error}");
    }
}

#[test]
fn every_method_and_the_field_observer_take_known_inputs() {
    // A cubic of four variables needs longer samples.
    let one = DRIVEN.replace(", k = \"1 + 0.5*sin(0.7*t)\"", "").replace("-k*x", "-x");
    for method in ["no-network", "untrained", "known-f", "regression", "extended-kalman"] {
        let result = result(&parsed(&format!("method = \"{method}\"\n{one}")));
        let rmse = result.agents[0].rmse().unwrap();
        assert!(rmse < 0.5, "{method}: {rmse}");
    }
    let field = |text: &str| {
        let text = text.replace("apply_at = 13.0", "apply_at = 13.0\nshared = true");
        result(&parsed(&format!("{text}\n[observer]\npreset = \"field\"\n")))
    };
    let [known, hidden] = [broadcasts(&field(DRIVEN)), broadcasts(&field(&hidden()))];
    assert!(known < hidden, "{known} and {hidden}");
}

#[test]
fn an_input_that_nothing_uses_is_warned_about() {
    let folder = Folder::new("unused-inputs");
    folder.write("driven.toml", &DRIVEN.replace("k = \"1", "spare = \"t\", k = \"1"));
    folder.write("experiment.csv", "t,y,u\n0,1,0\n1,2,1\n2,3,1\n");
    let recorded = "name = \"own\"\n[plant]\nmodel = \"recording\"\nfile = \"experiment.csv\"\n\
                    states = [\"x\"]\ninputs = [\"u\"]\n[time]\nduration = 2.0\nstep = 0.5\n[design]\n\
                    gain = [1.0]\nk2 = 2.0\nkappa = 1.0\nrho = 1.0\ndelta = 1.0\nepsilon = 1.0\n\
                    [[agents]]\noutput_matrix = [[1.0]]\nmeasured = [\"y\"]\n";
    folder.write("recorded.toml", recorded);
    let unused = |scenario: &str| {
        let report = object(&folder.succeed(&format!("check {scenario} --format json")));
        let warnings = report["warnings"].as_array().unwrap().clone();
        let mut unused = warnings.iter().filter(|warning| warning["code"] == "unused-input");
        unused.next().map_or(String::new(), |warning| warning["text"].as_str().unwrap().to_owned())
    };
    assert_eq!(unused("driven.toml"), "", "a network takes all inputs");
    for method in ["no-network", "known-f"] {
        let expected = format!(
            "nothing uses `spare` of plant.inputs: plant.derivative does not, and method = \"{method}\" has no \
             network that would; use or remove it"
        );
        assert_eq!(unused(&format!("driven.toml --set method={method}")), expected);
    }
    let expected =
        "nothing uses `u` of plant.inputs: there is no network that would; use or remove it";
    assert_eq!(unused("recorded.toml"), expected);
}

#[test]
fn nodes_do_not_know_inputs() {
    let scenario = parsed(DRIVEN);
    let problem = scenario.check_for_nodes().unwrap_err().to_string();
    assert!(problem.starts_with("plant.inputs: a network with known inputs is"), "{problem}");
    // Without a network they need not know them.
    assert!(Scenario { network: None, ..scenario }.check_for_nodes().is_ok());
}

/// Returns the error of `check`, which also prints what it found.
fn checked(folder: &Folder, file: &str) -> String {
    let output = folder.run(&format!("check {file}"));
    assert_eq!(output.status.code(), Some(1));
    texts(&output).1
}

#[test]
fn an_input_without_a_value_is_named() {
    let text = DRIVEN.replace("4*sin(w*t)", "1/(t - 0.5)");
    let options = RunOptions { seed: 0, learning: false, bounds: false };
    let error = run(&parsed(&text), options, &Silent).err().unwrap().to_string();
    assert!(error.contains("plant.inputs, expression 1 for u"), "{error}");
    let folder = Folder::new("input-without-a-value");
    folder.write("driven.toml", &text);
    let error = checked(&folder, "driven.toml");
    assert!(
        error.contains("plant.inputs, expression 1 for u") && error.contains("t = 0.5"),
        "{error}"
    );
}

#[test]
fn an_input_without_a_value_on_an_agents_clock_is_named() {
    // The plant ends at 24 s, but the clock of agent 1 is 3 s ahead.
    let ahead = DRIVEN.replacen(
        "output_matrix = [[1.0, 0.0]]",
        "output_matrix = [[1.0, 0.0]]\nclock = { offset = 3.0 }",
        1,
    );
    let folder = Folder::new("input-on-a-clock");
    let options = RunOptions { seed: 0, learning: false, bounds: false };
    for (input, expected) in [
        ("0*sqrt(25 - t)", "plant.inputs, expression 1 for u"),
        ("1e39*max(sign(t - 25), 0)", "agent 1: the known input u is 1e39 at t = 25"),
    ] {
        for health in ["", "\n[health]\n"] {
            let text = ahead.replace("4*sin(w*t)", &format!("4*sin(w*t) + {input}"));
            let text = text + health;
            folder.write("ahead.toml", &text);
            let early = checked(&folder, "ahead.toml");
            assert!(early.contains(expected), "{early}");
            let result = run(&parsed(&text), options, &Silent);
            let error = result.err().unwrap_or_else(|| panic!("{input}")).to_string();
            assert!(error.contains(expected), "{error}");
        }
    }
}

#[test]
fn a_number_is_a_constant_input() {
    let text = |k: &str| DRIVEN.replace("\"1 + 0.5*sin(0.7*t)\"", k);
    let scenario = parsed(&text("1.5"));
    assert_eq!(scenario.plant.known_inputs(3.0)[1], 1.5);
    let warnings: Vec<String> = result(&scenario)
        .trainings
        .iter()
        .flat_map(|training| training.warnings.iter().map(|warning| warning.text.clone()))
        .collect();
    assert!(warnings[0].contains("the known input k does not vary in the samples"), "{warnings:?}");
}

#[test]
fn a_package_without_the_inputs_is_not_trained_further() {
    let plain = parsed(&hidden());
    let package = result(&plain).trainings[0].package.clone();
    let mut scenario = parsed(DRIVEN);
    scenario.agents[0].package = Some(package);
    let options = RunOptions { seed: 0, learning: true, bounds: false };
    let error = run(&scenario, options, &Silent).err().unwrap().to_string();
    assert!(error.contains("takes 0 known inputs, but the plant has 2"), "{error}");
}
