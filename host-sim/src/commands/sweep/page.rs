//! The page about a study.

use std::io;
use std::path::Path;

use serde::Serialize;

use super::picture::tradeoff;
use super::summary::{CellSummary, Summary};
use super::{results, study};
use crate::commands::CommandError;
use crate::files::input::read_limited;
use crate::page::html;

/// Largest description of a study. \[bytes\]
const BYTES_MAX: u64 = 64 << 20;

#[derive(Serialize)]
struct Page<'a> {
    study: &'a serde_json::Value,
    /// The first seed, of which a number in JavaScript may not have all digits.
    seed_text: Option<String>,
    scenario_text: Option<String>,
    keys: &'a [String],
    cells: &'a [CellSummary],
    /// Label of the vertical axis; empty without a plot.
    error_label: &'a str,
    /// The key that lines go along; empty without lines.
    along: &'a str,
    lines: Vec<Line<'a>>,
}

#[derive(Serialize)]
struct Line<'a> {
    name: &'a str,
    is_joined: bool,
    points: Vec<Point<'a>>,
}

#[derive(Serialize)]
struct Point<'a> {
    label: &'a str,
    broadcasts: [f64; 3],
    error: [f64; 3],
}

/// Returns the page about the study in `folder`; `None` if there is none.
pub(in crate::commands) fn of_study(folder: &Path) -> Result<Option<String>, CommandError> {
    let results = &folder.join(results::NAME);
    if !results.is_file() {
        return Ok(None);
    }
    let summary = Summary::read(results)?;
    let description = folder.join(study::NAME);
    let study = match read_limited(&description, BYTES_MAX) {
        Ok(text) => serde_json::from_slice(&text)
            .map_err(|error| CommandError::unreadable(&description, error))?,
        // Tables of several parts, put together.
        Err(error) if error.kind() == io::ErrorKind::NotFound => serde_json::Value::Null,
        Err(error) => return Err(CommandError::unreadable(&description, error)),
    };
    let figure = tradeoff(String::new(), &summary);
    let lines = figure.iter().flat_map(|figure| &figure.lines).map(|line| Line {
        name: &line.name,
        is_joined: line.is_joined,
        points: line
            .points
            .iter()
            .map(|point| Point {
                label: &point.label,
                broadcasts: point.broadcasts,
                error: point.error,
            })
            .collect(),
    });
    let page = Page {
        study: &study,
        seed_text: study["seed"].as_u64().map(|seed| seed.to_string()),
        scenario_text: read_limited(&folder.join(study::SCENARIO), BYTES_MAX)
            .ok()
            .and_then(|text| String::from_utf8(text).ok()),
        keys: &summary.keys,
        cells: &summary.cells,
        error_label: figure.as_ref().map_or("", |figure| figure.error_label),
        along: figure.as_ref().map_or("", |figure| &figure.label),
        lines: lines.collect(),
    };
    let data =
        serde_json::to_string(&page).map_err(|error| CommandError::unreadable(results, error))?;
    let title = match study["scenario"].as_str() {
        Some(name) => &format!("{name}: study"),
        None => "Study",
    };
    Ok(Some(html(title, &data)))
}
