//! Sums and a square root whose results are fixed by the source, bit for bit.
//!
//! nalgebra stores the vectors and matrices. Its products are not used, because a feature enabled
//! by another crate can route them to a fused or reordered kernel. Here every sum starts at zero
//! and adds its terms in ascending order.

use micromath::F32Ext;
use nalgebra::{ArrayStorage, SMatrix, SVector};

/// Repeats a block for every `lane` below a constant, in ascending order; up to the largest dimension of a
/// node without a loop: firmware is optimised for size, where the compiler unrolls none, and a loop of
/// three turns takes three times the instructions of its body.
macro_rules! unrolled {
    ($lane:ident < $count:ident, $body:block) => {
        unrolled!($lane, $count, $body, 0 1 2 3 4 5 6 7 8 9 10 11);
        if $count > crate::NODE_DIMENSION_MAX {
            #[allow(clippy::needless_range_loop, reason = "the form of the turns above")]
            for $lane in crate::NODE_DIMENSION_MAX..$count $body
        }
    };
    ($lane:ident, $count:ident, $body:block, $($number:literal)*) => {$(
        if $number < $count {
            let $lane: usize = $number;
            $body
        }
    )*};
}
pub(crate) use unrolled;

/// Calls `work` with each item. Tests for another item at the end of a turn, not at its beginning:
/// optimised for size a loop stays as it is written, and this saves up to four instructions a turn.
#[inline(always)]
pub(crate) fn for_each<T>(items: impl IntoIterator<Item = T>, mut work: impl FnMut(T)) {
    let mut items = items.into_iter();
    let Some(mut item) = items.next() else { return };
    loop {
        work(item);
        match items.next() {
            Some(next) => item = next,
            None => return,
        }
    }
}

/// The zero vector. A constant, because an array expression of this size would be filled in a loop.
#[inline(always)]
pub(crate) const fn zeros<const N: usize>() -> SVector<f32, N> {
    const { SVector::from_array_storage(ArrayStorage([[0.0; N]])) }
}

/// Returns the components of a vector, for loops without nalgebra's iterators.
#[inline(always)]
pub(crate) fn components<const N: usize>(vector: &SVector<f32, N>) -> &[f32; N] {
    let [column] = &vector.data.0;
    column
}

/// Mutable version of [`components`].
#[inline(always)]
pub(crate) fn components_mut<const N: usize>(vector: &mut SVector<f32, N>) -> &mut [f32; N] {
    let [column] = &mut vector.data.0;
    column
}

/// Returns the inner product of two vectors, adding terms in ascending order.
#[inline(always)]
#[must_use]
pub fn dot<const N: usize>(a: &SVector<f32, N>, b: &SVector<f32, N>) -> f32 {
    let (a, b) = (components(a), components(b));
    let mut sum = 0.0;
    unrolled!(lane < N, { sum += a[lane] * b[lane] });
    sum
}

/// Returns `matrix * vector`, adding each component's terms in ascending order of the column.
#[inline(always)]
#[must_use]
pub fn product<const R: usize, const C: usize>(
    matrix: &SMatrix<f32, R, C>,
    vector: &SVector<f32, C>,
) -> SVector<f32, R> {
    let mut result = zeros();
    for (column, &factor) in matrix.data.0.iter().zip(components(vector)) {
        let result = components_mut(&mut result);
        unrolled!(lane < R, { result[lane] += column[lane] * factor });
    }
    result
}

/// Adds `factor * vector` to `accumulator`, in place.
#[inline(always)]
pub fn add_scaled<const N: usize>(
    accumulator: &mut SVector<f32, N>,
    factor: f32,
    vector: &SVector<f32, N>,
) {
    let (accumulator, vector) = (components_mut(accumulator), components(vector));
    unrolled!(lane < N, { accumulator[lane] += factor * vector[lane] });
}

/// Returns `minuend - subtrahend`.
#[inline(always)]
#[must_use]
pub fn difference<const N: usize>(
    minuend: &SVector<f32, N>,
    subtrahend: &SVector<f32, N>,
) -> SVector<f32, N> {
    let mut result = *minuend;
    let (values, subtrahend) = (components_mut(&mut result), components(subtrahend));
    unrolled!(lane < N, { values[lane] -= subtrahend[lane] });
    result
}

/// Returns whether every component is finite.
#[inline]
#[must_use]
pub fn all_finite<const N: usize>(vector: &SVector<f32, N>) -> bool {
    let values = components(vector);
    let mut finite = true;
    unrolled!(lane < N, { finite &= values[lane].is_finite() });
    finite
}

/// Returns the square root of a positive number, to within 1 ulp for every normal argument.
///
/// Three steps of Newton's iteration refine micromath's estimate, whose relative error is below
/// 6.1e-2 (from the exponent's bits). Each step squares the relative error and halves it: 6.1e-2,
/// 1.9e-3, 1.8e-6, below half an ulp. Zero, negative and subnormal arguments give 0.
#[must_use]
pub fn square_root(x: f32) -> f32 {
    if x < f32::MIN_POSITIVE {
        return 0.0;
    }
    let mut root = F32Ext::sqrt(x);
    for _ in 0..3 {
        root = 0.5 * (root + x / root);
    }
    root
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn square_root_is_within_one_ulp_of_the_exact_root() {
        let mut checked = 0;
        for bits in (f32::MIN_POSITIVE.to_bits()..f32::MAX.to_bits()).step_by(10_007) {
            let x = f32::from_bits(bits);
            let exact = libm::sqrt(f64::from(x));
            let ulp =
                f64::from(f32::from_bits(square_root(x).to_bits() + 1)) - f64::from(square_root(x));
            let error = (f64::from(square_root(x)) - exact).abs() / ulp;
            assert!(error <= 1.0, "square_root({x:e}) is off by {error} ulp");
            checked += 1;
        }
        assert!(checked > 200_000);
        assert_eq!(square_root(0.0), 0.0);
        assert_eq!(square_root(-1.0), 0.0);
    }

    #[test]
    fn sums_keep_their_order() {
        // Beside 2^24, 1 is lost unless it is added last.
        let a = SVector::<f32, 3>::new(16_777_216.0, 1.0, -16_777_216.0);
        assert_eq!(dot(&a, &SVector::repeat(1.0)), 0.0);
        let b = SVector::<f32, 3>::new(16_777_216.0, -16_777_216.0, 1.0);
        assert_eq!(dot(&b, &SVector::repeat(1.0)), 1.0);
    }

    #[test]
    fn product_is_the_plain_double_loop_bit_for_bit() {
        const N: usize = 12;
        let matrix =
            SMatrix::<f32, N, N>::from_fn(|r, c| ((r * 31 + c * 17) % 23) as f32 / 7.0 - 1.5);
        let vector = SVector::<f32, N>::from_fn(|r, _| (r as f32 - 5.5) / 3.0);
        let result = product(&matrix, &vector);
        for row in 0..N {
            let mut sum = 0.0f32;
            for column in 0..N {
                sum += matrix[(row, column)] * vector[column];
            }
            assert_eq!(result[row].to_bits(), sum.to_bits());
        }
    }

    #[test]
    fn finiteness_checks_every_component() {
        assert!(all_finite(&SVector::<f32, 3>::new(1.0, -2.0, f32::MAX)));
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            for place in 0..3 {
                let mut vector = SVector::<f32, 3>::zeros();
                vector[place] = bad;
                assert!(!all_finite(&vector));
            }
        }
    }
}
