//! Training samples and their random split into training, validation and test sets.
//!
//! Cost: one copy of the samples.
//!
//! Invariants: a [`Dataset`] has at least one sample and only finite numbers. The three sets of a
//! split are disjoint, together contain every sample, and keep the original order; the same seed
//! gives the same split on every machine.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Inputs x̂, which known inputs of the plant may follow, and targets ẋ̂.
#[derive(Clone, Debug, PartialEq)]
pub struct Dataset {
    dimension: usize,
    /// Inputs per sample: n and the known inputs.
    width: usize,
    inputs: Vec<f64>,
    targets: Vec<f64>,
}

/// The part of the data that an error refers to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// The inputs x̂.
    Inputs,
    /// The targets ẋ̂.
    Targets,
}

/// Why data cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum DataError {
    /// The dimension is 0.
    #[error("the dimension of the data is 0")]
    Dimension,
    /// A length is not a multiple of the dimension, or the lengths differ.
    #[error(
        "{inputs} input and {targets} target values do not form samples of dimension {dimension}"
    )]
    Length {
        /// Number of input values.
        inputs: usize,
        /// Number of target values.
        targets: usize,
        /// Dimension n.
        dimension: usize,
    },
    /// A value is infinite or NaN.
    #[error("non-finite value in {part:?}: sample {sample}, component {component}")]
    NotFinite {
        /// Inputs or targets.
        part: Part,
        /// Index of the sample.
        sample: usize,
        /// Index of the component.
        component: usize,
    },
    /// Fewer samples than needed.
    #[error("{found} samples, but at least {needed} are required")]
    TooFewSamples {
        /// Number of samples.
        found: usize,
        /// Number of samples required.
        needed: usize,
    },
    /// A fraction of the split is negative or not finite, or there is nothing to train on.
    #[error("split {split:?}, expected three fractions >= 0, the first above 0")]
    Split {
        /// The fractions.
        split: [f64; 3],
    },
}

impl Dataset {
    /// Creates samples of dimension n; `inputs` and `targets` are row-major, shape `[samples][n]`.
    ///
    /// # Errors
    /// If the lengths do not match, there are no samples, or a value is not finite.
    pub fn new(dimension: usize, inputs: Vec<f64>, targets: Vec<f64>) -> Result<Self, DataError> {
        Self::with_known_inputs(dimension, 0, inputs, targets)
    }

    /// Creates samples of dimension n with p known inputs; `inputs` are row-major, shape
    /// `[samples][n + p]`, `targets` of shape `[samples][n]`.
    ///
    /// # Errors
    /// Same as [`Self::new`].
    pub fn with_known_inputs(
        dimension: usize,
        known: usize,
        inputs: Vec<f64>,
        targets: Vec<f64>,
    ) -> Result<Self, DataError> {
        if dimension == 0 {
            return Err(DataError::Dimension);
        }
        let width = dimension + known;
        let samples = targets.len() / dimension;
        if inputs.len() != samples * width || !targets.len().is_multiple_of(dimension) {
            let (inputs, targets) = (inputs.len(), targets.len());
            return Err(DataError::Length { inputs, targets, dimension });
        }
        if inputs.is_empty() {
            return Err(DataError::TooFewSamples { found: 0, needed: 1 });
        }
        for (part, values, width) in
            [(Part::Inputs, &inputs, width), (Part::Targets, &targets, dimension)]
        {
            if let Some(index) = values.iter().position(|value| !value.is_finite()) {
                let (sample, component) = (index / width, index % width);
                return Err(DataError::NotFinite { part, sample, component });
            }
        }
        Ok(Self { dimension, width, inputs, targets })
    }

    /// Creates other samples with the same numbers of inputs and targets.
    ///
    /// # Errors
    /// Same as [`Self::new`].
    pub fn of_shape(&self, inputs: Vec<f64>, targets: Vec<f64>) -> Result<Self, DataError> {
        Self::with_known_inputs(self.dimension, self.known_inputs(), inputs, targets)
    }

    /// Returns the number of samples.
    #[must_use]
    #[allow(clippy::len_without_is_empty, reason = "a data set is never empty")]
    pub fn len(&self) -> usize {
        self.targets.len() / self.dimension
    }

