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
    // Another run without a page removes that of the first.
    folder.succeed("run mine.toml --seed 1 --out out");
    assert!(!folder.path("out/report.html").exists());
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

#[test]
fn a_folder_without_usable_results_is_refused() {
    let folder = Folder::new("report-bad");
    folder.write("mine.toml", &short().text());
    let cases: [(&str, &str, &str); 6] = [
        ("results.json", "", "cannot read"),
        ("results.json", "{\"results\":1,", "cannot read"),
        ("results.json", "{\"results\":1,\"agents\":[]}", "missing field"),
        ("traces.csv", "time [s],x [state unit]\n0,soon\n", "line 2: \"soon\" is not a number"),
        ("traces.csv", "t,x\n0,1\n", "not that of traces"),
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
