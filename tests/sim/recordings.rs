//! A recording in place of the plant.

use std::fs;

use host_sim::engine::{RunOptions, RunResult, Silent, run};
use host_sim::scenario::{PAPER, Scenario};

use crate::cli::command_line::{Folder, object};

fn result(scenario: &Scenario) -> RunResult {
    run(scenario, RunOptions { seed: 0, learning: true, bounds: true }, &Silent).unwrap()
}

/// The paper's scenario for four seconds, recorded in every step by its own traces.
fn recorded(folder: &Folder, agent_keys: &str, plant_keys: &str) -> String {
    let short = PAPER
        .replace("duration = 40.0", "duration = 4.0")
        .replace("\nfrom = 20.0", "\nfrom = 2.0")
        .replace("\nto = 40.0", "\nto = 4.0");
    let (before, _) = short.split_once("[[learning]]").unwrap();
    let (_, evaluation) = short.split_once("[evaluation]").unwrap();
    let text = format!("{before}\n[evaluation]{evaluation}");
    folder.write("simulated.toml", &text);
    folder.succeed("run simulated.toml --out simulated --baselines none");
    let (_, rest) = text.split_once("[plant]").unwrap();
    let (_, rest) = rest.split_once("[disturbance]").unwrap();
    let (_, rest) = rest.split_once("[time]").unwrap();
    let rest = rest.replace(
        "output_matrix = [[1.0, 0.0, 0.0]]",
        &format!("output_matrix = [[1.0, 0.0, 0.0]]\n{agent_keys}"),
    );
    let plant = format!(
        "name = \"recorded\"\n[plant]\nmodel = \"recording\"\nfile = \"simulated/traces.csv\"\n\
         time = \"time [s]\"\nstates = [\"x\", \"y\", \"z\"]\n{plant_keys}\n[time]"
    );
    plant + &rest
}

const REFERENCE: &str = "reference = [\"x [state unit]\", \"y [state unit]\", \"z [state unit]\"]";

#[test]
fn a_recording_of_every_step_is_as_good_as_the_plant() {
    let folder = Folder::new("recording-of-every-step");
    let text = recorded(&folder, "measured = [\"x [state unit]\"]", REFERENCE);
    folder.write("recorded.toml", &text);
    let scenario = Scenario::load(&folder.path("recorded.toml")).unwrap();
    let simulated = Scenario::load(&folder.path("simulated.toml")).unwrap();
    let (recorded, simulated) = (result(&scenario), result(&simulated));
    assert_eq!(recorded.digest, simulated.digest);
    for (recorded, simulated) in recorded.agents.iter().zip(&simulated.agents) {
        assert_eq!(recorded.rmse(), simulated.rmse());
        assert!(recorded.innovation_rms().is_some_and(|rms| rms > 0.0));
    }
}

#[test]
fn without_a_reference_there_are_innovations_and_no_errors() {
    let folder = Folder::new("recording-without-reference");
    let measured = |column: &str| format!("measured = [\"{column} [state unit]\"]");
    let text = recorded(&folder, &measured("x"), "")
        .replace(
            "output_matrix = [[0.0, 1.0, 0.0]]",
            &format!("output_matrix = [[0.0, 1.0, 0.0]]\n{}", measured("y")),
        )
        .replace(
            "output_matrix = [[0.0, 0.0, 1.0]]",
            &format!("output_matrix = [[0.0, 0.0, 1.0]]\n{}", measured("z")),
        );
    folder.write("recorded.toml", &text);
    let report = object(&folder.succeed("run recorded.toml --out out --format json"));
    for agent in report["agents"].as_array().unwrap() {
        assert!(agent["rmse"].is_null() && agent["max_error"].is_null(), "{agent}");
        assert!(agent["innovation_rms"].as_f64().unwrap() > 0.0, "{agent}");
    }
    let text = folder.succeed("run recorded.toml --out out");
    assert!(text.contains("innovation"), "{text}");
}