    /// Returns n, the dimension of the targets.
    #[must_use]
    pub fn dimension(&self) -> usize {
        self.dimension
    }

    /// Returns n + p, the number of inputs of a sample.
    #[must_use]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Returns p, the number of known inputs.
    #[must_use]
    pub fn known_inputs(&self) -> usize {
        self.width - self.dimension
    }

    /// Returns the inputs, row-major, shape `[samples][n + p]`.
    #[must_use]
    pub fn inputs(&self) -> &[f64] {
        &self.inputs
    }

    /// Returns the targets, row-major, shape `[samples][n]`.
    #[must_use]
    pub fn targets(&self) -> &[f64] {
        &self.targets
    }

    /// Replaces the values, which must be finite, for the same number of samples.
    pub(super) fn with_values(&self, inputs: Vec<f64>, targets: Vec<f64>) -> Self {
        debug_assert_eq!((inputs.len(), targets.len()), (self.inputs.len(), self.targets.len()));
        Self { dimension: self.dimension, width: self.width, inputs, targets }
    }

    /// Returns the samples with the given indices, or `None` if there are none.
    ///
    /// # Panics
    /// If an index is out of range.
    #[must_use]
    pub fn select(&self, indices: &[usize]) -> Option<Self> {
        let rows = |values: &[f64], n: usize| -> Vec<f64> {
            indices.iter().flat_map(|&s| values[s * n..][..n].iter().copied()).collect()
        };
        (!indices.is_empty()).then(|| Self {
            dimension: self.dimension,
            width: self.width,
            inputs: rows(&self.inputs, self.width),
            targets: rows(&self.targets, self.dimension),
        })
    }

    /// Splits the samples at random into training, validation and test sets of the given
    /// proportions.
    ///
    /// # Errors
    /// [`DataError::Split`] or, if the training set would be empty,
    /// [`DataError::TooFewSamples`].
    pub fn divide(&self, split: [f64; 3], seed: u64) -> Result<Division, DataError> {
        let indices = divide_at_random(self.len(), split, seed)?;
        let [train, validation, test] = &indices;
        Ok(Division {
            train: self.select(train).ok_or(DataError::TooFewSamples { found: 0, needed: 1 })?,
            validation: self.select(validation),
            test: self.select(test),
        })
    }
}

/// Three disjoint subsets of a data set.
#[derive(Clone, Debug, PartialEq)]
pub struct Division {
    /// Used to fit the parameters.
    pub train: Dataset,
    /// Used to stop before training fits noise.
    pub validation: Option<Dataset>,
    /// Used for reporting only.
    pub test: Option<Dataset>,
}

impl Division {
    /// Applies `change` to each subset.
    #[must_use]
    pub fn map(&self, change: impl Fn(&Dataset) -> Dataset) -> Self {
        Self {
            train: change(&self.train),
            validation: self.validation.as_ref().map(&change),
            test: self.test.as_ref().map(&change),
        }
    }
}

/// Returns the indices of training, validation and test set, each ascending.
///
/// As in the toolbox's `dividerand`, validation and test get their rounded share of a random
/// permutation, and training gets the rest.
///
/// # Errors
/// [`DataError::Split`] or [`DataError::TooFewSamples`].
pub fn divide_at_random(
    samples: usize,
    split: [f64; 3],
    seed: u64,
) -> Result<[Vec<usize>; 3], DataError> {
    if split.iter().any(|share| !(*share >= 0.0 && share.is_finite())) || split[0] <= 0.0 {
        return Err(DataError::Split { split });
    }
    let total = split[0] + split[1] + split[2];
    let validation = rounded_share(samples, split[1] / total);
    let test = rounded_share(samples, split[2] / total);
    let needed = validation + test + 1;
    if samples < needed {
        return Err(DataError::TooFewSamples { found: samples, needed });
    }
    let mut rest = permutation(samples, &mut ChaCha8Rng::seed_from_u64(seed));
    let mut last = rest.split_off(samples - test);
    let mut middle = rest.split_off(samples - test - validation);
    for part in [&mut rest, &mut middle, &mut last] {
        part.sort_unstable();
    }
    Ok([rest, middle, last])
}

