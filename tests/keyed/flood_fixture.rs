//! The journal with keys in the examination's flash (`tests/on-target/src/flood.rs`).

use agent_core::store::{Layout, MappedFlash, Store};
use agent_core::wire::secret::Secret;
use test_support::nor_flash::{SimulatedFlash, Tear};

use super::test_node::network_key;

/// The examination's.
const UNIT: u32 = 4_096;
const LAYOUT: Layout =
    Layout { slots: [0, UNIT], slot_length: UNIT, commit: 2 * UNIT, commit_length: 2 * UNIT };

#[test]
fn the_examined_node_has_the_journal_that_a_store_writes() {
    let mut flash = SimulatedFlash::<4, 4_096>::new(4 * UNIT as usize, Tear::Prefix, 0);
    let mut store = Store::open(&mut flash, LAYOUT).unwrap();
    assert_eq!(store.reserve_epochs(64), Ok((0, 64)));
    store.record_port_key(Secret::new([0x33; 16]), 1).unwrap();
    store.record_network_keys(&network_key(1).to_bytes()).unwrap();
    let journal = &flash.mapped()[2 * UNIT as usize..];
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/on-target/fixtures/keys.journal");
    let fixture = std::fs::read(path).unwrap();
    assert!(journal.starts_with(&fixture), "write these bytes to {path}: {:?}", &journal[..384]);
    assert!(journal[fixture.len()..].iter().all(|&byte| byte == 0xff));
}
