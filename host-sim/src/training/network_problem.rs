//! The training of one agent's inner network as a least-squares problem.
//!
//! ```text
//! e^o(s) = f̂^o(x_s) − y_s^o,   f̂(x) = Wᵀ σ(Φ̂(x)),   E = (1 / (S n)) Σ_s Σ_o e^o(s)²
//! ```
//!
//! The outer weights W are fixed, because on the node the update law adapts them. Only the
//! parameters of the inner layers are trained.
//!
//! Cost: dominated by JᵀJ, see `normal_matrix`. Memory for n parameters: about 4 n² bytes here and
//! 16 n² in the solver.
//!
//! Invariants: samples are processed in the order of the data set; the bits of every result depend
//! only on the arguments, not on the machine.

use super::data::Dataset;
use super::normal_matrix::NormalMatrix;
use super::propagation::{BATCH, Propagation, layer_shapes};
use super::trainer::levenberg_marquardt::LeastSquares;
use agent_core::observer::network::Architecture;
use pulp::{Arch, Simd, WithSimd};
use std::sync::atomic::{AtomicBool, Ordering};

/// Maximum number of trainable parameters; JᵀJ then takes half a gigabyte.
pub const PARAMETERS_MAX: usize = 8192;

/// Why network and data do not form a problem.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ProblemError {
    /// The outer weights do not have the shape `[L][n]`.
    #[error("{found} outer weights, expected {features} features times {dimension} outputs")]
    OuterWeightCount {
        /// Number of weights given.
        found: usize,
        /// Number of features L of the architecture.
        features: usize,
        /// Number of outputs n of the data.
        dimension: usize,
    },
    /// An outer weight is infinite or NaN.
    #[error("outer weight {index} is not finite")]
    OuterWeightNotFinite {
        /// Its index in row-major order.
        index: usize,
    },
    /// The data have a different number of inputs from the network.
    #[error("the data have {found} inputs, but the network has {expected}")]
    Inputs {
        /// Number of inputs of the architecture.
        expected: usize,
        /// Number of inputs of the data.
        found: usize,
    },
    /// More than [`PARAMETERS_MAX`] parameters.
    #[error("{found} inner parameters, but training supports at most {PARAMETERS_MAX}")]
    ParameterCount {
        /// Number of parameters of the architecture.
        found: usize,
    },
}

/// Inner network, fixed outer weights and data.
#[derive(Clone, Debug)]
pub struct NetworkProblem {
    arch: Arch,
    parameter_count: usize,
    train: Samples,
    validation: Option<Samples>,
    test: Option<Samples>,
    propagation: Propagation,
    normal: NormalMatrix,
    residuals: Vec<f64>,
    stop: Option<&'static AtomicBool>,
}

impl NetworkProblem {
    /// Creates the problem of training the inner layers of `architecture` with fixed
    /// `outer_weights` (row-major, shape `[L][n]`).
    ///
    /// # Errors
    /// If shapes do not match or a weight is not finite.
    pub fn new(
        architecture: &Architecture,
        outer_weights: &[f64],
        train: &Dataset,
        validation: Option<&Dataset>,
        test: Option<&Dataset>,
    ) -> Result<Self, ProblemError> {
        Self::with_arch(architecture, outer_weights, [Some(train), validation, test], Arch::new())
    }

    /// Like [`Self::new`], for a given instruction set.
    pub(super) fn with_arch(
        architecture: &Architecture,
        outer_weights: &[f64],
        data: [Option<&Dataset>; 3],
        arch: Arch,
    ) -> Result<Self, ProblemError> {
        let (expected, features) = (architecture.inputs(), architecture.features());
        let dimension = data.iter().flatten().next().map_or(expected, |data| data.dimension());
        for data in data.iter().flatten() {
            let found = data.width();
            if found != expected {
                return Err(ProblemError::Inputs { expected, found });
            }
        }
        let found = outer_weights.len();
        if found != features * dimension {
            return Err(ProblemError::OuterWeightCount { found, features, dimension });
        }
        if let Some(index) = outer_weights.iter().position(|weight| !weight.is_finite()) {
            return Err(ProblemError::OuterWeightNotFinite { index });
        }
        let parameter_count = architecture.parameter_count();
        if parameter_count > PARAMETERS_MAX {
            return Err(ProblemError::ParameterCount { found: parameter_count });
        }
        let [train, validation, test] = data.map(|data| data.map(Samples::new));
        Ok(Self {
            arch,
            parameter_count,
            train: train.unwrap_or_default(),
            validation,
            test,
            propagation: Propagation::new(architecture, outer_weights, arch),
            normal: NormalMatrix::new(&layer_shapes(architecture), dimension, arch),
            residuals: vec![0.0; dimension * BATCH],
            stop: None,
        })
    }

    /// Makes evaluations end early once `stop` is true.
    #[must_use]
    pub fn until(self, stop: Option<&'static AtomicBool>) -> Self {
        Self { stop, ..self }
    }
}

impl LeastSquares for NetworkProblem {
    fn parameter_count(&self) -> usize {
        self.parameter_count
    }

    fn cost(&mut self, parameters: &[f64]) -> f64 {
        self.propagation.set_parameters(parameters);
        let (propagation, residuals) = (&mut self.propagation, &mut self.residuals);
        mean_squared_error(self.arch, &self.train, propagation, residuals, self.stop)
    }

