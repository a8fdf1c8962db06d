//! Packages of trained networks: creation, acceptance by a node, and runs that do not depend on how
//! the agents got their networks.

use std::ops::ControlFlow;

use agent_core::package::{
    Capacity, Envelope, InUse, PackageError, Refusal, Requirements, SIGNATURE_BLOCK_LENGTH,
};
use host_sim::engine::{RunOptions, RunResult, Silent, run};
use host_sim::learning::trained::TrainingTask;
use host_sim::packages::check::check;
use host_sim::packages::{Draft, PackageBytes};
use host_sim::scenario::Scenario;
use host_sim::signing::OperatorKey;

use crate::sim::reproduce::paper;
use crate::sim::scenario_builder::{Described, SHORT_RECIPE, cycle, network, picks};

/// Limit of the overhead of the package of the paper's network. \[bytes\]
const OVERHEAD_MAX: usize = 160;

const ANYONE: Requirements<'static> =
    Requirements { public_key: None, in_use: None, capacity: Capacity::UNLIMITED };

fn learned(scenario: &Scenario) -> RunResult {
    run(scenario, RunOptions { seed: 0, learning: true, bounds: false }, &Silent).unwrap()
}

/// A scenario of a fraction of a second in which both agents learn.
fn short() -> Scenario {
    let mut scenario_builder =
        Described::linear(2, "path", [(picks(2, [0]), 1), (picks(2, [1]), 1)]);
    scenario_builder.duration = 0.8;
    scenario_builder.network = network(&[(4, "tanh"), (3, "logistic")], "2.0");
    scenario_builder.learning = cycle(&[1, 2], 0.1, 0.5, 0.6) + SHORT_RECIPE;
    let mut scenario = scenario_builder.scenario();
    scenario.record.samples = true;
    scenario
}

fn package() -> PackageBytes {
    learned(&short()).trainings[0].package.clone()
}

#[test]
fn overhead_of_the_papers_packages_is_at_most_160_bytes() {
    let result = learned(&paper("paper"));
    assert_eq!(result.trainings.len(), 3);
    for training in &result.trainings {
        let package = training.package.package();
        assert_eq!(package.network.parameters().len(), 425);
        let numbers = 425 + package.outer_weights.len() + package.test_vectors.len();
        let overhead = training.package.as_bytes().len() - 4 * numbers;
        assert!(overhead <= OVERHEAD_MAX, "agent {}: {overhead} bytes", training.agent);
    }
}

#[test]
fn rejects_every_single_bit_flip() {
    let unsigned = package();
    let signed = unsigned.signed(&OperatorKey::generate().unwrap());
    assert_eq!(signed.as_bytes().len(), unsigned.as_bytes().len() + SIGNATURE_BLOCK_LENGTH);
    for package in [unsigned, signed] {
        let mut bytes = package.as_bytes().to_vec();
        for bit in 0..8 * bytes.len() {
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert!(PackageBytes::new(&bytes).is_err(), "bit {bit}");
            bytes[bit / 8] ^= 1 << (bit % 8);
        }
        assert!(PackageBytes::new(&bytes).is_ok());
    }
}

#[test]
fn training_on_a_runs_samples_reproduces_its_package() {
    let scenario = short();
    for training in &learned(&scenario).trainings {
        let file = std::env::temp_dir().join(format!(
            "{}-samples-{}.csv",
            std::process::id(),
            training.agent
        ));
        training.recording.as_ref().unwrap().save(&file).unwrap();
        let network = scenario.network.as_ref().unwrap();
        let features = network.architecture.features();
        let recording =
            host_sim::packages::Recording::load(&file, scenario.dimension(), features).unwrap();
        std::fs::remove_file(&file).unwrap();
        let task = TrainingTask {
            scenario: &scenario,
            network,
            recipe: &scenario.recipes[0],
            agent: training.agent - 1,
            cycle: 0,
            seed: 0,
            version: training.package.package().version,
        };
        let trained = task.carry_out(&recording, &mut |_| ControlFlow::Continue(())).unwrap();
        assert_eq!(trained.package, training.package);
    }
}

