//! Measures the activations over every binary32 float.
//!
//! ```sh
//! cargo run --release -p agent-core --example activation_error
//! cargo run --release -p agent-core --example activation_error -- --stride 4099 --compare
//! ```
//!
//! `--stride K` takes every K-th float of each sign; `--compare` adds the libm crate's `tanhf` and
//! versions of the functions built on micromath's `exp`.
//!
//! The reference is the libm crate's binary64 function of the exact input. An error is |value -
//! reference| with the reference not rounded, in ulps of the binary32 binade that contains the
//! reference (2^-149 below the normal numbers). The resolution is the reference's own error, about
//! 2^-29 of such an ulp. Inputs are visited in the order of their bits, each sign separately, and
//! every value is compared with the previous one, including across the boundaries of the threads'
//! blocks.

use agent_core::math::activation::Activation;
use micromath::F32Ext;
use std::io::{IsTerminal, Write};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread;

#[path = "../inner-network/src/activation/laws.rs"]
#[allow(dead_code, reason = "the unit tests use the rest of the table")]
mod laws;

use laws::{Law, Symmetry, law};

/// A function under test and the properties it must have.
struct Subject {
    name: String,
    function: Box<dyn Fn(f32) -> f32 + Sync>,
    law: Law,
}

impl Subject {
    fn new(activation: Activation) -> Self {
        let function = Box::new(move |x| activation.value(x));
        Self { name: activation.name().to_owned(), function, law: law(activation) }
    }

    /// Another implementation of an activation.
    fn compared(activation: Activation, by: &str, function: fn(f32) -> f32) -> Self {
        let name = format!("{}, {by}", activation.name());
        Self { name, function: Box::new(function), law: law(activation) }
    }
}

/// Clamped, because micromath's `exp` otherwise ends in infinity over infinity.
fn micromath_tanh(x: f32) -> f32 {
    let e = F32Ext::exp(2.0 * x.clamp(-9.0, 9.0));
    (e - 1.0) / (e + 1.0)
}

fn micromath_logistic(x: f32) -> f32 {
    1.0 / (1.0 + F32Ext::exp(-x))
}

fn micromath_gaussian(x: f32) -> f32 {
    F32Ext::exp(-x * x)
}

fn compared() -> Vec<Subject> {
    vec![
        Subject::compared(Activation::Tanh, "libm tanhf", libm::tanhf),
        Subject::compared(Activation::Tanh, "micromath exp", micromath_tanh),
        Subject::compared(Activation::Logistic, "micromath exp", micromath_logistic),
        Subject::compared(Activation::Gaussian, "micromath exp", micromath_gaussian),
    ]
}

/// The result of a walk.
#[derive(Clone, Copy)]
struct Findings {
    worst_ulp: f64,
    worst_at: f32,
    worst_absolute: f64,
    monotone: bool,
    symmetric: bool,
    in_range: bool,
    nan_to_nan: bool,
}

impl Findings {
    const NONE: Self = Self {
        worst_ulp: 0.0,
        worst_at: 0.0,
        worst_absolute: 0.0,
        monotone: true,
        symmetric: true,
        in_range: true,
        nan_to_nan: true,
    };

    fn add_error(&mut self, x: f32, value: f32, reference: f64) {
        let absolute = (f64::from(value) - reference).abs();
        let ulp = absolute * reciprocal_ulp(reference);
        // On a tie the smaller |x| wins, so that the result does not depend on the threads.
        if ulp > self.worst_ulp || (ulp == self.worst_ulp && x.abs() < self.worst_at.abs()) {
            self.worst_ulp = ulp;
            self.worst_at = x;
        }
        self.worst_absolute = self.worst_absolute.max(absolute);
    }

    fn merge(&mut self, other: &Self) {
        if other.worst_ulp > self.worst_ulp
            || (other.worst_ulp == self.worst_ulp && other.worst_at.abs() < self.worst_at.abs())
        {
            self.worst_ulp = other.worst_ulp;
            self.worst_at = other.worst_at;
        }
        self.worst_absolute = self.worst_absolute.max(other.worst_absolute);
        self.monotone &= other.monotone;
        self.symmetric &= other.symmetric;
        self.in_range &= other.in_range;
        self.nan_to_nan &= other.nan_to_nan;
    }
}

/// 1 / (ulp of the binary32 binade of `reference`).
fn reciprocal_ulp(reference: f64) -> f64 {
    const BINARY64_BIAS: i64 = 1023;
    let stored = (reference.abs().to_bits() >> 52).cast_signed();
    let exponent = (stored - BINARY64_BIAS).max(-126);
    f64::from_bits((BINARY64_BIAS + 23 - exponent).cast_unsigned() << 52)
}

