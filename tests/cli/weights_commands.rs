//! `train`, `weights` and `flash` from the outside: an operator's day.

use std::fs;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use agent_core::package::{CHECKED_FIRST, HEADER2_LENGTH};
use agent_core::store::{Slot, Store};
use host_sim::memory_map::MemoryMap;
use serde_json::Value;

use crate::cli::command_line::{Folder, object, short, texts};
use test_support::nor_flash::{SimulatedFlash, Tear};

/// The repository's memory map.
const MEMORY: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../memory.x");

/// A folder with a scenario, the samples of a run and keys.
fn folder(name: &str) -> Folder {
    let folder = Folder::new(name);
    let scenario = short().text().replace("\nevents = ", "\nsamples = true\nevents = ");
    folder.write("mine.toml", &scenario);
    folder.succeed("run mine.toml --out out");
    folder.succeed("weights keygen --out operator");
    folder
}

const TRAIN: &str = "train out/agent1_cycle1_samples.csv --scenario mine.toml --agent 1";

fn json(folder: &Folder, arguments: &str) -> Value {
    object(&folder.succeed(&format!("{arguments} --format json")))
}

#[test]
fn from_samples_to_a_signed_package_that_cannot_be_changed() {
    let folder = folder("operator");
    let report = json(&folder, &format!("{TRAIN} --out node1.weights --sign operator.key"));
    assert_eq!((&report["agent"], &report["version"]), (&1.into(), &2.into()));
    assert_eq!(report["signed"], true);
    // The very package that the run switched in, but for the signature.
    let (own, runs) = (folder.path("node1.weights"), folder.path("out/agent1_cycle1.weights"));
    let (own, runs) = (fs::read(own).unwrap(), fs::read(runs).unwrap());
    assert_eq!(own.len(), runs.len());
    assert_eq!(own[..HEADER2_LENGTH], runs[..HEADER2_LENGTH]);
    assert_eq!(own[CHECKED_FIRST..], runs[CHECKED_FIRST..]);

    let facts = json(&folder, "weights inspect node1.weights");
    assert_eq!((&facts["agent"], &facts["signed"]), (&1.into(), &true.into()));
    assert!(facts["samples"].as_u64().unwrap() > 0);
    let text = folder.succeed("weights inspect node1.weights");
    assert!(text.contains("trained inputs") && text.contains("gain K1"), "{text}");

    let verified = json(&folder, "weights verify node1.weights --key operator.pub");
    assert_eq!((&verified["accepted"], &verified["test_vectors"]), (&true.into(), &4.into()));
    folder.succeed(&format!("weights verify node1.weights --memory {MEMORY}"));
    let error = folder.fail("weights verify out/agent1_cycle1.weights --key operator.pub", 2);
    assert!(error.contains("not signed"), "{error}");

    let error = folder.fail("weights verify node1.weights --features 3", 2);
    assert!(error.contains("4 features, but the node has room for 3"), "{error}");

    let mut bytes = own.clone();
    bytes[own.len() / 2] ^= 0x10;
    fs::write(folder.path("tampered.weights"), &bytes).unwrap();
    let error = folder.fail("weights verify tampered.weights --key operator.pub", 2);
    assert!(error.contains("tampered.weights") && error.contains("checksum"), "{error}");
    let output = folder.run("weights verify tampered.weights --format json");
    assert_eq!(output.status.code(), Some(2));
    assert_eq!(object(&texts(&output).0)["accepted"], false);
    folder.fail("run mine.toml --weights tampered.weights", 2);

    // The next training gets the next version, which the node takes, and not the one before.
    let next = json(&folder, &format!("{TRAIN} --out next.weights --base node1.weights --seed 5"));
    assert_eq!(next["version"], 3);
    folder.succeed("weights verify next.weights --in-use node1.weights");
    let error = folder.fail("weights verify node1.weights --in-use next.weights", 2);
    assert!(error.contains("version 2, but version 3 has already been used"), "{error}");
    // Only the operator can send a node back to it.
    let back = "weights sign node1.weights --key operator.key --epoch 1 --out back.weights";
    let report = json(&folder, back);
    assert_eq!((&report["epoch"], &report["version"]), (&1.into(), &2.into()));
    let node = "--in-use next.weights";
    folder.succeed(&format!("weights verify back.weights {node} --key operator.pub"));
    let shown = json(&folder, "weights inspect back.weights");
    assert_eq!((&shown["epoch"], &shown["format_version"]), (&1.into(), &2.into()));
    for old in ["node1", "next", "back"] {
        let again = format!("weights verify {old}.weights --in-use back.weights");
        let error = folder.fail(&again, 2);
        assert!(error.contains("has already been used") && error.contains("--epoch"), "{error}");
    }
    let replaces = "weights sign node1.weights --key operator.key --replaces 3 --out back.weights";
    let error = folder.fail(replaces, 2);
    assert!(error.contains("use a higher package epoch"), "{error}");
    let difference = json(&folder, "weights diff node1.weights next.weights");
    assert_eq!(difference["identical"], false);
    assert!(difference["inner_parameters"]["changed"].as_u64().unwrap() > 0);
    let same = folder.succeed("weights diff node1.weights node1.weights");
    assert!(same.contains("are identical"), "{same}");
}

