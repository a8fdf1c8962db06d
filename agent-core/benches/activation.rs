//! Benchmarks the activations on slices of 12 and 64 values against libm and micromath.
//!
//! `cargo bench -p agent-core --bench activation`

use agent_core::math::activation::Activation;
use divan::{Bencher, black_box};
use micromath::F32Ext;

fn main() {
    divan::main();
}

/// The width of a small layer and the largest width.
const WIDTHS: [usize; 2] = [12, 64];

/// Times `apply` on `width` values spread over [-3, 3], including the copy into place.
fn run(bencher: Bencher, width: usize, mut apply: impl FnMut(&mut [f32])) {
    let mut source = [0.0f32; 64];
    let mut bits = 0u16;
    for value in &mut source {
        // A full-period linear congruence: covers all octants and has no pattern that a branch
        // predictor could learn.
        bits = bits.wrapping_mul(25_173).wrapping_add(13_849);
        *value = (f32::from(bits) / 32_768.0 - 1.0) * 3.0;
    }
    let mut values = source;
    bencher.counter(divan::counter::ItemsCount::new(width)).bench_local(|| {
        let values = &mut values[..width];
        values.copy_from_slice(&black_box(&source)[..width]);
        apply(black_box(values));
    });
}

#[divan::bench(args = WIDTHS)]
fn tanh(bencher: Bencher, width: usize) {
    run(bencher, width, |values| Activation::Tanh.apply(values));
}

#[divan::bench(args = WIDTHS)]
fn tanh_libm(bencher: Bencher, width: usize) {
    run(bencher, width, |values| values.iter_mut().for_each(|v| *v = libm::tanhf(*v)));
}

#[divan::bench(args = WIDTHS)]
fn tanh_micromath(bencher: Bencher, width: usize) {
    run(bencher, width, |values| {
        for v in values {
            let e = F32Ext::exp(2.0 * v.clamp(-9.0, 9.0));
            *v = (e - 1.0) / (e + 1.0);
        }
    });
}

#[divan::bench(args = WIDTHS)]
fn logistic(bencher: Bencher, width: usize) {
    run(bencher, width, |values| Activation::Logistic.apply(values));
}

#[divan::bench(args = WIDTHS)]
fn logistic_micromath(bencher: Bencher, width: usize) {
    run(bencher, width, |values| {
        values.iter_mut().for_each(|v| *v = 1.0 / (1.0 + F32Ext::exp(-*v)));
    });
}

#[divan::bench(args = WIDTHS)]
fn gaussian(bencher: Bencher, width: usize) {
    run(bencher, width, |values| Activation::Gaussian.apply(values));
}

#[divan::bench(args = WIDTHS)]
fn gaussian_micromath(bencher: Bencher, width: usize) {
    run(bencher, width, |values| values.iter_mut().for_each(|v| *v = F32Ext::exp(-*v * *v)));
}
