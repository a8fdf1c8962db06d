//! `run --report` and `report`: pages about results, and folders without any.

use std::fs;

use serde_json::Value;

use crate::cli::command_line::{Folder, object, short, texts};
use crate::cli::json_documented::assert_documented;

/// Returns the data that a page holds.
fn data(page: &str) -> Value {
    let (_, rest) = page.split_once("<script type=\"application/json\" id=\"run\">").unwrap();
    let (data, _) = rest.split_once("</script>").unwrap();
    serde_json::from_str(data).unwrap()
}

fn text(folder: &Folder, name: &str) -> String {
    fs::read_to_string(folder.path(name)).unwrap()
}

fn column(table: &str, name: &str) -> Vec<f64> {
    let mut lines = table.lines();
    let place = lines.next().unwrap().split(',').position(|column| column == name).unwrap();
    let field = |line: &str| line.split(',').nth(place).unwrap().parse().unwrap_or(f64::NAN);
    lines.map(field).collect()
}

fn largest(values: &[f64]) -> f64 {
    values.iter().copied().fold(f64::NEG_INFINITY, f64::max)
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|v| v.as_f64().unwrap_or(f64::NAN)).collect()
}

#[test]
fn the_page_of_a_run_holds_what_the_run_printed_and_recorded() {
    let folder = Folder::new("report-run");
    folder.write("mine.toml", &short().text());
    let printed = object(&folder.succeed("run mine.toml --report --format json --out out"));
    let page = text(&folder, "out/report.html");
    let held = data(&page);
    assert_documented(&held, &["sha256", "rows_per_point", "gaps", "curves", "places"]);
    let results: Value = serde_json::from_str(&text(&folder, "out/results.json")).unwrap();
    for (key, value) in printed.as_object().unwrap().iter().filter(|(key, _)| *key != "elapsed_s") {
        assert_eq!((&held[key], &results[key]), (value, value), "{key}");
    }
    let traces = text(&folder, "out/traces.csv");
    for agent in 1..=2 {
        let errors = column(&traces, &format!("agent{agent}.error [state unit]"));
        let shown = numbers(&held["traces"]["errors"][agent - 1]);
        assert!((largest(&shown) / largest(&errors) - 1.0).abs() < 1e-4);
        let innovations = text(&folder, "out/innovations.csv");
        let innovations = column(&innovations, &format!("agent{agent} [output unit]"));
        let (last, before) = innovations.split_last().unwrap();
        assert!(last.is_nan() && before.iter().all(|innovation| *innovation >= 0.0));
        let shown = numbers(&held["traces"]["innovations"][agent - 1]);
        assert!((largest(&shown) / largest(before) - 1.0).abs() < 1e-4);
        let events = text(&folder, "out/events.csv");
        let count = column(&events, "agent").iter().filter(|of| **of == agent as f64).count();
        assert_eq!(held["events"]["gaps"][agent - 1].as_array().unwrap().len(), count);
    }
    // Another run without a page removes that of the first, also one that was made later.
    for page in ["", "report out"] {
        if !page.is_empty() {
            folder.succeed(page);
            assert!(folder.path("out/report.html").exists());
        }
        folder.succeed("run mine.toml --seed 1 --out out");
        assert!(!folder.path("out/report.html").exists(), "{page}");
    }
}

#[test]
fn a_page_can_be_made_later_and_replaced_but_replaces_nothing_else() {
    let folder = Folder::new("report-later");
    folder.write("mine.toml", &short().text());
    folder.succeed("run mine.toml --without-learning --out out");
    folder.succeed("sweep mine.toml --vary design.epsilon=10,90 --out study");
    for (results, at_least) in [("out", ["digest"]), ("study", ["lines"])] {
        let report = object(&folder.succeed(&format!("report {results} --format json")));
        assert_documented(&report, &["report", "bytes"]);
        let page = text(&folder, &format!("{results}/report.html"));
        assert_eq!(report["bytes"], page.len());
        assert_documented(&data(&page), &at_least);
        folder.succeed(&format!("report {results}"));
        folder.write("mine.html", "<p>mine</p>");
        let message = folder.fail(&format!("report {results} --out mine.html"), 2);
        assert!(message.contains("mine.html"), "{message}");
        assert_eq!(text(&folder, "mine.html"), "<p>mine</p>");
    }
    let cells = data(&text(&folder, "study/report.html"));
    assert_eq!(cells["cells"].as_array().unwrap().len(), 2);
}

/// A number is missing.
const TRACES: &str = "time [s],agent1.error [state unit],agent2.error [state unit]\n0,1,soon\n";
/// Rows are missing.
const INNOVATIONS: &str = "time [s],agent1 [output unit],agent2 [output unit]\n0.0,1,1\n";

