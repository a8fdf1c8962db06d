//! An array of a file: decoding, element order, and rounding to float32.

use std::borrow::Cow;
use std::mem;

use agent_core::observer::network::LAYER_WIDTH_MAX;

use super::TensorProblem;
use super::error::{Extent, fits};

/// Maximum number of elements of an array: the weights between two of the widest layers.
pub(super) const ELEMENTS_MAX: usize = LAYER_WIDTH_MAX * LAYER_WIDTH_MAX;

/// An array as stored in a file.
#[derive(Clone, Debug)]
pub(super) struct StoredArray<'f> {
    pub(super) name: String,
    pub(super) shape: Vec<usize>,
    pub(super) element: Element,
    /// Whether the first index varies fastest, as in Fortran.
    pub(super) first_index_fastest: bool,
    /// The elements; may be empty if there are more than [`ELEMENTS_MAX`].
    pub(super) bytes: Cow<'f, [u8]>,
}

/// Type of an array's elements.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Element {
    /// IEEE 754 binary32, little-endian.
    Float32,
    /// IEEE 754 binary64, little-endian.
    Float64,
    /// Any other type, as named in the file.
    Other(String),
}

impl Element {
    /// Returns the bytes per element of a supported type.
    pub(super) fn size(&self) -> Option<usize> {
        match self {
            Self::Float32 => Some(mem::size_of::<f32>()),
            Self::Float64 => Some(mem::size_of::<f64>()),
            Self::Other(_) => None,
        }
    }
}

/// The rounding of a float64 to float32.
#[derive(Clone, Debug, PartialEq)]
pub struct Rounding {
    /// Name of the array.
    pub array: String,
    /// Index in the array, from 0.
    pub index: Vec<usize>,
    /// The value in the file.
    pub value: f64,
    /// Distance between `value` and the nearest float32.
    pub error: f64,
}

/// Returns the number of elements of an array, `None` on overflow.
pub(super) fn element_count(shape: &[usize]) -> Option<usize> {
    shape.iter().try_fold(1usize, |count, &extent| count.checked_mul(extent))
}

impl StoredArray<'_> {
    /// Returns the elements in row-major order, as float32. Updates `rounding` if a larger one
    /// occurs.
    pub(super) fn values(
        &self,
        expected: &[Extent],
        rounding: &mut Option<Rounding>,
    ) -> Result<Vec<f32>, TensorProblem> {
        if !fits(&self.shape, expected) {
            return Err(TensorProblem::Shape {
                array: self.name.clone(),
                found: self.shape.clone(),
                expected: expected.to_vec(),
            });
        }
        let stored: Vec<f64> = match &self.element {
            Element::Float32 => decoded(&self.bytes, |bytes| f32::from_le_bytes(bytes).into()),
            Element::Float64 => decoded(&self.bytes, f64::from_le_bytes),
            Element::Other(found) => {
                let (array, found) = (self.name.clone(), found.clone());
                return Err(TensorProblem::ElementType { array, found });
            }
        };
        let expected = element_count(&self.shape);
        if expected != Some(stored.len()) {
            let reason = format!("{} elements for the shape {:?}", stored.len(), self.shape);
            return Err(TensorProblem::Array { array: self.name.clone(), reason });
        }
        (0..stored.len())
            .map(|position| {
                let index = self.index(position);
                self.rounded(stored[self.offset(&index)], index, rounding)
            })
            .collect()
    }

    /// Returns the index of the element at `position` in row-major order.
    fn index(&self, mut position: usize) -> Vec<usize> {
        let mut index = vec![0; self.shape.len()];
        for (index, &extent) in index.iter_mut().zip(&self.shape).rev() {
            *index = position % extent;
            position /= extent;
        }
        index
    }

    /// Returns the position of the element at `index` in the file.
    fn offset(&self, index: &[usize]) -> usize {
        let nested = |offset, (&index, &extent): (&usize, &usize)| offset * extent + index;
        let pairs = index.iter().zip(&self.shape);
        if self.first_index_fastest { pairs.rev().fold(0, nested) } else { pairs.fold(0, nested) }
    }

    fn rounded(
        &self,
        value: f64,
        index: Vec<usize>,
        rounding: &mut Option<Rounding>,
    ) -> Result<f32, TensorProblem> {
        let array = || self.name.clone();
        if !value.is_finite() {
            return Err(TensorProblem::NotFinite { array: array(), index, value });
        }
        // To nearest, ties to even. Float32 values are unchanged by the conversion to float64 and
        // back.
        let nearest = value as f32;
        if nearest.is_infinite() {
            return Err(TensorProblem::OutOfRange { array: array(), index, value });
        }
        let error = (f64::from(nearest) - value).abs();
        if error > rounding.as_ref().map_or(0.0, |largest| largest.error) {
            *rounding = Some(Rounding { array: array(), index, value, error });
        }
        Ok(nearest)
    }
}

