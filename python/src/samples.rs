//! Recorded samples as Python sees them.

use std::ops::Range;
use std::path::{Path, PathBuf};

use host_sim::packages::Recording;
use host_sim::scenario;
use numpy::{PyArray1, PyArray2, PyArrayMethods};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::{PyList, PyTuple};

use crate::arrays::{matrix, vector};
use crate::errors::{OrRaise, usage};
use agent_core::INPUTS_MAX;

/// Samples of one agent, to train on: time in seconds, shape `[k]`; the estimates, shape `[k, n]`; and their
/// derivatives, shape `[k, n]`, per second. `outer_weights`, shape `[L, n]`, are those that the network is trained for;
/// `agent` is the number of the agent that recorded them.
#[pyclass(module = "distributed_observer", frozen)]
#[derive(Debug)]
pub(crate) struct Samples {
    pub(crate) recording: Recording,
    agent: Option<usize>,
}

/// The name of samples in memory.
const NAME: &str = "samples";

impl Samples {
    /// Creates the samples of a learning cycle of an agent, from 1.
    pub(crate) fn of(recording: Recording, agent: usize) -> Self {
        Self { recording, agent: Some(agent) }
    }
}

#[pymethods]
impl Samples {
    #[new]
    #[pyo3(signature = (time, estimates, derivatives, *, outer_weights = None, agent = None))]
    fn new(
        py: Python<'_>,
        time: &Bound<'_, PyAny>,
        estimates: &Bound<'_, PyAny>,
        derivatives: &Bound<'_, PyAny>,
        outer_weights: Option<&Bound<'_, PyAny>>,
        agent: Option<usize>,
    ) -> PyResult<Self> {
        let time = vector("time", time)?;
        let (estimates, derivatives) =
            (matrix("estimates", estimates)?, matrix("derivatives", derivatives)?);
        let (time, estimates, derivatives) =
            (time.as_array(), estimates.as_array(), derivatives.as_array());
        let (k, n) = estimates.dim();
        if time.len() != k || derivatives.dim() != (k, n) {
            let text = format!(
                "time has {} entries, estimates have the shape {:?}, and derivatives {:?}; give one time for each row, \
                 and as many estimates as derivatives",
                time.len(),
                estimates.dim(),
                derivatives.dim()
            );
            return Err(usage(py, text));
        }
        check_dimension(py, n)?;
        let mut rows = Vec::with_capacity(k * (1 + 2 * n));
        for row in 0..k {
            rows.push(time[row]);
            rows.extend(estimates.row(row));
            rows.extend(derivatives.row(row));
        }
        let weights = match outer_weights {
            None => None,
            Some(weights) => Some(outer(py, weights, n)?),
        };
        let recording = Recording::from_rows(Path::new(NAME), n, &rows, weights).or_raise(py)?;
        Ok(Self { recording, agent })
    }

    /// The times. [s]
    #[getter]
    fn time<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        let Recording { start, interval, .. } = self.recording;
        let ticks = self.recording.ticks();
        PyArray1::from_vec(py, ticks.iter().map(|&tick| start + tick as f64 * interval).collect())
    }

    /// The estimates, shape `[k, n]`.
    #[getter]
    fn estimates<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        self.inputs(py, 0..self.recording.samples.dimension())
    }

    /// The known inputs of the plant, shape `[k, p]`.
    #[getter]
    fn known_inputs<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let samples = &self.recording.samples;
        self.inputs(py, samples.dimension()..samples.width())
    }

    /// Their derivatives, shape `[k, n]`, per second.
    #[getter]
    fn derivatives<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let samples = &self.recording.samples;
        PyArray1::from_slice(py, samples.targets()).reshape([samples.len(), samples.dimension()])
    }

    /// The outer weights that the network is trained for, shape `[L, n]`, or `None`.
    #[getter]
    fn outer_weights<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray2<f32>>>> {
        let n = self.recording.samples.dimension();
        let weights = self.recording.outer_weights.as_ref();
        let shaped =
            |weights: &Vec<f32>| PyArray1::from_slice(py, weights).reshape([weights.len() / n, n]);
        weights.map(shaped).transpose()
    }

    /// The number of the agent that recorded them, or `None`.
    #[getter]
    fn agent(&self) -> Option<usize> {
        self.agent
    }

    /// Write the samples as a CSV file, which `train` and `host-sim train` read.
    fn save(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        self.recording.save(&path).or_raise(py)
    }

    fn __len__(&self) -> usize {
        self.recording.samples.len()
    }

    fn __repr__(&self) -> String {
        let agent = self.agent.map_or(String::new(), |agent| format!(" of agent {agent}"));
        format!(
            "<Samples{agent}: {} rows, one every {} s>",
            self.__len__(),
            self.recording.interval
        )
    }
}

impl Samples {
    /// Returns these columns of the network's inputs.
    fn inputs<'py>(
        &self,
        py: Python<'py>,
        columns: Range<usize>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let (samples, count) = (&self.recording.samples, columns.len());
        let rows = samples.inputs().chunks_exact(samples.width());
        let numbers = rows.flat_map(|row| row[columns.clone()].iter().copied()).collect();
        PyArray1::from_vec(py, numbers).reshape([samples.len(), count])
    }
}

