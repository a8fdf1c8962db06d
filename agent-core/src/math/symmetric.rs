//! Symmetric matrices in compact form: most gains are diagonal or a multiple of the identity, so
//! their zeros are not stored.
//!
//! Both gains use this form: the outer law applies `Gamma` in every step, and `K_1` of the observer
//! is transmitted in it and expanded once.
//!
//! Invariants: none until [`SymmetricMatrix::validate`] has succeeded.

use nalgebra::SMatrix;
use serde::{Deserialize, Serialize};

use crate::math::parameter::{ParameterError, finite, positive};

/// How a symmetric matrix is written down; packages number the forms in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum MatrixForm {
    /// A multiple of the identity.
    Scalar,
    /// The diagonal.
    Diagonal,
    /// All entries, row by row.
    Full,
}

impl MatrixForm {
    /// Every form, in the order of the numbers in packages.
    pub const ALL: [Self; 3] = [Self::Scalar, Self::Diagonal, Self::Full];

    /// Returns its name in reports.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Scalar => "scalar",
            Self::Diagonal => "diagonal",
            Self::Full => "full",
        }
    }

    /// Returns how many entries a matrix of shape `[size, size]` has in this form.
    #[must_use]
    pub const fn count(self, size: usize) -> usize {
        match self {
            Self::Scalar => 1,
            Self::Diagonal => size,
            Self::Full => size * size,
        }
    }

    /// Returns the matrix of this form with these entries, of which there is at least one.
    #[must_use]
    pub fn matrix(self, entries: &[f32]) -> SymmetricMatrix<'_> {
        match self {
            Self::Scalar => SymmetricMatrix::Scalar(entries.first().copied().unwrap_or(0.0)),
            Self::Diagonal => SymmetricMatrix::Diagonal(entries),
            Self::Full => SymmetricMatrix::Full(entries),
        }
    }
}

