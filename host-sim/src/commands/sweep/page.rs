//! The page about a study.

use std::path::Path;

use serde::Serialize;

use super::picture::tradeoff;
use super::results;
use super::study::Study;
use super::summary::{CellSummary, Summary};
use crate::commands::CommandError;
use crate::page::html;

#[derive(Serialize)]
struct Page<'a> {
    study: Option<&'a Study>,
    /// The first seed, of which a number in JavaScript may not have all digits.
    seed_text: Option<String>,
    /// Hash of the results.
    digest: &'a str,
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
    let (study, scenario_text) = Study::of(folder, &summary).unzip();
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
        study: study.as_ref(),
        seed_text: study.as_ref().map(|study| study.seed.to_string()),
        digest: &summary.digest,
        scenario_text: scenario_text.flatten(),
        keys: &summary.keys,
        cells: &summary.cells,
        error_label: figure.as_ref().map_or("", |figure| figure.error_label),
        along: figure.as_ref().map_or("", |figure| &figure.label),
        lines: lines.collect(),
    };
    let data =
        serde_json::to_string(&page).map_err(|error| CommandError::unreadable(results, error))?;
    let title = match &study {
        Some(study) => format!("{}: study", study.scenario),
        None => "Study".to_owned(),
    };
    Ok(Some(html(&title, &data)))
}
