//! `sweep`: the table of a study, whatever the threads, the parts and the interruptions; and `--set`.

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::cli::command_line::{Folder, object, short, texts};
use crate::cli::json_documented::assert_documented;

/// 12 runs of a scenario of a fraction of a second, that learns.
const STUDY: &str = "sweep mine.toml --vary design.epsilon=10:90:log3 --vary observer.preset=paper,field \
                     --set network.outer.random=0.04 --seeds 2";

fn prepared(name: &str) -> Folder {
    let folder = Folder::new(name);
    folder.write("mine.toml", &short().text());
    folder
}

fn text(folder: &Folder, name: &str) -> String {
    fs::read_to_string(folder.path(name)).unwrap()
}

fn rows(table: &str) -> Vec<Vec<String>> {
    let fields = |line: &str| line.split(',').map(str::to_owned).collect();
    table.lines().map(fields).collect()
}

#[test]
fn every_row_is_what_run_measures() {
    let folder = prepared("sweep-rows");
    let report = object(&folder.succeed(&format!("{STUDY} --out out --format json")));
    assert_documented(&report, &["runs_before", "engine_s", "summary", "low"]);
    assert_eq!(
        (&report["cells"], &report["runs"], &report["runs_done"]),
        (&6.into(), &12.into(), &12.into())
    );
    let table = rows(&text(&folder, "out/results.csv"));
    let header = "design.epsilon,observer.preset,seed,initial_state,agent,rmse,broadcasts,bytes,max_error,\
                  diverged";
    assert_eq!(table[0].join(","), header);
    assert_eq!(table.len(), 1 + 12 * 2);
    let starts: Vec<String> = table[1..].iter().map(|row| row[..5].join(",")).collect();
    assert_eq!(starts[..3], ["10,paper,0,1,1", "10,paper,0,1,2", "10,paper,1,1,1"]);
    assert_eq!(starts[23], "90,field,1,1,2");
    // Cell 4: epsilon = 30, field.
    let run = object(&folder.succeed(
        "run mine.toml --set network.outer.random=0.04 --set design.epsilon=30 --set observer.preset=field \
         --seed 1 --format json --out run",
    ));
    for agent in 0..2 {
        let row = &table[1 + 3 * 4 + 2 + agent];
        let found = &run["agents"][agent];
        assert_eq!(row[..5].join(","), format!("30,field,1,1,{}", agent + 1));
        for (column, key) in
            [(5, "rmse"), (6, "broadcasts_evaluated"), (7, "bytes_evaluated"), (8, "max_error")]
        {
            assert_eq!(row[column].parse::<Value>().unwrap(), found[key], "{key}");
        }
        assert_eq!(row[9], "false");
    }
    let again = folder.succeed(&format!("{STUDY} --out out"));
    assert!(again.contains("All runs were already complete"), "{again}");
}

#[test]
fn the_table_does_not_depend_on_threads() {
    let folder = prepared("sweep-threads");
    let study = format!("{STUDY} --initial-states 2");
    folder.succeed(&format!("{study} --out one --threads 1"));
    folder.succeed(&format!("{study} --out four --threads 4"));
    assert_eq!(folder.files("one"), folder.files("four"));
    let files = folder.files("one").into_keys().collect::<Vec<_>>();
    let expected = [
        "results.csv",
        "scenario.toml",
        "summary.csv",
        "sweep.json",
        "tradeoff.png",
        "tradeoff.svg",
    ];
    assert_eq!(files, expected);
}

#[test]
fn the_tables_of_parts_one_after_the_other_are_the_whole() {
    let folder = prepared("sweep-parts");
    folder.succeed(&format!("{STUDY} --out whole"));
    let mut merged = Vec::new();
    for part in 1..=5 {
        let told = folder.succeed(&format!("{STUDY} --out parts --shard {part}/5"));
        assert!(told.contains("cat parts/shard-*/results.csv > parts/results.csv"), "{told}");
        merged.extend(fs::read(folder.path(&format!("parts/shard-{part}/results.csv"))).unwrap());
    }
    let whole = folder.files("whole");
    assert!(whole["results.csv"] == merged);
    fs::write(folder.path("parts/results.csv"), &merged).unwrap();
    let report = object(&folder.succeed("sweep --summarise parts/results.csv --format json"));
    assert_documented(&report, &["keys", "values"]);
    assert_eq!(report["runs"], 12);
    for name in ["summary.csv", "tradeoff.svg", "tradeoff.png"] {
        assert!(fs::read(folder.path("parts").join(name)).unwrap() == whole[name], "{name}");
    }
    let wrong = [&merged[merged.len() / 2..], &merged[..merged.len() / 2]].concat();
    fs::write(folder.path("wrong.csv"), wrong).unwrap();
    let message = folder.fail("sweep --summarise wrong.csv", 2);
    assert!(message.contains("wrong.csv:1: is not the header of results"), "{message}");
}

