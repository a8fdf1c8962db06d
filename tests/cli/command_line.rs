//! The program itself: what it prints where, which files it leaves, and how it ends.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use host_sim::engine::{RunOptions, Silent, run};
use host_sim::scenario::PAPER;
use serde_json::Value;

use crate::sim::reproduce::paper;
use crate::sim::scenario_builder::{Described, SHORT_RECIPE, cycle, network, picks};

/// A folder of its own for one test, removed at the end.
pub(crate) struct Folder(PathBuf);

impl Folder {
    pub(crate) fn new(name: &str) -> Self {
        let name = format!("host-sim-{}-{name}", std::process::id());
        let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
        fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    pub(crate) fn write(&self, name: &str, text: &str) {
        fs::write(self.path(name), text).unwrap();
    }

    /// Runs the program in this folder, with these arguments, separated by blanks.
    pub(crate) fn run(&self, arguments: &str) -> Output {
        Command::new(env!("CARGO_BIN_EXE_simulator-under-test"))
            .args(arguments.split_whitespace())
            .current_dir(&self.0)
            .output()
            .unwrap()
    }

    /// Starts the program in this folder, with pipes to what it says.
    pub(crate) fn start(&self, arguments: &str) -> Child {
        Command::new(env!("CARGO_BIN_EXE_simulator-under-test"))
            .args(arguments.split_whitespace())
            .current_dir(&self.0)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap()
    }

    /// Runs it; it must succeed and say nothing but warnings on standard error, which is a pipe here:
    /// scenarios of a fraction of a second teach a network little.
    pub(crate) fn succeed(&self, arguments: &str) -> String {
        let output = self.run(arguments);
        let (standard, error) = texts(&output);
        assert_eq!(output.status.code(), Some(0), "{arguments}: {error}");
        assert!(error.lines().all(|line| line.starts_with("warning: ")), "{arguments}: {error}");
        standard
    }

    /// Runs it; it must end with this code, without a result. Returns what it says.
    pub(crate) fn fail(&self, arguments: &str, code: i32) -> String {
        let output = self.run(arguments);
        let (standard, error) = texts(&output);
        assert_eq!((output.status.code(), standard.as_str()), (Some(code), ""), "{arguments}");
        assert!(error.starts_with("error: ") && error.ends_with('\n'), "{arguments}: {error}");
        assert!(!error.contains("panicked"), "{error}");
        error
    }

    /// The content of every result in a folder in this one: the manifest tells the command line, which
    /// differs from run to run.
    pub(crate) fn results(&self, folder: &str) -> BTreeMap<String, Vec<u8>> {
        let mut files = self.files(folder);
        assert!(files.remove("run.json").is_some());
        files
    }

    /// The content of every file in a folder in this one.
    pub(crate) fn files(&self, folder: &str) -> BTreeMap<String, Vec<u8>> {
        let entries = fs::read_dir(self.path(folder)).unwrap().map(Result::unwrap);
        let file = |entry: fs::DirEntry| {
            (entry.file_name().into_string().unwrap(), fs::read(entry.path()).unwrap())
        };
        entries.map(file).collect()
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

pub(crate) fn texts(output: &Output) -> (String, String) {
    let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).unwrap();
    (text(&output.stdout), text(&output.stderr))
}

/// A scenario of a fraction of a second that uses everything.
pub(crate) fn short() -> Described {
    let mut scenario_builder =
        Described::linear(2, "path", [(picks(2, [0]), 1), (picks(2, [1]), 1)]);
    scenario_builder.duration = 0.8;
    scenario_builder.network = network(&[(4, "tanh")], "2.0");
    scenario_builder.learning = cycle(&[1, 2], 0.1, 0.5, 0.6) + SHORT_RECIPE;
    // From the switch on, so that there is nothing to warn of.
    scenario_builder.learning += "\n[evaluation]\nfrom = 0.6\nto = 0.8\n";
    scenario_builder
}

/// The one JSON object that `text` is.
pub(crate) fn object(text: &str) -> Value {
    let value: Value = serde_json::from_str(text).unwrap_or_else(|e| panic!("{e}: {text}"));
    assert!(value.is_object() && text.ends_with("}\n") && text.lines().count() == 1, "{text}");
    value
}

fn assert_keys(value: &Value, expected: &[&str]) {
    let found: BTreeSet<_> = value.as_object().unwrap().keys().map(String::as_str).collect();
    assert_eq!(found, expected.iter().copied().collect(), "{value}");
}

fn agents(value: &Value) -> &[Value] {
    value["agents"].as_array().unwrap()
}

/// A number as JSON carries it: reading it rounds in the last digit, so both sides have to be read.
fn number(value: Option<f64>) -> Value {
    assert!(value.is_some());
    serde_json::from_str(&serde_json::to_string(&value).unwrap()).unwrap()
}

/// Every picture is there in both formats and is what its name says.
fn assert_pictures(files: &BTreeMap<String, Vec<u8>>, names: &[&str]) {
    for name in names {
        let svg = String::from_utf8(files[&format!("{name}.svg")].clone()).unwrap();
        assert!(svg.contains("<svg") && svg.trim_end().ends_with("</svg>"), "{name}");
        assert!(svg.matches("<path").count() + svg.matches("<polyline").count() > 0, "{name}");
        let png = &files[&format!("{name}.png")];
        assert_eq!(png[..8], *b"\x89PNG\r\n\x1a\n", "{name}");
        assert_eq!(png[png.len() - 8..png.len() - 4], *b"IEND", "{name}");
        let side = |at: usize| u32::from_be_bytes(png[at..at + 4].try_into().unwrap());
        assert!(side(16) >= 600 && side(20) >= 300, "{name}: {} x {}", side(16), side(20));
    }
}

/// Every CSV file has a header of distinct names, with units where a column has one, and lines of
/// as many fields.
fn assert_tables(files: &BTreeMap<String, Vec<u8>>, names: &[&str]) {
    let found: Vec<_> = files.keys().filter_map(|name| name.strip_suffix(".csv")).collect();
    assert_eq!(found, names);
    for name in names {
        let text = std::str::from_utf8(&files[&format!("{name}.csv")]).unwrap();
        let mut lines = text.lines();
        let header: Vec<_> = lines.next().unwrap().split(',').collect();
        assert_eq!(header.iter().collect::<BTreeSet<_>>().len(), header.len(), "{header:?}");
        let counts = [
            "agent",
            "cycle",
            "epoch",
            "sequence",
            "broadcasts",
            "frames_delivered",
            "frames_lost",
            "broadcasts_no_network",
            "broadcasts_untrained",
        ];
        let bare = ["damping", "gradient_norm"];
        for column in &header {
            assert!(column.starts_with(|c: char| c.is_ascii_alphabetic()), "{name}: {column}");
            let unit = column.split_once(" [").is_some_and(|(_, unit)| unit.ends_with(']'));
            let without = counts.contains(column) || bare.contains(column);
            assert!(unit != without, "{name}: {column}");
        }
        let mut rows = 0;
        for line in lines {
            let fields: Vec<_> = line.split(',').collect();
            assert_eq!(fields.len(), header.len(), "{name}: {line}");
            let number = |field: &&str| field.is_empty() || field.parse::<f64>().is_ok();
            assert!(fields.iter().all(number), "{name}: {line}");
            rows += 1;
        }
        assert!(rows > 1, "{name} has {rows} lines");
    }
}

#[test]
fn without_arguments_it_reproduces_the_paper_into_out() {
    let folder = Folder::new("default");
    let text = folder.succeed("");
    let files = folder.files("out");
    assert_pictures(&files, &["figure1", "figure2", "figure3", "figure4"]);
    let tables = [
        "events_with",
        "events_without",
        "table1",
        "traces_with",
        "traces_without",
        "training_with",
    ];
    assert_tables(&files, &tables);
    // And the manifest, which names them.
    assert_eq!(files.len(), 4 * 2 + tables.len() + 1);
    for expected in ["Table 1", "Theorem 1", "Theorem 2, agent 3", "out/figure2", "Recipe better"] {
        assert!(text.contains(expected), "{expected} is missing:\n{text}");
    }
    assert!(
        !text.contains("BROKEN") && !text.contains("NaN") && !text.contains('\u{1b}'),
        "{text}"
    );
    let table = std::str::from_utf8(&files["table1.csv"]).unwrap();
    assert_eq!(table.lines().count(), 4);
    assert!(text.contains("0.0777") && table.contains("0.0777"));
}

#[test]
fn reproduce_in_json_is_one_object_and_the_same_again() {
    let folder = Folder::new("reproduce-json");
    let first = object(&folder.succeed("reproduce --format json --out a --threads 1"));
    let second = object(&folder.succeed("reproduce --format json --out b --threads 2 --seed 0"));
    let keys =
        ["seed", "recipe", "elapsed_s", "agents", "trainings", "seeds", "checks", "warnings"];
    assert_keys(&first, &keys);
    assert_eq!((&first["checks"], &first["warnings"]), (&second["checks"], &second["warnings"]));
    assert_eq!((&first["seed"], &first["recipe"]), (&Value::from(0), &Value::from("better")));
    assert!(first["elapsed_s"].as_f64().unwrap() > 0.0);
    assert_eq!(agents(&first).len(), 3);
    for (number, agent) in (1..).zip(agents(&first)) {
        let keys = [
            "agent",
            "rmse_no_network",
            "rmse_without",
            "rmse_with",
            "change_percent_no_network",
            "change_percent",
            "mean_interval_no_network",
            "mean_interval_without",
            "mean_interval_with",
            "broadcasts_no_network",
            "broadcasts_without",
            "broadcasts_with",
        ];
        assert_keys(agent, &[&keys[..], &["explained_variance"]].concat());
        assert_eq!(agent["agent"], number);
        assert!(keys.iter().all(|key| agent[key].is_number()), "{agent}");
        assert!(agent["broadcasts_with"].is_u64() && agent["broadcasts_without"].is_u64());
        let number = |key: &str| agent[key].as_f64().unwrap();
        let change = 100.0 * (number("rmse_with") / number("rmse_without") - 1.0);
        assert!(test_support::close(number("change_percent"), change, 1e-12, 0.0));
        let change = 100.0 * (number("rmse_with") / number("rmse_no_network") - 1.0);
        assert!(test_support::close(number("change_percent_no_network"), change, 1e-12, 0.0));
    }
    assert_eq!(agents(&first), agents(&second));
    // Tables and pictures, too, are the same bytes on one thread and on two.
    let (first, second) = (folder.results("a"), folder.results("b"));
    assert!(first.keys().eq(second.keys()));
    for (name, bytes) in &first {
        assert!(*bytes == second[name], "{name}");
    }
}

#[test]
fn run_in_json_is_one_object() {
    let folder = Folder::new("run-json");
    folder.write("mine.toml", &short().text());
    let result = object(&folder.succeed("run mine.toml --format json --seed 7"));
    let keys = [
        "scenario",
        "seed",
        "initial_state",
        "elapsed_s",
        "baselines",
        "agents",
        "trainings",
        "link",
        "radio",
        "processor",
        "methods",
        "checks",
        "warnings",
    ];
    assert_keys(&result, &keys);
    assert_eq!((&result["scenario"], &result["seed"]), (&"scenario_builder".into(), &7.into()));
    let keys = [
        "agent",
        "rmse",
        "rmse_no_network",
        "rmse_untrained",
        "change_percent_no_network",
        "change_percent",
        "explained_variance",
        "max_error",
        "innovation_rms",
        "broadcasts",
        "frames_sent",
        "broadcasts_evaluated",
        "bytes_evaluated",
        "frames_delivered",
        "frames_lost",
        "bytes_sent",
        "airtime_s",
        "broadcasts_no_network",
        "broadcasts_untrained",
        "mean_interval",
        "min_interval",
    ];
    let options = RunOptions { seed: 7, learning: true, bounds: false };
    let scenario = short().scenario();
    let expected = run(&scenario, options, &Silent).unwrap();
    for (training, record) in
        result["trainings"].as_array().unwrap().iter().zip(&expected.trainings)
    {
        let quality = &record.quality;
        assert_eq!((&training["agent"], &training["cycle"]), (&record.agent.into(), &1.into()));
        assert_eq!(training["samples"], record.samples);
        assert_eq!(training["training_error"], number(Some(quality.training.error)));
        assert_eq!(training["validation_error"], number(quality.validation.map(|fit| fit.error)));
    }
    assert_eq!(result["trainings"].as_array().unwrap().len(), 2);
    let expected = expected.agents;
    assert_eq!(agents(&result).len(), 2);
    for (index, agent) in agents(&result).iter().enumerate() {
        assert_keys(agent, &keys);
        let statistics = &expected[index];
        assert_eq!(agent["agent"], index + 1);
        assert_eq!(agent["broadcasts"], statistics.broadcasts());
        assert_eq!(agent["rmse"], number(statistics.rmse()));
        assert_eq!(agent["max_error"], number(statistics.max_error()));
        assert_eq!(agent["mean_interval"], number(statistics.mean_interval(&scenario.time)));
        assert_eq!(agent["min_interval"], number(statistics.min_interval(&scenario.time)));
    }
    let files = folder.results("out/scenario_builder");
    assert_pictures(&files, &["errors", "events", "states"]);
    assert_tables(&files, &["agents", "events", "innovations", "traces", "training"]);
    // The same seed draws the same pictures; another one, others.
    folder.succeed("run mine.toml --format json --seed 7 --out again --threads 2");
    assert!(files == folder.results("again"));
    folder.succeed("run mine.toml --seed 8 --out other");
    assert_ne!(files["traces.csv"], folder.files("other")["traces.csv"]);
}

#[test]
fn a_watched_run_tells_what_was_counted() {
    let folder = Folder::new("watched");
    let mut watched = short();
    watched.learning += "\n[health]\nfall_back_after = 20\n";
    folder.write("mine.toml", &watched.text());
    let result = object(&folder.succeed("run mine.toml --format json"));
    let options = RunOptions { seed: 0, learning: true, bounds: true };
    let expected = run(&watched.scenario(), options, &Silent).unwrap().agents;
    for (agent, expected) in agents(&result).iter().zip(&expected) {
        let health = &agent["health"];
        let keys = [
            "outside_box",
            "implausible",
            "projection_active",
            "diverged",
            "measurements_not_finite",
            "steps_refused",
            "skipped_ticks",
            "early_broadcasts",
            "frames_not_finite",
            "frames_implausible",
            "frames_refused",
            "frames_stale",
            "fall_backs",
            "returns",
            "restarts",
        ];
        assert_keys(health, &keys);
        assert!(keys.iter().all(|key| health[key].is_u64()), "{health}");
        let counters = expected.health.unwrap();
        assert_eq!(health["outside_box"], counters.outside_box);
        assert_eq!(health["fall_backs"], counters.fall_backs);
        assert_eq!(health["restarts"], counters.restarts);
    }
    assert!(expected.iter().any(|agent| agent.health.unwrap().outside_box > 0));
    let text = folder.succeed("run mine.toml");
    assert!(text.contains("\nHealth\n  agent ") && text.contains("outside the trained box: "));
    folder.write("calm.toml", &short().text());
    assert!(!folder.succeed("run calm.toml").contains("\nHealth\n"));
}

#[test]
fn a_run_that_records_nothing_draws_nothing() {
    let folder = Folder::new("nothing");
    let mut bare = short();
    (bare.trace_stride, bare.events, bare.learning) = (0, false, String::new());
    folder.write("bare.toml", &bare.text());
    folder.succeed("run bare.toml");
    assert!(folder.files("out/scenario_builder").keys().eq([
        "agents.csv",
        "results.json",
        "run.json"
    ]));
}

#[test]
fn the_printed_scenario_is_the_one_that_reproduce_runs() {
    let folder = Folder::new("scenario");
    let names = folder.succeed("scenario");
    assert_eq!(
        names.lines().map(|line| line.split_once(' ').unwrap().0).collect::<Vec<_>>(),
        host_sim::scenario::BUILT_IN.map(|(name, _)| name)
    );
    for (name, text) in host_sim::scenario::BUILT_IN {
        assert_eq!(folder.succeed(&format!("scenario {name}")), text);
    }
    folder.write("mine.toml", PAPER);
    let result = object(&folder.succeed("run mine.toml --format json --out mine"));
    let options = RunOptions { seed: 0, learning: true, bounds: false };
    let expected = run(&paper("better"), options, &Silent).unwrap();
    for (agent, expected) in agents(&result).iter().zip(&expected.agents) {
        assert_eq!(agent["rmse"], number(expected.rmse()));
        assert_eq!(agent["broadcasts"], expected.broadcasts());
    }
}

#[test]
fn bad_usage_ends_with_2() {
    let folder = Folder::new("usage");
    folder.write("mine.toml", &short().text());
    for (arguments, named) in [
        ("--no-such-option", "--no-such-option"),
        ("no-such-command", "no-such-command"),
        ("reproduce --recipe best", "best"),
        ("reproduce --seed -1", "-1"),
        ("reproduce --format yaml", "yaml"),
        ("scenario peper", "paper"),
        ("run", "<SCENARIO>"),
        ("run missing.toml", "missing.toml"),
        ("run mine.toml --threads many", "many"),
    ] {
        let message = folder.fail(arguments, 2);
        assert!(message.contains(named), "{arguments}: {message}");
    }
    // Nothing was made on the way.
    assert_eq!(fs::read_dir(&folder.0).unwrap().count(), 1);
    for arguments in ["--help", "run --help", "--version"] {
        assert!(!folder.succeed(arguments).is_empty());
    }
}

#[test]
fn a_mistake_in_a_scenario_changes_no_file() {
    let folder = Folder::new("mistake");
    folder.write("wrong.toml", &short().text().replace("duration = 0.8", "duration = -0.8"));
    fs::create_dir(folder.path("results")).unwrap();
    folder.write("results/agents.csv", "from the run before\n");
    folder.write("results/notes.txt", "mine\n");
    let before = folder.files("results");
    let line = 1 + short().text().lines().position(|line| line.contains("duration =")).unwrap();
    let message = folder.fail("run wrong.toml --out results", 2);
    let place = format!("error: wrong.toml:{line}: time.duration: ");
    assert!(message.starts_with(&place) && message.contains("; for example "), "{message}");
    assert_eq!(message.lines().count(), 1);
    let output = folder.run("run wrong.toml --out results --format json");
    assert_eq!(output.status.code(), Some(2));
    assert_eq!(object(&texts(&output).0)["error"]["line"], line);
    assert_eq!(folder.files("results"), before);
}

#[test]
fn a_plant_that_diverges_ends_with_1_and_leaves_results_alone() {
    let folder = Folder::new("diverges");
    let mut scenario_builder = Described::linear(1, "ring", [(picks(1, [0]), 1)]);
    scenario_builder.graph.clear();
    scenario_builder.plant = "[plant]\nmodel = \"expressions\"\nstates = [\"x\"]\n\
                       derivative = [\"x^3\"]\ninitial_state = [10.0]\n"
        .to_owned();
    folder.write("cubic.toml", &scenario_builder.text());
    folder.write("mine.toml", &short().text());
    folder.succeed("run mine.toml --baselines none --out results");
    let before = folder.files("results");
    let message = folder.fail("run cubic.toml --out results", 1);
    // x^3 from 10 reaches infinity at 1/200 s, by Euler's method a little later.
    assert!(message.starts_with("error: the plant diverged at t = 0.0"), "{message}");
    assert_eq!(folder.files("results"), before);
}

#[test]
fn results_that_cannot_be_written_end_with_1() {
    let folder = Folder::new("blocked");
    folder.write("mine.toml", &short().text());
    folder.write("blocked", "a file\n");
    for arguments in ["run mine.toml --out blocked", "reproduce --out blocked/below"] {
        let message = folder.fail(arguments, 1);
        assert!(message.contains("blocked is not a folder; choose another one"), "{message}");
    }
    assert_eq!(fs::read(folder.path("blocked")).unwrap(), b"a file\n");
}