fn check_dimension(py: Python<'_>, n: usize) -> PyResult<()> {
    match n {
        1..=INPUTS_MAX => Ok(()),
        n => Err(usage(py, format!("estimates have {n} columns; give 1 to {INPUTS_MAX}"))),
    }
}

fn outer(py: Python<'_>, weights: &Bound<'_, PyAny>, n: usize) -> PyResult<Vec<f32>> {
    let weights = matrix("outer_weights", weights)?;
    let weights = weights.as_array();
    if weights.ncols() != n || !weights.iter().all(|weight| (*weight as f32).is_finite()) {
        let shape = weights.dim();
        let text = format!(
            "outer_weights have the shape {shape:?}; give finite numbers, a row for each feature and \
                            {n} columns"
        );
        return Err(usage(py, text));
    }
    Ok(weights.iter().map(|&weight| weight as f32).collect())
}

/// Recordings that Python gave: files, or samples in memory.
pub(crate) enum Given {
    /// Files.
    Paths(Vec<PathBuf>),
    /// In memory: names, agents from 1 if they are known, and samples.
    Memory(Vec<(PathBuf, Option<usize>, Recording)>),
}

/// Reads what Python gave as samples: a path, an array with a row for each sample (time, estimate, derivative),
/// `Samples`, or a list of these.
pub(crate) fn given(value: &Bound<'_, PyAny>, scenario: &scenario::Scenario) -> PyResult<Given> {
    let py = value.py();
    let items: Option<Vec<Bound<'_, PyAny>>> =
        match (value.cast::<PyList>(), value.cast::<PyTuple>()) {
            (Ok(list), _) => Some(list.iter().collect()),
            (_, Ok(tuple)) => Some(tuple.iter().collect()),
            _ => None,
        };
    // Rows of numbers are one table, not several.
    let is_table =
        |items: &Vec<Bound<'_, PyAny>>| items.iter().all(|item| item.extract::<Vec<f64>>().is_ok());
    let parts = items.filter(|items| !is_table(items)).unwrap_or_else(|| vec![value.clone()]);
    let paths: Vec<PathBuf> = parts.iter().filter_map(|part| part.extract().ok()).collect();
    if paths.len() == parts.len() {
        return Ok(Given::Paths(paths));
    }
    if !paths.is_empty() {
        let text = "samples holds paths and samples in memory; give one or the other";
        return Err(PyTypeError::new_err(text));
    }
    let name = |place: usize| match parts.len() {
        1 => PathBuf::from(NAME),
        _ => PathBuf::from(format!("{NAME}[{place}]")),
    };
    let memory = parts.iter().enumerate().map(|(place, part)| {
        let name = name(place);
        if let Ok(samples) = part.cast::<Samples>() {
            let samples = samples.get();
            check_features(py, &name, &samples.recording, scenario)?;
            return Ok((name, samples.agent, samples.recording.clone()));
        }
        let recording = rows(py, &name, part, scenario.dimension())?;
        Ok((name, None, recording))
    });
    memory.collect::<PyResult<_>>().map(Given::Memory)
}

/// Checks that samples fit to the scenario.
fn check_features(
    py: Python<'_>,
    name: &Path,
    recording: &Recording,
    scenario: &scenario::Scenario,
) -> PyResult<()> {
    let (found, n) = (recording.samples.dimension(), scenario.dimension());
    let shown = name.display();
    if recording.samples.known_inputs() > 0 {
        let text = format!(
            "{shown}: samples have known inputs of the plant, which packages for nodes cannot use; learn in the \
             run instead"
        );
        return Err(usage(py, text));
    }
    if found != n {
        let text = format!(
            "{shown}: estimates have {found} components, but the scenario's state has {n}; give \
                            samples of this scenario"
        );
        return Err(usage(py, text));
    }
    let weights = recording.outer_weights.as_ref().map(|weights| weights.len() / n);
    let features = scenario.network.as_ref().map(|network| network.architecture.features());
    if let (Some(found), Some(features)) = (weights, features)
        && found != features
    {
        let text = format!(
            "{shown}: outer weights of {found} features, but the network has {features}; give samples of \
                            this scenario"
        );
        return Err(usage(py, text));
    }
    Ok(())
}

/// Reads an array with a row for each sample.
fn rows(py: Python<'_>, name: &Path, value: &Bound<'_, PyAny>, n: usize) -> PyResult<Recording> {
    let shown = name.display().to_string();
    let array = matrix(&shown, value)?;
    let array = array.as_array();
    if array.ncols() != 1 + 2 * n {
        let text = format!(
            "{shown} has {} columns; give {}: the time, {n} of the estimate and {n} of its derivative",
            array.ncols(),
            1 + 2 * n
        );
        return Err(usage(py, text));
    }
    let rows: Vec<f64> = array.iter().copied().collect();
    Recording::from_rows(name, n, &rows, None).or_raise(py)
}
