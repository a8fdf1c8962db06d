//! NOR flash in memory, as strict as the strictest device: access is aligned, a word is written
//! once between two erasures, and the power can fail at any byte.

use std::cell::Cell;
use std::collections::BTreeMap;

use agent_core::store::MappedFlash;
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash, check_erase, check_read,
    check_write,
};

/// State of a word or an erase unit after the power fails during its write or erasure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tear {
    /// Complete up to the byte at which the power failed.
    Prefix,
    /// The word, or the whole unit, contains garbage.
    Garbage,
    /// The word, or the whole unit, reads as erased but is not: writes fail.
    Unseen,
    /// The word, or the whole unit, has all its bits but cannot be read.
    Unreadable,
    /// The bits of the word, or of the whole unit, are half-way: every read can find them as they
    /// were, as they should be, or mixed.
    Marginal,
}

impl Tear {
    /// Every kind of damage, to test them in a loop.
    pub const ALL: [Self; 5] =
        [Self::Prefix, Self::Garbage, Self::Unseen, Self::Unreadable, Self::Marginal];
}

/// Failure of a write or an erasure without power loss.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// Reports an error and has done nothing.
    Nothing,
    /// Reports an error but has done everything.
    Everything,
    /// Reports an error and has torn its first word or its first unit.
    Torn,
    /// Reports success but has torn its first word or its first unit.
    Silent,
}

/// Why an operation was refused or failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SimulatedError {
    /// Not aligned, or out of bounds.
    Arguments(NorFlashErrorKind),
    /// The bytes are unreadable, temporarily or until they are erased.
    Unreadable,
    /// A word was written twice without an erasure in between.
    Rewritten,
    /// The power failed, now or before.
    PowerLost,
    /// The armed [`Fault`] occurred.
    Fault,
}

impl NorFlashError for SimulatedError {
    fn kind(&self) -> NorFlashErrorKind {
        match self {
            Self::Arguments(kind) => *kind,
            _ => NorFlashErrorKind::Other,
        }
    }
}

/// Flash with words of `WRITE` bytes and erase units of `ERASE` bytes.
#[derive(Clone, Debug)]
pub struct SimulatedFlash<const WRITE: usize, const ERASE: usize> {
    bytes: Vec<u8>,
    /// Whether each word has been written, completely or not, since it was erased.
    written: Vec<bool>,
    /// Whether each word is unreadable until it is erased.
    unreadable: Vec<bool>,
    /// Bytes before and after, of words whose bits are half-way.
    marginal: BTreeMap<usize, ([u8; WRITE], [u8; WRITE])>,
    tear: Tear,
    /// Whether words are protected by error correction, which reports torn ones.
    has_correction: bool,
    /// Number of bytes that can be written and erased before the power fails.
    energy: Cell<Option<usize>>,
    /// Number of writes and erasures before the fault, number of failures, and the fault.
    fault: Cell<Option<(usize, usize, Fault)>>,
    /// Number of reads that succeed before failing, and number of failures.
    read_fault: Cell<(usize, usize)>,
    noise: u64,
    /// Whether the power has failed; every call fails until [`Self::power_on`].
    pub power_lost: bool,
    /// Number of bytes written and erased.
    pub spent: usize,
    /// Number of calls of `erase`.
    pub erasures: usize,
    /// Number of refused writes to words that are not erased.
    pub rewrites: usize,
    /// Number of calls that violated alignment or bounds.
    pub misuses: usize,
}

impl<const WRITE: usize, const ERASE: usize> SimulatedFlash<WRITE, ERASE> {
    /// Creates erased flash of `capacity` bytes; `seed` determines the garbage of
    /// [`Tear::Garbage`].
    #[must_use]
    pub fn new(capacity: usize, tear: Tear, seed: u64) -> Self {
        Self {
            bytes: vec![0xff; capacity],
            written: vec![false; capacity / WRITE],
            unreadable: vec![false; capacity / WRITE],
            marginal: BTreeMap::new(),
            tear,
            has_correction: false,
            energy: Cell::new(None),
            fault: Cell::new(None),
            read_fault: Cell::new((0, 0)),
            noise: seed,
            power_lost: false,
            spent: 0,
            erasures: 0,
            rewrites: 0,
            misuses: 0,
        }
    }