fn decoded<const SIZE: usize>(bytes: &[u8], decode: impl Fn([u8; SIZE]) -> f64) -> Vec<f64> {
    bytes.as_chunks().0.iter().map(|&chunk| decode(chunk)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const MATRIX: [Extent; 2] = [Extent::Exactly("rows", 2), Extent::UpTo("columns", 4)];

    fn stored(values: &[f64], shape: &[usize]) -> StoredArray<'static> {
        StoredArray {
            name: "a".to_owned(),
            shape: shape.to_vec(),
            element: Element::Float64,
            first_index_fastest: false,
            bytes: values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>().into(),
        }
    }

    #[test]
    fn both_element_orders_give_the_same_rows() {
        let rows = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let by_columns = StoredArray {
            first_index_fastest: true,
            ..stored(&[1.0, 4.0, 2.0, 5.0, 3.0, 6.0], &[2, 3])
        };
        let mut rounding = None;
        for array in [stored(&rows, &[2, 3]), by_columns] {
            assert_eq!(array.values(&MATRIX, &mut rounding).unwrap(), rows.map(|v| v as f32));
        }
        assert_eq!(rounding, None);
    }

    #[test]
    fn reports_the_largest_rounding() {
        let mut rounding = None;
        let values =
            stored(&[0.5, 0.1, -3.3, 1.0], &[2, 2]).values(&MATRIX, &mut rounding).unwrap();
        assert_eq!(values, [0.5, 0.1, -3.3, 1.0]);
        let largest = rounding.clone().unwrap();
        assert_eq!((largest.index.as_slice(), largest.value), (&[1, 0][..], -3.3));
        assert_eq!(largest.error, (f64::from(-3.3f32) + 3.3).abs());
        stored(&[0.1; 4], &[2, 2]).values(&MATRIX, &mut rounding).unwrap();
        assert_eq!(rounding, Some(largest), "replaced by a smaller one");
    }

    #[test]
    fn float32_values_keep_their_bits() {
        let bits = [0x8000_0000u32, 1, 0x7f7f_ffff, 0x0080_0000];
        let array = StoredArray {
            element: Element::Float32,
            bytes: bits.iter().flat_map(|b| b.to_le_bytes()).collect::<Vec<u8>>().into(),
            ..stored(&[], &[2, 2])
        };
        let mut rounding = None;
        let values = array.values(&MATRIX, &mut rounding).unwrap();
        assert_eq!(values.iter().map(|v| v.to_bits()).collect::<Vec<_>>(), bits);
        assert_eq!(rounding, None);
    }

    #[test]
    fn rejects_values_that_do_not_fit_float32() {
        let refused = |value| {
            let array = stored(&[0.0, 0.0, value, 0.0], &[2, 2]);
            array.values(&MATRIX, &mut None).unwrap_err().to_string()
        };
        assert!(refused(f64::NAN).contains("array `a` contains NaN at [1, 0]"));
        assert!(refused(f64::NEG_INFINITY).contains("array `a` contains -inf at [1, 0]"));
        assert!(refused(1e39).contains("array `a` contains 1e39 at [1, 0], beyond"));
    }

    #[test]
    fn checks_the_shape_first() {
        for shape in [&[2, 5][..], &[2, 0], &[2], &[2, 2, 1], &[4, 2]] {
            let problem = stored(&[], shape).values(&MATRIX, &mut None).unwrap_err();
            assert!(matches!(problem, TensorProblem::Shape { .. }), "{shape:?}: {problem}");
        }
        let transposed = stored(&[], &[4, 2]).values(&MATRIX, &mut None).unwrap_err().to_string();
        assert!(transposed.contains("[4, 2], expected [rows 2, columns 1 to 4]; transpose it"));
        let short = stored(&[1.0], &[2, 2]).values(&MATRIX, &mut None).unwrap_err().to_string();
        assert!(short.contains("1 elements for the shape [2, 2]"), "{short}");
    }
}
