//! Real packages in a weight store, as on a node: received in chunks, checked, tried, confirmed,
//! with the network read in place in every step.

use agent_core::StateVector;
use agent_core::agent::AgentState;
use agent_core::agent::inbox::Inbox;
use agent_core::observer::network::{InnerNetwork, Scratch};
use agent_core::package::{NetworkPlace, Package, Refusal, Requirements, Serial, accept};
use agent_core::store::{CheckedError, Layout, Slot, Store};
use host_sim::analysis::TriggerConstants;
use host_sim::learning::trained;
use host_sim::packages::{Draft, PackageBytes};

use crate::sim::scenario_builder::{Described, network, picks};
use test_support::nor_flash::{SimulatedFlash, Tear};

/// State dimension.
const N: usize = 2;
/// The node's capacity for features.
const FEATURES: usize = 4;
/// Length of a chunk. \[byte\]
const CHUNK: usize = 100;
/// The repository's memory map.
pub(crate) const LAYOUT: Layout =
    Layout { slots: [0, 0x7000], slot_length: 0x7000, commit: 0xe000, commit_length: 0x2000 };

pub(crate) type Flash = SimulatedFlash<8, 0x1000>;

pub(crate) fn new_flash() -> Flash {
    Flash::new(0x1_0000, Tear::Prefix, 0)
}

/// A package of this version for the first of two agents; other versions have other weights.
pub(crate) fn package(version: u32) -> PackageBytes {
    let mut scenario_builder =
        Described::linear(N, "path", [(picks(N, [0]), 1), (picks(N, [1]), 1)]);
    scenario_builder.network = network(&[(5, "tanh"), (3, "logistic")], "2.0");
    let scenario = scenario_builder.scenario();
    let network = scenario.network.as_ref().unwrap();
    let count = network.architecture.parameter_count();
    let inner: Vec<_> = (0..count).map(|i| ((i as f32 + version as f32) * 0.7).sin()).collect();
    let trigger = TriggerConstants::new(&scenario);
    let initial = trained::initial(&scenario, &trigger, network, &inner, 0, 0).unwrap();
    Draft { version, ..Draft::copy(&initial.package()) }.seal().unwrap()
}

/// What a node keeps of the package in use.
#[derive(Clone, Debug, PartialEq)]
struct Running {
    serial: Serial,
    place: NetworkPlace,
}

/// Returns the check of a node that has activated packages up to `highest`.
fn check(highest: Option<Serial>) -> impl FnMut(&[u8]) -> Result<Running, Refusal> {
    let mut scratch = Scratch::NEW;
    move |bytes| {
        let node = Requirements { highest, ..Requirements::ANY };
        let package = accept::<N>(bytes, &node, &mut scratch)?;
        Ok(Running { serial: package.serial(), place: NetworkPlace::new(&package, bytes).unwrap() })
    }
}

/// Opens a store and loads the package in use.
fn boot(flash: &mut Flash) -> (Store<&mut Flash>, Option<Running>) {
    let mut store = Store::open(flash, LAYOUT).unwrap();
    let loaded = store.load(check(None));
    (store, loaded.in_use.map(|(_, running)| running))
}

fn upload(store: &mut Store<&mut Flash>, bytes: &[u8]) {
    store.begin(bytes.len() as u32).unwrap();
    for (index, chunk) in bytes.chunks(CHUNK).enumerate() {
        let accepts = |_: &[u8]| Ok::<_, CheckedError<Refusal>>(());
        store.write((index * CHUNK) as u32, chunk, accepts).unwrap();
    }
}

fn serials(running: &Running) -> (Serial, Serial) {
    (running.serial, running.serial)
}

/// Puts a package on trial.
fn begin_trial(
    store: &mut Store<&mut Flash>,
    bytes: &[u8],
    highest: Option<Serial>,
) -> Result<Running, CheckedError<Refusal>> {
    upload(store, bytes);
    store.stage(check(highest))?;
    store.activate(check(highest), serials)
}

/// Returns flash with a confirmed package of version 1.
fn factory_fresh() -> Flash {
    let mut flash = new_flash();
    let (mut store, nothing) = boot(&mut flash);
    assert_eq!(nothing, None);
    begin_trial(&mut store, package(1).as_bytes(), None).unwrap();
    store.confirm().unwrap();
    flash
}

/// Returns the bits of the estimates over some steps of an agent with the parameters of the package
/// in `bytes`, whose network comes from `network` in every step.
fn estimates<P: AsRef<[f32]>>(
    bytes: &[u8],
    network: impl Fn() -> InnerNetwork<P>,
) -> Vec<[u32; N]> {
    let package = Package::decode(bytes).unwrap();
    let mut neighbours = vec![package.node.neighbours().next().unwrap(); 2];
    let mut gain = [0.0; FEATURES * FEATURES];
    let params = package.node.params::<N>(&mut neighbours, &mut gain).unwrap();
    let places = vec![None; params.neighbours().len()];
    let weights = package.outer_weights;
    let mut state =
        AgentState::<N, FEATURES, _>::new(&params, StateVector::zeros(), weights, places.clone())
            .unwrap();
    let mut inbox = Inbox::new(places);
    let step = |tick: u32| {
        let measurement = [(tick as f32 * 0.05).cos()];
        state.step(&params, Some(&network()), tick.into(), &measurement, &mut inbox).unwrap();
        let estimate = state.estimate();
        [0, 1].map(|component| estimate[component].to_bits())
    };
    (0..200).map(step).collect()
}

