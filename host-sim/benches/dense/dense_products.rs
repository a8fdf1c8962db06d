//! One dense JᵀJ of the size of a Levenberg–Marquardt iteration on the paper's network, on one core.
//!
//! `cargo bench --manifest-path host-sim/benches/dense/Cargo.toml`
//!
//! These products are a lower bound for solvers with an explicit Jacobian: J of 12,600 × 425
//! (4,200 samples, 3 outputs) times its transpose, without computing J.

use divan::Bencher;
use faer::linalg::matmul::{matmul, triangular};
use faer::{Accum, Mat, Par};

const ROWS: usize = 12_600;
const PARAMETERS: usize = 425;

fn main() {
    divan::main();
}

fn jacobian() -> Mat<f64> {
    Mat::from_fn(ROWS, PARAMETERS, |i, j| libm::sin((i * PARAMETERS + j) as f64))
}

#[divan::bench]
fn dense_faer(bencher: Bencher<'_, '_>) {
    let j = jacobian();
    let mut product = Mat::<f64>::zeros(PARAMETERS, PARAMETERS);
    bencher.bench_local(|| {
        matmul(&mut product, Accum::Replace, j.transpose(), &j, 1.0, Par::Seq);
    });
}

#[divan::bench]
fn dense_faer_lower_half(bencher: Bencher<'_, '_>) {
    use triangular::BlockStructure::{Rectangular, TriangularLower};
    let j = jacobian();
    let mut product = Mat::<f64>::zeros(PARAMETERS, PARAMETERS);
    bencher.bench_local(|| {
        triangular::matmul(
            &mut product,
            TriangularLower,
            Accum::Replace,
            j.transpose(),
            Rectangular,
            &j,
            Rectangular,
            1.0,
            Par::Seq,
        );
    });
}

#[divan::bench]
#[allow(unsafe_code, reason = "matrixmultiply has no safe interface")]
fn dense_matrixmultiply(bencher: Bencher<'_, '_>) {
    let j: Vec<f64> = (0..ROWS * PARAMETERS).map(|i| libm::sin(i as f64)).collect();
    let mut product = vec![0.0; PARAMETERS * PARAMETERS];
    let (m, k) = (PARAMETERS, ROWS);
    bencher.bench_local(|| {
        // SAFETY: J is row-major with m columns and k rows, so Jᵀ has strides (1, m) and J has
        // (m, 1); the product is row-major, m by m. All three are allocated to that size.
        unsafe {
            let (j, product, stride) = (j.as_ptr(), product.as_mut_ptr(), PARAMETERS as isize);
            matrixmultiply::dgemm(
                m, k, m, 1.0, j, 1, stride, j, stride, 1, 0.0, product, stride, 1,
            );
        }
    });
}