#[test]
fn packages_for_older_firmware_are_of_format_1() {
    let folder = folder("format-1");
    let format = |file: &str| {
        let shown = json(&folder, &format!("weights inspect {file}"));
        (shown["format_version"].as_u64().unwrap(), shown["epoch"].as_u64().unwrap())
    };
    let output = folder.run(&format!("{TRAIN} --out old.weights --package-format 1"));
    assert!(output.status.success());
    assert!(texts(&output).1.contains("has no limits for the trial"), "{}", texts(&output).1);
    assert_eq!(format("old.weights"), (1, 0));
    assert_eq!(fs::read(folder.path("old.weights")).unwrap()[..4], *b"OWP\x01");
    assert_eq!(json(&folder, "weights inspect old.weights")["trial"], Value::Null);
    // Such a package may still replace newer ones, with the operator's permission.
    folder.succeed("weights renumber old.weights --version 9 --out newer.weights");
    assert_eq!(format("newer.weights"), (1, 0));
    folder.succeed("weights sign old.weights --key operator.key --replaces 9 --out back.weights");
    let node = "--in-use newer.weights --key operator.pub";
    folder.succeed(&format!("weights verify back.weights {node}"));
    // An epoch makes it one of format 2, unless that is ruled out.
    folder.succeed("weights sign old.weights --key operator.key --epoch 2 --out two.weights");
    assert_eq!(format("two.weights"), (2, 2));
    folder.succeed("weights renumber old.weights --version 4 --epoch 1 --out three.weights");
    assert_eq!(format("three.weights"), (2, 1));
    let error = folder.fail("weights renumber two.weights --version 4 --package-format 1", 2);
    assert!(error.contains("format 1 has no package epochs"), "{error}");
    folder.succeed("weights renumber two.weights --version 4 --epoch 0 --package-format 1");
    assert_eq!(format("two.weights"), (1, 0));
    // Training keeps the epoch of its base.
    let next = format!("{TRAIN} --base three.weights --out next.weights");
    let next = json(&folder, &next);
    assert_eq!((&next["epoch"], &next["version"]), (&1.into(), &5.into()));
}

#[test]
fn a_network_goes_out_and_comes_back() {
    let folder = folder("exchange");
    folder.succeed(&format!("{TRAIN} --out node1.weights"));
    // The second takes the place of the first, and so the version after it.
    for (kind, version) in [("npz", 3), ("safetensors", 4)] {
        folder.succeed(&format!("weights export node1.weights --out net.{kind}"));
        let report = json(
            &folder,
            &format!("weights import net.{kind} --base node1.weights --out in.weights"),
        );
        assert_eq!((&report["version"], &report["agent"]), (&version.into(), &1.into()));
        assert_eq!(report["largest_rounding"], Value::Null);
        let difference = json(&folder, "weights diff node1.weights in.weights");
        assert_eq!(difference["inner_parameters"], Value::Null, "no parameter changes");
        folder.succeed("weights verify in.weights --in-use node1.weights");
        // It runs; the other agent starts as the scenario says.
        folder.succeed("run mine.toml --weights in.weights --without-learning --out again");
    }
    let error = folder.fail("weights import net.npz --out in.weights", 2);
    assert!(error.contains("--base"), "{error}");
    folder.succeed("weights import net.npz --scenario mine.toml --agent 1 --out other.weights");
    fs::write(folder.path("broken.npz"), b"PK").unwrap();
    let error = folder.fail("weights import broken.npz --base node1.weights --out x.weights", 2);
    assert!(error.contains("broken.npz"), "{error}");
    assert!(!folder.path("x.weights").exists());
}