/// The same from the bytes in flash, using only the location.
fn estimates_from_flash(store: &Store<&mut Flash>, running: &Running) -> Vec<[u32; N]> {
    let bytes = store.bytes(store.in_use().unwrap()).unwrap();
    estimates(bytes, || running.place.network(bytes).unwrap())
}

/// The same from a copy of the network in memory.
fn estimates_from_memory(package: &PackageBytes) -> Vec<[u32; N]> {
    let network = package.package().network;
    let parameters = network.parameters().to_vec();
    let network = InnerNetwork::new(network.architecture().clone(), parameters).unwrap();
    estimates(package.as_bytes(), || network.clone())
}

#[test]
fn a_new_network_runs_from_flash_and_stays_once_confirmed() {
    let (old, new) = (package(1), package(2));
    let (from_old, from_new) = (estimates_from_memory(&old), estimates_from_memory(&new));
    assert_ne!(from_old, from_new);
    let mut flash = factory_fresh();
    let (mut store, running) = boot(&mut flash);
    let running = running.unwrap();
    assert_eq!((store.in_use(), running.serial.version), (Some(Slot::A), 1));
    assert_eq!(estimates_from_flash(&store, &running), from_old);
    // While the next one is received, the node continues.
    upload(&mut store, new.as_bytes());
    assert_eq!(estimates_from_flash(&store, &running), from_old);
    store.stage(check(Some(running.serial))).unwrap();
    let tried = store.activate(check(Some(running.serial)), serials).unwrap();
    assert_eq!(estimates_from_flash(&store, &tried), from_new);
    store.confirm().unwrap();
    let (store, running) = boot(&mut flash);
    assert_eq!((store.in_use(), &running), (Some(Slot::B), &Some(tried)));
    assert_eq!(estimates_from_flash(&store, &running.unwrap()), from_new);
    assert_eq!(store.bytes(Slot::B), Some(new.as_bytes()));
    assert_eq!((store.flash().misuses, store.flash().rewrites), (0, 0));
}

#[test]
fn an_older_package_is_refused_and_the_running_one_stays() {
    let mut flash = factory_fresh();
    let (mut store, _) = boot(&mut flash);
    let running = begin_trial(&mut store, package(5).as_bytes(), None).unwrap();
    store.confirm().unwrap();
    let outcome = begin_trial(&mut store, package(4).as_bytes(), Some(running.serial));
    let older = Refusal::Older {
        highest: Serial { epoch: 0, version: 5 },
        found: Serial { epoch: 0, version: 4 },
    };
    assert_eq!(outcome, Err(CheckedError::Refused(older)));
    assert_eq!((store.staged(), store.is_on_trial()), (None, false));
    let expected = estimates_from_memory(&package(5));
    assert_eq!(estimates_from_flash(&store, &running), expected);
    let (store, loaded) = boot(&mut flash);
    assert_eq!(loaded, Some(running.clone()));
    assert_eq!(estimates_from_flash(&store, &running), expected);
}

#[test]
fn a_package_with_a_flipped_byte_is_refused_wherever_it_is() {
    let mut flash = factory_fresh();
    let new = package(2);
    for place in (0..new.as_bytes().len()).step_by(7) {
        let mut bytes = new.as_bytes().to_vec();
        bytes[place] ^= 0xff;
        let (mut store, running) = boot(&mut flash);
        let running = running.unwrap();
        let outcome = begin_trial(&mut store, &bytes, Some(running.serial));
        let refused = matches!(outcome, Err(CheckedError::Refused(Refusal::Package(_))));
        assert!(refused, "byte {place}: {outcome:?}");
        assert_eq!((running.serial.version, store.in_use()), (1, Some(Slot::A)));
    }
    assert_eq!(boot(&mut flash).1.unwrap().serial.version, 1);
}

#[test]
fn a_reboot_during_a_trial_brings_the_old_network_back() {
    let mut flash = factory_fresh();
    let (mut store, running) = boot(&mut flash);
    let running = running.unwrap();
    begin_trial(&mut store, package(2).as_bytes(), Some(running.serial)).unwrap();
    let (mut store, loaded) = boot(&mut flash);
    assert_eq!(loaded, Some(running.clone()));
    assert_eq!(store.opening().trial_ended, Some(Ok(())));
    assert_eq!(estimates_from_flash(&store, &running), estimates_from_memory(&package(1)));
    // The failed package is discarded; it can be sent again.
    assert_eq!(store.bytes(Slot::B), None);
    begin_trial(&mut store, package(2).as_bytes(), Some(running.serial)).unwrap();
    store.confirm().unwrap();
    assert_eq!(boot(&mut flash).1.unwrap().serial.version, 2);
}
