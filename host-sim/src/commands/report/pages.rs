//! From a folder of results to a page.

use std::io;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::commands::run_folder::{RESULTS, is_complete};
use crate::commands::sweep;
use crate::commands::{CommandError, ErrorCode};
use crate::files::input::read_limited;
use crate::page::{curves, events, html, layout, traces};

/// Agents whose estimates are drawn; of more, those with the largest, the median and the smallest error.
const ESTIMATES: usize = 20;
/// Largest description of a run or a study. \[bytes\]
const BYTES_MAX: u64 = 256 << 20;

/// What is taken from `results.json` here; the rest is for the page's script.
#[derive(Deserialize)]
struct Outline {
    /// Version of the keys.
    results: u32,
    scenario: String,
    seed: u64,
    steps: u64,
    step_s: f64,
    agents: Vec<AgentOutline>,
    graph: GraphOutline,
}

#[derive(Deserialize)]
struct AgentOutline {
    rmse: Option<f64>,
}

#[derive(Deserialize)]
struct GraphOutline {
    /// Agents, counted from 1, and `a_ij`.
    edges: Vec<(usize, usize, f64)>,
}

/// What a page needs besides `results.json`.
#[derive(Serialize)]
struct Tables {
    /// The seed, of which a number in JavaScript may not have all digits.
    seed_text: String,
    command: Vec<String>,
    traces: Option<traces::Thinned>,
    events: Option<events::Events>,
    curves: Vec<curves::Curve>,
    /// Shape `[N]` of x and y from 0 to 1.
    places: Vec<[f32; 2]>,
}

/// Returns the page about the results in `folder`.
pub(super) fn of_folder(
    folder: &Path,
    command: impl FnOnce() -> Vec<String>,
) -> Result<String, CommandError> {
    let path = folder.join(RESULTS);
    match read_limited(&path, BYTES_MAX) {
        Ok(text) => of_run(folder, text, command()),
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            if let Some(page) = sweep::page::of_study(folder)? {
                return Ok(page);
            }
            let text = format!(
                "{}: no results.json of `run` and no results.csv of `sweep`; give a folder that one of them wrote",
                folder.display()
            );
            Err(CommandError::new(ErrorCode::Results, text).about(folder))
        }
        Err(error) => Err(CommandError::unreadable(&path, error)),
    }
}

fn of_run(folder: &Path, results: Vec<u8>, command: Vec<String>) -> Result<String, CommandError> {
    let path = folder.join(RESULTS);
    let outline: Outline =
        serde_json::from_slice(&results).map_err(|error| CommandError::unreadable(&path, error))?;
    if outline.results != 1 {
        let problem =
            format!("it is of version {}; this program reads version 1 only", outline.results);
        return Err(CommandError::unreadable(&path, problem));
    }
    if !is_complete(folder) {
        let problem = "the run was interrupted while it replaced the files of another one";
        return Err(CommandError::unreadable(folder, problem));
    }
    let results =
        String::from_utf8(results).map_err(|error| CommandError::unreadable(&path, error))?;
    let file = |name: &str| Some(folder.join(name)).filter(|path| path.is_file());
    let shown = agents_shown(&outline);
    let count = outline.agents.len();
    let (traces, (events, curves)) = rayon::join(
        || {
            let is_shown = |agent: usize| shown.contains(&agent);
            let innovations = file("innovations.csv");
            let traces = file("traces.csv");
            traces
                .map(|path| traces::read(&path, innovations.as_deref(), count, is_shown))
                .transpose()
        },
        || {
            rayon::join(
                || {
                    let read = |path: std::path::PathBuf| {
                        events::read(&path, count, outline.steps, outline.step_s)
                    };
                    file("events.csv").map(read).transpose()
                },
                || file("training.csv").map(|path| curves::read(&path)).transpose(),
            )
        },
    );
    let edges = outline.graph.edges.iter();
    let edges: Option<Vec<(usize, usize)>> = edges
        .map(|&(a, b, _)| Some((a.checked_sub(1)?, b.checked_sub(1)?)))
        .map(|edge| edge.filter(|&(a, b)| a.max(b) < count))
        .collect();
    let edges = edges
        .ok_or_else(|| CommandError::unreadable(&path, "an edge joins agents that do not exist"))?;
    let places = layout::places(count, &edges);
    let tables = Tables {
        seed_text: outline.seed.to_string(),
        command,
        traces: traces?,
        events: events?,
        curves: curves?.unwrap_or_default(),
        places: places.into_iter().map(|[x, y]| [rounded(x), rounded(y)]).collect(),
    };
    let tables =
        serde_json::to_string(&tables).map_err(|error| CommandError::unreadable(&path, error))?;
    // One object of both, so that the numbers of the results keep their digits.
    let results = results.trim_end().strip_suffix('}').unwrap_or_default();
    let data = format!("{results},{}", tables.strip_prefix('{').unwrap_or_default());
    Ok(html(&outline.scenario, &data))
}

fn rounded(value: f64) -> f32 {
    (value * 1e4).round() as f32 / 1e4
}

/// Returns the agents whose estimates are drawn, from 1.
fn agents_shown(outline: &Outline) -> Vec<usize> {
    let mut agents: Vec<usize> = (1..=outline.agents.len()).collect();
    if agents.len() > ESTIMATES {
        let error = |agent: usize| outline.agents[agent - 1].rmse.unwrap_or(f64::INFINITY);
        agents.sort_by(|&a, &b| error(a).total_cmp(&error(b)));
        agents = vec![agents[0], agents[agents.len() / 2], agents[agents.len() - 1]];
    }
    agents
}
