//! `docs/json.md` knows every key of the JSON that runs print, every warning and every column.

use std::collections::BTreeSet;

use host_sim::warning::WarningCode;
use serde_json::Value;

use crate::cli::command_line::{Folder, object, short};

const DOCUMENTED: &str = include_str!("../../docs/json.md");

fn is_documented(word: &str) -> bool {
    DOCUMENTED.contains(&format!("`{word}`"))
}

/// Every key, however deep.
fn keys(value: &Value, found: &mut BTreeSet<String>) {
    match value {
        Value::Object(object) => {
            for (key, value) in object {
                found.insert(key.clone());
                keys(value, found);
            }
        }
        Value::Array(values) => values.iter().for_each(|value| keys(value, found)),
        _ => {}
    }
}

pub(super) fn assert_documented(value: &Value, at_least: &[&str]) {
    let mut found = BTreeSet::new();
    keys(value, &mut found);
    for key in at_least {
        assert!(found.contains(*key), "{key} is missing: {found:?}");
    }
    let missing: Vec<_> = found.iter().filter(|key| !is_documented(key)).collect();
    assert!(missing.is_empty(), "docs/json.md does not know {missing:?}");
}

#[test]
fn every_warning_is_documented() {
    let missing: Vec<_> =
        WarningCode::ALL.iter().filter(|code| !is_documented(code.as_str())).collect();
    assert!(missing.is_empty(), "{missing:?}");
}

#[test]
fn every_key_of_run_frontier_and_reproduce_is_documented() {
    let folder = Folder::new("documented");
    let mut watched = short();
    watched.learning += "\n[health]\nfall_back_after = 20\n";
    folder.write("mine.toml", &watched.text());
    let run = object(&folder.succeed("run mine.toml --format json --out run"));
    assert_documented(&run, &["rmse_no_network", "explained_variance", "stopped_by", "restarts"]);
    let frontier = object(&folder.succeed(
        "frontier mine.toml --forms paper,periodic --seeds 2 --initial-states 2 --format json --out frontier",
    ));
    assert_documented(&frontier, &["certified", "bound", "within_target", "channel_share"]);
    // Seven radii or errors of a form at most, with four runs each; `flow-eso` sets the periods.
    let points = frontier["points"].as_array().unwrap();
    for form in ["paper", "flow-eso", "periodic"] {
        let of_form: Vec<_> = points.iter().filter(|point| point["form"] == form).collect();
        assert!(of_form.len() >= 16 && of_form.len() % 4 == 0, "{form}: {}", of_form.len());
        assert!(of_form.iter().all(|point| point["broadcasts"].is_u64()), "{of_form:?}");
        assert!(of_form.iter().all(|point| point["rmse"].as_array().unwrap().len() == 2));
    }
    let reproduce = object(&folder.succeed("reproduce --seeds 2 --format json --out paper"));
    assert_documented(&reproduce, &["rmse_no_network", "change_percent", "median", "test_error"]);
}

#[test]
fn every_column_is_documented() {
    let folder = Folder::new("documented-columns");
    folder.write("mine.toml", &short().text());
    folder.succeed("run mine.toml --out out");
    folder.succeed("frontier mine.toml --forms flow --seeds 1 --initial-states 1 --out frontier");
    let frontier = folder.files("frontier").into_iter();
    let frontier = frontier.filter(|(name, _)| name == "frontier.csv");
    for (name, bytes) in folder.files("out").into_iter().chain(frontier) {
        // Columns of traces and samples are made of names and numbers.
        if !name.ends_with(".csv")
            || ["traces.csv", "innovations.csv"].contains(&name.as_str())
            || name.ends_with("samples.csv")
        {
            continue;
        }
        let text = String::from_utf8(bytes).unwrap();
        for column in text.lines().next().unwrap().split(',') {
            let column = column.split(" [").next().unwrap();
            // Of agent I.
            let column = if column.starts_with("rmse_") && name == "frontier.csv" {
                "rmse_I"
            } else {
                column
            };
            assert!(is_documented(column), "{name}: {column}");
        }
    }
}
