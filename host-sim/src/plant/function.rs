//! A plant whose drift is a function of the program that uses this library, such as a Python callable.
//!
//! The bits of a run are those of the function: what it computes has to be the same on every machine if the
//! run is to be.

use std::fmt;
use std::sync::Arc;

/// The drift `f`. Runs beside each other, such as baselines, call it from several threads.
pub trait Rate: Send + Sync {
    /// Writes `f` at `time` \[s\] and state `x`, shape `[n]`, to `dx`, shape `[n]`: numbers that are not finite end
    /// the run.
    fn evaluate(&self, time: f64, x: &[f64], dx: &mut [f64]);
}

/// A function as a plant.
///
/// ```
/// use std::sync::Arc;
///
/// use host_sim::plant::{FunctionPlant, Plant, Rate};
///
/// struct Decay;
///
/// impl Rate for Decay {
///     fn evaluate(&self, _time: f64, x: &[f64], dx: &mut [f64]) {
///         dx[0] = -x[0];
///     }
/// }
///
/// let plant = Plant::Function(FunctionPlant::new(vec!["x".to_owned()], Arc::new(Decay)));
/// let mut dx = [0.0];
/// plant.derivative(0.0, &[2.0], &mut dx);
/// assert_eq!(dx, [-2.0]);
/// ```
#[derive(Clone)]
pub struct FunctionPlant {
    state_names: Vec<String>,
    rate: Arc<dyn Rate>,
}

impl FunctionPlant {
    /// Creates a plant with these names of the state's components, shape `[n]`.
    #[must_use]
    pub fn new(state_names: Vec<String>, rate: Arc<dyn Rate>) -> Self {
        Self { state_names, rate }
    }

    /// Returns the names of the state's components, shape `[n]`.
    #[must_use]
    pub fn state_names(&self) -> &[String] {
        &self.state_names
    }

    /// Returns the function.
    #[must_use]
    pub fn rate(&self) -> &dyn Rate {
        &*self.rate
    }
}

impl PartialEq for FunctionPlant {
    /// Whether both call the same function.
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.rate, &other.rate) && self.state_names == other.state_names
    }
}

impl fmt::Debug for FunctionPlant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("FunctionPlant")
            .field("state_names", &self.state_names)
            .finish_non_exhaustive()
    }
}
