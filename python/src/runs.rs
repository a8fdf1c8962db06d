//! Runs, and their results as Python's own types.

use std::path::Path;

use host_sim::commands::{Choice, PreparedRun, ReportedRun};
use host_sim::engine::TrainingRecord;
use host_sim::error::ErrorReport;
use host_sim::scenario::{self, Method};
use numpy::{PyArray1, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyBytes, PyDict, PyList};

use crate::attended::attended;
use crate::errors::{OrRaise, exception, usage};
use crate::plant::CallablePlant;
use crate::samples::Samples;
use crate::{json, packages};

/// What to run, in addition to the scenario.
pub(crate) struct Request {
    pub(crate) seed: u64,
    pub(crate) threads: u16,
    pub(crate) learning: bool,
    pub(crate) choices: Vec<Choice>,
}

/// Returns the methods to compare with, from their names on the command line.
pub(crate) fn choices(py: Python<'_>, names: &[String]) -> PyResult<Vec<Choice>> {
    let choice = |name: &String| match name.as_str() {
        "all" => Ok(Choice::All),
        "none" => Ok(Choice::None),
        name => {
            let found = Method::NAMES.iter().find(|(known, _)| *known == name);
            found.map(|&(_, method)| Choice::Only(method)).ok_or_else(|| {
                let known: Vec<_> = Method::NAMES.iter().map(|(known, _)| *known).collect();
                let text = format!(
                    "baselines: unknown method {name:?}; choose all, none, or of {}",
                    known.join(", ")
                );
                usage(py, text)
            })
        }
    };
    names.iter().map(choice).collect()
}

/// Runs a scenario, with packages for the agents that they name.
pub(crate) fn run<'py>(
    py: Python<'py>,
    (mut scenario, callable): (scenario::Scenario, Option<CallablePlant>),
    request: &Request,
    packages: &[Bound<'py, PyAny>],
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyAny>> {
    give_packages(py, &mut scenario, packages)?;
    if !request.learning {
        if scenario.method == Method::Regression {
            let problem = "learning=False: method = \"regression\" fits the samples of learning cycles; leave \
                           one of them out";
            return Err(usage(py, problem));
        }
        scenario.learning.clear();
    }
    let &Request { seed, threads, ref choices, .. } = request;
    let done = attended(py, threads, progress, |watch| {
        PreparedRun::new(&scenario, seed, choices)
            .and_then(|prepared| prepared.carry_out(watch))
            .map_err(|error| error.report())
    })?;
    if let Some(error) = callable.and_then(|callable| callable.raised()) {
        return Err(error);
    }
    let run = done.or_raise(py)?;
    let result = result(py, &run)?;
    match run.outcome() {
        Ok(()) => Ok(result),
        Err(error) => {
            let error = exception(py, &error.report());
            error.value(py).setattr("result", result)?;
            Err(error)
        }
    }
}

/// Gives each package to the agent that it names.
fn give_packages(
    py: Python<'_>,
    scenario: &mut scenario::Scenario,
    given: &[Bound<'_, PyAny>],
) -> PyResult<()> {
    for package in given {
        let (package, path) = packages::read(package)?;
        let number = package.package().node.agent as usize;
        let Some(index) = number.checked_sub(1).filter(|&index| index < scenario.agents.len())
        else {
            return Err(exception(py, &no_such_agent(&path, number, scenario)));
        };
        if scenario.agents[index].package.replace(package).is_some() {
            let problem = format!("{}: second package for agent {number}", path.display());
            let text = problem + "; give at most one per agent";
            return Err(exception(py, &ErrorReport::usage(text).about(&path)));
        }
    }
    Ok(())
}

/// Returns the error of a package for an agent that the scenario does not have.
fn no_such_agent(path: &Path, number: usize, scenario: &scenario::Scenario) -> ErrorReport {
    let (agents, name) = (scenario.agents.len(), &scenario.name);
    let path_shown = path.display();
    let text = format!(
        "{path_shown}: package for agent {number}, but scenario {name} has agents 1 to {agents}"
    );
    ErrorReport::usage(text).about(path)
}

static RESULT: PyOnceLock<Py<PyAny>> = PyOnceLock::new();

/// Returns the result of a run as the class `Result`.
fn result<'py>(py: Python<'py>, run: &ReportedRun) -> PyResult<Bound<'py, PyAny>> {
    let scenario = run.scenario();
    let arguments = PyDict::new(py);
    arguments.set_item("report", json::to_python(py, &run.report())?)?;
    arguments.set_item("traces", traces(py, run)?)?;
    let time = &scenario.time;
    let events = run.result().agents.iter().map(|agent| {
        PyArray1::from_vec(py, agent.events.iter().map(|&tick| time.at(tick)).collect())
    });
    arguments.set_item("events", PyList::new(py, events)?)?;
    let trained = PyDict::new(py);
    let samples = PyDict::new(py);
    for training in &run.result().trainings {
        let TrainingRecord { agent, cycle, package, recording, .. } = training;
        trained.set_item((agent, cycle), PyBytes::new(py, package.as_bytes()))?;
        if let Some(recording) = recording {
            samples.set_item((agent, cycle), Samples::of(recording.clone(), *agent))?;
        }
    }
    arguments.set_item("packages", trained)?;
    arguments.set_item("samples", samples)?;
    arguments.set_item("digest", run.result().digest)?;
    arguments.set_item("state_names", scenario.plant.state_names())?;
    RESULT.import(py, "distributed_observer._result", "Result")?.call((), Some(&arguments))
}

/// Returns the traces: `time`, shape `[k]`, `state`, shape `[k, n]`, `estimates`, shape `[k, N, n]`, and `errors`,
/// shape `[k, N]`.
fn traces<'py>(py: Python<'py>, run: &ReportedRun) -> PyResult<Bound<'py, PyDict>> {
    let traces = &run.result().traces;
    let (k, n, agents) = (traces.rows(), run.scenario().dimension(), run.scenario().agents.len());
    let mut state = Vec::with_capacity(k * n);
    let mut estimates = Vec::with_capacity(k * n * agents);
    let mut errors = Vec::with_capacity(k * agents);
    for row in 0..k {
        state.extend_from_slice(traces.truth(row));
        for agent in 0..agents {
            estimates.extend_from_slice(traces.estimate(row, agent));
            errors.push(traces.error(row, agent));
        }
    }
    let result = PyDict::new(py);
    result.set_item("time", PyArray1::from_slice(py, traces.time()))?;
    result.set_item("state", PyArray1::from_vec(py, state).reshape([k, n])?)?;
    let estimates = PyArray1::from_vec(py, estimates).reshape([k, agents, n])?;
    result.set_item("estimates", estimates)?;
    result.set_item("errors", PyArray1::from_vec(py, errors).reshape([k, agents])?)?;
    Ok(result)
}
