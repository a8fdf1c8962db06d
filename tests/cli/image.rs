//! Flash images: every format reads back, and nothing outside the segments is changed.

use std::collections::BTreeMap;
use std::path::Path;

use agent_core::store::Slot;
use host_sim::image::{Format, Image, ImageError, ImageFormat, ToolUse, Uf2Family, commands_for};
use host_sim::memory_map::WeightsRegion;
use proptest::prelude::*;

use crate::cli::memory_map::WEIGHTS;

/// Bytes by their addresses.
pub(crate) type Memory = BTreeMap<u64, u8>;

const FAMILY: Uf2Family = Uf2Family(0xE48B_FF56);

/// Arbitrary bytes in place of the store's record.
pub(crate) const RECORD: [u8; 32] = *b"slot in use, confirmed (a test).";

/// Creates a package of this length whose bytes depend on their position.
pub(crate) fn package(length: usize) -> Vec<u8> {
    (0..length).map(|at| (at % 251) as u8).collect()
}

pub(crate) fn image(slot: Slot, length: usize) -> Image {
    Image::new(&WEIGHTS, slot, &package(length), &RECORD).unwrap()
}

/// Stores bytes at an address; no byte may be written twice.
fn put(memory: &mut Memory, address: u64, bytes: &[u8]) {
    for (address, &byte) in (address..).zip(bytes) {
        assert_eq!(memory.insert(address, byte), None, "{address:#x} is written twice");
    }
}

fn segments(image: &Image) -> Memory {
    let mut memory = Memory::new();
    for segment in image.segments() {
        put(&mut memory, segment.address.into(), &segment.bytes);
    }
    memory
}

pub(crate) fn read_hex(file: &[u8]) -> Memory {
    let mut memory = Memory::new();
    let mut upper = 0;
    let mut ended = false;
    for record in ihex::Reader::new(std::str::from_utf8(file).unwrap()) {
        assert!(!ended, "a record behind the end");
        match record.expect("a valid record") {
            ihex::Record::ExtendedLinearAddress(high) => upper = u64::from(high) << 16,
            ihex::Record::Data { offset, value } => {
                let last = usize::from(offset) + value.len() - 1;
                assert!(last < 1 << 16, "a record crosses into the next 64 KiB");
                put(&mut memory, upper + u64::from(offset), &value);
            }
            ihex::Record::EndOfFile => ended = true,
            other => panic!("{other:?} is not expected"),
        }
    }
    assert!(ended && file.ends_with(b":00000001FF\n"));
    memory
}

fn read_uf2(file: &[u8], family: u32) -> Memory {
    let mut memory = Memory::new();
    assert_eq!(file.len() % 512, 0);
    let count = (file.len() / 512) as u32;
    for (number, block) in (0..).zip(file.chunks(512)) {
        let word = |at: usize| u32::from_le_bytes(block[at..at + 4].try_into().unwrap());
        assert_eq!(&block[..4], b"UF2\n");
        assert_eq!((word(4), word(508)), (0x9E5D_5157, 0x0AB1_6F30));
        assert_eq!((word(8), word(28)), (0x2000, family));
        assert_eq!((word(16), word(20), word(24)), (256, number, count));
        assert_eq!(word(12) % 256, 0);
        assert!(block[32 + 256..508].iter().all(|&byte| byte == 0));
        put(&mut memory, word(12).into(), &block[32..32 + 256]);
    }
    memory
}

/// Returns the addresses outside `segments`, all of which must contain 0xFF.
fn besides(memory: &Memory, segments: &Memory) -> Vec<u64> {
    for (address, byte) in segments {
        assert_eq!(memory.get(address), Some(byte), "{address:#x}");
    }
    let others = memory.iter().filter(|(address, _)| !segments.contains_key(address));
    others
        .map(|(&address, &byte)| {
            assert_eq!(byte, 0xFF, "{address:#x}");
            address
        })
        .collect()
}

#[test]
fn package_and_record_are_where_the_firmware_looks() {
    for (slot, address) in [(Slot::A, 0x2100_0000), (Slot::B, 0x2100_7000)] {
        let memory = segments(&image(slot, 2_213));
        for (at, byte) in (0..).zip(package(2_213)) {
            assert_eq!(memory[&(address + at)], byte);
        }
        // Padded to 2,216.
        assert_eq!([2_213, 2_214, 2_215].map(|at| memory[&(address + at)]), [0xFF; 3]);
        assert!(!memory.contains_key(&(address + 2_216)));
        let commit: Vec<u8> = memory.range(0x2100_E000..).map(|(_, &byte)| byte).collect();
        assert_eq!(commit.len(), 8 << 10);
        assert_eq!(commit[..32], RECORD);
        assert!(commit[32..].iter().all(|&byte| byte == 0xFF));
        assert_eq!(memory.len(), 2_216 + (8 << 10));
    }
}

