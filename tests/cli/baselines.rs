//! Baselines: the runs without a network and with the untrained one, compared with the
//! run itself, and the spread over seeds.

use host_sim::engine::{RunOptions, RunResult, Silent, run};
use host_sim::scenario::{Method, PAPER, Scenario};
use serde_json::Value;

use crate::cli::command_line::{Folder, object, short, texts};

fn simulate(scenario: &Scenario, seed: u64, learning: bool) -> RunResult {
    run(scenario, RunOptions { seed, learning, bounds: false }, &Silent).unwrap()
}

/// The runs without a network, with the untrained one, and with learning.
fn three_runs(scenario: &Scenario, seed: u64) -> [RunResult; 3] {
    let mut feedback = scenario.clone();
    (feedback.network, feedback.learning) = (None, Vec::new());
    [
        simulate(&feedback, seed, false),
        simulate(scenario, seed, false),
        simulate(scenario, seed, true),
    ]
}

fn agents(report: &Value) -> &[Value] {
    report["agents"].as_array().unwrap()
}

/// Returns a number as stored in JSON.
fn json(number: f64) -> Value {
    serde_json::from_str(&serde_json::to_string(&number).unwrap()).unwrap()
}

fn rmse(run: &RunResult, agent: usize) -> f64 {
    run.agents[agent].rmse().unwrap()
}

#[test]
fn a_run_is_compared_with_no_network_and_the_untrained_one() {
    let folder = Folder::new("baselines");
    folder.write("mine.toml", &short().text());
    let report = object(&folder.succeed("run mine.toml --format json --seed 3 --out json"));
    let [feedback, untrained, learned] = three_runs(&short().scenario(), 3);
    for (index, agent) in agents(&report).iter().enumerate() {
        let errors = [&feedback, &untrained, &learned].map(|run| rmse(run, index));
        assert_eq!(agent["rmse_no_network"], json(errors[0]));
        assert_eq!(agent["rmse_untrained"], json(errors[1]));
        assert_eq!(agent["rmse"], json(errors[2]));
        assert!(errors[0] != errors[1] && errors[1] != errors[2], "{errors:?}");
        let change = |before: f64| json(100.0 * (errors[2] - before) / before);
        assert_eq!(agent["change_percent_no_network"], change(errors[0]));
        assert_eq!(agent["change_percent"], change(errors[1]));
        assert_eq!(agent["broadcasts_no_network"], feedback.agents[index].broadcasts());
        assert_eq!(agent["broadcasts_untrained"], untrained.agents[index].broadcasts());
    }
    for baseline in ["no_network", "untrained"] {
        assert_eq!(report["baselines"][baseline]["status"], "done");
    }
    // The table and the file agree.
    let text = folder.succeed("run mine.toml --seed 3 --out text");
    let columns = ["no network", "untrained", "learned", "change against"];
    assert!(columns.iter().all(|column| text.contains(column)), "{text}");
    let table = String::from_utf8(folder.files("text")["agents.csv"].clone()).unwrap();
    let header: Vec<_> = table.lines().next().unwrap().split(',').collect();
    let at = header.iter().position(|name| *name == "rmse_no_network [state unit]").unwrap();
    for (index, line) in table.lines().skip(1).enumerate() {
        let error: f64 = line.split(',').nth(at).unwrap().parse().unwrap();
        assert_eq!(error.to_bits(), rmse(&feedback, index).to_bits());
    }
}

#[test]
fn every_method_runs_on_its_own() {
    let folder = Folder::new("methods-alone");
    let methods = ["no-network", "untrained", "regression", "known-f", "kalman", "extended-kalman"];
    for method in methods {
        let report = object(
            &folder
                .succeed(&format!("run paper --set method={method} --format json --out {method}")),
        );
        assert_eq!(agents(&report).len(), 3, "{method}");
        assert!(agents(&report).iter().all(|agent| agent["rmse"].is_f64()), "{method}");
    }
}