    /// Protects words by error correction: a word with only some of its bits cannot be read.
    #[must_use]
    pub fn with_correction(mut self, has_correction: bool) -> Self {
        self.has_correction = has_correction;
        self
    }

    /// Switches the power on, to fail after `energy` bytes, or never.
    pub fn power_on(&mut self, energy: Option<usize>) {
        self.power_lost = false;
        self.energy.set(energy);
        let words: Vec<_> = self.marginal.keys().copied().collect();
        for word in words {
            let found = self.marginal_word(word).unwrap_or([0; WRITE]);
            self.bytes[word * WRITE..][..WRITE].copy_from_slice(&found);
        }
    }

    /// Returns what a read finds in a word whose bits are half-way; `None` for an error.
    fn marginal_word(&mut self, word: usize) -> Option<[u8; WRITE]> {
        let (before, after) = self.marginal[&word];
        match self.noise() % 4 {
            0 | 1 => Some(after),
            2 => Some(before),
            _ => {
                let mixed = std::array::from_fn(|i| {
                    let mask = self.noise();
                    (before[i] & mask) | (after[i] & !mask)
                });
                (!self.has_correction || mixed == before || mixed == after).then_some(mixed)
            }
        }
    }

    /// Makes the power fail after `energy` bytes.
    pub fn drain(&self, energy: usize) {
        self.energy.set(Some(energy));
    }

    /// Makes `count` writes and erasures fail after `others` successful ones.
    pub fn arm(&self, others: usize, count: usize, fault: Fault) {
        self.fault.set(Some((others, count, fault)));
    }

    /// Makes `count` reads fail after `others` successful ones.
    pub fn arm_reads(&self, others: usize, count: usize) {
        self.read_fault.set((others, count));
    }

    /// Makes `length` bytes unreadable until they are erased, as error correction does with words
    /// that it cannot correct.
    pub fn spoil(&mut self, offset: usize, length: usize) {
        let words = offset / WRITE..(offset + length).div_ceil(WRITE);
        self.unreadable[words.clone()].fill(true);
        self.written[words].fill(true);
    }

    /// Overwrites bytes, like a debugger or failing cells.
    pub fn overwrite(&mut self, offset: usize, bytes: &[u8]) {
        self.bytes[offset..offset + bytes.len()].copy_from_slice(bytes);
        let words = offset / WRITE..(offset + bytes.len()).div_ceil(WRITE);
        self.written[words].fill(true);
    }

    fn checked(&mut self, arguments: Result<(), NorFlashErrorKind>) -> Result<(), SimulatedError> {
        if self.power_lost {
            return Err(SimulatedError::PowerLost);
        }
        arguments.map_err(|kind| {
            self.misuses += 1;
            SimulatedError::Arguments(kind)
        })
    }