#[test]
fn studies_and_methods_without_a_reference_show_innovations() {
    let folder = Folder::new("recording-studied");
    let measured = |column: &str| format!("measured = [\"{column} [state unit]\"]");
    let rows = ["[0.0, 1.0, 0.0]", "[0.0, 0.0, 1.0]"];
    let mut text = recorded(&folder, &measured("x"), "");
    for (row, column) in rows.iter().zip(["y", "z"]) {
        let plain = format!("output_matrix = [{row}]");
        text = text.replace(&plain, &format!("{plain}\n{}", measured(column)));
    }
    folder.write("recorded.toml", &text);
    let sweep = "sweep recorded.toml --vary design.epsilon=1000,3000 --seeds 2 --out study";
    let study = object(&folder.succeed(&format!("{sweep} --format json")));
    for cell in study["summary"].as_array().unwrap() {
        assert!(cell["rmse"].is_null(), "{cell}");
        assert!(cell["innovation_rms"]["median"].as_f64().unwrap() > 0.0, "{cell}");
    }
    let results = fs::read_to_string(folder.path("study/results.csv")).unwrap();
    let (header, rows) = results.split_once('\n').unwrap();
    assert!(header.ends_with("rmse,broadcasts,bytes,max_error,innovation_rms,diverged"));
    for row in rows.lines() {
        let fields: Vec<&str> = row.split(',').collect();
        let ["", _, _, "", innovation, "false"] = fields[4..] else { panic!("{row}") };
        assert!(innovation.parse::<f64>().unwrap() > 0.0, "{row}");
    }
    // Half of the table is continued to the same bytes.
    let half = &results[..results.len() / 2];
    fs::write(folder.path("study/results.csv"), half).unwrap();
    let shown = folder.succeed(sweep);
    assert!(shown.contains("largest innovation RMS of an agent"), "{shown}");
    assert_eq!(fs::read_to_string(folder.path("study/results.csv")).unwrap(), results);
    let picture = fs::read_to_string(folder.path("study/tradeoff.svg")).unwrap();
    assert!(picture.contains("largest innovation RMS of an agent [output unit]"), "{picture}");

    folder.write("plain.toml", &format!("method = \"no-network\"\n{text}"));
    let text = folder.succeed("run plain.toml --baselines observer,untrained --out methods");
    assert!(text.contains("innovation RMS"), "{text}");
    let table = fs::read_to_string(folder.path("methods/methods.csv")).unwrap();
    let mut lines = table.lines();
    assert!(lines.next().unwrap().starts_with("method,agent,rmse,innovation_rms,broadcasts_all"));
    for line in lines {
        let fields: Vec<&str> = line.split(',').collect();
        assert!(fields[2].is_empty() && fields[3].parse::<f64>().unwrap() > 0.0, "{line}");
    }
}

#[test]
fn a_recording_that_does_not_fit_is_refused_with_its_place() {
    let folder = Folder::new("recordings-refused");
    let good = "t,y1,y2\n0,1,2\n0.5,1,2\n4.0,1,2\n";
    let scenario = |plant: &str, agent: &str| {
        format!(
            "name = \"mine\"\n[plant]\nmodel = \"recording\"\nfile = \"data.csv\"\n\
             states = [\"a\", \"b\"]\n{plant}\n[time]\nduration = 4.0\nstep = 0.5\n\
             [design]\ngain = [1.0, 1.0]\nk2 = 2.0\nkappa = 1.0\nrho = 1.0\ndelta = 1.0\nepsilon = 1.0\n\
             [[agents]]\noutput_matrix = [[1.0, 0.0], [0.0, 1.0]]\n{agent}\n"
        )
    };
    let both = "measured = [\"y1\", \"y2\"]";
    for (data, plant, agent, expected) in [
        (good, "", both, ""),
        (good, "", "measured = [\"y1\", \"y3\"]", "no column `y3`"),
        (good, "", "measured = [\"y1\"]", "names 1 column, expected 2"),
        (good, "", "", "there is nothing to measure"),
        (good, "reference = [\"y1\", \"nothing\"]", both, "no column `nothing`"),
        (good, "time = \"seconds\"", both, "no column `seconds`"),
        (good, "between = \"maybe\"", both, "maybe"),
        (good, "initial_state = [1.0, 2.0]", both, "unknown key"),
        ("t,y1,y2\n0,1,2\n0.5,1,2\n3.5,1,2\n", "", both, "longer than the recording of 3.5 s"),
        ("t,y1,y2\n0,1,2\n0.5,1,2\n0.5,1,2\n", "", both, "does not increase in line 4"),
        ("t,y1,y2\n0,1,2\n0.5,x,2\n4,1,2\n", "", both, "line 3, column `y1`: `x` is not a finite"),
        (
            "t,y1,y2\n# a comment\n\n0,1,2\n,1,2\n4,1,2\n",
            "",
            both,
            "line 5 of the file has no time",
        ),
        ("0,1,2\n0.5,1,2\n4,1,2\n", "", both, "numbers instead of names"),
        ("t,y1,y1\n0,1,2\n4,1,2\n", "", both, "two columns are called `y1`"),
        ("t,y1,y2\n0,1,2\n0.5,,2\n4,1,2\n", "reference = [\"y1\", \"y2\"]", both, "line 3"),
        (
            "t,y1,y2\n0,1,2\n",
            "",
            both,
            "data.csv: the recording has only one row of numbers, in line 2",
        ),
        (
            "# a comment\nt,y1,y2\n",
            "",
            both,
            "data.csv: the recording has no rows after its header",
        ),
        ("", "", both, "data.csv is empty"),
        ("t,y1,y2\n0,1,\n0.5,1,\n4,1,\n", "", both, "the column `y2` has no numbers"),
    ] {
        fs::write(folder.path("data.csv"), data).unwrap();
        folder.write("mine.toml", &scenario(plant, agent));
        let found = Scenario::load(&folder.path("mine.toml")).map(|_| ());
        let found = found.map_err(|error| error.to_string()).err().unwrap_or_default();
        assert_eq!(expected.is_empty(), found.is_empty(), "{found}");
        assert!(found.contains(expected), "{expected}: {found}");
    }
    fs::write(folder.path("data.csv"), good).unwrap();
    folder.write("mine.toml", &("method = \"kalman\"\n".to_owned() + &scenario("", both)));
    let error = Scenario::load(&folder.path("mine.toml")).unwrap_err().to_string();
    assert!(error.contains("a recording does not define f"), "{error}");
}

