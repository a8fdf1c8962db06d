//! Simulator and nodes in lockstep, with the firmware's own loop in threads as nodes.

use std::num::NonZeroU32;
use std::sync::Arc;
use std::time::Duration;

use host_sim::analysis::TriggerConstants;
use host_sim::cosim::board::Board;
use host_sim::cosim::fault::{Fault, NodeError};
use host_sim::cosim::{CosimError, CosimReport, Setup, Start, cosimulate};
use host_sim::engine::Silent;
use host_sim::learning::agent_config;
use host_sim::packages::{Draft, PackageBytes};
use host_sim::scenario::{PAPER, Scenario, SwitchIn, Window};
use host_sim::service::Line;
use host_sim::signing::OperatorKey;

use crate::cosim::loop_node::{self, Quirks};

/// Returns the paper's experiment shortened to two seconds, with a short training.
pub(crate) fn short_paper() -> Scenario {
    let mut scenario = Scenario::parse("paper", PAPER).unwrap();
    scenario.time.duration = 2.0;
    scenario.evaluation = Window { from: 1.0, to: 2.0 };
    scenario.learning[0].collect = Window { from: 0.2, to: 0.8 };
    scenario.learning[0].apply_at = 1.0;
    for recipe in &mut scenario.recipes {
        *recipe.trainer.epochs_max_mut() = 4;
        recipe.smoothing_window = Some(0.02);
        recipe.decimation = NonZeroU32::new(2);
        recipe.switch_in = SwitchIn::Always;
    }
    scenario
}

/// Returns half a second of it, without learning.
pub(crate) fn without_learning() -> Scenario {
    let mut scenario = short_paper();
    scenario.time.duration = 0.5;
    scenario.learning.clear();
    scenario
}

pub(crate) fn board(package: Option<&PackageBytes>, quirks: &Quirks, lives_on: bool) -> Board {
    let line = Line::over_socket(loop_node::spawn(package, quirks), &Arc::default()).unwrap();
    Board::new(line, "thread", lives_on)
}

fn cosimulated(scenario: &Scenario, start: &mut Start<'_>) -> Result<CosimReport, CosimError> {
    let setup = Setup::new(start, Duration::from_secs(5), &Arc::default());
    cosimulate(scenario, 0, setup, None, &Silent)
}

#[test]
fn cosim_of_the_paper_with_a_learning_cycle_has_the_same_bits() {
    let scenario = short_paper();
    let start =
        &mut |_, package: &PackageBytes| Ok(board(Some(package), &Quirks::default(), false));
    let report = cosimulated(&scenario, start).unwrap();
    assert_eq!((report.first_mismatch, report.mismatches), (None, 0));
    assert_eq!((report.steps, report.nodes), (2000, 3));
    for board in &report.boards {
        assert_eq!((board.compared, board.switches, &board.parted), (2000, 1, &None));
        assert!(board.broadcasts > 100, "{board:?}");
    }
}

/// Returns the package with changed content, as a separate package.
fn changed(package: &PackageBytes, change: impl FnOnce(&mut Draft)) -> PackageBytes {
    let mut draft = Draft::copy(&package.package());
    change(&mut draft);
    draft.seal().unwrap()
}

#[test]
fn cosim_finds_one_bit_in_the_weights_of_one_node() {
    let scenario = without_learning();
    let start = &mut |index, package: &PackageBytes| {
        let uses = (index == 1).then(|| {
            changed(package, |draft| {
                let bias = draft.inner.last_mut().unwrap();
                *bias = f32::from_bits(bias.to_bits() ^ 1 << 8);
            })
        });
        Ok(board(Some(package), &Quirks { uses, ..Quirks::default() }, false))
    };
    let report = cosimulated(&scenario, start).unwrap();
    let first = report.first_mismatch.unwrap();
    assert_eq!((first.agent, first.quantity), (2, "derivative"));
    assert!(first.node != first.simulator && first.node.contains("(0x"), "{first}");
    assert!(report.boards[1].mismatches > 0 && report.steps == 500);
}

#[test]
fn cosim_finds_a_trigger_that_differs() {
    let scenario = without_learning();
    let start = &mut |index, package: &PackageBytes| {
        let mut other = short_paper();
        other.design.epsilon *= 1.5;
        let node = agent_config(&other, &TriggerConstants::new(&other), index);
        let uses = (index == 2).then(|| changed(package, |draft| draft.node = node));
        Ok(board(Some(package), &Quirks { uses, ..Quirks::default() }, false))
    };
    let report = cosimulated(&scenario, start).unwrap();
    let first = report.first_mismatch.unwrap();
    assert_eq!((first.agent, first.quantity), (3, "broadcast"));
    assert_eq!((first.node.as_str(), first.simulator.as_str()), ("none", "one frame"));
}

#[test]
fn cosim_gives_a_board_that_lives_on_the_package_of_its_agent() {
    let mut scenario = short_paper();
    scenario.time.duration = 0.2;
    let start = &mut |index, package: &PackageBytes| {
        // One has no package, one has its own, one has a different one.
        let own = match index {
            0 => None,
            1 => Some(package.clone()),
            _ => Some(changed(package, |draft| {
                draft.version = 0;
                draft.inner[0] = 0.25;
            })),
        };
        Ok(board(own.as_ref(), &Quirks::default(), true))
    };
    let report = cosimulated(&scenario, start).unwrap();
    assert_eq!((report.first_mismatch, report.steps), (None, 200));
}

#[test]
fn cosim_names_the_node_with_the_wrong_package() {
    let start = &mut |index, package: &PackageBytes| {
        let own = changed(package, |draft| draft.inner[0] = 0.25);
        let own = if index == 1 { &own } else { package };
        Ok(board(Some(own), &Quirks::default(), false))
    };
    let error = cosimulated(&short_paper(), start).unwrap_err();
    assert!(
        matches!(error, CosimError::Node(NodeError { agent: 2, fault: Fault::Package { .. }, .. })),
        "{error}"
    );
}

#[test]
fn cosim_with_a_key_signs_all_that_it_puts_into_nodes() {
    let (scenario, key) = (short_paper(), OperatorKey::generate().unwrap());
    let start = &mut |_, package: &PackageBytes| {
        assert!(package.is_signed());
        let public_key = Some(*key.public_key());
        Ok(board(Some(package), &Quirks { public_key, ..Quirks::default() }, false))
    };
    let mut setup = Setup::new(start, Duration::from_secs(5), &Arc::default());
    setup.signer = Some(&key);
    let report = cosimulate(&scenario, 0, setup, None, &Silent).unwrap();
    assert_eq!((report.first_mismatch, report.mismatches, report.steps), (None, 0, 2000));
    assert!(report.boards.iter().all(|board| board.switches == 1), "{:?}", report.boards);
}
