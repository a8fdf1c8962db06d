//! Frames as Python sees them.

use host_sim::frames;
use numpy::{PyArray1, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::bytes::bytes;
use crate::errors::OrRaise;

/// Decode a frame of version 1. `dimension` is the number of state components; only announcements of the
/// field observer need it.
#[pyfunction]
#[pyo3(signature = (frame, dimension = None))]
pub(crate) fn decode<'py>(
    frame: &Bound<'py, PyAny>,
    dimension: Option<usize>,
) -> PyResult<Bound<'py, PyDict>> {
    let py = frame.py();
    let content = frames::decode(&bytes("frame", frame)?, dimension).or_raise(py)?;
    let result = PyDict::new(py);
    result.set_item("sender", content.sender)?;
    result.set_item("sequence", content.sequence)?;
    result.set_item("tick", content.tick)?;
    result.set_item("kind", content.kind)?;
    let estimate = content.estimate.map(|estimate| PyArray1::from_vec(py, estimate));
    result.set_item("estimate", estimate)?;
    let announced = content.announced.map(|announced| {
        let dictionary = PyDict::new(py);
        dictionary.set_item("digest", announced.digest)?;
        dictionary.set_item("hold", announced.hold)?;
        dictionary.set_item("rate", PyArray1::from_vec(py, announced.rate))?;
        dictionary.set_item("directions", announced.directions)?;
        let numbers = announced.disturbances.len();
        let disturbances = PyArray1::from_vec(py, announced.disturbances.concat());
        dictionary.set_item("disturbances", disturbances.reshape([numbers, 3])?)?;
        PyResult::Ok(dictionary)
    });
    result.set_item("announced", announced.transpose()?)?;
    Ok(result)
}
