//! The native part of the Python module `distributed_observer`: host-sim's library, for notebooks.
//!
//! | module | what Python sees |
//! | --- | --- |
//! | `scenario`, `runs` | `load`, `Scenario` and its runs |
//! | `agent` | `Agent`, stepped by hand |
//! | `samples`, `training` | `Samples` and `train` |
//! | `packages`, `frames` | packages and frames as bytes |
//! | `plant` | a Python callable as the plant |
//! | `errors`, `arrays`, `json`, `attended` | conversions; long work that Python can watch and interrupt |
//!
//! Nothing is computed here: every function converts its arguments, calls the library, and converts what
//! comes back. The Python package beside this crate adds what is easier to write in Python: results, data
//! frames and progress bars. `docs/python.md` is the page for users.

// The signatures of functions for Python are those of Python.
#![allow(clippy::needless_pass_by_value, reason = "arguments arrive by value from Python")]

mod agent;
mod arrays;
mod attended;
mod bytes;
mod errors;
mod frames;
mod json;
mod packages;
mod plant;
mod runs;
mod samples;
mod scenario;
mod training;

/// The native part of `distributed_observer`.
#[pyo3::pymodule]
mod _native {
    #[pymodule_export]
    use crate::agent::Agent;
    #[pymodule_export]
    use crate::frames::decode;
    #[pymodule_export]
    use crate::packages::{inspect, keygen, sign, verify};
    #[pymodule_export]
    use crate::samples::Samples;
    #[pymodule_export]
    use crate::scenario::{Scenario, load, scenarios};
    #[pymodule_export]
    use crate::training::train;
}
