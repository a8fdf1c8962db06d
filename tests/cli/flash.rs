//! Flashing with a substitute for probe-rs that keeps the chip's memory in a file.
#![cfg(unix)]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use agent_core::store::Slot;
use host_sim::flash::{FlashError, FlashStep, FlashTarget, ProbeRs};
use host_sim::image::Image;

use crate::cli::image::image;

/// A folder with a separate chip, removed at the end.
struct Chip(PathBuf);

impl Chip {
    fn new(name: &str) -> Self {
        let name = format!("flash-{}-{name}", std::process::id());
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
        fs::create_dir_all(&folder).unwrap();
        let program = Path::new(env!("CARGO_MANIFEST_DIR")).join("fake_probe_rs/probe-rs");
        // A link, not a copy: a program that is still open for writing cannot be started.
        std::os::unix::fs::symlink(program, folder.join("probe-rs")).unwrap();
        Self(folder)
    }

    fn set(&self, file: &str, content: &str) {
        fs::write(self.0.join(file), content).unwrap();
    }

    fn calls(&self) -> Vec<String> {
        let calls = fs::read_to_string(self.0.join("calls")).unwrap();
        calls.lines().map(str::to_owned).collect()
    }

    fn memory(&self) -> BTreeMap<u64, u8> {
        let memory = fs::read_to_string(self.0.join("memory")).unwrap();
        let byte = |line: &str| {
            let (address, byte) = line.split_once(' ').unwrap();
            (u64::from_str_radix(address, 16).unwrap(), u8::from_str_radix(byte, 16).unwrap())
        };
        memory.lines().map(byte).collect()
    }

    /// Flashes with the program on `PATH`; also returns the steps.
    fn flash(&self, image: &Image) -> (Result<(), FlashError>, Vec<FlashStep>) {
        let path = std::env::join_paths([Path::new("no/such/folder"), &self.0]).unwrap();
        let probe_rs = ProbeRs::find_in(&path).unwrap();
        let target = FlashTarget { chip: Some("nRF52840".to_owned()), probe: None };
        let mut steps = Vec::new();
        (probe_rs.flash(&target, image, &mut |step| steps.push(step)), steps)
    }
}

impl Drop for Chip {
    fn drop(&mut self) {
        // Best effort: anything left is in the build folder.
        let _ = fs::remove_dir_all(&self.0);
    }
}

#[test]
fn chip_contains_only_the_image() {
    for (slot, name) in [(Slot::A, "slot-a"), (Slot::B, "slot-b")] {
        let chip = Chip::new(name);
        let image = image(slot, 2_213);
        let (done, steps) = chip.flash(&image);
        done.unwrap();
        let expected: BTreeMap<u64, u8> = image
            .segments()
            .iter()
            .flat_map(|segment| segment.span().zip(segment.bytes.clone()))
            .collect();
        assert_eq!(chip.memory(), expected);
        let steps: Vec<_> = steps.iter().map(ToString::to_string).collect();
        let address = if slot == Slot::A { "0x21000000" } else { "0x21007000" };
        assert_eq!(
            steps,
            [
                "writing 10408 bytes".to_owned(),
                "reading the commit area back: 8192 bytes at 0x2100e000".to_owned(),
                format!("reading the package back: 2216 bytes at {address}"),
                "resetting the chip".to_owned(),
            ]
        );
    }
}

#[test]
fn calls_probe_rs_with_valid_options() {
    let chip = Chip::new("calls");
    chip.flash(&image(Slot::B, 64)).0.unwrap();
    let calls = chip.calls();
    let (download, rest) = calls.split_first().unwrap();
    let file = download
        .strip_prefix("download --chip nRF52840 --binary-format hex --restore-unwritten ")
        .unwrap();
    assert!(!Path::new(file).exists(), "{file} was left behind");
    assert_eq!(
        rest,
        [
            "read --chip nRF52840 b8 0x2100e000 8192",
            "read --chip nRF52840 b8 0x21007000 64",
            "reset --chip nRF52840",
        ]
    );
}

#[test]
fn supports_versions_that_print_no_addresses() {
    let chip = Chip::new("list");
    chip.set("list", "");
    chip.flash(&image(Slot::A, 2_213)).0.unwrap();
}

#[test]
fn reports_a_mismatch_and_does_not_reset_the_chip() {
    for (address, name, expected) in
        [(0x2100_0010, "the package", 0x10_u8), (0x2100_FFFF, "the commit area", 0xFF)]
    {
        let chip = Chip::new(&format!("corrupt-{address:x}"));
        // Of two differences, the first is reported.
        chip.set("corrupt", &format!("{:#x}\n{address:#x}\n", address + 0x20));
        let error = chip.flash(&image(Slot::A, 2_213)).0.unwrap_err();
        let FlashError::Differs { name: named, address: at, expected: wrote, found } = error else {
            panic!("{error}");
        };
        assert_eq!((named, at, wrote, found), (name, address, expected, expected.wrapping_add(1)));
        assert!(!chip.calls().iter().any(|call| call.starts_with("reset")));
    }
}

#[test]
fn passes_on_the_errors_of_probe_rs() {
    for (command, step) in
        [("download", "writing"), ("read", "reading the commit area back"), ("reset", "resetting")]
    {
        let chip = Chip::new(&format!("fail-{command}"));
        chip.set("fail", command);
        let error = chip.flash(&image(Slot::A, 100)).0.unwrap_err();
        assert!(matches!(error, FlashError::Failed { .. }), "{error}");
        let message = error.to_string();
        for part in
            [step, &format!("probe-rs {command} --chip nRF52840"), "Error: no probe was found"]
        {
            assert!(message.contains(part), "{part}: {message}");
        }
    }
}

#[test]
fn missing_probe_rs_error_says_how_to_install_it() {
    let nowhere = ProbeRs::find_in("/no/such/folder".as_ref()).unwrap_err();
    let named = ProbeRs::find(Some(Path::new("no/such/probe-rs"))).unwrap_err();
    for (error, part) in [(nowhere, "probe-rs: "), (named, "no/such/probe-rs: ")] {
        let message = error.to_string();
        assert!(matches!(error, FlashError::NotInstalled { .. }), "{message}");
        assert!(message.starts_with(part) && message.contains("cargo install"), "{message}");
    }
    let chip = Chip::new("named");
    let program = chip.0.join("probe-rs");
    assert_eq!(ProbeRs::find(Some(&program)).unwrap().program(), program);
}