    /// The splitmix64 generator; any other would do.
    fn noise(&mut self) -> u8 {
        self.noise = self.noise.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mixed = (self.noise ^ (self.noise >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        ((mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb) >> 56) as u8
    }

    /// Returns how many of `length` bytes the energy lasts for, and any other fault.
    fn effort(&mut self, length: usize) -> (usize, Option<Fault>) {
        let done = self.energy.get().map_or(length, |energy| energy.min(length));
        self.energy.set(self.energy.get().map(|energy| energy - done));
        self.power_lost = done < length;
        self.spent += done;
        let fault = match self.fault.take() {
            Some((0, count, fault)) => {
                self.fault.set((count > 1).then_some((0, count - 1, fault)));
                Some(fault)
            }
            Some((others, count, fault)) => {
                self.fault.set(Some((others - 1, count, fault)));
                None
            }
            None => None,
        };
        (done, fault.filter(|_| !self.power_lost))
    }

    /// Returns how to tear: marginal bits are for power cuts only, since what is read back after a
    /// fault must not be a matter of luck.
    fn how(&self) -> Tear {
        match self.tear {
            Tear::Marginal if !self.power_lost => Tear::Garbage,
            tear => tear,
        }
    }

    /// Tears a word between what it held and `after`.
    fn tear_word(&mut self, word: usize, after: [u8; WRITE]) {
        let place = word * WRITE..(word + 1) * WRITE;
        let before = self.bytes[place.clone()].try_into().unwrap();
        self.written[word] = true;
        match self.how() {
            Tear::Prefix | Tear::Unseen => {}
            Tear::Garbage => {
                for byte in place {
                    self.bytes[byte] = self.noise();
                }
                self.unreadable[word] |= self.has_correction;
            }
            Tear::Unreadable => {
                self.bytes[place].copy_from_slice(&after);
                self.unreadable[word] = true;
            }
            Tear::Marginal => {
                self.marginal.insert(word, (before, after));
                let found = self.marginal_word(word).unwrap_or(before);
                self.bytes[place].copy_from_slice(&found);
            }
        }
    }

    /// Writes the first `done` bytes; `torn` says whether the following word is torn.
    fn write_some(&mut self, offset: usize, bytes: &[u8], done: usize, torn: bool) {
        let is_cut_inside = torn && self.how() == Tear::Prefix;
        let whole = if torn && !is_cut_inside { done - done % WRITE } else { done };
        for (place, byte) in self.bytes[offset..].iter_mut().zip(&bytes[..whole]) {
            *place &= byte;
        }
        self.written[offset / WRITE..(offset + whole).div_ceil(WRITE)].fill(true);
        if is_cut_inside && self.has_correction && !whole.is_multiple_of(WRITE) {
            self.unreadable[(offset + whole) / WRITE] = true;
        }
        if torn && !is_cut_inside {
            let word = (offset + whole) / WRITE;
            self.tear_word(word, bytes[whole..whole + WRITE].try_into().unwrap());
        }
    }

    /// Erases the first `done` bytes from `start` on; `torn` says whether the following unit is
    /// torn.
    fn erase_some(&mut self, start: usize, done: usize, torn: bool) {
        let is_cut_inside = torn && self.how() == Tear::Prefix;
        let whole = if torn && !is_cut_inside { done - done % ERASE } else { done };
        let words = start / WRITE..(start + whole) / WRITE;
        self.bytes[start..start + whole].fill(0xff);
        self.written[words.clone()].fill(false);
        self.unreadable[words.clone()].fill(false);
        self.marginal.retain(|word, _| !words.contains(word));
        if is_cut_inside && self.has_correction && !whole.is_multiple_of(WRITE) {
            self.unreadable[(start + whole) / WRITE] = true;
        }
        if torn && !is_cut_inside {
            for word in (start + whole) / WRITE..(start + whole + ERASE) / WRITE {
                self.marginal.remove(&word);
                if self.how() == Tear::Unseen {
                    self.bytes[word * WRITE..(word + 1) * WRITE].fill(0xff);
                    // The cells are not erased, but no longer what an interrupted write left.
                    self.unreadable[word] = false;
                }
                self.tear_word(word, [0xff; WRITE]);
            }
        }
    }

    /// Returns how far an operation of `length` bytes gets, whether it is torn there, and its
    /// result.
    fn course(&mut self, length: usize) -> (usize, bool, Result<(), SimulatedError>) {
        match self.effort(length) {
            (done, _) if done < length => (done, true, Err(SimulatedError::PowerLost)),
            (_, Some(Fault::Nothing)) => (0, false, Err(SimulatedError::Fault)),
            (_, Some(Fault::Everything)) => (length, false, Err(SimulatedError::Fault)),
            (_, Some(Fault::Torn)) => (0, true, Err(SimulatedError::Fault)),
            (_, Some(Fault::Silent)) => (0, true, Ok(())),
            (_, None) => (length, false, Ok(())),
        }
    }
}

impl<const WRITE: usize, const ERASE: usize> ErrorType for SimulatedFlash<WRITE, ERASE> {
    type Error = SimulatedError;
}

impl<const WRITE: usize, const ERASE: usize> ReadNorFlash for SimulatedFlash<WRITE, ERASE> {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), SimulatedError> {
        let arguments = check_read(self, offset, bytes.len());
        self.checked(arguments)?;
        let (others, count) = self.read_fault.get();
        self.read_fault.set((
            others.saturating_sub(1),
            if others == 0 { count.saturating_sub(1) } else { count },
        ));
        let words = offset as usize / WRITE..(offset as usize + bytes.len()).div_ceil(WRITE);
        if (others == 0 && count > 0) || self.unreadable[words.clone()].contains(&true) {
            return Err(SimulatedError::Unreadable);
        }
        bytes.copy_from_slice(&self.bytes[offset as usize..][..bytes.len()]);
        let marginal: Vec<_> = self.marginal.range(words).map(|(&word, _)| word).collect();
        for word in marginal {
            let found = self.marginal_word(word).ok_or(SimulatedError::Unreadable)?;
            for (place, byte) in (word * WRITE..).zip(found) {
                if let Some(index) = place.checked_sub(offset as usize)
                    && let Some(read) = bytes.get_mut(index)
                {
                    *read = byte;
                }
            }
        }
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.bytes.len()
    }
}

impl<const WRITE: usize, const ERASE: usize> NorFlash for SimulatedFlash<WRITE, ERASE> {
    const WRITE_SIZE: usize = WRITE;
    const ERASE_SIZE: usize = ERASE;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), SimulatedError> {
        let arguments = check_erase(self, from, to);
        self.checked(arguments)?;
        self.erasures += 1;
        let (start, length) = (from as usize, (to - from) as usize);
        let (done, torn, outcome) = self.course(length);
        self.erase_some(start, done, torn && done < length);
        outcome
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), SimulatedError> {
        let arguments = check_write(self, offset, bytes.len());
        self.checked(arguments)?;
        let start = offset as usize;
        if self.written[start / WRITE..(start + bytes.len()) / WRITE].contains(&true) {
            self.rewrites += 1;
            return Err(SimulatedError::Rewritten);
        }
        let (done, torn, outcome) = self.course(bytes.len());
        self.write_some(start, bytes, done, torn && done < bytes.len());
        outcome
    }
}

