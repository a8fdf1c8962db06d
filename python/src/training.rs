//! `train` for Python.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use host_sim::error::{ErrorCode, ErrorReport};
use host_sim::offline::{
    Follower, OfflineTask, OfflineTraining, Samples, agent_index, network_of, serial_after,
};
use host_sim::packages::PackageBytes;
use host_sim::training::EpochReport;
use host_sim::warning::Warning;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyList};

use crate::attended::{Watch, attended};
use crate::errors::{OrRaise, exception};
use crate::packages;
use crate::samples::{Given, given};
use crate::scenario::Scenario;

/// Train a network on recorded samples and return it as a weight package: what `host-sim train` writes.
///
/// `samples` is the path of a recording, `Samples`, an array with the columns time, estimate and derivative, or a
/// list of these. `agent` is the number of the agent that gets the network, or a list of numbers; then a list of
/// packages is returned. `base` is the package in use, whose version is incremented.
#[pyfunction]
#[pyo3(signature = (samples, scenario, agent, *, recipe = None, seed = 0, threads = 0, base = None, version = None, progress = None))]
#[expect(clippy::too_many_arguments, reason = "keywords in Python")]
pub(crate) fn train<'py>(
    py: Python<'py>,
    samples: &Bound<'py, PyAny>,
    scenario: &Scenario,
    agent: &Bound<'py, PyAny>,
    recipe: Option<&str>,
    seed: u64,
    threads: u16,
    base: Option<&Bound<'py, PyAny>>,
    version: Option<u32>,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyAny>> {
    let (numbers, is_one): (Vec<usize>, bool) = match agent.extract::<usize>() {
        Ok(number) => (vec![number], true),
        Err(_) => (agent.extract()?, false),
    };
    let path = scenario.path();
    let (described, _) = scenario.for_run();
    described
        .check_for_nodes()
        .map_err(|error| ErrorReport::of(&error).about(path))
        .or_raise(py)?;
    let agents = agent_indices(&described, &numbers).or_raise(py)?;
    let base = base.map(packages::read).transpose()?;
    let task = OfflineTask {
        scenario: &described,
        agents: &agents,
        recipe,
        seed,
        base: base.as_ref().map(|(package, path): &(PackageBytes, PathBuf)| (package, &**path)),
    };
    network_of(&described).or_raise(py)?;
    task.recipe().or_raise(py)?;
    task.check_base().or_raise(py)?;
    let (mut samples, warnings) = match given(samples, &described)? {
        Given::Paths(paths) => task.load(&paths).or_raise(py)?,
        Given::Memory(parts) => (in_memory(&parts, &agents).or_raise(py)?, Vec::new()),
    };
    let serial = serial_after(task.base, version).or_raise(py)?;
    let serials = vec![serial; agents.len()];
    let done = attended(py, threads, progress, |watch| {
        let mut follower = Following { watch, warnings: Vec::new() };
        let end = (Path::new("package"), None);
        let done = task.carry_out(&mut samples, &serials, warnings, &mut follower, end);
        (done, follower.warnings)
    })?;
    let (done, warnings) = done;
    warn(py, &warnings)?;
    let training: OfflineTraining<'_> = done.or_raise(py)?;
    if training.is_interrupted() {
        let error = ErrorReport::new(ErrorCode::Interrupted, "the training was interrupted");
        return Err(exception(py, &error));
    }
    let packages: Vec<_> =
        training.packages.iter().map(|package| PyBytes::new(py, package.as_bytes())).collect();
    match &packages[..] {
        [package] if is_one => Ok(package.clone().into_any()),
        packages => Ok(PyList::new(py, packages)?.into_any()),
    }
}

/// Converts numbers of agents, from 1, to indices, from 0.
fn agent_indices(
    scenario: &host_sim::scenario::Scenario,
    numbers: &[usize],
) -> Result<Vec<usize>, ErrorReport> {
    let mut agents = Vec::with_capacity(numbers.len());
    for &number in numbers {
        let index = agent_index(scenario, number)?;
        if agents.contains(&index) {
            let text = format!("agent={number}: given twice; give it once");
            return Err(ErrorReport::usage(text));
        }
        agents.push(index);
    }
    if agents.is_empty() {
        return Err(ErrorReport::usage("no agent; give the number of at least one"));
    }
    Ok(agents)
}

/// Returns samples in memory, each with the agent that recorded it.
fn in_memory(
    parts: &[(PathBuf, Option<usize>, host_sim::packages::Recording)],
    agents: &[usize],
) -> Result<Samples, ErrorReport> {
    let mut samples = Samples::default();
    for (name, number, recording) in parts {
        let known = number.and_then(|number| number.checked_sub(1));
        let agent = known.unwrap_or(agents[0]);
        if !agents.contains(&agent) {
            let (own, wanted, shown) = (agent + 1, agents[0] + 1, name.display());
            let text = format!(
                "{shown}: samples of agent {own}, not of agent {wanted}; pass agent={own}, or a recording of agent \
                 {wanted}"
            );
            return Err(ErrorReport::new(ErrorCode::Samples, text).about(name));
        }
        samples.paths.push(name.clone());
        samples.agents.push(agent);
        samples.recordings.push(recording.clone());
    }
    Ok(samples)
}

/// Passes the course of a training on.
struct Following<'w> {
    watch: &'w Watch,
    warnings: Vec<Warning>,
}

impl Follower for Following<'_> {
    fn warn(&mut self, warning: &Warning) {
        self.warnings.push(warning.clone());
    }

    fn epoch(&mut self, report: &EpochReport, most: usize) -> ControlFlow<()> {
        self.watch.reached(report.epoch as u64, most as u64);
        if self.watch.is_stopped() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    }
}

/// Gives warnings to Python's module `warnings`.
fn warn(py: Python<'_>, warnings: &[Warning]) -> PyResult<()> {
    if warnings.is_empty() {
        return Ok(());
    }
    let warn = py.import("distributed_observer._errors")?.getattr("warn")?;
    for Warning { code, text } in warnings {
        warn.call1((text, code.as_str()))?;
    }
    Ok(())
}
