//! Input from other tools and from users: recordings, images, numbers on the command line.
//! Input is accepted or rejected with an error that names the problem, but never guessed.

use std::fs;

use host_sim::memory_map::MemoryMap;
use serde_json::Value;

use crate::cli::command_line::{Folder, object, short, texts};

const MEMORY: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../memory.x");
pub(super) const SAMPLES: &str = "out/agent1_cycle1_samples.csv";
pub(super) const TRAIN: &str = "--scenario mine.toml --agent 1 --out node1.weights";

/// Creates a folder with a scenario and the samples of a run.
fn folder(name: &str) -> Folder {
    let folder = Folder::new(name);
    let scenario = short().text().replace("\nevents = ", "\nsamples = true\nevents = ");
    folder.write("mine.toml", &scenario);
    folder.succeed("run mine.toml --out out");
    folder
}

/// Like [`folder`], with a package.
pub(super) fn with_package(name: &str) -> Folder {
    let folder = folder(name);
    folder.succeed(&format!("train {SAMPLES} {TRAIN}"));
    folder
}

pub(super) fn json(folder: &Folder, arguments: &str) -> Value {
    object(&folder.succeed(&format!("{arguments} --format json")))
}

fn samples(folder: &Folder) -> Vec<String> {
    let text = fs::read_to_string(folder.path(SAMPLES)).unwrap();
    text.lines().map(str::to_owned).collect()
}

#[test]
fn recordings_in_other_formats_train_the_same_package() {
    let folder = with_package("units");
    let package = fs::read(folder.path("node1.weights")).unwrap();
    let lines = samples(&folder);
    let milliseconds = |line: &String| -> String {
        let (time, rest) = line.split_once(',').unwrap();
        // In plain decimal notation.
        let time: f64 = time.parse().unwrap();
        format!("{},{rest}", (time * 1e6).round() / 1e3)
    };
    let mut in_ms = vec![lines[0].replace("time [s]", "Time (ms)")];
    in_ms.extend(lines[1..].iter().map(milliseconds));
    for (text, what) in [
        (in_ms.join("\n"), "ms"),
        (lines.join("\r\n").replace(',', ";"), "semicolons"),
        (format!("\u{feff}{}", lines.join("\n").replace(',', "\t")), "tabs"),
    ] {
        folder.write("other.csv", &text);
        folder.succeed(&format!("train other.csv {TRAIN} --package-version 2"));
        assert_eq!(fs::read(folder.path("node1.weights")).unwrap(), package, "{what}");
    }
    folder.write("other.csv", &lines.join("\n").replace("time [s]", "time (ticks)"));
    let error = folder.fail(&format!("train other.csv {TRAIN}"), 2);
    assert!(error.contains("other.csv:1: unknown unit of time in \"time (ticks)\""), "{error}");
}

#[test]
fn missing_samples_are_reported_and_bridged() {
    let folder = folder("lost");
    let lines = samples(&folder);
    let whole = json(&folder, &format!("train {SAMPLES} {TRAIN}"));
    assert_eq!((&whole["gaps"], &whole["pieces"]), (&0.into(), &1.into()));
    // Every 37th sample is lost.
    let kept: Vec<&str> = lines
        .iter()
        .enumerate()
        .filter(|(i, _)| *i == 0 || i % 37 != 0)
        .map(|(_, l)| l.as_str())
        .collect();
    let lost = lines.len() - kept.len();
    folder.write("lost.csv", &kept.join("\n"));
    let report = json(&folder, &format!("train lost.csv {TRAIN} --package-version 9"));
    assert_eq!(report["missing_samples"], lost as u64);
    assert_eq!(report["gaps"], lost as u64);
    let (all, used) = (whole["samples"].as_u64().unwrap(), report["samples"].as_u64().unwrap());
    assert!(used * 10 >= all * 9, "{used} of {all}");
    let text = folder.succeed(&format!("train lost.csv {TRAIN} --package-version 9"));
    assert!(text.contains(&format!("{lost} gaps ({lost} missing)")), "{text}");
}

#[test]
fn image_format_follows_the_file_extension() {
    let folder = with_package("ending");
    let image = format!("weights image node1.weights --slot a --memory {MEMORY}");
    folder.succeed(&format!("{image} --out x.bin"));
    assert_eq!(fs::read(folder.path("x.bin")).unwrap().len(), 0x1_0000);
    folder.succeed(&format!("{image} --out x.HEX"));
    assert!(fs::read(folder.path("x.HEX")).unwrap().starts_with(b":02000004"));
    folder.succeed(&format!("{image} --out x.img --format bin"));
    for (arguments, part) in [
        ("--out y.uf2", "requires the family of the chip"),
        ("--out y.bin --format hex", "y.bin: the extension means bin, but --format is hex"),
        ("--out y.hex --format uf2 --family 17", "the extension means hex, but --format is uf2"),
        ("--out y.elf", "y.elf: unknown extension; give --format"),
        ("--out y", "unknown extension"),
    ] {
        let error = folder.fail(&format!("{image} {arguments}"), 2);
        assert!(error.contains(part), "{arguments}: {error}");
    }
    // A family whose chips have no flash there: a warning, in both output forms.
    for (family, flash) in
        [("rp2040", "0x10000000 to 0x11000000"), ("stm32f4", "0x8000000 to 0x8200000")]
    {
        let told = format!(
            "WARNING: slot A is at 0x21000000 to 0x21007000, outside the flash of {family} at {flash}"
        );
        let text = folder.succeed(&format!("{image} --out z.uf2 --family {family}"));
        assert!(text.contains(&told), "{text}");
        let notes = object(
            &folder.succeed(&format!("{image} --format uf2,json --out z.uf2 --family {family}")),
        );
        assert!(notes["notes"][0].as_str().unwrap().contains(&told), "{notes}");
    }
    let left = fs::read_dir(folder.path(".")).unwrap().flatten();
    assert!(!left.into_iter().any(|file| file.file_name().to_string_lossy().starts_with('y')));
}