#[test]
fn baselines_change_no_bit_of_the_run() {
    let folder = Folder::new("no-baselines");
    folder.write("mine.toml", &short().text());
    let with = object(&folder.succeed("run mine.toml --format json --out with --threads 3"));
    let without =
        object(&folder.succeed("run mine.toml --format json --out without --baselines none"));
    for (with, without) in agents(&with).iter().zip(agents(&without)) {
        for key in ["rmse", "max_error", "broadcasts", "mean_interval", "min_interval"] {
            assert_eq!(with[key], without[key], "{key}");
        }
        for key in ["rmse_no_network", "rmse_untrained", "change_percent", "broadcasts_untrained"] {
            assert!(with[key].is_number() && without[key].is_null(), "{key}");
        }
    }
    assert_eq!(without["baselines"]["untrained"]["status"], "not_run");
    let (with, without) = (folder.files("with"), folder.files("without"));
    for name in ["traces.csv", "events.csv", "training.csv"] {
        assert!(with[name] == without[name], "{name}");
    }
    // They appear in the error figure, and only there.
    let figure = |name| String::from_utf8(with[name].clone()).unwrap();
    assert!(figure("errors.svg").contains("no network, RMS"));
    assert_eq!(with["states.svg"], without["states.svg"]);
    assert_ne!(with["errors.svg"], without["errors.svg"]);
    let text = folder.succeed("run mine.toml --baselines none --out without");
    assert!(!text.contains("no network") && !text.contains("untrained"), "{text}");
}

#[test]
fn no_baselines_without_learning_unless_requested() {
    let folder = Folder::new("bare-baselines");
    folder.write("mine.toml", &short().text());
    let run = |more: &str| {
        let line = format!("run mine.toml --format json --without-learning --out out {more}");
        object(&folder.succeed(&line))
    };
    let plain = run("");
    assert!(agents(&plain)[0]["rmse_no_network"].is_null());
    let [feedback, untrained, _] = three_runs(&short().scenario(), 0);
    let all = run("--baselines all");
    assert_eq!(all["baselines"]["untrained"]["status"], "this_run");
    for (index, agent) in agents(&all).iter().enumerate() {
        assert_eq!(agent["rmse_no_network"], json(rmse(&feedback, index)));
        assert_eq!(agent["rmse"], json(rmse(&untrained, index)));
        assert_eq!(agent["rmse_untrained"], agent["rmse"]);
    }
}

#[test]
fn other_methods_are_listed_with_what_they_know() {
    let folder = Folder::new("methods");
    folder.write("mine.toml", &short().text());
    let line =
        "run mine.toml --baselines known-f,extended-kalman,no-network --out out --format json";
    let report = object(&folder.succeed(line));
    let methods = report["methods"].as_array().unwrap();
    let names: Vec<_> = methods.iter().map(|row| row["method"].as_str().unwrap()).collect();
    assert_eq!(names, ["observer", "no-network", "known-f", "extended-kalman"]);
    for row in methods {
        assert_eq!(row["rmse"].as_array().unwrap().len(), 2, "{row}");
        assert!(row["reason"].is_null() && row["bytes"].is_u64(), "{row}");
    }
    for file in ["methods.csv", "methods.svg", "methods.png"] {
        assert!(folder.path("out").join(file).is_file(), "{file}");
    }
    // The method as a key of the scenario is the same run.
    folder.write("kalman.toml", &format!("method = \"extended-kalman\"\n{}", short().text()));
    let own = object(&folder.succeed("run kalman.toml --format json --out other"));
    for (index, agent) in agents(&own).iter().enumerate() {
        assert_eq!(agent["rmse"], methods[3]["rmse"][index]);
    }
    for (choice, problem) in [
        ("all,kalman", "`all` cannot be combined"),
        ("kalman,none", "`none` cannot be combined"),
        ("karman", "invalid value"),
    ] {
        let error = folder.fail(&format!("run mine.toml --baselines {choice} --out out"), 2);
        assert!(error.contains(problem), "{error}");
    }
    let error = folder.fail("run mine.toml --without-learning --baselines regression", 2);
    assert!(error.contains("no learning cycle"), "{error}");
    for command in
        ["cosim kalman.toml --steps 1", "train x.csv --scenario kalman.toml --agent 1 --out a"]
    {
        let error = folder.fail(command, 2);
        assert!(error.contains("for simulation only"), "{error}");
    }
}

#[test]
fn a_method_that_cannot_deal_with_a_scenario_is_refused_before_a_run() {
    let folder = Folder::new("methods-refused");
    for command in ["check", "run"] {
        let line = format!("{command} paper --set method=kalman --set clock={{drift=20}}");
        let output = folder.run(&line);
        assert_eq!(output.status.code(), Some(1), "{command}");
        assert!(texts(&output).1.contains("no clocks of their own"), "{command}: {output:?}");
    }
    let error =
        folder.fail("sweep deployment --vary method=observer,extended-kalman --out study", 1);
    assert!(error.contains("method=extended-kalman: "), "{error}");
    assert!(!folder.path("study").exists());
    let error = folder.fail("run deployment --baselines known-f,kalman", 2);
    assert!(error.contains("--baselines kalman: "), "{error}");
}

#[test]
fn samples_of_an_estimate_that_diverged_are_not_blamed_on_units() {
    let folder = Folder::new("methods-diverged");
    let error = folder.fail("run deployment --set method=periodic", 1);
    assert!(error.contains("its estimates had diverged"), "{error}");
    assert!(error.contains("not enough"), "{error}");
}

