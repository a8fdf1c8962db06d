//! What survives a reset, but not a loss of power: how often the chip has started, why the firmware
//! reset it, and the epochs that it has reserved.
//!
//! A record is a few words of RAM that the start-up code does not initialise. After power-on they hold
//! anything, which magic number and CRC reveal.
//!
//! Memory: [`BootRecord::WORDS`] words. Cost: one CRC of 48 bytes at the start, at a panic, and
//! whenever epochs are taken.

use agent_core::service::{FILE_NAME, PanicPlace, ResetCause};
use agent_core::wire::crc::crc32;

use crate::{Epochs, Start};

/// The record.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BootRecord {
    /// Starts since the supply was switched on.
    boots: u32,
    /// Whether the firmware has panicked, or the processor has reported a fault, since the last start.
    failed: bool,
    place: Option<PanicPlace>,
    epochs: Epochs,
}

impl BootRecord {
    /// Words in memory: magic number, starts, flags, epochs, line, file, CRC.
    pub const WORDS: usize = 7 + FILE_NAME / 4;
    const MAGIC: u32 = u32::from_le_bytes(*b"BOOT");

    /// Returns the record in memory; an empty one after power-on.
    #[must_use]
    pub fn from_words(words: &[u32; Self::WORDS]) -> Self {
        let [magic, boots, flags, next, end, line, file @ .., crc] = words;
        if *magic != Self::MAGIC || *crc != checksum(words) {
            return Self::default();
        }
        let mut name = [0; FILE_NAME];
        let bytes = file.iter().flat_map(|word| word.to_le_bytes());
        name.iter_mut().zip(bytes).for_each(|(place, byte)| *place = byte);
        Self {
            boots: *boots,
            failed: flags & 1 != 0,
            place: (flags & 2 != 0).then_some(PanicPlace { file: name, line: *line }),
            epochs: Epochs { next: *next, end: *end },
        }
    }

    /// Returns the record as it is stored.
    #[must_use]
    pub fn to_words(&self) -> [u32; Self::WORDS] {
        let mut words = [0; Self::WORDS];
        let [magic, boots, flags, next, end, line, file @ .., _] = &mut words;
        (*magic, *boots) = (Self::MAGIC, self.boots);
        (*next, *end) = (self.epochs.next, self.epochs.end);
        *flags = u32::from(self.failed) | u32::from(self.place.is_some()) << 1;
        if let Some(place) = &self.place {
            *line = place.line;
            for (word, bytes) in file.iter_mut().zip(place.file.as_chunks().0) {
                *word = u32::from_le_bytes(*bytes);
            }
        }
        let crc = checksum(&words);
        let [.., last] = &mut words;
        *last = crc;
        words
    }

    /// Records a panic, or a fault of the processor, whose place is not known.
    pub fn fail(&mut self, place: Option<PanicPlace>) {
        (self.failed, self.place) = (true, place);
    }

    /// Keeps these epochs for the next start.
    pub fn keep_epochs(&mut self, epochs: Epochs) {
        self.epochs = epochs;
    }

    /// Counts a start whose reset had `cause`, according to the chip, and returns what there is to
    /// report about it.
    pub fn start(&mut self, cause: ResetCause) -> Start {
        self.boots = self.boots.saturating_add(1);
        let cause = if self.failed { ResetCause::Panic } else { cause };
        self.failed = false;
        Start { cause, panic: self.place.take(), boots: Some(self.boots), epochs: self.epochs }
    }
}

fn checksum(words: &[u32; BootRecord::WORDS]) -> u32 {
    let mut bytes = [0; 4 * (BootRecord::WORDS - 1)];
    let contents = words.iter().flat_map(|word| word.to_le_bytes());
    bytes.iter_mut().zip(contents).for_each(|(place, byte)| *place = byte);
    crc32(&[&bytes])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_is_told_once_after_the_reset() {
        let mut record = BootRecord::default();
        let start = record.start(ResetCause::PowerOn);
        assert_eq!((start.cause, start.panic, start.boots), (ResetCause::PowerOn, None, Some(1)));
        let place = PanicPlace::new("firmware-template/src/a_long_name/of_a_file.rs", 4711);
        assert_eq!(&place.file, b"a_long_name/of_a_file.rs");
        record.fail(Some(place));
        let mut record = BootRecord::from_words(&record.to_words());
        let start = record.start(ResetCause::Software);
        assert_eq!(
            (start.cause, start.panic, start.boots),
            (ResetCause::Panic, Some(place), Some(2))
        );
        let start = BootRecord::from_words(&record.to_words()).start(ResetCause::Watchdog);
        assert_eq!((start.cause, start.panic, start.boots), (ResetCause::Watchdog, None, Some(3)));
    }

    #[test]
    fn epochs_are_kept_until_they_are_replaced() {
        let mut record = BootRecord::default();
        assert_eq!(record.start(ResetCause::PowerOn).epochs, Epochs::default());
        let epochs = Epochs { next: 12, end: 64 };
        record.keep_epochs(epochs);
        let mut record = BootRecord::from_words(&record.to_words());
        assert_eq!(record.start(ResetCause::Software).epochs, epochs);
        assert_eq!(record.start(ResetCause::Watchdog).epochs, epochs);
    }

    #[test]
    fn what_ram_holds_after_power_on_is_not_a_record() {
        let mut record = BootRecord::default();
        record.start(ResetCause::PowerOn);
        record.fail(None);
        let words = record.to_words();
        assert_eq!(BootRecord::from_words(&words), record);
        for word in 0..words.len() {
            for bit in 0..32 {
                let mut flipped = words;
                flipped[word] ^= 1 << bit;
                assert_eq!(BootRecord::from_words(&flipped), BootRecord::default());
            }
        }
        for noise in [0, u32::MAX, 0xcccc_cccc] {
            assert_eq!(BootRecord::from_words(&[noise; BootRecord::WORDS]), BootRecord::default());
        }
    }
}
