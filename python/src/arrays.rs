//! Numbers from Python: NumPy arrays of any type and layout, sequences, and single numbers.

use numpy::{
    Element, PyArray, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2,
    PyUntypedArrayMethods,
};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::PyFloat;

use crate::errors::usage;

static ASARRAY: PyOnceLock<Py<PyAny>> = PyOnceLock::new();
static DOUBLE: PyOnceLock<Py<PyAny>> = PyOnceLock::new();

/// Writes the numbers of `value` to `numbers`, in single precision: the nearest to each, as for a simulated
/// sensor. `name` is that of the argument.
///
/// Regular arrays of f32 and f64 are read where they are.
///
/// # Errors
/// If the value is not a vector of real numbers.
#[inline]
pub(crate) fn read_singles(
    name: &str,
    value: &Bound<'_, PyAny>,
    numbers: &mut Vec<f32>,
) -> PyResult<()> {
    numbers.clear();
    if let Ok(array) = value.cast::<PyArray1<f32>>()
        && is_regular(array)
    {
        numbers.extend(array.try_readonly()?.as_array().iter());
    } else if let Ok(array) = value.cast::<PyArray1<f64>>()
        && is_regular(array)
    {
        numbers.extend(array.try_readonly()?.as_array().iter().map(|&number| number as f32));
    } else if let Ok(number) = value.cast::<PyFloat>() {
        numbers.push(number.extract::<f64>()? as f32);
    } else {
        let array = vector(name, value)?;
        numbers.extend(array.as_array().iter().map(|&number| number as f32));
    }
    Ok(())
}

/// Returns whether elements are aligned and whole elements apart. A field of a packed structured array is
/// not, and cannot be read where it is.
pub(crate) fn is_regular<T: Element, D: numpy::ndarray::Dimension>(
    array: &Bound<'_, PyArray<T, D>>,
) -> bool {
    let size = size_of::<T>() as isize;
    let is_aligned = (array.data() as usize).is_multiple_of(align_of::<T>());
    is_aligned && array.strides().iter().all(|stride| stride % size == 0)
}

/// Returns `value` as a regular array of f64 with one axis, which is a copy only if it is not one already.
///
/// # Errors
/// If the value is not a vector of real numbers.
pub(crate) fn vector<'py>(
    name: &str,
    value: &Bound<'py, PyAny>,
) -> PyResult<PyReadonlyArray1<'py, f64>> {
    let array = doubles(name, value)?;
    let one = array.cast_into::<PyArray1<f64>>().or_else(|error| {
        let array = error.into_inner();
        // A single number is a vector of one.
        if axes(&array)? == 0 {
            return Ok(array.call_method1("reshape", (1,))?.cast_into::<PyArray1<f64>>()?);
        }
        Err(wrong_axes(name, &array, "one axis")?)
    })?;
    Ok(one.try_readonly()?)
}

/// Returns `value` as a regular array of f64 with two axes, which is a copy only if it is not one already.
///
/// # Errors
/// If the value is not a matrix of real numbers.
pub(crate) fn matrix<'py>(
    name: &str,
    value: &Bound<'py, PyAny>,
) -> PyResult<PyReadonlyArray2<'py, f64>> {
    let array = doubles(name, value)?;
    match array.cast_into::<PyArray2<f64>>() {
        Ok(array) => Ok(array.try_readonly()?),
        Err(error) => Err(wrong_axes(name, &error.into_inner(), "two axes")?),
    }
}

fn axes(array: &Bound<'_, PyAny>) -> PyResult<usize> {
    array.getattr("ndim")?.extract()
}

/// Returns the exception for an array with another number of axes.
fn wrong_axes(name: &str, array: &Bound<'_, PyAny>, expected: &str) -> PyResult<PyErr> {
    let shape = array.getattr("shape")?.repr()?;
    let text = format!("{name} has the shape {shape}; give an array with {expected}");
    Ok(usage(array.py(), text))
}

/// Converts `value` by `numpy.asarray` to f64; complex numbers and texts are refused.
fn doubles<'py>(name: &str, value: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    let py = value.py();
    let asarray = ASARRAY.import(py, "numpy", "asarray")?;
    let array = asarray.call1((value,))?;
    let kind: String = array.getattr("dtype")?.getattr("kind")?.extract()?;
    if !["f", "i", "u", "b"].contains(&&*kind) {
        let found = array.getattr("dtype")?.str()?;
        let text = format!("{name} holds {found}; give real numbers");
        return Err(PyTypeError::new_err(text));
    }
    let double = DOUBLE.import(py, "numpy", "float64")?;
    let array = asarray.call1((array, double))?;
    let is_whole = match (array.cast::<PyArray1<f64>>(), array.cast::<PyArray2<f64>>()) {
        (Ok(array), _) => is_regular(array),
        (_, Ok(array)) => is_regular(array),
        // Refused later, for its number of axes.
        _ => true,
    };
    if is_whole { Ok(array) } else { array.call_method0("copy") }
}