#[test]
fn a_killed_sweep_is_continued_to_the_same_bytes() {
    let folder = prepared("sweep-killed");
    let study = format!("{STUDY} --seeds 6 --threads 2").replace("--seeds 2", "");
    folder.succeed(&format!("{study} --out whole"));
    let whole = fs::read(folder.path("whole/results.csv")).unwrap();
    let part = folder.path("part/results.csv");
    let length = || fs::metadata(&part).map_or(0, |found| found.len());
    let mut child = Command::new(env!("CARGO_BIN_EXE_simulator-under-test"))
        .args(format!("{study} --out part").split_whitespace())
        .current_dir(folder.path("."))
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let start = Instant::now();
    while length() < 600 && start.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(2));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    let killed = fs::read(&part).unwrap();
    assert!(whole.starts_with(&killed) && killed.len() >= 600, "{} bytes", killed.len());
    // A line that was torn, and a run without its second agent.
    for kept in [killed.len(), killed.len() - 7, 130] {
        fs::write(&part, &whole[..kept]).unwrap();
        let report = object(&folder.succeed(&format!("{study} --out part --format json")));
        assert_eq!(
            report["runs_before"].as_u64().unwrap() + report["runs_done"].as_u64().unwrap(),
            36
        );
        assert!(fs::read(&part).unwrap() == whole, "{kept}");
    }
}

#[test]
fn more_seeds_and_initial_states_keep_the_rows_that_are_there() {
    let folder = prepared("sweep-growing");
    let study = STUDY.replace(" --seeds 2", "");
    let run = |size: &str, out: &str| {
        let report = object(&folder.succeed(&format!("{study} {size} --out {out} --format json")));
        ["runs_before", "runs_done"].map(|key| report[key].as_u64().unwrap())
    };
    let large = "--seeds 3 --initial-states 2";
    assert_eq!(run(large, "whole"), [0, 36]);
    let whole = folder.files("whole");
    assert_eq!(run("--seeds 2", "grown"), [0, 12]);
    let small = folder.files("grown");
    assert_eq!(run(large, "grown"), [12, 24]);
    assert!(folder.files("grown") == whole);
    // The command ended while it extended the study: a part of the new table is written.
    fs::write(folder.path("grown/results.csv"), &whole["results.csv"][..400]).unwrap();
    fs::write(folder.path("grown/.results-before.csv"), &small["results.csv"]).unwrap();
    let [before, done] = run(large, "grown");
    assert!((12..36).contains(&before) && before + done == 36, "{before} and {done}");
    assert!(folder.files("grown") == whole);
    // Rows are taken as they are, without another run.
    run("--initial-states 2", "marked");
    let table = text(&folder, "marked/results.csv");
    let line = table.lines().find(|line| line.starts_with("90,field,0,2,2,")).unwrap();
    let row = "90,field,0,2,2,0.25,7,70,0.5,false";
    fs::write(folder.path("marked/results.csv"), table.replace(line, row)).unwrap();
    assert_eq!(run("--initial-states 2 --seeds 3", "marked"), [12, 24]);
    let whole = String::from_utf8(whole["results.csv"].clone()).unwrap();
    assert!(text(&folder, "marked/results.csv") == whole.replace(line, row));
    for (size, problem) in [
        ("--seeds 2 --initial-states 2", "--seeds is 3 there and 2 here; repeat its command"),
        ("--seeds 9", "--seeds is 3 there and 9 here, --initial-states is 2 there and 1 here"),
    ] {
        let message = folder.fail(&format!("{study} {size} --out grown"), 2);
        assert!(message.contains(problem), "{message}");
    }
    folder.succeed(&format!("{study} --shard 1/2 --out parts"));
    let message = folder.fail(&format!("{study} --shard 1/2 --seeds 2 --out parts"), 2);
    assert!(message.contains("--seeds is 1 there and 2 here"), "{message}");
}