#[test]
fn a_study_says_how_to_repeat_it() {
    let folder = Folder::new("report-repeat");
    folder.write("mine.toml", &short().text());
    let study =
        "sweep mine.toml --set learning=[] --set name=\"5\" --vary design.epsilon=10,90 --seeds 2";
    let report = object(&folder.succeed(&format!("{study} --out one --threads 2 --format json")));
    folder.succeed("report one");
    let page = data(&text(&folder, "one/report.html"));
    assert_eq!(page["study"]["host_sim"], env!("CARGO_PKG_VERSION"));
    assert_eq!(page["study"]["scenario_hash"], report["scenario_hash"]);
    assert_eq!(
        (&page["digest"], &page["study"]["command"]),
        (&report["digest"], &report["command"])
    );
    let words: Vec<&str> =
        report["command"].as_array().unwrap().iter().map(|word| word.as_str().unwrap()).collect();
    let expected = [
        "host-sim",
        "sweep",
        "mine.toml",
        "--set",
        "learning=[]",
        "--set",
        "name=\"5\"",
        "--vary",
        "design.epsilon=10,90",
        "--seed",
        "0",
        "--seeds",
        "2",
        "--initial-states",
        "1",
    ];
    assert_eq!(words, expected);
    let told = folder.succeed(&format!("{} --out two", words[1..].join(" ")));
    let digest = report["digest"].as_str().unwrap();
    assert!(told.contains(&format!("Digest of the results {digest}, by host-sim ")), "{told}");
    assert!(
        told.contains("Repeat it with: host-sim sweep mine.toml --set 'learning=[]' --set"),
        "{told}"
    );
    assert!(folder.files("two")["results.csv"] == folder.files("one")["results.csv"]);
    assert_eq!(told.lines().rev().take(2).collect::<Vec<_>>(), {
        let summary = folder.succeed("sweep --summarise one/results.csv");
        summary.lines().rev().take(2).map(str::to_owned).collect::<Vec<_>>()
    });
    // Other results have another digest.
    let other = object(&folder.succeed(&format!("{study} --seed 5 --out other --format json")));
    assert_ne!(other["digest"], report["digest"]);
}

#[test]
fn results_that_do_not_belong_together_are_refused() {
    let folder = Folder::new("report-mixed");
    folder.write("mine.toml", &short().text());
    folder.succeed("run mine.toml --without-learning --out out");
    for (name, from, to, expected) in [
        ("run.json", "\"complete\": true", "\"complete\": false", "was interrupted"),
        ("results.json", "{\"results\":1,", "{\"results\":2,", "version 2"),
    ] {
        let before = text(&folder, &format!("out/{name}"));
        assert!(before.contains(from), "{before}");
        folder.write(&format!("out/{name}"), &before.replacen(from, to, 1));
        let message = folder.fail("report out", 2);
        assert!(message.contains(expected), "{message}");
        folder.write(&format!("out/{name}"), &before);
    }
    folder.succeed("report out");
}

#[test]
fn the_page_of_a_study_is_removed_when_it_continues() {
    let folder = Folder::new("report-study");
    folder.write("mine.toml", &short().text());
    let study = "sweep mine.toml --vary design.epsilon=10,90 --seed 9007199254740993";
    folder.succeed(&format!("{study} --shard 1/2 --out study"));
    folder.succeed(&format!("{study} --shard 2/2 --out study"));
    folder.succeed("report study/shard-1");
    let part = data(&text(&folder, "study/shard-1/report.html"));
    assert_eq!(
        (&part["seed_text"], &part["study"]["shard"]),
        (&"9007199254740993".into(), &"1/2".into())
    );
    folder.succeed(&format!("{study} --shard 1/2 --out study"));
    assert!(!folder.path("study/shard-1/report.html").exists());
    // Put together by hand: nothing says what the study was.
    let rows = |part: &str| text(&folder, &format!("study/{part}/results.csv"));
    fs::create_dir(folder.path("whole")).unwrap();
    let merged = rows("shard-1") + &rows("shard-2");
    folder.write("whole/results.csv", &merged);
    folder.succeed("report whole");
    let whole = data(&text(&folder, "whole/report.html"));
    assert!(whole["study"].is_null() && whole["cells"].as_array().unwrap().len() == 2);
    // Beside the parts it is known.
    folder.write("study/results.csv", &merged);
    folder.succeed("report study");
    let whole = data(&text(&folder, "study/report.html"));
    assert_eq!((&whole["study"]["shard"], &whole["study"]["runs"]), (&"1/1".into(), &2.into()));
    let words = whole["study"]["command"].as_array().unwrap();
    assert_eq!(words.last().unwrap(), "1", "{words:?}");
    assert!(words.contains(&"9007199254740993".into()), "{words:?}");
}

#[test]
fn a_folder_without_usable_results_is_refused() {
    let folder = Folder::new("report-bad");
    folder.write("mine.toml", &short().text());
    let cases: [(&str, &str, &str); 9] = [
        ("results.json", "", "cannot be read"),
        ("results.json", "{\"results\":1,", "cannot be read"),
        ("results.json", "{\"results\":1,\"agents\":[]}", "missing field"),
        ("traces.csv", "t,x\n0,1\n", "not the table of this run's traces"),
        ("traces.csv", "time [s],x [state unit]\n0,1\n", "not the table of this run's traces"),
        ("traces.csv", TRACES, "line 2: \"soon\" is not a number"),
        ("innovations.csv", "time [s],foo\n0,1\n", "not the table of the innovations"),
        ("innovations.csv", INNOVATIONS, "not the table of the innovations"),
        ("events.csv", "agent,sequence,time [s]\n9,1,0\n", "\"9\" is not the number of an agent"),
    ];
    for (name, content, expected) in cases {
        folder.succeed("run mine.toml --without-learning --out out");
        folder.write(&format!("out/{name}"), content);
        let output = folder.run("report out --format json");
        assert_eq!(output.status.code(), Some(2), "{name}: {content}");
        let error = object(&texts(&output).0)["error"].clone();
        assert_eq!(error["code"], "invalid-results", "{name}: {content}");
        let message = error["text"].as_str().unwrap();
        assert!(message.contains(expected) && message.contains(name), "{message}");
        assert!(!folder.path("out/report.html").exists());
        fs::remove_dir_all(folder.path("out")).unwrap();
    }
    fs::create_dir(folder.path("empty")).unwrap();
    let message = folder.fail("report empty", 2);
    assert!(
        message.contains("no results.json of `run` and no results.csv of `sweep`"),
        "{message}"
    );
    let message = folder.fail("report nowhere", 2);
    assert!(message.contains("nowhere"), "{message}");
}
