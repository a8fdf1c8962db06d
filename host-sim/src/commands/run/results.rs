//! `results.json`: all that is reported of a run, with what a page about it needs besides the tables.
//! Nothing in it depends on when, where and how fast the run was.

use std::fmt::Write as _;
use std::io;
use std::path::Path;

use serde::Serialize;
use sha2::{Digest, Sha256};

use super::ReportedRun;
use crate::commands::error::ErrorReport;
use crate::commands::run_folder::{RESULTS, RESULTS_KIND};
use crate::commands::{CommandError, output};
use crate::files::output::write_result;
use crate::packages::{PackageBytes, PackageSummary};

#[derive(Serialize)]
struct Graph {
    /// Agents, counted from 1, and `a_ij`.
    edges: Vec<(usize, usize, f64)>,
}

#[derive(Serialize)]
struct Results<'a, R: Serialize> {
    /// Version of this file's keys.
    results: u8,
    #[serde(flatten)]
    report: R,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<ErrorReport>,
    /// Version of this program.
    host_sim: &'static str,
    scenario_hash: String,
    scenario_text: &'a str,
    digest: String,
    /// Name of the run in comparison with its baselines.
    run_name: &'static str,
    method: &'static str,
    steps: u64,
    step_s: f64,
    evaluation: [f64; 2],
    states: Vec<String>,
    /// Whether the true state is known, so that there are errors.
    is_known: bool,
    /// What the plant's own state is; `None` if it is not known.
    truth_name: Option<&'static str>,
    markers: Vec<Mark>,
    graph: Graph,
    packages: Vec<Packed>,
}

/// A point in time that matters.
#[derive(Serialize)]
struct Mark {
    time: f64,
    label: String,
}

/// A package that was used or trained.
#[derive(Serialize)]
struct Packed {
    /// Its file in the folder of the run, or `null` for one that was given.
    file: Option<String>,
    #[serde(flatten)]
    summary: PackageSummary,
    sha256: String,
    signed: bool,
    recipe: String,
}

impl Packed {
    fn new(file: Option<String>, bytes: &PackageBytes) -> Self {
        let sha256 =
            Sha256::digest(bytes.as_bytes()).iter().fold(String::new(), |mut text, byte| {
                // Writing into a string cannot fail.
                let _ = write!(text, "{byte:02x}");
                text
            });
        Self {
            file,
            summary: PackageSummary::new(bytes),
            sha256,
            signed: bytes.is_signed(),
            recipe: bytes.package().provenance.recipe.to_owned(),
        }
    }
}

/// Writes the file into `folder`, where the run's packages already are. `text` is that of the scenario.
pub(super) fn write(folder: &Path, run: &ReportedRun, text: &str) -> Result<(), CommandError> {
    let (scenario, result) = (&run.scenario, &run.result);
    let mark = |marker: &crate::figures::Marker<'_>| Mark {
        time: marker.time(),
        label: marker.label().to_owned(),
    };
    let edge = |edge: &crate::graph::Edge| (edge.first + 1, edge.second + 1, edge.weight);
    let results = Results {
        results: 1,
        report: run.report_without_time(),
        error: run.outcome().err().map(|error| error.report()),
        host_sim: env!("CARGO_PKG_VERSION"),
        scenario_hash: format!("{:#018x}", scenario.hash),
        scenario_text: text,
        digest: format!("{:#018x}", result.digest),
        run_name: run.name(),
        method: scenario.method.name(),
        steps: scenario.steps(),
        step_s: scenario.time.step_size,
        evaluation: [scenario.evaluation.from, scenario.evaluation.to],
        states: scenario.plant.state_names(),
        is_known: scenario.plant.is_known(),
        truth_name: output::truth_name(scenario),
        markers: output::markers(&result.cycles, &result.trainings).iter().map(mark).collect(),
        graph: Graph { edges: scenario.graph.edges().iter().map(edge).collect() },
        packages: packages(folder, run)?,
    };
    let path = folder.join(RESULTS);
    write_result(&path, RESULTS_KIND, |file| {
        serde_json::to_writer(&mut *file, &results).map_err(io::Error::from)?;
        file.write_all(b"\n")
    })?;
    Ok(())
}

/// Returns the packages that were given, and those that the run wrote to `folder`.
fn packages(folder: &Path, run: &ReportedRun) -> Result<Vec<Packed>, CommandError> {
    let given = run.scenario.agents.iter().filter_map(|agent| agent.package.as_ref());
    let mut packages: Vec<Packed> = given.map(|bytes| Packed::new(None, bytes)).collect();
    for training in &run.result.trainings {
        let name = output::package_name(training.agent, training.cycle);
        let path = folder.join(&name);
        if path.exists() {
            packages.push(Packed::new(Some(name), &PackageBytes::load(&path)?));
        }
    }
    Ok(packages)
}