#[test]
fn a_folder_with_other_results_is_refused() {
    let folder = prepared("sweep-other");
    let small = "sweep mine.toml --vary design.epsilon=10,20 --out out";
    folder.succeed(&format!("{small} --seeds 2"));
    let before = folder.files("out");
    for (other, problem) in [
        (small.to_owned(), "--seeds is 2 there and 1 here"),
        (format!("{small} --seeds 3 --seed 3"), "--seed is 0 there and 3 here"),
        (
            format!("{small} --seeds 3").replace("10,20", "10,30"),
            "the values of the varied keys differ",
        ),
        (
            small.replace("epsilon", "rho"),
            "what is varied is design.epsilon there and design.rho here",
        ),
        (
            format!("{small} --set design.rho=1.5"),
            "of scenario.toml is `rho = 1.0` there and `rho = 1.5` here",
        ),
    ] {
        let message = folder.fail(&other, 2);
        assert!(message.contains(problem), "{message}");
    }
    assert_eq!(folder.files("out"), before);
    fs::create_dir(folder.path("own")).unwrap();
    folder.write("own/results.csv", "mine\n");
    let message = folder.fail(&small.replace("out out", "out own"), 2);
    assert!(message.contains("refusing to overwrite"), "{message}");
    folder.write("own/results.csv", "");
    folder.write("own/scenario.toml", "mine\n");
    let message = folder.fail(&small.replace("out out", "out own"), 2);
    assert!(message.contains("refusing to overwrite"), "{message}");
}

#[test]
fn mistakes_are_found_before_anything_runs() {
    let folder = prepared("sweep-mistakes");
    folder.write("points.csv", "design.epsilon,design.rho\n10,1\n20,\n");
    for (arguments, problem) in [
        (
            "--vary design.epsilon=10,-1",
            "--vary design.epsilon=-1: design.epsilon: is -1, expected",
        ),
        ("--vary design.epsilom=10,20", "design.epsilom: unknown key; did you mean epsilon?"),
        ("--vary design.epsilon=10:20", "how many values?"),
        ("--vary design.epsilon=10,20 --set design.epsilon=3", "the key is also varied"),
        (
            "--vary agents.3.count=1,2",
            "agents is a list with 2 entries, and \"3\" is not one of them",
        ),
        ("--vary design.epsilon=1,2 --latin 3", "are drawn from a range"),
        ("--points points.csv", "points.csv:3: design.rho has no value"),
        ("--points none.csv", "none.csv: cannot be read"),
        ("--set design.epsilon", "has no value; write KEY=VALUE"),
        ("--shard 3/2", "write K/N, such as 1/8"),
    ] {
        let output = folder.run(&format!("sweep mine.toml {arguments}"));
        let (_, error) = texts(&output);
        assert_eq!(output.status.code(), Some(2), "{arguments}: {error}");
        assert!(error.contains(problem), "{arguments}: {error}");
    }
    assert!(!folder.path("out").exists());
}

#[test]
fn points_and_latin_hypercubes_are_cells() {
    let folder = prepared("sweep-points");
    folder.write("points.csv", "design.epsilon,observer.preset\n10,paper\n30,field\n");
    folder.succeed("sweep mine.toml --points points.csv --out points");
    let starts: Vec<String> = rows(&text(&folder, "points/results.csv"))[1..]
        .iter()
        .map(|row| row[..3].join(","))
        .collect();
    assert_eq!(starts, ["10,paper,0", "10,paper,0", "30,field,0", "30,field,0"]);
    let latin = "sweep mine.toml --vary design.epsilon=10:1000:log --vary design.gain.scale=0.8:1.2 --latin 4";
    let values = |name: &str, more: &str| {
        folder.succeed(&format!("{latin} --out {name} {more}"));
        let table = rows(&text(&folder, &format!("{name}/results.csv")));
        table[1..].iter().map(|row| row[..2].join(",")).collect::<Vec<_>>()
    };
    let drawn = values("latin", "");
    assert_eq!(drawn.len(), 8);
    assert_eq!(drawn, values("again", ""));
    assert_ne!(drawn, values("seed", "--seed 1"));
}

