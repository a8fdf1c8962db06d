//! Bytes from Python.

use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::pybacked::PyBackedBytes;
use pyo3::types::PyMemoryView;

/// Returns the bytes of a `bytes`, `bytearray` or `memoryview`; only `bytes` are not copied. `name` is that of the
/// argument.
///
/// # Errors
/// If the value is of another type.
#[inline]
pub(crate) fn bytes(name: &str, value: &Bound<'_, PyAny>) -> PyResult<PyBackedBytes> {
    if let Ok(bytes) = value.extract() {
        return Ok(bytes);
    }
    if value.is_instance_of::<PyMemoryView>() {
        return Ok(value.call_method0("tobytes")?.extract()?);
    }
    let found = value.get_type().name()?;
    Err(PyTypeError::new_err(format!("{name} is of type {found}; give bytes")))
}