    fn normal_equations(
        &mut self,
        parameters: &[f64],
        hessian: &mut [f64],
        gradient: &mut [f64],
    ) -> f64 {
        self.propagation.set_parameters(parameters);
        self.normal.clear();
        let mut sums = SquareSums::new();
        for batch in self.train.batches() {
            if is_set(self.stop) {
                return f64::NAN;
            }
            let estimates = self.propagation.forward(batch.inputs);
            sums.add(self.arch, estimates, &batch, &mut self.residuals);
            self.propagation.backward();
            self.normal.add(&self.propagation, &self.residuals, batch.samples);
        }
        self.normal.write(1.0 / self.train.residual_count(), hessian, gradient);
        sums.total() / self.train.residual_count()
    }

    fn stopped(&self) -> bool {
        is_set(self.stop)
    }

    fn validation_cost(&mut self, parameters: &[f64]) -> Option<f64> {
        self.propagation.set_parameters(parameters);
        let samples = self.validation.as_ref()?;
        let (propagation, residuals) = (&mut self.propagation, &mut self.residuals);
        Some(mean_squared_error(self.arch, samples, propagation, residuals, self.stop))
    }

    fn test_cost(&mut self, parameters: &[f64]) -> Option<f64> {
        self.propagation.set_parameters(parameters);
        let samples = self.test.as_ref()?;
        let (propagation, residuals) = (&mut self.propagation, &mut self.residuals);
        Some(mean_squared_error(self.arch, samples, propagation, residuals, self.stop))
    }
}

/// Whether training must end at once.
fn is_set(stop: Option<&AtomicBool>) -> bool {
    stop.is_some_and(|stop| stop.load(Ordering::Relaxed))
}

/// Computes E over `samples` for the parameters set in `propagation`; unspecified once `stop` is
/// true.
fn mean_squared_error(
    arch: Arch,
    samples: &Samples,
    propagation: &mut Propagation,
    residuals: &mut [f64],
    stop: Option<&AtomicBool>,
) -> f64 {
    let mut sums = SquareSums::new();
    for batch in samples.batches() {
        if is_set(stop) {
            break;
        }
        sums.add(arch, propagation.forward(batch.inputs), &batch, residuals);
    }
    sums.total() / samples.residual_count()
}

/// A data set in batches of quantity-major rows; the last batch is padded with zeros.
#[derive(Clone, Debug, Default)]
struct Samples {
    count: usize,
    /// n, and inputs of a sample.
    sizes: [usize; 2],
    /// Shape `[batches][inputs][BATCH]`.
    inputs: Vec<f64>,
    /// Shape `[batches][n][BATCH]`.
    targets: Vec<f64>,
}

/// One batch of rows of [`BATCH`], of which the first `samples` count.
struct Batch<'a> {
    inputs: &'a [f64],
    targets: &'a [f64],
    samples: usize,
}

impl Samples {
    fn new(data: &Dataset) -> Self {
        let (count, dimension, width) = (data.len(), data.dimension(), data.width());
        let by_quantity = |rows: &[f64], width: usize| {
            let block = width * BATCH;
            let mut batches = vec![0.0; count.div_ceil(BATCH) * block];
            for (s, row) in rows.chunks_exact(width).enumerate() {
                for (i, value) in row.iter().enumerate() {
                    batches[s / BATCH * block + i * BATCH + s % BATCH] = *value;
                }
            }
            batches
        };
        let inputs = by_quantity(data.inputs(), width);
        let targets = by_quantity(data.targets(), dimension);
        Self { count, sizes: [dimension, width], inputs, targets }
    }

    fn batches(&self) -> impl Iterator<Item = Batch<'_>> {
        let [targets, inputs] = self.sizes.map(|size| size * BATCH);
        self.inputs.chunks_exact(inputs).zip(self.targets.chunks_exact(targets)).enumerate().map(
            |(index, (inputs, targets))| Batch {
                inputs,
                targets,
                samples: BATCH.min(self.count - index * BATCH),
            },
        )
    }

    /// Returns M as a divisor.
    fn residual_count(&self) -> f64 {
        (self.count * self.sizes[0]) as f64
    }
}

/// Σ e², one sum per position in a batch.
struct SquareSums([f64; BATCH]);

impl SquareSums {
    fn new() -> Self {
        Self([0.0; BATCH])
    }

    /// Writes estimate − target of a batch to `residuals` and adds their squares.
    fn add(&mut self, arch: Arch, estimates: &[f64], batch: &Batch<'_>, residuals: &mut [f64]) {
        let sums = &mut self.0[..batch.samples];
        arch.dispatch(SubtractAndSquare { estimates, targets: batch.targets, residuals, sums });
    }

    fn total(&self) -> f64 {
        self.0.iter().fold(0.0, |sum, square| sum + square)
    }
}

/// `residuals = estimates − targets`, `sums += residuals²`.
struct SubtractAndSquare<'a> {
    estimates: &'a [f64],
    targets: &'a [f64],
    residuals: &'a mut [f64],
    sums: &'a mut [f64],
}

impl WithSimd for SubtractAndSquare<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let rows = self.estimates.chunks_exact(BATCH).zip(self.targets.chunks_exact(BATCH));
        for ((estimates, targets), residuals) in rows.zip(self.residuals.chunks_exact_mut(BATCH)) {
            for s in 0..BATCH {
                residuals[s] = estimates[s] - targets[s];
            }
            for (sum, residual) in self.sums.iter_mut().zip(&*residuals) {
                *sum += residual * residual;
            }
        }
    }
}