#[test]
fn hex_contains_only_the_segments() {
    for slot in [Slot::A, Slot::B] {
        let image = image(slot, 2_213);
        assert_eq!(read_hex(&image.encode(ImageFormat::Hex).unwrap()), segments(&image));
    }
}

#[test]
fn uf2_pads_only_the_last_erase_unit() {
    for (slot, address) in [(Slot::A, 0x2100_0000_u64), (Slot::B, 0x2100_7000)] {
        let image = image(slot, 5_000);
        let memory = read_uf2(&image.encode(ImageFormat::Uf2(FAMILY)).unwrap(), FAMILY.0);
        let filled: Vec<u64> = (address + 5_000..address + 8_192).collect();
        assert_eq!(besides(&memory, &segments(&image)), filled);
    }
}

#[test]
fn bin_blanks_the_gap_between_the_segments() {
    for (slot, address) in [(Slot::A, 0x2100_0000_u64), (Slot::B, 0x2100_7000)] {
        let image = image(slot, 2_213);
        let file = image.encode(ImageFormat::Bin).unwrap();
        assert_eq!(u64::from(image.base()), address);
        assert_eq!(file.len() as u64, 0x2101_0000 - address);
        let mut memory = Memory::new();
        put(&mut memory, address, &file);
        let gap: Vec<u64> = (address + 2_216..0x2100_E000).collect();
        assert_eq!(besides(&memory, &segments(&image)), gap);
        assert_eq!(image.gaps().collect::<Vec<_>>(), vec![address + 2_216..0x2100_E000]);
        assert_eq!(image.gap_holds_other_slot(), slot == Slot::A);
    }
}

#[test]
fn accepts_a_full_slot_and_rejects_one_more_byte() {
    let full = image(Slot::A, 28 << 10);
    assert_eq!(full.segments()[0].span(), 0x2100_0000..0x2100_7000);
    let refused = Image::new(&WEIGHTS, Slot::A, &package((28 << 10) + 1), &RECORD);
    assert_eq!(
        refused,
        Err(ImageError::PackageLength { found: (28 << 10) + 1, slot_length: 28 << 10 })
    );
    let refused = Image::new(&WEIGHTS, Slot::A, &[], &RECORD).unwrap_err().to_string();
    assert!(refused.contains("0 bytes") && refused.contains("28672"), "{refused}");
}

#[test]
fn rejects_a_record_of_invalid_length() {
    for length in [0, 31, 4_104] {
        let refused = Image::new(&WEIGHTS, Slot::A, &package(8), &package(length));
        assert_eq!(
            refused,
            Err(ImageError::RecordLength { found: length, half_length: 4_096 }),
            "{length}"
        );
    }
}

#[test]
fn rejects_segments_outside_the_region_or_overlapping() {
    for region in [
        WeightsRegion { slot_a: 0x2F_F000, ..WEIGHTS },
        WeightsRegion { slot_a: 0x2100_F000, ..WEIGHTS },
        WeightsRegion { slot_a: 0x2101_0000, ..WEIGHTS },
        WeightsRegion { commit: 0x2100_F000, ..WEIGHTS },
        WeightsRegion { commit: 0x2100_0000, ..WEIGHTS },
        WeightsRegion { slot_a: u32::MAX - 7, ..WEIGHTS },
    ] {
        let refused = Image::new(&region, Slot::A, &package(100), &RECORD).unwrap_err();
        assert!(matches!(refused, ImageError::Outside { .. }), "{refused}");
        assert!(refused.to_string().contains("memory.x"), "{refused}");
    }
}

#[test]
fn uf2_rejects_unaligned_segments() {
    let region = WeightsRegion { erase_size: 128, slot_a: 0x2100_0080, ..WEIGHTS };
    let image = Image::new(&region, Slot::A, &package(256), &RECORD).unwrap();
    let refused = image.encode(ImageFormat::Uf2(FAMILY)).unwrap_err();
    assert!(matches!(refused, ImageError::Uf2Alignment { start: 0x2100_0080, .. }), "{refused}");
    assert_eq!(Format::Uf2.with_family(None), Err(ImageError::FamilyMissing));
    assert_eq!(Format::Hex.with_family(None), Ok(ImageFormat::Hex));
}

#[test]
fn format_follows_the_file_extension() {
    for (name, format) in [
        ("a.bin", Some(Format::Bin)),
        ("a.b.HEX", Some(Format::Hex)),
        ("a.uf2", Some(Format::Uf2)),
        ("a.elf", None),
        ("bin", None),
    ] {
        assert_eq!(Format::of_file(Path::new(name)), format, "{name}");
    }
}

