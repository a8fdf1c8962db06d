//! Flash layout of known chips: address range and sector sizes.
//!
//! A memory map can declare erase units that the chip does not have. Erasing a part of the store
//! then also erases its neighbours, both on the node and when flashing; for known chips this is
//! rejected. Sector sizes are from the manufacturers' reference manuals; if the devices of a series
//! differ, the smallest is used.

use super::{Image, ImageError, Uf2Family};

/// Flash of a chip or a series of chips.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Part {
    /// Prefix of the chip's name, in lower case.
    name: &'static str,
    /// The flash's first address.
    origin: u32,
    /// Flash length of the largest device. \[bytes\]
    length: u32,
    /// Lengths of the first sectors; the last one repeats to the end of a bank. \[bytes\]
    sectors: &'static [u32],
    /// Length of a bank, after which the sectors repeat. \[bytes\]
    bank: u32,
}

const KIB: u32 = 1 << 10;
const MIB: u32 = 1 << 20;
const STM32: u32 = 0x0800_0000;
const RP: u32 = 0x1000_0000;

/// Sectors of 16, 64 and 128 KiB (RM0090, RM0033).
const STM32F4: [u32; 6] = [16 * KIB, 16 * KIB, 16 * KIB, 16 * KIB, 64 * KIB, 128 * KIB];

/// Sectors of 32, 128 and 256 KiB (RM0385, RM0410).
const STM32F7: [u32; 6] = [32 * KIB, 32 * KIB, 32 * KIB, 32 * KIB, 128 * KIB, 256 * KIB];

const fn uniform(name: &'static str, origin: u32, length: u32, sector: &'static [u32]) -> Part {
    Part { name, origin, length, sectors: sector, bank: length }
}

/// Longer names come before their prefixes.
const PARTS: [Part; 25] = [
    Part { name: "stm32f2", origin: STM32, length: MIB, sectors: &STM32F4, bank: MIB },
    Part { name: "stm32f4", origin: STM32, length: 2 * MIB, sectors: &STM32F4, bank: MIB },
    Part { name: "stm32f7", origin: STM32, length: 2 * MIB, sectors: &STM32F7, bank: 2 * MIB },
    uniform("stm32f0", STM32, 256 * KIB, &[KIB]),
    uniform("stm32f1", STM32, MIB, &[KIB]),
    uniform("stm32f3", STM32, 512 * KIB, &[2 * KIB]),
    uniform("stm32g0", STM32, 512 * KIB, &[2 * KIB]),
    uniform("stm32g4", STM32, 512 * KIB, &[2 * KIB]),
    uniform("stm32h5", STM32, 2 * MIB, &[8 * KIB]),
    uniform("stm32h7a", STM32, 2 * MIB, &[8 * KIB]),
    uniform("stm32h7b", STM32, 2 * MIB, &[8 * KIB]),
    uniform("stm32h7r", STM32, 64 * KIB, &[8 * KIB]),
    uniform("stm32h7s", STM32, 64 * KIB, &[8 * KIB]),
    uniform("stm32h7", STM32, 2 * MIB, &[128 * KIB]),
    uniform("stm32l4", STM32, 2 * MIB, &[2 * KIB]),
    uniform("stm32u5", STM32, 4 * MIB, &[8 * KIB]),
    uniform("stm32wba", STM32, 2 * MIB, &[8 * KIB]),
    uniform("stm32wb", STM32, MIB, &[2 * KIB]),
    uniform("stm32wl", STM32, 256 * KIB, &[2 * KIB]),
    uniform("nrf51", 0, 256 * KIB, &[KIB]),
    uniform("nrf52", 0, MIB, &[4 * KIB]),
    uniform("nrf91", 0, MIB, &[4 * KIB]),
    uniform("rp2040", RP, 16 * MIB, &[4 * KIB]),
    uniform("rp235", RP, 32 * MIB, &[4 * KIB]),
    uniform("atsamd51", 0, MIB, &[8 * KIB]),
];

impl Part {
    /// Returns the chip with this name, as probe-rs spells it; `None` for unknown chips.
    #[must_use]
    pub fn of_chip(name: &str) -> Option<Self> {
        let name = name.to_ascii_lowercase();
        PARTS.into_iter().find(|part| name.starts_with(part.name))
    }

