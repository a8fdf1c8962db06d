//! Numbers of the UF2 format.

/// Data bytes per block, as supported by every bootloader.
pub(super) const PAYLOAD: usize = 256;

/// Length of a block. \[bytes\]
pub(super) const BLOCK: usize = 512;

/// The first two words of a block and the last one.
pub(super) const MAGIC: [u32; 3] = [0x0A32_4655, 0x9E5D_5157, 0x0AB1_6F30];

/// Flag: the word at 28 is a family.
pub(super) const FAMILY_PRESENT: u32 = 0x2000;

/// Families with a name; the numbers are from the official list.
pub const UF2_FAMILIES: [(&str, u32); 5] = [
    ("rp2040", 0xE48B_FF56),
    ("rp2350-arm-s", 0xE48B_FF59),
    ("rp2350-riscv", 0xE48B_FF5A),
    ("nrf52840", 0xADA5_2840),
    ("stm32f4", 0x5775_5A57),
];
