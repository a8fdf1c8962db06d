//! The library's errors as `ObserverError`.

use host_sim::error::{ErrorReport, Reported};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::PyType;

static OBSERVER_ERROR: PyOnceLock<Py<PyType>> = PyOnceLock::new();

/// Returns the exception for an error: the text of the command line, with `code`, `file` and `line`.
pub(crate) fn exception(py: Python<'_>, error: &impl Reported) -> PyErr {
    let file = error.file().map(|file| file.display().to_string());
    let arguments = (error.to_string(), error.code().as_str(), file, error.line());
    let class = OBSERVER_ERROR.import(py, "distributed_observer._errors", "ObserverError");
    match class.and_then(|class| class.call1(arguments)) {
        Ok(exception) => PyErr::from_value(exception),
        Err(error) => error,
    }
}

/// Returns the exception for an invalid argument.
pub(crate) fn usage(py: Python<'_>, text: impl Into<String>) -> PyErr {
    exception(py, &ErrorReport::usage(text))
}

/// Raises the library's errors.
pub(crate) trait OrRaise<T> {
    /// Converts an error into the exception.
    fn or_raise(self, py: Python<'_>) -> PyResult<T>;
}

impl<T, E: Reported> OrRaise<T> for Result<T, E> {
    fn or_raise(self, py: Python<'_>) -> PyResult<T> {
        self.map_err(|error| exception(py, &error))
    }
}