impl<const WRITE: usize, const ERASE: usize> MappedFlash for SimulatedFlash<WRITE, ERASE> {
    fn mapped(&self) -> &[u8] {
        &self.bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_simulated_flash_is_as_strict_as_it_says() {
        let mut flash = SimulatedFlash::<4, 16>::new(64, Tear::Prefix, 0);
        let unaligned = Err(SimulatedError::Arguments(NorFlashErrorKind::NotAligned));
        let outside = Err(SimulatedError::Arguments(NorFlashErrorKind::OutOfBounds));
        assert_eq!(flash.write(2, &[0; 4]), unaligned);
        assert_eq!(flash.write(0, &[0; 3]), unaligned);
        assert_eq!(flash.erase(0, 24), unaligned);
        assert_eq!(flash.erase(48, 80), outside);
        assert_eq!(flash.misuses, 4);
        assert_eq!(flash.write(4, &[1, 2, 3, 4]), Ok(()));
        assert_eq!(flash.write(0, &[0; 8]), Err(SimulatedError::Rewritten));
        assert_eq!(flash.mapped()[..9], [0xff, 0xff, 0xff, 0xff, 1, 2, 3, 4, 0xff]);
        assert_eq!(flash.erase(0, 16), Ok(()));
        assert_eq!(flash.write(4, &[9; 8]), Ok(()));
        assert_eq!(flash.spent, 4 + 16 + 8);
    }

    #[test]
    fn armed_reads_fail() {
        let mut flash = SimulatedFlash::<4, 16>::new(64, Tear::Prefix, 0);
        flash.arm_reads(1, 2);
        let outcomes = [0; 4].map(|_| flash.read(0, &mut [0]).is_ok());
        assert_eq!(outcomes, [true, false, false, true]);
        flash.spoil(20, 4);
        assert_eq!(flash.read(16, &mut [0; 4]), Ok(()));
        assert_eq!(flash.read(16, &mut [0; 5]), Err(SimulatedError::Unreadable));
        assert_eq!(flash.write(20, &[0; 4]), Err(SimulatedError::Rewritten));
        flash.erase(16, 32).unwrap();
        assert_eq!(flash.read(16, &mut [0; 16]), Ok(()));
    }

    #[test]
    fn error_correction_reports_torn_words() {
        for tear in [Tear::Prefix, Tear::Garbage, Tear::Unreadable] {
            let flash = SimulatedFlash::<4, 16>::new(64, tear, 0);
            let mut flash = flash.with_correction(true);
            flash.power_on(Some(6));
            assert_eq!(flash.write(0, &[0; 12]), Err(SimulatedError::PowerLost));
            flash.power_on(None);
            assert_eq!(flash.read(0, &mut [0; 4]), Ok(()));
            assert_eq!(flash.read(4, &mut [0; 4]), Err(SimulatedError::Unreadable));
            assert_eq!(flash.read(8, &mut [0; 8]), Ok(()));
            flash.erase(0, 16).unwrap();
            assert_eq!(flash.read(4, &mut [0; 4]), Ok(()));
        }
    }

    #[test]
    fn the_simulated_power_fails_at_its_byte_and_stays_off() {
        for tear in Tear::ALL {
            let mut flash = SimulatedFlash::<4, 16>::new(64, tear, 0);
            flash.power_on(Some(6));
            assert_eq!(flash.write(0, &[0; 12]), Err(SimulatedError::PowerLost));
            assert_eq!(flash.write(16, &[0; 4]), Err(SimulatedError::PowerLost));
            assert_eq!(flash.read(0, &mut [0]), Err(SimulatedError::PowerLost));
            flash.power_on(None);
            assert_eq!(flash.mapped()[..4], [0; 4]);
            assert_eq!(flash.mapped()[8..], [0xff; 56]);
            let word = &flash.mapped()[4..8];
            match tear {
                Tear::Prefix => assert_eq!(word, [0, 0, 0xff, 0xff]),
                Tear::Garbage => assert_ne!(word, [0xff; 4]),
                Tear::Unseen => assert_eq!(word, [0xff; 4]),
                Tear::Unreadable => assert_eq!(word, [0; 4]),
                Tear::Marginal => {
                    let mut read = || {
                        let mut bytes = [0x55; 4];
                        flash.read(4, &mut bytes).map(|()| bytes)
                    };
                    let found: std::collections::BTreeSet<_> =
                        (0..100).map(|_| read().unwrap()).collect();
                    assert!(found.contains(&[0; 4]) && found.contains(&[0xff; 4]));
                    assert!(found.len() > 10);
                }
            }
            assert_eq!(flash.read(4, &mut [0]).is_err(), tear == Tear::Unreadable);
            assert_eq!(flash.write(4, &[0; 4]), Err(SimulatedError::Rewritten));
            assert_eq!(flash.write(8, &[7; 4]), Ok(()));
            flash.power_on(Some(10));
            assert_eq!(flash.erase(0, 16), Err(SimulatedError::PowerLost));
            flash.power_on(None);
            let unit = flash.mapped()[..16].to_vec();
            match tear {
                Tear::Prefix => assert_eq!(unit[8..], [0xff, 0xff, 7, 7, 0xff, 0xff, 0xff, 0xff]),
                Tear::Garbage => assert!(unit[..4] != [0xff; 4] && unit[12..] != [0xff; 4]),
                Tear::Unseen | Tear::Unreadable => assert_eq!(unit, [0xff; 16]),
                Tear::Marginal => {}
            }
            // Only in the first case have whole words been erased.
            assert_eq!(flash.write(0, &[1; 4]).is_ok(), tear == Tear::Prefix);
            assert_eq!(flash.write(8, &[1; 4]), Err(SimulatedError::Rewritten));
        }
    }
}