#[test]
fn a_method_that_fails_or_extrapolates_says_what_fits_it() {
    let folder = Folder::new("methods-advice");
    let line = "run paper --baselines periodic,regression --format json --out out";
    let report = object(&folder.succeed(line));
    let text = |code: &str| {
        let mut found = report["warnings"].as_array().unwrap().iter();
        let warning = found.find(|warning| warning["code"] == code);
        warning.unwrap_or_else(|| panic!("{code}"))["text"].as_str().unwrap().to_owned()
    };
    let failed = text("baseline-failed");
    assert!(
        failed.contains("method periodic failed") && failed.contains("periodic broadcasts"),
        "{failed}"
    );
    assert!(failed.ends_with("not a fault of the scenario"), "{failed}");
    let outside = text("extrapolation");
    assert!(
        outside.contains("z by up to") && outside.contains("collect_to of [[learning]]"),
        "{outside}"
    );
}

#[test]
fn the_field_observer_has_one_baseline_because_both_are_the_same() {
    let folder = Folder::new("field-baselines");
    let observer = "\n[observer]\nfrom = 0.3\nerror = 0.05\n";
    folder.write("mine.toml", &(short().text() + observer));
    let scenario = Scenario::parse("mine.toml", &(short().text() + observer)).unwrap();
    let [no_network, untrained] = [Method::NoNetwork, Method::Untrained]
        .map(|method| simulate(&Scenario { method, ..scenario.clone() }, 0, false).digest);
    assert_eq!(no_network, untrained);
    let text = folder.succeed("run mine.toml --baselines all --out out");
    assert!(text.contains("`untrained` is the same as `no network`"), "{text}");
    assert_eq!(text.matches("untrained").count(), 1, "{text}");
    let report = object(&folder.succeed("run mine.toml --baselines all --out out --format json"));
    for agent in agents(&report) {
        assert!(agent["rmse_no_network"].is_f64(), "{agent}");
        assert_eq!(agent["rmse_no_network"], agent["rmse_untrained"]);
    }
    assert_eq!(report["baselines"]["untrained"]["status"], "done");
    // Nor has a run without training two of them.
    let alone = "run mine.toml --without-learning --baselines all --format json --out alone";
    let report = object(&folder.succeed(alone));
    for baseline in ["no_network", "untrained"] {
        assert_eq!(report["baselines"][baseline]["status"], "this_run");
    }
    let methods = report["methods"].as_array().unwrap().iter();
    assert!(!methods.map(|row| &row["method"]).any(|method| method == "untrained"));
}

#[test]
fn packages_are_compared_with_the_scenarios_own_network() {
    let folder = Folder::new("package-baselines");
    let text = short().text();
    folder.write("mine.toml", &text);
    folder.succeed("run mine.toml --out first");
    let packages = "--weights first/agent1_cycle1.weights --weights first/agent2_cycle1.weights";
    let line = format!("--without-learning {packages} --format json --out out");
    let report = object(&folder.succeed(&format!("run mine.toml {line}")));
    let [feedback, untrained, _] = three_runs(&short().scenario(), 0);
    for (index, agent) in agents(&report).iter().enumerate() {
        assert_eq!(agent["rmse_no_network"], json(rmse(&feedback, index)));
        assert_eq!(agent["rmse_untrained"], json(rmse(&untrained, index)));
        assert_ne!(agent["rmse"], agent["rmse_untrained"]);
    }
    let text = folder.succeed(&format!("run mine.toml --without-learning {packages} --out out"));
    assert!(text.contains("packages") && !text.contains("learned"), "{text}");
}