#[test]
fn rejects_parts_that_share_a_sector() {
    let folder = with_package("sectors");
    let map = fs::read_to_string(MEMORY).unwrap();
    let at = |origin: &str, flash: &str| {
        map.replace("0x21000000, LENGTH = 64K", &format!("{origin}, LENGTH = 64K"))
            .replace("ORIGIN = 0x00000000, LENGTH = 4M", &format!("ORIGIN = {flash}, LENGTH = 16K"))
            .replace("ASSERT(ORIGIN(RAM) + LENGTH(RAM) <= ORIGIN(WEIGHTS)", "ASSERT(1")
    };
    folder.write("stm32.x", &at("0x08020000", "0x08000000"));
    folder.write("nrf.x", &at("0x000F0000", "0x00000000"));
    let image = |map: &str, rest: &str| {
        format!("weights image node1.weights --slot a --memory {map} --out i.hex {rest}")
    };
    let error = folder.fail(&image("stm32.x", "--chip STM32F405RGTx"), 2);
    let part = "slot A is at 0x8020000 to 0x8027000, but stm32f4 can only erase all of 0x8020000 to 0x8040000";
    assert!(error.contains(part), "{error}");
    let flash =
        "flash node1.weights --slot a --memory stm32.x --chip STM32F405RGTx --probe-rs none";
    assert!(folder.fail(flash, 2).contains(part));
    // An unknown chip, and one with sectors of 4 KiB.
    folder.succeed(&image("stm32.x", "--chip ESP32C3"));
    folder.succeed(&image("nrf.x", "--chip nRF52840_xxAA"));
    let uf2 = "weights image node1.weights --slot b --memory nrf.x --out i.uf2 --family nrf52840";
    folder.succeed(uf2);
    let notes = &json(&folder, &image("nrf.x", "").replace("i.hex", "j.hex --format hex"))["notes"];
    assert!(notes.to_string().contains("bootloaders erase whole sectors"), "{notes}");
}

#[test]
fn rejects_a_map_that_needs_a_file_of_gigabytes() {
    let folder = with_package("gigabytes");
    let text = "MEMORY { WEIGHTS : ORIGIN = 0, LENGTH = 2048M } _weights_erase_size = 4K;\n\
        _weights_slot_a_origin = 0; _weights_slot_a_length = 8K;\n\
        _weights_slot_b_origin = 8K; _weights_slot_b_length = 8K;\n\
        _weights_commit_origin = 1024M; _weights_commit_length = 8K;";
    MemoryMap::parse(text, "wide.x").unwrap().weights().expect("a valid map");
    folder.write("wide.x", text);
    let image = "weights image node1.weights --slot a --memory wide.x";
    let error = folder.fail(&format!("{image} --out i.bin"), 2);
    assert!(error.contains("would have 1073750016 bytes, most of them blank"), "{error}");
    folder.succeed(&format!("{image} --out i.hex"));
}