/// Bits of +infinity, one more than those of the largest finite float.
const INFINITY: u32 = 0x7f80_0000;
/// One more than the bits of the last NaN without sign.
const END: u32 = 0x8000_0000;
/// Samples that a thread processes at a time.
const BLOCK: u32 = 1 << 20;

/// Walks magnitudes `first`, `first + stride`, … below `end`, both signs of each.
fn walk(subject: &Subject, first: u32, end: u32, stride: u32) -> Findings {
    let function = &subject.function;
    let Law { reference, symmetry, falls, range, .. } = subject.law;
    let mut findings = Findings::NONE;
    let before = first.saturating_sub(stride);
    let mut last = (function(f32::from_bits(before)), function(-f32::from_bits(before)));
    if first == 0 {
        findings.monotone &= falls || last.1 <= last.0;
    }
    for bits in (first..end.min(INFINITY + 1)).step_by(stride as usize) {
        let x = f32::from_bits(bits);
        let (positive, negative) = (function(x), function(-x));
        findings.monotone &= if falls { positive <= last.0 } else { positive >= last.0 };
        findings.monotone &= negative <= last.1;
        last = (positive, negative);
        findings.in_range &= (range.0..=range.1).contains(&positive);
        findings.in_range &= (range.0..=range.1).contains(&negative);
        let expected = reference(f64::from(x));
        let expected_negative = match symmetry {
            Symmetry::Odd => {
                findings.symmetric &= negative.to_bits() == (-positive).to_bits();
                -expected
            }
            Symmetry::Even => {
                findings.symmetric &= negative.to_bits() == positive.to_bits();
                expected
            }
            Symmetry::None => reference(f64::from(-x)),
        };
        findings.add_error(x, positive, expected);
        findings.add_error(-x, negative, expected_negative);
    }
    for bits in (first..end).step_by(stride as usize).filter(|&bits| bits > INFINITY) {
        let x = f32::from_bits(bits);
        findings.nan_to_nan &= function(x).is_nan() && function(-x).is_nan();
    }
    findings
}

/// Walks all magnitudes on all cores.
fn measure(subject: &Subject, stride: u32) -> Findings {
    let samples = END.div_ceil(stride);
    let blocks = samples.div_ceil(BLOCK);
    let next = AtomicU32::new(0);
    let total = Mutex::new(Findings::NONE);
    let threads = thread::available_parallelism().map_or(1, usize::from);
    thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                loop {
                    let block = next.fetch_add(1, Ordering::Relaxed);
                    if block >= blocks {
                        break;
                    }
                    let first = block * BLOCK * stride;
                    let end = (u64::from(first) + u64::from(BLOCK) * u64::from(stride))
                        .min(u64::from(END));
                    let end = u32::try_from(end).unwrap_or(END);
                    let findings = walk(subject, first, end, stride);
                    total.lock().expect("no thread panics while it merges").merge(&findings);
                    if std::io::stderr().is_terminal() {
                        eprint!("\r{}: {} %   ", subject.name, (block + 1) * 100 / blocks);
                    }
                }
            });
        }
    });
    if std::io::stderr().is_terminal() {
        eprint!("\r\x1b[K");
    }
    total.into_inner().expect("no thread panicked")
}

fn yes(holds: bool) -> &'static str {
    if holds { "yes" } else { "NO" }
}

fn main() {
    let mut stride = 1;
    let mut compare = false;
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--compare" => compare = true,
            "--stride" => match arguments.next().map(|k| k.parse()) {
                Some(Ok(k @ 1..=0x0fff_ffff)) => stride = k,
                _ => {
                    eprintln!("invalid --stride: expected a number from 1 to 268435455");
                    std::process::exit(2);
                }
            },
            other => {
                eprintln!("unknown argument {other}: expected --stride K or --compare");
                std::process::exit(2);
            }
        }
    }
    println!(
        "{:24} {:>12} {:>14} {:>12}  monotone  symmetry  range  NaN",
        "function", "worst ulp", "at x", "worst abs"
    );
    let mut subjects: Vec<_> = Activation::ALL.map(Subject::new).into();
    if compare {
        subjects.extend(compared());
    }
    for subject in &subjects {
        let findings = measure(subject, stride);
        let symmetry = match subject.law.symmetry {
            Symmetry::Odd if findings.symmetric => "odd",
            Symmetry::Even if findings.symmetric => "even",
            Symmetry::None => "-",
            _ => "NO",
        };
        println!(
            "{:24} {:>12.4} {:>14e} {:>12.3e}  {:8}  {symmetry:8}  {:5}  {}",
            subject.name,
            findings.worst_ulp,
            findings.worst_at,
            findings.worst_absolute,
            yes(findings.monotone),
            yes(findings.in_range),
            yes(findings.nan_to_nan),
        );
        // Printed line by line even into a pipe, because a full walk takes minutes.
        std::io::stdout().flush().expect("standard output is open");
    }
}
