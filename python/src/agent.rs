//! An agent that Python steps.

use agent_core::health::HealthSettings;
use host_sim::agent;
use numpy::{PyArray1, PyArray2, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::arrays::read_singles;
use crate::bytes::bytes;
use crate::errors::OrRaise;
use crate::{json, packages};

/// One agent, as a node runs it: made from a weight package, stepped by hand.
///
/// `estimate` is where it begins, shape `[n]`; by default in the middle of the box that its network was trained
/// on, as a node does. With `health=False` its monitor only counts: it believes every neighbour and never restarts, as in
/// a scenario without `[health]`.
#[pyclass(module = "distributed_observer")]
#[derive(Debug)]
pub(crate) struct Agent {
    agent: agent::Agent,
    tick: u64,
    /// Room for a measurement.
    measurement: Vec<f32>,
}

#[pymethods]
impl Agent {
    #[new]
    #[pyo3(signature = (package, *, estimate = None, health = true))]
    fn new(
        package: &Bound<'_, PyAny>,
        estimate: Option<&Bound<'_, PyAny>>,
        health: bool,
    ) -> PyResult<Self> {
        let py = package.py();
        let (package, _) = packages::read(package)?;
        let mut begin = Vec::new();
        if let Some(estimate) = estimate {
            read_singles("estimate", estimate, &mut begin)?;
        }
        let begin = estimate.map(|_| &begin[..]);
        let health = if health { &HealthSettings::RECOMMENDED } else { &agent::COUNTING };
        let agent = agent::Agent::new(&package, begin, health).or_raise(py)?;
        Ok(Self { agent, tick: 0, measurement: Vec::new() })
    }

    /// Keep a received frame for the next step.
    #[inline]
    fn receive(&mut self, frame: &Bound<'_, PyAny>) -> PyResult<()> {
        self.agent.receive(&bytes("frame", frame)?).or_raise(frame.py())
    }

    /// Take a step and return the frame to broadcast, or `None` if the event trigger did not fire.
    ///
    /// `measurement` has the shape `[m]`; without one, the agent goes on from its neighbours alone. `tick` is the
    /// number of the step, by default one more than that of the step before.
    #[inline]
    #[pyo3(signature = (measurement = None, *, tick = None))]
    fn step<'py>(
        &mut self,
        py: Python<'py>,
        measurement: Option<&Bound<'py, PyAny>>,
        tick: Option<u64>,
    ) -> PyResult<Option<Bound<'py, PyBytes>>> {
        let measured = match measurement {
            None => None,
            Some(value) => {
                read_singles("measurement", value, &mut self.measurement)?;
                Some(&self.measurement[..])
            }
        };
        let tick = tick.unwrap_or(self.tick);
        let frame = self.agent.step(tick, measured).or_raise(py)?;
        self.tick = tick.saturating_add(1);
        Ok(frame.map(|frame| PyBytes::new(py, &frame)))
    }

    /// Return the frame with its last broadcast sample. Before the first step, that is what a node sends
    /// when it starts.
    fn announcement<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        PyBytes::new(py, &self.agent.announcement())
    }

    /// The estimate of the state after the last step, shape `[n]`, as a new array.
    #[getter]
    fn estimate<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        PyArray1::from_slice(py, self.agent.estimate())
    }

    /// The derivative of the estimate in the last step, shape `[n]`, per second; `None` if there was none.
    #[getter]
    fn derivative<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyArray1<f32>>> {
        self.agent.derivative().map(|derivative| PyArray1::from_slice(py, derivative))
    }

    /// The outer weights, shape `[L, n]`, as a new array.
    #[getter]
    fn outer_weights<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let (weights, n) = (self.agent.outer_weights(), self.agent.estimate().len());
        PyArray1::from_slice(py, weights).reshape([weights.len() / n, n])
    }

    /// The health counters of a node, by name.
    #[getter]
    fn health<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        json::to_python(py, self.agent.health())
    }

    /// Whether the network is in use, and not switched off by the health monitor.
    #[getter]
    fn network_in_use(&self) -> bool {
        self.agent.network_in_use()
    }

    /// The number of the agent, from 1.
    #[getter]
    fn number(&self) -> u32 {
        self.agent.id()
    }

    /// The number of the next step.
    #[getter]
    fn tick(&self) -> u64 {
        self.tick
    }

    /// The package that the agent was made from.
    #[getter]
    fn package<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        PyBytes::new(py, self.agent.package().as_bytes())
    }

    fn __repr__(&self) -> String {
        format!("<Agent {} at tick {}>", self.agent.id(), self.tick)
    }
}