#[test]
fn a_run_that_diverges_is_a_row_and_not_the_end() {
    let folder = prepared("sweep-diverged");
    let told = folder.succeed("sweep mine.toml --vary design.gain=60,5000");
    assert!(told.contains("1 run failed; the first: design.gain = 5000, seed 0: agent"), "{told}");
    let table = text(&folder, "out/scenario_builder-sweep/results.csv");
    assert!(table.ends_with("5000,0,1,1,,,,,true\n5000,0,1,2,,,,,true\n"), "{table}");
    let summary = text(&folder, "out/scenario_builder-sweep/summary.csv");
    assert!(summary.ends_with("5000,all,1,1,,,,,,,,,,,,,,,,\n"), "{summary}");
    let output = folder.run("sweep mine.toml --vary design.gain=5000 --out all");
    let (told, error) = texts(&output);
    assert_eq!(output.status.code(), Some(1), "{told}{error}");
    assert!(error.starts_with("error: every run failed; the first: agent"), "{error}");
    assert!(Path::new(&folder.path("all/results.csv")).exists());
}

#[test]
fn every_command_takes_changes() {
    let folder = prepared("set");
    let same = |command: &str| {
        let message = folder.fail(&format!("{command} --set design.epsilom=3"), 2);
        assert!(
            message.contains(
                ": --set design.epsilom=3: design.epsilom: unknown key; did you mean epsilon?"
            ),
            "{command}: {message}"
        );
    };
    for command in [
        "run mine.toml",
        "check mine.toml",
        "design mine.toml",
        "frontier mine.toml",
        "sweep mine.toml",
        "scenario paper",
        "train samples.csv --scenario mine.toml --agent 1 --out new.weights",
        "weights import arrays.npz --scenario mine.toml --agent 1 --out new.weights",
    ] {
        same(command);
    }
    #[cfg(unix)]
    same("cosim mine.toml");
    // A key that the file does not have moves its lines: a mistake in the file keeps its own line.
    folder.write("broken.toml", &short().text().replace("rho = 1.0", "rho = -1.0"));
    let plain = folder.fail("check broken.toml", 2);
    assert_eq!(plain, folder.fail("check broken.toml --set link.loss=0.1", 2));
    let changed = folder.succeed("scenario paper --set design.epsilon=500");
    folder.write("changed.toml", &changed);
    let [direct, file] = ["paper --set design.epsilon=500", "changed.toml"]
        .map(|scenario| folder.succeed(&format!("check {scenario}")));
    assert_eq!(direct, file);
}

#[test]
fn drawn_initial_states_depend_on_the_seed_only() {
    let folder = prepared("drawn-state");
    let run = |more: &str| {
        let command = format!("run mine.toml --format json --baselines none --out out {more}");
        object(&folder.succeed(&command))["initial_state"].clone()
    };
    let random = "--set plant.initial_state.random=[1,0.5]";
    let drawn = run(&format!("{random} --seed 5 --threads 1"));
    assert_eq!(drawn, run(&format!("{random} --seed 5 --threads 3 --set design.epsilon=20")));
    assert_ne!(drawn, run(&format!("{random} --seed 6")));
    assert_eq!(run(""), serde_json::json!([1.0, 1.0]));
    let state: Vec<f64> = drawn.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect();
    assert!(state[0].abs() <= 1.0 && state[1].abs() <= 0.5 && state != [1.0, 1.0]);
    let told = folder.succeed(&format!("run mine.toml {random} --seed 5 --out out"));
    assert!(told.contains("Initial state, drawn: ["), "{told}");
    // A run with this state given is the same run. The state is taken as it is printed, because reading
    // JSON rounds in the last digit.
    let printed = folder.succeed(&format!(
        "run mine.toml --format json --baselines none --out out {random} --seed 5"
    ));
    let (_, printed) = printed.split_once("\"initial_state\":").unwrap();
    let printed = printed.split_inclusive(']').next().unwrap();
    let given = format!("--set plant.initial_state={printed} --seed 5");
    let agents = |more: &str| {
        let command = format!("run mine.toml --format json --baselines none --out out {more}");
        object(&folder.succeed(&command))["agents"].clone()
    };
    assert_eq!(agents(&format!("{random} --seed 5")), agents(&given));
    // The same holds for a sweep, where each seed draws its own.
    folder.succeed(&format!("sweep mine.toml {random} --seeds 7 --out drawn"));
    folder.succeed(&format!("sweep mine.toml {given} --out given"));
    let table = rows(&text(&folder, "drawn/results.csv"));
    let given = rows(&text(&folder, "given/results.csv"));
    assert_eq!(table[1 + 2 * 5..3 + 2 * 5], given[1..3]);
    assert_ne!(table[1][3..], table[3][3..]);
    for command in ["check", "design", "frontier --forms flow --seeds 1 --initial-states 2"] {
        folder.succeed(&format!("{command} {random} mine.toml"));
    }
}

