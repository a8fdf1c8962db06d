//! Scenarios as Python sees them.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use host_sim::engine::start_package;
use host_sim::offline::agent_index;
use host_sim::scenario::{self, BUILT_IN, Change, ScenarioSource};
use numpy::{PyArray1, PyArray2, PyArrayMethods};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::errors::{OrRaise, usage};
use crate::plant::CallablePlant;

/// The names of the state's components, if they are not the scenario's, and the plant.
type PlantFunction = (Option<Vec<String>>, Arc<Py<PyAny>>);

/// An experiment: plant, agents, network, learning. Made by `load` and `Scenario.from_toml`, and never changed.
#[pyclass(module = "distributed_observer", frozen)]
#[derive(Debug)]
pub(crate) struct Scenario {
    pub(crate) scenario: Arc<scenario::Scenario>,
    /// Its name in errors.
    file: String,
    text: String,
    /// The callable in place of the plant.
    function: Option<PlantFunction>,
}

/// Load a built-in scenario by its name, or a scenario file. `set` changes keys, as `--set` does:
/// `load("paper", set={"link.loss": 0.1})`.
#[pyfunction]
#[pyo3(signature = (path_or_name, *, set = None))]
pub(crate) fn load(
    py: Python<'_>,
    path_or_name: PathBuf,
    set: Option<&Bound<'_, PyAny>>,
) -> PyResult<Scenario> {
    let source = ScenarioSource::find(&path_or_name).or_raise(py)?;
    Scenario::read(py, source, set)
}

/// Return the names of the built-in scenarios.
#[pyfunction]
pub(crate) fn scenarios() -> Vec<&'static str> {
    BUILT_IN.iter().map(|(name, _)| *name).collect()
}

impl Scenario {
    fn read(
        py: Python<'_>,
        source: ScenarioSource,
        set: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let changes = changes(py, set)?;
        let (scenario, text) = source.load(&changes).or_raise(py)?;
        Ok(Self { scenario: Arc::new(scenario), file: source.name, text, function: None })
    }

    /// Returns the scenario for one run, and its callable plant.
    pub(crate) fn for_run(&self) -> (scenario::Scenario, Option<CallablePlant>) {
        let mut scenario = (*self.scenario).clone();
        let callable = self.function.as_ref().map(|(names, function)| {
            let names = names.clone().unwrap_or_else(|| scenario.plant.state_names());
            let callable = CallablePlant::new(names, Arc::clone(function));
            scenario.plant = callable.plant();
            callable
        });
        (scenario, callable)
    }

    /// Returns the scenario with this function as the plant; `names` are those of the state's components, if they
    /// are not the scenario's.
    fn with_function(
        &self,
        py: Python<'_>,
        function: Arc<Py<PyAny>>,
        names: Option<Vec<String>>,
    ) -> PyResult<Self> {
        if self.scenario.plant.recording().is_some() {
            let text = "the plant is a recording, which agents measure; choose a scenario with a plant of \
                        equations";
            return Err(usage(py, text));
        }
        let n = self.scenario.dimension();
        if let Some(names) = &names
            && names.len() != n
        {
            let text =
                format!("{} state names; give one for each of the {n} components", names.len());
            return Err(usage(py, text));
        }
        Ok(Self {
            scenario: Arc::clone(&self.scenario),
            file: self.file.clone(),
            text: self.text.clone(),
            function: Some((names, function)),
        })
    }

    /// Returns the name in errors.
    pub(crate) fn path(&self) -> &Path {
        Path::new(&self.file)
    }

    fn agent(&self, py: Python<'_>, number: usize) -> PyResult<&scenario::Agent> {
        let index = agent_index(&self.scenario, number).or_raise(py)?;
        Ok(&self.scenario.agents[index])
    }
}

/// A name, or a sequence of names.
#[derive(FromPyObject)]
enum Names {
    One(String),
    Several(Vec<String>),
}

/// Returns the changes of keys.
fn changes(py: Python<'_>, set: Option<&Bound<'_, PyAny>>) -> PyResult<Vec<Change>> {
    let Some(set) = set else { return Ok(Vec::new()) };
    let pairs: Vec<(String, String)> =
        py.import("distributed_observer._toml")?.call_method1("changes", (set,))?.extract()?;
    let change = |(key, value): &(String, String)| {
        let change = Change::new("--set", key, value);
        change.map_err(|error| usage(py, format!("set: {key}: {error}")))
    };
    pairs.iter().map(change).collect()
}

#[pymethods]
impl Scenario {
    /// Read a scenario from the text of a file. `name` stands for the file in errors.
    #[staticmethod]
    #[pyo3(signature = (text, *, name = "scenario.toml", set = None))]
    fn from_toml(
        py: Python<'_>,
        text: String,
        name: &str,
        set: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        Self::read(py, ScenarioSource { name: name.to_owned(), text }, set)
    }

    /// Return the scenario with changed keys. A callable plant stays.
    fn with_changes(&self, py: Python<'_>, set: &Bound<'_, PyAny>) -> PyResult<Self> {
        let source = ScenarioSource { name: self.file.clone(), text: self.text.clone() };
        let changed = Self::read(py, source, Some(set))?;
        match &self.function {
            None => Ok(changed),
            Some((names, function)) => {
                changed.with_function(py, Arc::clone(function), names.clone())
            }
        }
    }