    /// Returns the chips of this UF2 family; `None` for unknown chips.
    #[must_use]
    pub fn of_family(family: Uf2Family) -> Option<Self> {
        Self::of_chip(&family.to_string())
    }

    fn holds(&self, start: u64, end: u64) -> bool {
        let origin = u64::from(self.origin);
        start >= origin && end <= origin + u64::from(self.length)
    }

    /// Returns first address and length of the sector that contains `address`, which must be in the
    /// flash.
    fn sector(&self, address: u64) -> (u64, u64) {
        let offset = address - u64::from(self.origin);
        let bank = u64::from(self.bank);
        let mut start = offset / bank * bank;
        let mut sectors = self.sectors.iter().map(|&length| u64::from(length));
        let mut length = sectors.next().unwrap_or(bank);
        for next in sectors {
            if offset < start + length {
                break;
            }
            start += length;
            length = next;
        }
        start += (offset - start) / length * length;
        (u64::from(self.origin) + start, length)
    }
}

impl Image {
    /// Checks the memory map against the chip's flash.
    ///
    /// # Errors
    /// If a part of the store starts or ends inside a sector of the chip. With `only_flash`, as for
    /// bootloaders, also if a part is outside the chip's flash; otherwise such parts are not
    /// checked, because they may be in the flash of another chip.
    pub fn check_part(&self, part: &Part, only_flash: bool) -> Result<(), ImageError> {
        let region = self.region();
        let half = region.commit_length / 2;
        for (name, start, length) in [
            ("slot A", region.slot_a, region.slot_length),
            ("slot B", region.slot_b, region.slot_length),
            ("the first half of the commit area", region.commit, half),
            ("the second half of the commit area", region.commit + half, half),
        ] {
            let (start, end) = (u64::from(start), u64::from(start) + u64::from(length));
            if !part.holds(start, end) {
                if only_flash {
                    let (flash_start, length) = (u64::from(part.origin), u64::from(part.length));
                    let flash_end = flash_start + length;
                    let chip = part.name;
                    return Err(ImageError::NotFlash {
                        name,
                        start,
                        end,
                        chip,
                        flash_start,
                        flash_end,
                    });
                }
                continue;
            }
            for address in [start, end] {
                // The end of the flash is the end of its last sector.
                if address == u64::from(part.origin) + u64::from(part.length) {
                    continue;
                }
                let (sector, length) = part.sector(address);
                if sector != address {
                    let (chip, sector_end) = (part.name, sector + length);
                    return Err(ImageError::Sector { name, start, end, chip, sector, sector_end });
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sectors_match_the_reference_manuals() {
        let part = |name| Part::of_chip(name).unwrap();
        for (chip, address, start, length) in [
            ("STM32F405RGTx", 0x0800_0000, 0x0800_0000, 16 * KIB),
            ("STM32F405RGTx", 0x0800_7FFF, 0x0800_4000, 16 * KIB),
            ("STM32F405RGTx", 0x0801_0000, 0x0801_0000, 64 * KIB),
            ("STM32F405RGTx", 0x0802_0000, 0x0802_0000, 128 * KIB),
            ("STM32F405RGTx", 0x080F_FFFF, 0x080E_0000, 128 * KIB),
            ("stm32f429zi", 0x0810_4001, 0x0810_4000, 16 * KIB),
            ("STM32F767ZITx", 0x0802_0000, 0x0802_0000, 128 * KIB),
            ("STM32F767ZITx", 0x0807_0000, 0x0804_0000, 256 * KIB),
            ("STM32H743ZI", 0x0803_0000, 0x0802_0000, 128 * KIB),
            ("STM32H7A3ZI", 0x0803_3000, 0x0803_2000, 8 * KIB),
            ("nRF52840_xxAA", 0x000F_0FFF, 0x000F_0000, 4 * KIB),
            ("RP2040", 0x1000_1001, 0x1000_1000, 4 * KIB),
        ] {
            assert_eq!(part(chip).sector(address), (start, length.into()), "{chip} {address:#x}");
        }
        assert_eq!(Part::of_chip("esp32c3"), None);
        assert_eq!(Part::of_family(Uf2Family(0xE48B_FF56)), Part::of_chip("rp2040"));
        assert_eq!(Part::of_family(Uf2Family(0xE48B_FF59)), Part::of_chip("rp2350"));
        assert_eq!(Part::of_family(Uf2Family(17)), None);
    }
}