#[test]
fn tables_for_papers_are_latex() {
    let folder = Folder::new("latex");
    folder.write("mine.toml", &short().text());
    for command in [
        "run mine.toml --baselines known-f --out run",
        "sweep mine.toml --vary design.epsilon=50,100 --seeds 1 --out sweep",
        "sweep --summarise sweep/results.csv",
    ] {
        let text = folder.succeed(&format!("{command} --format latex"));
        assert!(text.starts_with("% ") && text.contains("\\begin{tabular}"), "{text}");
        let rows = text.matches(" \\\\\n").count();
        assert!(rows >= 3 && text.trim_end().ends_with("\\end{tabular}"), "{text}");
    }
    // Other commands neither take nor offer it.
    let error = folder.fail("design mine.toml --format latex", 2);
    assert!(error.contains("invalid value 'latex'"), "{error}");
    for (command, has_tables) in
        [("design", false), ("train", false), ("check", false), ("run", true), ("frontier", true)]
    {
        assert_eq!(
            folder.succeed(&format!("{command} --help")).contains("latex"),
            has_tables,
            "{command}"
        );
    }
}

#[test]
fn a_pdf_is_of_the_table_beside_it_or_not_there() {
    let folder = prepared("sweep-pdf");
    let small = "sweep mine.toml --set learning=[] --vary design.epsilon=10,20";
    // A foreign file is found before anything runs.
    fs::create_dir(folder.path("foreign")).unwrap();
    folder.write("foreign/tradeoff.pdf", "mine");
    let message = folder.fail(&format!("{small} --out foreign --pdf"), 2);
    assert!(message.contains("tradeoff.pdf: not a PDF document"), "{message}");
    fs::create_dir(folder.path("other")).unwrap();
    folder.write("other/summary.csv", "mine");
    let message = folder.fail(&format!("{small} --out other"), 2);
    assert!(message.contains("summary.csv: not the summary of a sweep"), "{message}");
    for folder_name in ["foreign", "other"] {
        assert!(!folder.path(folder_name).join("results.csv").exists());
    }
    folder.succeed(&format!("{small} --out out --pdf"));
    let pdf = fs::read(folder.path("out/tradeoff.pdf")).unwrap();
    assert!(pdf.starts_with(b"%PDF-"));
    // Without --pdf an older one does not stay beside the new picture.
    folder.succeed("sweep --summarise out/results.csv");
    assert!(!folder.path("out/tradeoff.pdf").exists());
    folder.succeed("sweep --summarise out/results.csv --pdf");
    assert_eq!(fs::read(folder.path("out/tradeoff.pdf")).unwrap(), pdf);
    // A part of a study has no picture.
    let message = folder.fail(&format!("{small} --out parts --shard 1/2 --pdf"), 2);
    assert!(message.contains("pass the option with --summarise"), "{message}");
}

#[test]
fn what_is_missing_or_has_no_effect_is_said() {
    let folder = prepared("sweep-remarks");
    let warnings = |line: &str| {
        let output = folder.run(line);
        let (standard, error) = texts(&output);
        assert_eq!(output.status.code(), Some(0), "{standard}{error}");
        error
    };
    let untrained = "sweep mine.toml --set method=no-network --seeds 3";
    let idle = warnings(&format!("{untrained} --vary kalman.radius=0.1,0.2 --out idle"));
    assert!(
        idle.contains("all 2 cells have the same results: kalman.radius has no effect"),
        "{idle}"
    );
    assert!(idle.contains("nothing in this scenario depends on the seed"), "{idle}");
    let whole = warnings(&format!("{STUDY} --out out"));
    assert!(!whole.contains("no effect") && !whole.contains("not complete"), "{whole}");
    // As an interruption leaves it.
    let table = text(&folder, "out/results.csv");
    let rows: String = table.lines().take(1 + 2 * 3).map(|line| format!("{line}\n")).collect();
    fs::write(folder.path("out/results.csv"), rows).unwrap();
    let part = warnings("sweep --summarise out/results.csv");
    assert!(part.contains("the table has 3 of 12 runs, and 2 of 6 cells"), "{part}");
    let json = object(&folder.succeed("sweep --summarise out/results.csv --format json"));
    assert_eq!(json["warnings"][0]["code"], "incomplete-study", "{json}");
    folder.succeed("report out");
    assert!(text(&folder, "out/report.html").contains("\"runs\":12"));
}