#[test]
fn evaluates_a_package_with_the_nodes_code() {
    let folder = with_package("evaluate");
    // A recording that matches the network exactly has no error.
    let report = json(&folder, &format!("weights evaluate node1.weights {SAMPLES}"));
    assert_eq!((&report["agent"], &report["version"]), (&1.into(), &2.into()));
    assert_eq!(report["outside_box"], 0, "it was trained on these samples");
    assert_eq!(report["not_finite"], 0);
    let number = |value: &Value| value.as_f64().unwrap();
    let components = report["components"].as_array().unwrap();
    // Compare the means with sums computed here.
    let lines = samples(&folder);
    let n = components.len();
    let names: Vec<&str> = lines[0].split(',').collect();
    for (index, component) in components.iter().enumerate() {
        let name = format!("dxhat{} [", index + 1);
        let column = names.iter().position(|found| found.starts_with(&name)).unwrap();
        let values: Vec<f64> =
            lines[1..].iter().map(|l| l.split(',').nth(column).unwrap().parse().unwrap()).collect();
        let count = values.len() as f64;
        let square = values.iter().map(|x| x * x).sum::<f64>() / count;
        let mean = values.iter().sum::<f64>() / count;
        let variance = values.iter().map(|x| (x - mean) * (x - mean)).sum::<f64>() / count;
        let near = |found: &Value, expected| tests_close(number(found), expected);
        assert!(near(&component["mse_without"], square), "{component} {square}");
        assert!(near(&component["mse_constant"], variance), "{component} {variance}");
        let explained = 1.0 - number(&component["mse"]) / number(&component["mse_constant"]);
        assert!(near(&component["explained"], explained));
        assert!(number(&component["mse"]) > 0.0);
        assert!(near(&component["rms"], number(&component["mse"]).sqrt()));
    }
    let total: f64 = components.iter().map(|c| number(&c["mse"])).sum();
    assert!(tests_close(number(&report["total"]["mse"]), total));
    let text = folder
        .succeed(&format!("weights evaluate node1.weights {SAMPLES} --smoothing-window 0.02"));
    assert!(text.contains("0 samples (0.0 %) are outside the trained box"), "{text}");
    assert!(text.lines().filter(|line| line.contains(" %")).count() > n, "{text}");

    // Shifted by more than the width of the box, all samples are outside.
    let shifted = lines[1..].iter().map(|line| {
        let fields: Vec<&str> = line.split(',').collect();
        let first: f64 = fields[1].parse().unwrap();
        format!("{},{},{}", fields[0], first + 1e4, fields[2..].join(","))
    });
    let shifted: Vec<String> = [lines[0].clone()].into_iter().chain(shifted).collect();
    folder.write("shifted.csv", &shifted.join("\n"));
    let report = json(&folder, "weights evaluate node1.weights shifted.csv");
    assert_eq!(report["outside_box_share"], 1.0);
    let error = folder.fail("weights evaluate node1.weights mine.toml", 2);
    assert!(error.contains("mine.toml"), "{error}");
}

fn tests_close(found: f64, expected: f64) -> bool {
    test_support::close(found, expected, 1e-9, 0.0)
}

#[test]
fn rejects_absurd_numbers_with_their_range() {
    let folder = with_package("numbers");
    let absurd = ["-1", "NaN", "inf", "1e-300", "1e300", "x", ""];
    for option in ["cosim --serve s --speed", "cosim --timeout"] {
        for number in absurd.into_iter().chain(["1e-30", "0"]) {
            let error = refused(&folder, &format!("{option}={number}"));
            assert!(error.contains("from 0.001 to 1000000"), "{option} {number}: {error}");
        }
    }
    let whole = ["-1", "NaN", "1.5", "99999999999999999999999", ""];
    for (option, others) in [
        ("cosim --steps", &["0", "18446744073709551615"][..]),
        ("cosim --threads", &["70000"]),
        ("run mine.toml --seed", &[]),
        ("run mine.toml --threads", &["1025"]),
        ("monitor unix:none --every", &["0", "4294967296"]),
        ("monitor unix:none --count", &["0"]),
        ("train a.csv --scenario mine.toml --out o.weights --agent", &["0", "99"]),
        (
            "train a.csv --scenario mine.toml --out o.weights --agent 1 --package-version",
            &["4294967296"],
        ),
        ("weights renumber node1.weights --version", &["4294967296"]),
        ("weights sign node1.weights --key k --replaces", &["4294967296"]),
        ("weights sign node1.weights --key k --epoch", &["4294967296"]),
        ("weights renumber node1.weights --version 3 --epoch", &["4294967296"]),
        ("weights renumber node1.weights --version 3 --package-format", &["0", "3"]),
        ("weights verify node1.weights --features", &[]),
        ("weights import net.npz --out o.weights --scenario mine.toml --agent", &["0", "99"]),
    ] {
        for number in whole.iter().chain(others) {
            refused(&folder, &format!("{option}={number}"));
        }
    }
    for number in absurd.into_iter().filter(|number| *number != "1e-300") {
        let option =
            format!("weights evaluate node1.weights {SAMPLES} --smoothing-window={number}");
        let error = refused(&folder, &option);
        assert!(error.contains("at least 0 and below 1e9"), "{error}");
    }
}

/// Returns the error of a command that must exit with code 2 and without a panic.
fn refused(folder: &Folder, arguments: &str) -> String {
    let output = folder.run(arguments);
    let (standard, error) = texts(&output);
    assert_eq!((output.status.code(), standard.as_str()), (Some(2), ""), "{arguments}: {error}");
    assert!(error.starts_with("error: ") && !error.contains("panicked"), "{arguments}: {error}");
    error
}

#[test]
fn errors_about_oversized_nodes_name_the_scenario_keys() {
    let folder = folder("keys");
    let text = fs::read_to_string(folder.path("mine.toml")).unwrap();
    let bound = text.lines().find(|line| line.starts_with("bound = ")).expect("a bound").to_owned();
    for (lines, part) in [
        ("bound = 1e38".to_owned(), "outer_law.bound minus outer_law.boundary_layer is 9.5e37"),
        (format!("{bound}\nsmoothing = 1e-39"), "outer_law.smoothing is 1e-39"),
    ] {
        folder.write("large.toml", &text.replacen(&bound, &lines, 1));
        let output = folder.run("run large.toml --out large");
        let error = texts(&output).1;
        assert_ne!(output.status.code(), Some(0));
        assert!(error.contains(part), "{error}");
    }
}