/// A symmetric matrix, shape `[size, size]`; its user knows which size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SymmetricMatrix<'a> {
    /// A multiple of the identity.
    Scalar(f32),
    /// The diagonal; all other entries are zero.
    Diagonal(&'a [f32]),
    /// All entries, in row-major order.
    Full(&'a [f32]),
}

impl SymmetricMatrix<'_> {
    /// Returns the form that it is written in.
    #[must_use]
    pub const fn form(&self) -> MatrixForm {
        match self {
            Self::Scalar(_) => MatrixForm::Scalar,
            Self::Diagonal(_) => MatrixForm::Diagonal,
            Self::Full(_) => MatrixForm::Full,
        }
    }

    /// # Errors
    /// A wrong number of entries for `size`, an entry that is not finite, or a full matrix that is
    /// not symmetric.
    pub fn validate(&self, parameter: &'static str, size: usize) -> Result<(), ParameterError> {
        let length = |expected: usize, found: usize| match expected == found {
            true => Ok(()),
            false => Err(ParameterError::Length { parameter, expected, found }),
        };
        finite(parameter, self.entries())?;
        match *self {
            Self::Scalar(_) => Ok(()),
            Self::Diagonal(diagonal) => length(size, diagonal.len()),
            Self::Full(entries) => {
                length(size * size, entries.len())?;
                for row in 0..size {
                    for column in 0..row {
                        if self.entry(row, column, size) != self.entry(column, row, size) {
                            return Err(ParameterError::NotSymmetric { parameter, row, column });
                        }
                    }
                }
                Ok(())
            }
        }
    }

    /// Checks that the diagonal is positive.
    ///
    /// # Errors
    /// A diagonal entry that is not above 0. Whether a full matrix is positive definite is checked
    /// on the host, which has memory for a factorisation.
    pub fn validate_diagonal(
        &self,
        parameter: &'static str,
        size: usize,
    ) -> Result<(), ParameterError> {
        let step = if matches!(self, Self::Full(_)) { size + 1 } else { 1 };
        let mut entries = self.entries();
        while let Some(&entry) = entries.first() {
            positive(parameter, entry)?;
            entries = entries.get(step..).unwrap_or_default();
        }
        Ok(())
    }

    /// Returns the stored entries.
    #[must_use]
    pub fn entries(&self) -> &[f32] {
        match self {
            Self::Scalar(entry) => core::slice::from_ref(entry),
            Self::Diagonal(entries) | Self::Full(entries) => entries,
        }
    }

    /// Returns an entry of the matrix; 0 where none is stored.
    fn entry(&self, row: usize, column: usize, size: usize) -> f32 {
        let place = match self {
            Self::Full(_) => row * size + column,
            _ if row != column => return 0.0,
            Self::Diagonal(_) => row,
            Self::Scalar(_) => 0,
        };
        self.entries().get(place).copied().unwrap_or(0.0)
    }

    /// Returns the full matrix; entries that are not stored are zero.
    #[must_use]
    pub fn unfold<const N: usize>(&self) -> SMatrix<f32, N, N> {
        let mut matrix = SMatrix::from([[0.0; N]; N]);
        for (column, entries) in matrix.data.0.iter_mut().enumerate() {
            for (row, entry) in entries.iter_mut().enumerate() {
                *entry = self.entry(row, column, N);
            }
        }
        matrix
    }

    /// Writes `matrix * vector` to `result`, adding terms in ascending order of the column.
    #[inline]
    pub fn apply(&self, vector: &[f32], result: &mut [f32]) {
        match *self {
            Self::Scalar(entry) => {
                for (result, value) in result.iter_mut().zip(vector) {
                    *result = entry * value;
                }
            }
            Self::Diagonal(diagonal) => {
                for ((result, value), entry) in result.iter_mut().zip(vector).zip(diagonal) {
                    *result = entry * value;
                }
            }
            Self::Full(entries) => {
                let mut rows: &[f32] = entries;
                for result in result {
                    let Some((row, rest)) = rows.split_at_checked(vector.len()) else { break };
                    *result = row.iter().zip(vector).fold(0.0, |sum, (entry, v)| sum + entry * v);
                    rows = rest;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::SymmetricMatrix::{Diagonal, Full, Scalar};
    use super::*;

    #[test]
    fn the_three_forms_of_a_matrix_agree_bit_for_bit() {
        let forms = [Scalar(3.0), Diagonal(&[3.0, 3.0]), Full(&[3.0, 0.0, 0.0, 3.0])];
        for form in forms {
            assert_eq!(form.validate("gain", 2), Ok(()));
            assert_eq!(form.validate_diagonal("gain", 2), Ok(()));
            assert_eq!(form.unfold::<2>(), SMatrix::<f32, 2, 2>::from_diagonal_element(3.0));
            let mut result = [0.0; 2];
            form.apply(&[0.3, -0.7], &mut result);
            assert_eq!(result, [3.0f32 * 0.3, 3.0f32 * -0.7]);
        }
    }

    #[test]
    fn a_form_and_its_entries_give_the_matrix_back() {
        let entries = [2.0, 0.5, 0.5, 3.0];
        for (index, form) in MatrixForm::ALL.into_iter().enumerate() {
            // The order is that of the numbers in packages.
            assert_eq!(form as usize, index);
            let matrix = form.matrix(&entries[..form.count(2)]);
            assert_eq!((matrix.form(), matrix.entries()), (form, &entries[..form.count(2)]));
            assert_eq!(matrix.validate("gain", 2), Ok(()), "{}", form.name());
        }
        assert_eq!(MatrixForm::ALL.map(|form| form.count(3)), [1, 3, 9]);
    }

    #[test]
    fn refuses_what_is_not_a_symmetric_matrix_of_this_size() {
        let not_symmetric = ParameterError::NotSymmetric { parameter: "gain", row: 2, column: 0 };
        let skew = [1.0, 0.5, 0.2, 0.5, 1.0, 0.0, 0.3, 0.0, 1.0];
        assert_eq!(Full(&skew).validate("gain", 3), Err(not_symmetric));
        assert!(Diagonal(&[1.0]).validate("gain", 2).is_err());
        assert!(Full(&[1.0; 3]).validate("gain", 2).is_err());
        assert!(Scalar(f32::NAN).validate("gain", 2).is_err());
        assert!(Full(&[1.0, f32::INFINITY, f32::INFINITY, 1.0]).validate("gain", 2).is_err());
        // A negative entry off the diagonal is allowed.
        assert!(Full(&[1.0, -0.5, -0.5, 1.0]).validate_diagonal("gain", 2).is_ok());
        assert!(Full(&[1.0, 0.5, 0.5, -1.0]).validate_diagonal("gain", 2).is_err());
        assert!(Diagonal(&[1.0, 0.0]).validate_diagonal("gain", 2).is_err());
        assert!(Scalar(-1.0).validate_diagonal("gain", 2).is_err());
    }
}