    /// Return the scenario with `function(x, t)` as the plant: it gets the state as an array of shape `[n]` and the
    /// time in seconds, and returns the derivative. The dimension, the initial state and the disturbance stay those
    /// of the scenario.
    #[pyo3(signature = (function, *, state_names = None))]
    fn with_plant(
        &self,
        py: Python<'_>,
        function: Py<PyAny>,
        state_names: Option<Vec<String>>,
    ) -> PyResult<Self> {
        if !function.bind(py).is_callable() {
            return Err(PyTypeError::new_err("the plant is not callable; give a function f(x, t)"));
        }
        self.with_function(py, Arc::new(function), state_names)
    }

    /// Return the package that an agent, from 1, starts a run with: the scenario's untrained network, or
    /// `None` without one.
    #[pyo3(signature = (agent, seed = 0))]
    fn package<'py>(
        &self,
        py: Python<'py>,
        agent: usize,
        seed: u64,
    ) -> PyResult<Option<Bound<'py, PyBytes>>> {
        let index = agent_index(&self.scenario, agent).or_raise(py)?;
        let package = start_package(&self.scenario, index, seed).or_raise(py)?;
        Ok(package.map(|package| PyBytes::new(py, package.as_bytes())))
    }

    /// Return the initial estimate of an agent, from 1, shape `[n]`.
    fn initial_estimate<'py>(
        &self,
        py: Python<'py>,
        agent: usize,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        Ok(PyArray1::from_slice(py, &self.agent(py, agent)?.initial_estimate))
    }

    /// Return the output matrix of an agent, from 1, shape `[m, n]`.
    fn output_matrix<'py>(
        &self,
        py: Python<'py>,
        agent: usize,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let matrix = &self.agent(py, agent)?.output_matrix;
        let rows: Vec<f64> = matrix.transpose().iter().copied().collect();
        PyArray1::from_vec(py, rows).reshape([matrix.nrows(), matrix.ncols()])
    }

    /// Return the numbers of the agents that an agent, from 1, hears.
    fn neighbours(&self, py: Python<'_>, agent: usize) -> PyResult<Vec<usize>> {
        let index = agent_index(&self.scenario, agent).or_raise(py)?;
        let neighbours = self.scenario.graph.neighbours(index);
        Ok(neighbours.iter().map(|neighbour| neighbour.agent + 1).collect())
    }

    /// Its name.
    #[getter]
    fn name(&self) -> &str {
        &self.scenario.name
    }

    /// Its text, with all changes.
    #[getter]
    fn text(&self) -> &str {
        &self.text
    }

    /// The number of agents.
    #[getter]
    fn agents(&self) -> usize {
        self.scenario.agents.len()
    }

    /// The number of state components.
    #[getter]
    fn dimension(&self) -> usize {
        self.scenario.dimension()
    }

    /// The names of the state components.
    #[getter]
    fn state_names(&self) -> Vec<String> {
        let given = self.function.as_ref().and_then(|(names, _)| names.clone());
        given.unwrap_or_else(|| self.scenario.plant.state_names())
    }

    /// The number of steps of a run.
    #[getter]
    fn steps(&self) -> u64 {
        self.scenario.steps()
    }

    /// The length of a step. [s]
    #[getter]
    fn step_size(&self) -> f64 {
        self.scenario.time.step_size
    }

    /// The length of a run. [s]
    #[getter]
    fn duration(&self) -> f64 {
        self.scenario.time.duration
    }

    /// Run the scenario on `threads` threads, 0 for one per core.
    ///
    /// `packages` are for the agents that they name, in place of the scenario's network; `learning = False` leaves
    /// out the learning cycles; `baselines` are names of methods to compare with, by default those of the command
    /// line. `progress` is a callable that gets the steps done and their total; by default a bar is shown in
    /// notebooks.
    #[pyo3(signature = (seed = 0, threads = 0, *, packages = None, learning = true, baselines = None, progress = None))]
    #[expect(clippy::too_many_arguments, reason = "keywords in Python")]
    fn run<'py>(
        &self,
        py: Python<'py>,
        seed: u64,
        threads: u16,
        packages: Option<Vec<Bound<'py, PyAny>>>,
        learning: bool,
        baselines: Option<Names>,
        progress: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let packages = packages.unwrap_or_default();
        let baselines = match baselines {
            Some(Names::One(name)) => vec![name],
            Some(Names::Several(names)) => names,
            None => Vec::new(),
        };
        let choices = crate::runs::choices(py, &baselines)?;
        let request = crate::runs::Request { seed, threads, learning, choices };
        crate::runs::run(py, self.for_run(), &request, &packages, progress)
    }

    fn __repr__(&self) -> String {
        let scenario = &self.scenario;
        let plant = if self.function.is_some() { ", plant in Python" } else { "" };
        let (agents, n, duration) =
            (scenario.agents.len(), scenario.dimension(), scenario.time.duration);
        format!("<Scenario {}: {agents} agents, {n} states, {duration} s{plant}>", scenario.name)
    }
}
