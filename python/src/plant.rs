//! A Python callable as the plant: `f(x, t)` returns `dx/dt`.

use std::sync::{Arc, Mutex};

use host_sim::plant::{FunctionPlant, Plant, Rate};
use numpy::{PyArray1, PyArrayMethods};
use pyo3::prelude::*;

use crate::arrays::{is_regular, vector};
use crate::errors::usage;

/// The first exception in a run.
type Raised = Arc<Mutex<Option<PyErr>>>;

/// The plant of one run.
pub(crate) struct CallablePlant {
    state_names: Vec<String>,
    function: Arc<Py<PyAny>>,
    raised: Raised,
}

impl CallablePlant {
    /// Creates the plant of a run, with these names of the state's components.
    pub(crate) fn new(state_names: Vec<String>, function: Arc<Py<PyAny>>) -> Self {
        Self { state_names, function, raised: Raised::default() }
    }

    /// Returns it as the library's.
    pub(crate) fn plant(&self) -> Plant {
        let rate =
            CallableRate { function: Arc::clone(&self.function), raised: Arc::clone(&self.raised) };
        Plant::Function(FunctionPlant::new(self.state_names.clone(), Arc::new(rate)))
    }

    /// Returns the first exception of the callable.
    pub(crate) fn raised(&self) -> Option<PyErr> {
        self.raised.lock().ok()?.take()
    }
}

struct CallableRate {
    function: Arc<Py<PyAny>>,
    raised: Raised,
}

impl Rate for CallableRate {
    fn evaluate(&self, time: f64, x: &[f64], dx: &mut [f64]) {
        // Nothing more is called after an exception: the run is about to end.
        let has_raised = self.raised.lock().map_or(true, |raised| raised.is_some());
        let outcome = match has_raised {
            true => Ok(false),
            false => Python::attach(|py| self.call(py, time, x, dx)),
        };
        match outcome {
            Ok(true) => return,
            Ok(false) => {}
            Err(error) => {
                if let Ok(mut raised) = self.raised.lock() {
                    raised.get_or_insert(error);
                }
            }
        }
        dx.fill(f64::NAN);
    }
}

impl CallableRate {
    /// Calls the function; returns whether it gave a derivative.
    fn call(&self, py: Python<'_>, time: f64, x: &[f64], dx: &mut [f64]) -> PyResult<bool> {
        let state = PyArray1::from_slice(py, x);
        let result = self.function.bind(py).call1((state, time))?;
        let numbers = match result.cast::<PyArray1<f64>>() {
            Ok(array) if is_regular(array) => array.try_readonly()?,
            _ => vector("the derivative of the plant", &result)?,
        };
        let numbers = numbers.as_array();
        if numbers.len() != dx.len() {
            let (found, expected) = (numbers.len(), dx.len());
            let text = format!(
                "the plant returned {found} numbers at t = {time}; return the derivative of all {expected} \
                 state components"
            );
            return Err(usage(py, text));
        }
        if let Some(place) = numbers.iter().position(|number| !number.is_finite()) {
            let text = format!(
                "the plant returned {} as the derivative of component {} at t = {time}, x = {x:?}; return finite \
                 numbers",
                numbers[place],
                place + 1
            );
            return Err(usage(py, text));
        }
        dx.iter_mut().zip(numbers.iter()).for_each(|(dx, &number)| *dx = number);
        Ok(true)
    }
}
