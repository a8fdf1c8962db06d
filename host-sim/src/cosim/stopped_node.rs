//! Reads the flash of a node that is not running, with the node's own code.

use agent_core::package::signature::PublicKey;
use agent_core::package::{Envelope, PackageError, Refusal, Requirements};
use agent_core::store::{LayoutError, Store};

use crate::image::RamFlash;
use crate::memory_map::WeightsRegion;
use crate::packages::PackageBytes;
use crate::packages::check::check;

/// Returns the package that a node with this flash uses after a reset, if any.
///
/// # Errors
/// If the memory map does not fit the flash.
pub(super) fn package_in_use(
    flash: RamFlash,
    region: &WeightsRegion,
    key: Option<PublicKey>,
) -> Result<Option<PackageBytes>, LayoutError> {
    let mut store = Store::open(flash, region.layout())?;
    let requirements = Requirements { public_keys: key.as_slice(), ..Requirements::ANY };
    let accepted = |bytes: &[u8]| -> Result<PackageBytes, Refusal> {
        let package =
            PackageBytes::new(bytes).map_err(|error: PackageError| Refusal::Package(error))?;
        check(&package, &requirements)?;
        Ok(package)
    };
    let loaded = store.load(accepted).in_use;
    Ok(loaded
        .or_else(|| {
            let length = |slot: &[u8]| u32::try_from(Envelope::length_in(slot)?).ok();
            let serial = |package: &PackageBytes| package.package().serial();
            store.salvage(length, accepted, |new, old| serial(new) > serial(old))
        })
        .map(|(_, package)| package))
}

#[cfg(test)]
mod tests {
    use agent_core::store::Slot;

    use super::*;
    use crate::analysis::TriggerConstants;
    use crate::image::{ERASED, Image};
    use crate::learning::trained;
    use crate::memory_map::MemoryMap;
    use crate::scenario::{PAPER, Scenario};
    use crate::signing::OperatorKey;

    fn start_package() -> PackageBytes {
        let scenario = Scenario::parse("paper", PAPER).unwrap();
        let trigger = TriggerConstants::new(&scenario);
        let network = scenario.network.as_ref().unwrap();
        let inner = vec![0.1; network.architecture.parameter_count()];
        trained::initial(&scenario, &trigger, network, &inner, 0, 0).unwrap()
    }

    #[test]
    fn the_package_of_a_stopped_node_is_found() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../memory.x");
        let region = MemoryMap::read(path.as_ref()).unwrap().weights().unwrap();
        let mut bytes = vec![ERASED; region.length as usize];
        let found = |bytes: &[u8], key: Option<PublicKey>| {
            package_in_use(RamFlash::new(bytes), &region, key).unwrap()
        };
        assert_eq!(found(&bytes, None), None);
        let key = OperatorKey::generate().unwrap();
        let package = start_package();
        for (package, accepted) in [(package.clone(), false), (package.signed(&key), true)] {
            let image = Image::of_package(&region, Slot::B, &package).unwrap();
            for segment in image.segments() {
                let start = (segment.address - region.origin) as usize;
                bytes[start..start + segment.bytes.len()].copy_from_slice(&segment.bytes);
            }
            assert_eq!(found(&bytes, None), Some(package.clone()));
            // Firmware with a key accepts only signed packages.
            let signed_only = found(&bytes, Some(*key.public_key()));
            assert_eq!(signed_only, accepted.then_some(package));
        }
    }
}