#[test]
fn images_lie_where_the_memory_map_says() {
    let folder = folder("image");
    folder.succeed(&format!("{TRAIN} --out node1.weights"));
    let package = fs::read(folder.path("node1.weights")).unwrap();
    let report = object(&folder.succeed(&format!(
        "weights image node1.weights --slot b --memory {MEMORY} --format bin,json"
    )));
    assert_eq!(report["segments"][0]["address"], 0x2100_7000);
    let bin = fs::read(folder.path("node1.slot-b.bin")).unwrap();
    assert_eq!(bin.len(), 0x9000);
    assert_eq!(bin[..package.len()], package);
    // What a node finds in this flash, it loads.
    let mut flash = SimulatedFlash::<8, 0x1000>::new(0x1_0000, Tear::Prefix, 0);
    flash.overwrite(0x7000, &bin);
    let layout = MemoryMap::read(MEMORY.as_ref()).unwrap().weights().unwrap().layout();
    let mut store = Store::open(flash, layout).unwrap();
    let loaded = store.load(|bytes| if bytes == package { Ok(()) } else { Err(()) });
    assert_eq!(loaded.in_use, Some((Slot::B, ())));
    assert!(!store.is_on_trial());
    for (format, family) in [("hex", ""), ("uf2", " --family stm32f4")] {
        let text = folder.succeed(&format!(
            "weights image node1.weights --slot A --memory {MEMORY} --format {format}{family}"
        ));
        assert!(text.contains("probe-rs") && text.contains("0x21000000"), "{text}");
        assert!(folder.path(&format!("node1.slot-a.{format}")).exists());
    }
    let error = folder
        .fail(&format!("weights image node1.weights --slot a --memory {MEMORY} --format uf2"), 2);
    assert!(error.contains("family"), "{error}");
    folder.write("small.x", &fs::read_to_string(MEMORY).unwrap().replace("= 28K;", "= 0;"));
    folder.fail("weights image node1.weights --slot a --memory small.x", 2);
}

#[test]
fn ctrl_c_ends_training_with_the_best_so_far() {
    let folder = Folder::new("ctrl-c");
    // Noise, which no network of this size fits, and so many epochs that they would take hours.
    let mut endless = folder.succeed("scenario paper");
    for (setting, large) in
        [("epochs = 25", "epochs = 1000000"), ("failures = 6", "failures = 1000000")]
    {
        assert!(endless.contains(setting));
        endless = endless.replace(setting, large);
    }
    folder.write(
        "endless.toml",
        &endless.replace("initial = { fill = 0.1 }", "initial = { random = \"glorot\" }"),
    );
    let mut samples = "time,xhat1,xhat2,xhat3,dxhat1,dxhat2,dxhat3\n".to_owned();
    for row in 0..6000 {
        let noise =
            |place: u32| f64::from((row * 7 + place).wrapping_mul(2_654_435_769) >> 8) / 1e6;
        let values: Vec<String> = (0..6).map(|place| noise(place).to_string()).collect();
        samples += &format!("{},{}\n", f64::from(row) * 0.001, values.join(","));
    }
    folder.write("noise.csv", &samples);
    let child = Command::new(env!("CARGO_BIN_EXE_simulator-under-test"))
        .args("train noise.csv --scenario endless.toml --agent 1 --recipe paper".split(' '))
        .args("--out best.weights --format json".split(' '))
        .current_dir(folder.path("."))
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let start = Instant::now();
    std::thread::sleep(Duration::from_millis(1500));
    let kill = Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(kill.success());
    let output = child.wait_with_output().unwrap();
    assert!(start.elapsed() < Duration::from_secs(60), "it went on for {:?}", start.elapsed());
    let (standard, error) = texts(&output);
    assert_eq!(output.status.code(), Some(0), "{standard}{error}");
    // Noise is not to be learned, and that is reported; what was asked for is written all the same.
    assert!(error.lines().all(|line| line.starts_with("warning: ")), "{error}");
    let report = object(&standard);
    assert_eq!(report["stopped_by"], "interruption", "{report}");
    folder.succeed("weights verify best.weights");
}

#[test]
fn mistakes_on_the_command_line_say_what_to_do() {
    let folder = folder("mistakes");
    let cases = [
        ("train no.csv --scenario mine.toml --agent 1 --out x.weights", "no.csv"),
        ("train out/traces.csv --scenario mine.toml --agent 1 --out x.weights", "xhat1"),
        (
            "train out/agent1_cycle1_samples.csv --scenario mine.toml --agent 3 --out x.weights",
            "agents 1 to 2",
        ),
        (
            "train out/agent1_cycle1_samples.csv --scenario mine.toml --agent 1 --recipe no --out x",
            "choose a recipe",
        ),
        ("train out/agent1_cycle1_samples.csv --scenario no.toml --agent 1 --out x", "no.toml"),
        (
            "train out/agent1_cycle1_samples.csv --scenario mine.toml --agent 1 --out mine.toml",
            "mine.toml",
        ),
        ("weights inspect mine.toml", "mine.toml"),
        ("weights sign out/agent1_cycle1.weights --key operator.pub", "operator.pub"),
        ("weights keygen --out operator", "already exists"),
        (
            "run mine.toml --weights out/agent1_cycle1.weights --weights out/agent1_cycle1.weights",
            "second",
        ),
    ];
    let before = fs::read(folder.path("mine.toml")).unwrap();
    for (arguments, expected) in cases {
        let error = folder.fail(arguments, 2);
        assert!(error.contains(expected), "{arguments}: {error}");
    }
    assert_eq!(fs::read(folder.path("mine.toml")).unwrap(), before);
    assert!(!folder.path("x.weights").exists() && !folder.path("x").exists());
}