#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "between 0 and samples")]
fn rounded_share(samples: usize, share: f64) -> usize {
    (samples as f64 * share).round() as usize
}

/// Shuffles 0..count by Fisher and Yates.
fn permutation(count: usize, generator: &mut impl Rng) -> Vec<usize> {
    let mut indices: Vec<usize> = (0..count).collect();
    for last in (1..count).rev() {
        indices.swap(last, below(last + 1, generator));
    }
    indices
}

/// Draws uniformly from 0..bound without bias: draws above the last multiple of `bound` are
/// repeated.
#[allow(clippy::cast_possible_truncation, reason = "below `bound`, a usize")]
fn below(bound: usize, generator: &mut impl Rng) -> usize {
    let bound = bound as u64;
    let excess = (u64::MAX % bound + 1) % bound;
    loop {
        let draw = generator.next_u64();
        if draw <= u64::MAX - excess {
            return (draw % bound) as usize;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn rejects_inconsistent_data() {
        assert_eq!(Dataset::new(0, vec![], vec![]), Err(DataError::Dimension));
        assert_eq!(
            Dataset::new(2, vec![0.0; 4], vec![0.0; 6]),
            Err(DataError::Length { inputs: 4, targets: 6, dimension: 2 })
        );
        assert_eq!(
            Dataset::new(2, vec![0.0; 3], vec![0.0; 3]),
            Err(DataError::Length { inputs: 3, targets: 3, dimension: 2 })
        );
        assert_eq!(
            Dataset::new(2, vec![], vec![]),
            Err(DataError::TooFewSamples { found: 0, needed: 1 })
        );
        let error = DataError::NotFinite { part: Part::Targets, sample: 1, component: 0 };
        assert_eq!(Dataset::new(2, vec![0.0; 4], vec![0.0, 0.0, f64::NAN, 0.0]), Err(error));
        assert_eq!(error.to_string(), "non-finite value in Targets: sample 1, component 0");
        let data = Dataset::new(1, vec![1.0, 2.0], vec![3.0, 4.0]).expect("fits");
        assert_eq!(data.select(&[1]), Some(Dataset::new(1, vec![2.0], vec![4.0]).expect("fits")));
        let split = [0.0, 1.0, 0.0];
        assert_eq!(data.divide(split, 1), Err(DataError::Split { split }));
        let error = DataError::TooFewSamples { found: 2, needed: 3 };
        assert_eq!(data.divide([0.01, 1.0, 0.0], 1), Err(error));
        let whole = data.divide([1.0, 0.0, 0.0], 1).expect("valid");
        assert_eq!((whole.train, whole.validation, whole.test), (data, None, None));
    }

    #[test]
    fn split_of_the_paper_has_the_papers_sizes() {
        let sizes = divide_at_random(6000, [0.7, 0.15, 0.15], 3).expect("valid").map(|p| p.len());
        assert_eq!(sizes, [4200, 900, 900]);
    }

    proptest! {
        #[test]
        fn subsets_partition_the_samples(
            samples in 4usize..500, validation in 0.0..0.3f64, test in 0.0..0.3f64, seed: u64,
        ) {
            let split = [1.0 - validation - test, validation, test];
            let parts = divide_at_random(samples, split, seed).expect("enough samples");
            prop_assert_eq!(&parts, &divide_at_random(samples, split, seed).expect("same"));
            for (part, share) in parts[1..].iter().zip([validation, test]) {
                prop_assert!((part.len() as f64 - samples as f64 * share).abs() <= 0.5 + 1e-9);
            }
            prop_assert!(parts.iter().all(|part| part.is_sorted()));
            let mut all = parts.concat();
            all.sort_unstable();
            prop_assert_eq!(all, (0..samples).collect::<Vec<_>>());
        }

        #[test]
        fn different_seeds_give_different_splits(seed in 0..u64::MAX) {
            let division = |seed| divide_at_random(100, [0.7, 0.15, 0.15], seed).expect("valid");
            prop_assert_ne!(division(seed), division(seed + 1));
        }
    }
}
