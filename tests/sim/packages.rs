//! Packages of trained networks: creation, acceptance by a node, and runs that do not depend on how
//! the agents got their networks.

use std::ops::ControlFlow;

use agent_core::math::symmetric::SymmetricMatrix;
use agent_core::package::{
    CHECKED_FIRST, EncodeError, Envelope, Format, HEADER2_LENGTH, PackageError, Refusal,
    Requirements, SIGNATURE_BLOCK_LENGTH, Serial, StepRange, signature_block,
};
use host_sim::engine::{RunOptions, RunResult, Silent, run};
use host_sim::learning::trained::TrainingTask;
use host_sim::packages::check::check;
use host_sim::packages::{Draft, PackageBytes};
use host_sim::scenario::Scenario;
use host_sim::signing::OperatorKey;

use crate::sim::reproduce::paper;
use crate::sim::scenario_builder::{Described, SHORT_RECIPE, cycle, network, picks};

/// Limit of the overhead of the package of the paper's network in format 1. \[bytes\]
const OVERHEAD_MAX: usize = 160;
/// What format 2 adds: header and signature block instead of 12 bytes, and 8 for each section.
const OVERHEAD2_MAX: usize = OVERHEAD_MAX + CHECKED_FIRST - 12 + 8 * 8;

const ANYONE: Requirements<'static> = Requirements::ANY;

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
fn overhead_of_the_papers_packages_is_bounded() {
    let result = learned(&paper("paper"));
    assert_eq!(result.trainings.len(), 3);
    for training in &result.trainings {
        let package = training.package.package();
        assert_eq!(package.network.parameters().len(), 425);
        let numbers = 425 + package.outer_weights.len() + package.test_vectors.len();
        for (format, most) in [(Format::One, OVERHEAD_MAX), (Format::Two, OVERHEAD2_MAX)] {
            let package = training.package.converted(format).unwrap();
            let overhead = package.as_bytes().len() - 4 * numbers;
            assert!(overhead <= most, "agent {}, {format:?}: {overhead} bytes", training.agent);
        }
    }
}

