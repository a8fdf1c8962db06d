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
fn every_key_of_run_and_reproduce_is_documented() {
    let folder = Folder::new("documented");
    let mut watched = short();
    watched.learning += "\n[health]\nfall_back_after = 20\n";
    folder.write("mine.toml", &watched.text());
    let run = object(&folder.succeed("run mine.toml --format json --out run"));
    assert_documented(&run, &["rmse_no_network", "explained_variance", "stopped_by", "restarts"]);
    let reproduce = object(&folder.succeed("reproduce --seeds 2 --format json --out paper"));
    assert_documented(&reproduce, &["rmse_no_network", "change_percent", "median", "test_error"]);
}

#[test]
fn every_column_is_documented() {
    let folder = Folder::new("documented-columns");
    folder.write("mine.toml", &short().text());
    folder.succeed("run mine.toml --out out");
    for (name, bytes) in folder.files("out") {
        // Columns of traces and samples are made of names and numbers.
        if !name.ends_with(".csv") || name == "traces.csv" || name.ends_with("samples.csv") {
            continue;
        }
        let text = String::from_utf8(bytes).unwrap();
        for column in text.lines().next().unwrap().split(',') {
            let column = column.split(" [").next().unwrap();
            assert!(is_documented(column), "{name}: {column}");
        }
    }
}
