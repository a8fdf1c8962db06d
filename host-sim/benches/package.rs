//! Cost on the host of all of a node's checks on a package of the paper's size (2,096 bytes, 425 +
//! 15 parameters, four test vectors): `cargo bench -p host-sim --bench package`.

use agent_core::observer::network::Scratch;
use agent_core::package::{Package, Requirements, accept};
use divan::{Bencher, black_box};
use host_sim::engine::{RunOptions, Silent, run};
use host_sim::packages::PackageBytes;
use host_sim::scenario::{PAPER, Scenario};
use host_sim::signing::OperatorKey;

fn main() {
    divan::main();
}

/// The package that agent 1 of the paper switches in.
fn paper_sized() -> PackageBytes {
    let scenario = Scenario::parse("paper.toml", PAPER).expect("the built-in scenario is valid");
    let options = RunOptions { seed: 0, learning: true, bounds: false };
    let result = run(&scenario, options, &Silent).expect("the built-in scenario runs");
    result.trainings[0].package.clone()
}

fn check(bencher: Bencher<'_, '_>, package: &PackageBytes, requirements: &Requirements<'_>) {
    let mut scratch = Scratch::NEW;
    bencher.bench_local(|| {
        accept::<3>(black_box(package.as_bytes()), requirements, &mut scratch)
            .map(|package| package.version)
            .expect("a valid package")
    });
}

const UNRESTRICTED: Requirements<'static> = Requirements::ANY;

#[divan::bench]
fn acceptance_unsigned(bencher: Bencher<'_, '_>) {
    check(bencher, &paper_sized(), &UNRESTRICTED);
}

#[divan::bench]
fn acceptance_signed(bencher: Bencher<'_, '_>) {
    let key = OperatorKey::generate().expect("random numbers");
    let requirements = Requirements { public_keys: &[*key.public_key()], ..UNRESTRICTED };
    check(bencher, &paper_sized().signed(&key), &requirements);
}

#[divan::bench]
fn decoding(bencher: Bencher<'_, '_>) {
    let package = paper_sized();
    bencher.bench_local(|| {
        Package::decode(black_box(package.as_bytes())).expect("a valid package").version
    });
}