#[test]
fn interrupted_training_gives_the_best_package_so_far() {
    let scenario = short();
    let training = &learned(&scenario).trainings[0];
    let task = TrainingTask {
        scenario: &scenario,
        network: scenario.network.as_ref().unwrap(),
        recipe: &scenario.recipes[0],
        agent: 0,
        cycle: 0,
        seed: 0,
        version: 7,
    };
    let recording = training.recording.as_ref().unwrap();
    let mut epochs = 0;
    let mut stop = |_: &_| {
        epochs += 1;
        if epochs == 3 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let trained = task.carry_out(recording, &mut stop).unwrap();
    assert_eq!(epochs, 3);
    let error = |report: &host_sim::training::TrainingReport| report.best().unwrap().train;
    assert!(error(&trained.report) < trained.report.epochs[0].train);
    check(&trained.package, &ANYONE).unwrap();
}

#[test]
fn starting_with_packages_reproduces_the_run() {
    // Passing the initial packages explicitly changes nothing.
    let scenario = short();
    let network = scenario.network.as_ref().unwrap();
    let trigger = host_sim::analysis::TriggerConstants::new(&scenario);
    let inner = {
        let trained =
            learned(&scenario).trainings[0].package.package().network.parameters().to_vec();
        vec![0.25; trained.len()]
    };
    let mut with = scenario.clone();
    for (index, agent) in with.agents.iter_mut().enumerate() {
        let package =
            host_sim::learning::trained::initial(&scenario, &trigger, network, &inner, index, 0);
        agent.package = Some(package.unwrap());
    }
    let mut filled = scenario.clone();
    filled.network.as_mut().unwrap().inner = host_sim::training::InitialParameters::Constant(0.25);
    assert_eq!(learned(&with).digest, learned(&filled).digest);
}

#[test]
fn trained_packages_estimate_better_from_the_start() {
    let scenario = paper("paper");
    let trainings = learned(&scenario).trainings;
    let mut with = scenario.clone();
    with.learning.clear();
    let baseline = learned(&with);
    for (agent, training) in with.agents.iter_mut().zip(&trainings) {
        agent.package = Some(training.package.clone());
    }
    for (with, without) in learned(&with).agents.iter().zip(&baseline.agents) {
        let (with, without) = (with.rmse().unwrap(), without.rmse().unwrap());
        assert!(with < 0.6 * without, "{with} with the package, {without} without");
    }
}

#[test]
fn rejects_a_package_for_another_node() {
    let scenario = short();
    let mut wrong = scenario.clone();
    wrong.agents[1].package = Some(package());
    let options = RunOptions { seed: 0, learning: true, bounds: false };
    let error = run(&wrong, options, &Silent).unwrap_err().to_string();
    assert!(error.contains("agent 2") && error.contains("agent number"), "{error}");
    let mut wrong = scenario.clone();
    wrong.design.gain *= 1.5;
    wrong.agents[0].package = Some(package());
    let error = run(&wrong, options, &Silent).unwrap_err().to_string();
    assert!(error.contains("gain K1") && error.contains("; "), "{error}");
}

#[test]
fn signatures_are_required_if_there_is_a_key() {
    let (key, other) = (OperatorKey::generate().unwrap(), OperatorKey::generate().unwrap());
    let node = Requirements { public_key: Some(key.public_key()), ..ANYONE };
    let unsigned = package();
    assert_eq!(check(&unsigned, &node).unwrap_err(), Refusal::Unsigned);
    assert_eq!(check(&unsigned.signed(&other), &node).unwrap_err(), Refusal::Signature);
    let signed = unsigned.signed(&key);
    assert_eq!(check(&signed, &node).unwrap(), unsigned.package());
    // Signing again replaces the signature.
    assert_eq!(unsigned.signed(&other).signed(&key), signed);
    // Without a key, a node accepts any signature that is not damaged.
    assert!(check(&unsigned.signed(&other), &ANYONE).is_ok());
    // A signature of another package.
    let draft = Draft { version: 9, ..Draft::copy(&unsigned.package()) };
    let forged = draft.seal().unwrap();
    let block = &signed.as_bytes()[unsigned.as_bytes().len()..];
    let forged = PackageBytes::new(&[forged.as_bytes(), block].concat()).unwrap();
    assert_eq!(check(&forged, &node).unwrap_err(), Refusal::Signature);
    // A changed signature with a matching checksum.
    let envelope = Envelope::open(signed.as_bytes()).unwrap();
    let mut changed = *envelope.signature.unwrap();
    changed[40] ^= 1;
    let block = agent_core::package::signature_block(&changed);
    let forged = PackageBytes::new(&[envelope.signed_part, &block].concat()).unwrap();
    assert_eq!(check(&forged, &node).unwrap_err(), Refusal::Signature);
}

#[test]
fn accepts_an_older_package_only_with_a_signature() {
    let key = OperatorKey::generate().unwrap();
    let package = package();
    let draft = Draft::copy(&package.package());
    let (agent, newer) = (draft.node.node().agent, draft.version + 1);
    let in_use = Some(InUse { agent, version: newer });
    let keyless = Requirements { in_use, ..ANYONE };
    let node = Requirements { public_key: Some(key.public_key()), ..keyless };
    let older = Refusal::Older { in_use: newer, found: draft.version };
    assert_eq!(check(&package.signed(&key), &node).unwrap_err(), older);
    let exception = Draft { replaces: Some(newer), ..draft.clone() }.seal().unwrap();
    assert!(check(&exception.signed(&key), &node).is_ok());
    assert_eq!(check(&exception, &keyless).unwrap_err(), older);
    assert_eq!(check(&exception.signed(&key), &keyless).unwrap_err(), older);
    let too_narrow = Draft { replaces: Some(draft.version), ..draft }.seal().unwrap();
    assert_eq!(check(&too_narrow.signed(&key), &node).unwrap_err(), older);
}

#[test]
fn does_not_seal_an_unacceptable_draft() {
    let draft = Draft::copy(&package().package());
    let far = Draft { outer_weights: vec![1e6; draft.outer_weights.len()], ..draft.clone() };
    assert!(far.seal().unwrap_err().to_string().contains("network.outer"));
    let short = Draft { outer_weights: vec![0.0], ..draft.clone() };
    assert!(short.seal().is_err());
    let infinite = Draft { inner: vec![f32::NAN; draft.inner.len()], ..draft.clone() };
    assert!(infinite.seal().is_err());
    let long = Draft { recipe: "x".repeat(4000), ..draft };
    assert_eq!(long.seal().unwrap().package().provenance.recipe.len(), 4000);
}

#[test]
fn rejects_a_file_that_is_not_a_package() {
    let path = std::env::temp_dir().join(format!("{}-no.weights", std::process::id()));
    std::fs::write(&path, b"not a package at all").unwrap();
    let error = PackageBytes::load(&path).unwrap_err().to_string();
    assert!(error.contains("no.weights") && error.contains("; "), "{error}");
    std::fs::remove_file(&path).unwrap();
    assert_eq!(PackageBytes::new(b"not a package at all").unwrap_err(), PackageError::Magic);
}