/// Returns the command lines for slot B; `None` if a tool needs another format.
fn lines(name: &str, format: Format) -> Vec<(&'static str, Option<String>)> {
    let commands = commands_for(&image(Slot::B, 100), Path::new(name), format);
    let line = |usage| match usage {
        ToolUse::Line(line) => Some(line),
        ToolUse::Needs(formats) => {
            assert!(!formats.is_empty() && !formats.contains(&format));
            None
        }
    };
    commands.into_iter().map(|command| (command.tool, line(command.usage))).collect()
}

#[test]
fn every_tool_gets_its_exact_command_line() {
    let line = |text: &str| Some(text.to_owned());
    assert_eq!(
        lines("w.bin", Format::Bin),
        [
            (
                "probe-rs",
                line(
                    "probe-rs download --chip CHIP --binary-format bin --base-address 0x21007000 --restore-unwritten --verify w.bin && probe-rs reset --chip CHIP"
                )
            ),
            (
                "OpenOCD",
                line("openocd -f BOARD.cfg -c 'program w.bin verify reset exit 0x21007000'")
            ),
            ("st-flash", line("st-flash --reset write w.bin 0x21007000")),
            ("dfu-util", line("dfu-util -a 0 -s 0x21007000 -D w.bin")),
            ("picotool", line("picotool load -v w.bin -t bin -o 0x21007000 && picotool reboot")),
            ("USB drive of a bootloader", None),
        ]
    );
    assert_eq!(
        lines("my weights.hex", Format::Hex),
        [
            (
                "probe-rs",
                line(
                    "probe-rs download --chip CHIP --binary-format hex --restore-unwritten --verify 'my weights.hex' && probe-rs reset --chip CHIP"
                )
            ),
            (
                "OpenOCD",
                line("openocd -f BOARD.cfg -c 'program my\\ weights.hex verify reset exit'")
            ),
            ("st-flash", line("st-flash --reset --format ihex write 'my weights.hex'")),
            ("dfu-util", None),
            ("picotool", None),
            ("USB drive of a bootloader", None),
        ]
    );
    assert_eq!(
        lines("w.uf2", Format::Uf2),
        [
            ("probe-rs", None),
            ("OpenOCD", None),
            ("st-flash", None),
            ("dfu-util", None),
            ("picotool", line("picotool load -v w.uf2 -t uf2 && picotool reboot")),
            ("USB drive of a bootloader", line("cp w.uf2 DRIVE")),
        ]
    );
    let needs = &commands_for(&image(Slot::B, 100), Path::new("w.hex"), Format::Hex)[4];
    assert_eq!(
        needs.to_string(),
        "picotool: does not support this format; use --format uf2 or bin"
    );
}

/// Valid regions of all sizes, with the commit area first or last.
fn regions() -> impl Strategy<Value = WeightsRegion> {
    (0_u32..4, 1_u32..5, 2_u32..4, 0_u32..3, any::<bool>(), 0_u32..16).prop_map(
        |(size, slot, commit, spare, commit_first, high)| {
            let erase_size = 512 << size;
            let (slot_length, commit_length) = (slot * erase_size, commit * erase_size);
            let spare = spare * erase_size;
            let length = 2 * slot_length + commit_length + 2 * spare;
            // The highest position ends at the last address; most cross a 64 KiB boundary.
            let origin =
                if high == 0 { length.wrapping_neg() } else { high * 0x1_0000 - erase_size };
            let slots = origin + spare + if commit_first { commit_length } else { 0 };
            WeightsRegion {
                origin,
                length,
                slot_a: slots,
                slot_b: slots + slot_length,
                slot_length,
                commit: if commit_first { origin } else { origin + (length - commit_length) },
                commit_length,
                erase_size,
            }
        },
    )
}

proptest! {
    // Each case creates three maps of thousands of bytes.
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn all_formats_agree(
        region in regions(),
        b in any::<bool>(),
        share in 0.0_f64..=1.0,
    ) {
        let length = 1 + (f64::from(region.slot_length - 1) * share) as usize;
        let slot = if b { Slot::B } else { Slot::A };
        let image = Image::new(&region, slot, &package(length), &RECORD).unwrap();
        let segments = segments(&image);
        prop_assert_eq!(&read_hex(&image.encode(ImageFormat::Hex).unwrap()), &segments);
        let uf2 = read_uf2(&image.encode(ImageFormat::Uf2(FAMILY)).unwrap(), FAMILY.0);
        let start = u64::from(if b { region.slot_b } else { region.slot_a });
        let unit = u64::from(region.erase_size);
        let filled: Vec<u64> =
            (start + length.next_multiple_of(8) as u64..start + (length as u64).next_multiple_of(unit)).collect();
        prop_assert_eq!(besides(&uf2, &segments), filled);
        let mut bin = Memory::new();
        put(&mut bin, image.base().into(), &image.encode(ImageFormat::Bin).unwrap());
        prop_assert_eq!(besides(&bin, &segments), image.gaps().flatten().collect::<Vec<u64>>());
    }
}