#[test]
fn seeds_give_median_and_range() {
    let folder = Folder::new("seeds");
    let line = "reproduce --format json --seed 4 --seeds 3";
    let report = object(&folder.succeed(&format!("{line} --out a --threads 1")));
    let again = object(&folder.succeed(&format!("{line} --out b --threads 3")));
    assert_eq!((&report["agents"], &report["seeds"]), (&again["agents"], &again["seeds"]));
    let scenario = Scenario::parse("paper.toml", PAPER).unwrap();
    let runs: Vec<_> = (4..7).map(|seed| simulate(&scenario, seed, true)).collect();
    let seeds = &report["seeds"];
    assert_eq!((&seeds["first"], &seeds["count"]), (&4.into(), &3.into()));
    for (index, agent) in agents(seeds).iter().enumerate() {
        let sorted = |value: &dyn Fn(&RunResult) -> f64| {
            let mut values: Vec<f64> = runs.iter().map(value).collect();
            values.sort_by(f64::total_cmp);
            values
        };
        let errors = sorted(&|run| rmse(run, index));
        let counts = sorted(&|run| run.agents[index].broadcasts() as f64);
        let intervals = sorted(&|run| run.agents[index].mean_interval(&scenario.time).unwrap());
        for (key, values) in
            [("rmse", errors), ("broadcasts", counts), ("mean_interval", intervals)]
        {
            let spread = &agent[key];
            for (level, value) in ["min", "median", "max"].into_iter().zip(values) {
                assert_eq!(spread[level], json(value), "{key}, {level}");
            }
        }
        let changes = &agent["change_percent_no_network"];
        assert!(changes["min"].as_f64() <= changes["median"].as_f64());
    }
    // The first seed's run is the one of the other tables.
    assert_eq!(agents(&report)[0]["rmse_with"], json(rmse(&runs[0], 0)));
    let (first, second) = (folder.files("a"), folder.files("b"));
    assert_eq!(first["seeds.csv"], second["seeds.csv"]);
    let table = std::str::from_utf8(&first["seeds.csv"]).unwrap();
    assert_eq!(table.lines().count(), 1 + 3 * 3);
    let text = folder.succeed("reproduce --seeds 2 --out text");
    assert!(
        text.contains("2 runs, seeds 0 to 1;") && text.contains("broadcasts, learned"),
        "{text}"
    );
    let latex = folder.succeed("reproduce --seeds 2 --format latex --out text");
    for title in ["Errors, seeds 0 to 1;", "Broadcasts, seeds 0 to 1;"] {
        assert!(latex.contains(title), "{title}: {latex}");
    }
    let message = folder.fail("reproduce --seed 18446744073709551615 --seeds 2", 2);
    assert!(message.contains("--seed 18446744073709551615"), "{message}");
}

#[test]
fn states_have_their_names_in_traces_and_figures() {
    let folder = Folder::new("state-names");
    let mut mine = short();
    mine.plant = "[plant]\nmodel = \"expressions\"\nstates = [\"time\", \"prey_of_the_north\"]\n\
                  derivative = [\"-0.3*prey_of_the_north\", \"0.3*time\"]\n\
                  initial_state = [1.0, 1.0]\n"
        .to_owned();
    folder.write("mine.toml", &mine.text());
    folder.succeed("run mine.toml --out out");
    let files = folder.files("out");
    let text = |name: &str| String::from_utf8(files[name].clone()).unwrap();
    let traces = text("traces.csv");
    let header: Vec<_> = traces.lines().next().unwrap().split(',').collect();
    let expected = [
        "time [s]",
        "time [state unit]",
        "prey_of_the_north [state unit]",
        "agent1.timehat [state unit]",
        "agent1.prey_of_the_northhat [state unit]",
        "agent1.error [state unit]",
        "agent2.timehat [state unit]",
        "agent2.prey_of_the_northhat [state unit]",
        "agent2.error [state unit]",
    ];
    assert_eq!(header, expected);
    assert!(text("states.svg").contains("prey_of_the_north"));
    // Samples keep the names that `train` reads.
    folder
        .write("mine.toml", &mine.text().replace("events = true", "events = true\nsamples = true"));
    folder.succeed("run mine.toml --out samples");
    let files = folder.files("samples");
    let samples = std::str::from_utf8(&files["agent1_cycle1_samples.csv"]).unwrap();
    assert!(samples.contains("xhat1") && samples.contains("dxhat2"), "{}", &samples[..200]);
}

#[test]
fn a_tiny_state_keeps_its_digits() {
    let folder = Folder::new("tiny");
    let mut tiny = short();
    // The same oscillators a million times smaller.
    tiny.plant = tiny.plant.replace("initial_state = [1.0, 1.0]", "initial_state = [1e-6, 1e-6]");
    tiny.epsilon = 1e-10;
    (tiny.network, tiny.learning) = (String::new(), String::new());
    folder.write("tiny.toml", &tiny.text());
    let report = object(&folder.succeed("run tiny.toml --format json --out out"));
    let text = folder.succeed("run tiny.toml --out out");
    let row = text.lines().find(|line| line.starts_with("    1 ")).unwrap();
    let shown: Vec<&str> = row.split_whitespace().collect();
    for (key, column) in [("rmse", 1), ("max_error", 2)] {
        let (exact, shown) =
            (agents(&report)[0][key].as_f64().unwrap(), shown[column].parse::<f64>().unwrap());
        assert!(exact > 0.0 && exact < 1e-5, "{key}: {exact}");
        assert!(test_support::close(shown, exact, 5e-4, 0.0), "{key}: {shown}, {exact}");
    }
}
