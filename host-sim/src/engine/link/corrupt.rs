//! Corruption: one to three bytes of a copy are replaced by others, which a receiver's checks must
//! find.

use super::layer::{Effect, Layer, Transmission};
use crate::random::{Purpose, Random};
use crate::scenario::EdgeSettings;

#[derive(Debug)]
pub(super) struct Corrupt {
    random: Random,
    corrupted: u64,
}

impl Corrupt {
    pub(super) fn new(seed: u64) -> Self {
        Self { random: Random::new(seed, Purpose::Corrupt), corrupted: 0 }
    }
}

impl Layer for Corrupt {
    fn name(&self) -> &'static str {
        "corrupt"
    }

    fn effect(&self) -> Effect {
        Effect::Alters("with changed bytes")
    }

    fn carry(
        &mut self,
        edge: &EdgeSettings,
        mut transmission: Transmission,
        next: &mut dyn FnMut(Transmission),
    ) {
        let at = transmission.at();
        if self.random.happens(edge.corrupt, at) && !transmission.bytes.is_empty() {
            self.corrupted += 1;
            let [sender, receiver, number] = at;
            let mut bytes = transmission.bytes.to_vec();
            let changed = 1 + self.random.bits([sender, receiver, number | 1 << 62]) % 3;
            for change in 1..=changed {
                let draw = self.random.bits([sender | change << 48, receiver, number | 1 << 63]);
                let place = (draw >> 8) as usize % bytes.len();
                // Never 0, so that the byte differs from before.
                bytes[place] ^= (draw & 0xff).max(1) as u8;
            }
            // Two changes of one byte can undo each other.
            if bytes == *transmission.bytes {
                bytes[0] ^= 1;
            }
            transmission.bytes = bytes.into();
        }
        next(transmission);
    }

    fn count(&self) -> u64 {
        self.corrupted
    }
}