#[test]
fn rejects_every_single_bit_flip() {
    let key = OperatorKey::generate().unwrap();
    for format in [Format::One, Format::Two] {
        let unsigned = package().converted(format).unwrap();
        let signed = unsigned.signed(&key);
        let added = signed.as_bytes().len() - unsigned.as_bytes().len();
        assert_eq!(added, if format == Format::One { SIGNATURE_BLOCK_LENGTH } else { 0 });
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
}

#[test]
fn a_package_has_the_same_content_in_both_formats() {
    let two = package();
    assert_eq!(two.format(), Format::Two);
    let one = two.converted(Format::One).unwrap();
    assert_eq!(one.format(), Format::One);
    let mut content = two.package();
    content.trial = None;
    assert_eq!(one.package(), content);
    // Back again, all but the limits of the trial.
    let again = one.converted(Format::Two).unwrap();
    assert_eq!(again.package(), content);
    let next = Serial { epoch: 1, version: 4 };
    assert_eq!(one.with_serial(next).unwrap_err(), EncodeError::Epoch { epoch: 1 });
    let moved = two.with_serial(next).unwrap();
    assert_eq!(moved.package().serial(), next);
    assert_eq!(moved.converted(Format::One).unwrap_err(), EncodeError::Epoch { epoch: 1 });
    assert_eq!(two.replacing(9).unwrap_err(), EncodeError::Replaces);
    let far = Draft { node: two_with_agent(70_000), ..Draft::copy(&two.package()) };
    let far = far.seal().unwrap();
    assert_eq!(far.package().node.agent, 70_000);
    assert_eq!(far.converted(Format::One).unwrap_err(), EncodeError::Agent { id: 70_000 });
}

/// Returns the configuration of the package's node under another agent number.
fn two_with_agent(agent: u32) -> host_sim::packages::OwnedAgentConfig {
    let package = package();
    let mut node = package.package().node;
    node.agent = agent;
    host_sim::packages::OwnedAgentConfig::copy(&node)
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
            epoch: 0,
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
        epoch: 0,
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
    let node = Requirements { public_keys: &[*key.public_key()], ..ANYONE };
    let unsigned = package();
    assert_eq!(check(&unsigned, &node).unwrap_err(), Refusal::Unsigned);
    assert_eq!(check(&unsigned.signed(&other), &node).unwrap_err(), Refusal::Signature);
    let signed = unsigned.signed(&key);
    assert_eq!(check(&signed, &node).unwrap(), unsigned.package());
    // Signing again replaces the signature.
    assert_eq!(unsigned.signed(&other).signed(&key), signed);
    // Without a key, a node accepts any signature that is not damaged.
    assert!(check(&unsigned.signed(&other), &ANYONE).is_ok());
    // A signature of another package, and a changed one with a matching checksum.
    let with_block = |package: &PackageBytes, block: &[u8]| {
        let mut bytes = package.as_bytes().to_vec();
        bytes[HEADER2_LENGTH..CHECKED_FIRST].copy_from_slice(block);
        PackageBytes::new(&bytes).unwrap()
    };
    let draft = Draft { version: 9, ..Draft::copy(&unsigned.package()) };
    let block = &signed.as_bytes()[HEADER2_LENGTH..CHECKED_FIRST];
    let forged = with_block(&draft.seal().unwrap(), block);
    assert_eq!(check(&forged, &node).unwrap_err(), Refusal::Signature);
    let mut changed = *Envelope::open(signed.as_bytes()).unwrap().signature.unwrap();
    changed[40] ^= 1;
    let forged = with_block(&unsigned, &signature_block(&changed));
    assert_eq!(check(&forged, &node).unwrap_err(), Refusal::Signature);
}

#[test]
fn goes_back_by_the_next_epoch() {
    let package = package();
    let version = package.package().version;
    let serial = |epoch, version| Serial { epoch, version };
    let node = Requirements { highest: Some(serial(0, version + 5)), ..ANYONE };
    let older = Refusal::Older { highest: serial(0, version + 5), found: serial(0, version) };
    assert_eq!(check(&package, &node).unwrap_err(), older);
    let back = package.with_serial(serial(1, version)).unwrap();
    assert_eq!(check(&back, &node).unwrap().serial(), serial(1, version));
    // Once activated, neither it nor anything older.
    let after = node.serial_after_activation(&back.package());
    let node = Requirements { highest: Some(after), ..node };
    let repeated = Refusal::Repeated { serial: serial(1, version) };
    assert_eq!(check(&back, &node).unwrap_err(), repeated);
    let newest = package.with_serial(serial(0, u32::MAX)).unwrap();
    assert!(matches!(check(&newest, &node).unwrap_err(), Refusal::Older { .. }));
}

#[test]
fn accepts_an_older_package_of_format_1_only_with_a_signature_and_once() {
    let key = OperatorKey::generate().unwrap();
    let package = package().converted(Format::One).unwrap();
    let version = package.package().version;
    let serial = |version| Serial { epoch: 0, version };
    let newer = version + 1;
    let keyless = Requirements { highest: Some(serial(newer)), ..ANYONE };
    let node = Requirements { public_keys: &[*key.public_key()], ..keyless };
    let older = Refusal::Older { highest: serial(newer), found: serial(version) };
    assert_eq!(check(&package.signed(&key), &node).unwrap_err(), older);
    let exception = package.replacing(newer).unwrap();
    assert!(check(&exception.signed(&key), &node).is_ok());
    assert_eq!(check(&exception, &keyless).unwrap_err(), older);
    assert_eq!(check(&exception.signed(&key), &keyless).unwrap_err(), older);
    let too_narrow = package.replacing(version).unwrap();
    assert_eq!(check(&too_narrow.signed(&key), &node).unwrap_err(), older);
    let after = node.serial_after_activation(&exception.package());
    let node = Requirements { highest: Some(after), ..node };
    let again = Refusal::Older { highest: serial(newer + 1), found: serial(version) };
    assert_eq!(check(&exception.signed(&key), &node).unwrap_err(), again);
}

#[test]
fn does_not_pack_what_a_node_refuses() {
    let draft = Draft::copy(&package().package());
    let refused = |change: &dyn Fn(&mut agent_core::package::AgentConfig<'_>)| {
        let mut node = draft.node.node();
        change(&mut node);
        let node = host_sim::packages::OwnedAgentConfig::copy(&node);
        Draft { node, ..draft.clone() }.seal().unwrap_err().to_string()
    };
    let gain =
        "a node would refuse the package: design.gain is 0e0, expected a finite number above 0";
    assert_eq!(refused(&|node| node.gain = SymmetricMatrix::Scalar(0.0)), gain);
    assert_eq!(refused(&|node| node.gain = SymmetricMatrix::Diagonal(&[5.0, 0.0])), gain);
    assert_eq!(
        refused(&|node| node.output_matrix = &[0.0, 0.0]),
        "a node would refuse the package: agents.output_matrix is 0e0, expected an entry other than \
         0 in every row"
    );
    let mut short = draft.node.node();
    short.step_size = 1e-7;
    let node = host_sim::packages::OwnedAgentConfig::copy(&short);
    let short = Draft { node, ..draft.clone() }.seal().unwrap();
    let board = Requirements { step_range: StepRange::DEFAULT, ..ANYONE };
    assert!(matches!(check(&short, &board).unwrap_err(), Refusal::Step { .. }));
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