#[test]
fn the_copy_of_a_scenario_can_be_run_where_it_lies() {
    let folder = Folder::new("recordings-copied");
    let text = recorded(&folder, "measured = [\"x [state unit]\"]", REFERENCE);
    fs::create_dir(folder.path("own")).unwrap();
    folder.write("own/recorded.toml", &text.replace("simulated/", "../simulated/"));
    let study = "sweep own/recorded.toml --set design.epsilon=50 --vary design.rho=1,2 --out out/deep/study";
    folder.succeed(study);
    let copy = fs::read_to_string(folder.path("out/deep/study/scenario.toml")).unwrap();
    assert!(copy.contains("file = \"../../../simulated/traces.csv\"\n"), "{copy}");
    folder.succeed("check out/deep/study/scenario.toml");
    folder.succeed("sweep out/deep/study/scenario.toml --vary design.rho=1,2 --out copied");
    let rows = |name: &str| fs::read(folder.path(name).join("results.csv")).unwrap();
    assert!(rows("copied") == rows("out/deep/study"));
    // The folder of a study can be moved.
    fs::rename(folder.path("out/deep/study"), folder.path("moved")).unwrap();
    let again = folder.succeed(&study.replace("out/deep/study", "moved --seeds 2"));
    assert!(again.contains("Continued after 2 of 4 runs"), "{again}");
    let copy = fs::read_to_string(folder.path("moved/scenario.toml")).unwrap();
    assert!(copy.contains("file = \"../simulated/traces.csv\"\n"), "{copy}");
}

#[test]
fn a_study_is_of_recordings_or_of_plants() {
    let folder = Folder::new("recordings-mixed");
    folder.write("one.csv", "t,y\n0,1\n0.5,1\n4.0,1\n");
    folder.write("two.csv", "t,y\n0,2\n0.5,1\n4.0,1\n");
    let linear = "model=\"linear\",parameters={matrix=[[-1.0]]},initial_state=[1.0]";
    let file = |name: &str| {
        format!("model=\"recording\",file=\"{name}\",states=[\"x\"],reference=[\"y\"]")
    };
    folder.write(
        "mine.toml",
        &format!(
            "name = \"mine\"\nplant = {{{linear}}}\n[time]\nduration = 4.0\nstep = 0.5\n[design]\n\
             gain = [1.0]\nk2 = 2.0\nkappa = 1.0\nrho = 1.0\ndelta = 1.0\nepsilon = 1.0\n\
             [[agents]]\noutput_matrix = [[1.0]]\n"
        ),
    );
    let [one, two] = ["one.csv", "two.csv"].map(file);
    for varied in [format!("{{{one}}},{{{linear}}}"), format!("{{{linear}}},{{{one}}}")] {
        let message = folder.fail(&format!("sweep mine.toml --vary plant={varied} --out out"), 2);
        assert!(message.contains("one.csv") && message.contains("uses a recording"), "{message}");
        assert!(message.contains("run a separate study for each"), "{message}");
    }
    assert!(!folder.path("out").exists());
    // The scenario's own plant is in no cell.
    let recorded = format!("sweep mine.toml --vary plant={{{one}}},{{{two}}} --out out");
    folder.succeed(&recorded);
    let header = fs::read_to_string(folder.path("out/results.csv")).unwrap();
    assert!(header.lines().next().unwrap().ends_with("innovation_rms,diverged"), "{header}");
    let message = folder.fail(&format!("{recorded} --initial-states 2"), 2);
    assert!(message.contains("a recording has only one initial state"), "{message}");
    // A recording of a cell is a part of the study.
    folder.write("two.csv", "t,y\n0,3\n0.5,1\n4.0,1\n");
    let message = folder.fail(&format!("{recorded} --seeds 2"), 2);
    assert!(message.contains("the values of the varied keys differ, or a recording"), "{message}");
}

#[test]
fn what_a_recording_does_not_define_is_refused_everywhere() {
    let folder = Folder::new("recordings-without-f");
    let text = recorded(&folder, "measured = [\"x [state unit]\"]", REFERENCE);
    folder.write("recorded.toml", &text);
    for command in [
        "run recorded.toml --baselines known-f",
        "run recorded.toml --baselines kalman",
        "frontier recorded.toml --forms known-f",
        "design recorded.toml",
        "run recorded.toml --set method=extended-kalman",
    ] {
        let error = folder.fail(command, 2);
        assert!(error.contains("recording"), "{command}: {error}");
    }
    // `all` leaves them out.
    let report =
        object(&folder.succeed("run recorded.toml --baselines all --out out --format json"));
    let methods = report["methods"].as_array().unwrap();
    assert!(methods.iter().all(|row| !row["knows"].as_str().unwrap().contains("f exactly")));
    // A second and a third run replace what the first one wrote.
    folder.succeed("run recorded.toml --out out");
    folder.succeed("run recorded.toml --out out");
}
