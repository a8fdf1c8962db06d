//! The released firmware in the real emulator. `cargo xtask test` builds the firmware, installs the
//! emulator where it is allowed to, and then runs these tests.

use crate::cli::command_line::Folder;

/// The environment variable that names the firmware's ELF file.
const FIRMWARE: &str = "QEMU_MPS2_AN386_FIRMWARE";

fn firmware() -> String {
    std::env::var(FIRMWARE).unwrap_or_else(|_| {
        panic!("{FIRMWARE} must name the firmware; build it with `cargo xtask firmware`")
    })
}

fn cosim(folder: &Folder, firmware: &str, arguments: &str) -> serde_json::Value {
    let told = folder.succeed(&format!("cosim --firmware {firmware} --format json {arguments}"));
    serde_json::from_str(&told).unwrap()
}

/// Processes that were started with this word in their command line.
fn processes_with(word: &str) -> Vec<String> {
    let processes = std::fs::read_dir("/proc").unwrap().filter_map(Result::ok);
    let line = |entry: &std::fs::DirEntry| std::fs::read(entry.path().join("cmdline")).ok();
    let found = processes.filter(|entry| {
        line(entry).is_some_and(|line| String::from_utf8_lossy(&line).contains(word))
    });
    found.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect()
}

/// Returns the paper's scenario with its learning cycle moved to the start.
fn early_learning() -> String {
    let mut text = host_sim::scenario::PAPER.to_owned();
    for (from, to) in [
        ("collect_from = 10.0", "collect_from = 0.2"),
        ("collect_to = 16.0", "collect_to = 0.8"),
        ("apply_at = 20.0", "apply_at = 1.0"),
        ("smoothing_window = 0.4", "smoothing_window = 0.02"),
        ("decimation = 20", "decimation = 2"),
        ("epochs = 60", "epochs = 4"),
        ("[recipes.better]", "[recipes.better]\nswitch_in = \"always\""),
    ] {
        assert!(text.contains(from), "{from}");
        text = text.replace(from, to);
    }
    text
}

#[test]
#[ignore = "requires the firmware and QEMU; run `cargo xtask test`"]
fn cosim_in_qemu_has_the_same_bits_with_a_package_switched_in() {
    let folder = Folder::new("cosim-qemu");
    // A copy, so that its processes are those of this test.
    let own = folder.path("only-here.elf");
    std::fs::copy(firmware(), &own).unwrap();
    let own = own.to_str().unwrap();
    folder.write("early.toml", &early_learning());
    let pipes = cosim(&folder, own, "early.toml --steps 4000");
    let uart = cosim(&folder, own, "early.toml --steps 1500 --boards qemu-uart,qemu,qemu-uart");
    for (report, steps) in [(pipes, 4000), (uart, 1500)] {
        assert_eq!((&report["mismatches"], &report["steps"]), (&0.into(), &steps.into()));
        assert!(report["first_mismatch"].is_null());
        for board in report["boards"].as_array().unwrap() {
            assert_eq!((&board["switches"], &board["compared"]), (&1.into(), &steps.into()));
        }
    }
    assert_eq!(processes_with(own), [""; 0], "processes are left");
}

#[test]
#[ignore = "requires the firmware and QEMU; run `cargo xtask test`"]
fn cosim_in_qemu_continues_with_kept_flash() {
    let folder = Folder::new("cosim-qemu-keep");
    let learns = "paper --keep flash --steps 300 --without-learning";
    let firmware = firmware();
    let first = cosim(&folder, &firmware, learns);
    assert_eq!((&first["mismatches"], &first["steps"]), (&0.into(), &300.into()));
    let agents: Vec<_> = folder.files("flash").into_keys().collect();
    assert_eq!(agents, ["agent-1.flash", "agent-2.flash", "agent-3.flash"]);
    let second = cosim(&folder, &firmware, learns);
    assert_eq!((&second["mismatches"], &second["digest"]), (&0.into(), &first["digest"]));
    // Nodes of another scenario are refused.
    let text = host_sim::scenario::PAPER.replace("epsilon = 3000.0", "epsilon = 2000.0");
    assert_ne!(text, host_sim::scenario::PAPER);
    folder.write("other.toml", &text);
    let refused = format!("cosim other.toml --firmware {firmware} --keep flash --steps 9");
    let error = folder.fail(&refused, 2);
    assert!(error.contains("flash/agent-1.flash: the trigger of its package differs"), "{error}");
}

#[test]
#[ignore = "requires the firmware and QEMU; run `cargo xtask test`"]
fn cosim_in_qemu_has_the_same_bits_with_keys() {
    let folder = Folder::new("cosim-qemu-keys");
    let plain = "paper --steps 800 --without-learning --boards qemu,qemu-uart,qemu";
    let without = cosim(&folder, &firmware(), plain);
    let with = cosim(&folder, &firmware(), &format!("{plain} --network-key"));
    assert_eq!((&with["mismatches"], &with["digest"]), (&0.into(), &without["digest"]));
    for board in with["boards"].as_array().unwrap() {
        assert_eq!(board["compared"], 800);
    }
}

/// Trees, a disturbance model and samples that evolve by the shared model, from the switch on;
/// without and with keys.
#[test]
#[ignore = "requires the firmware and QEMU; run `cargo xtask test`"]
fn cosim_in_qemu_has_the_same_bits_with_the_field_observer() {
    let folder = Folder::new("cosim-qemu-field-observer");
    let mut text = early_learning().replace("collect_from", "shared = true\ncollect_from");
    text += "\n[observer]\nfrom = 1.0\nhold = \"model\"\ndisturbance = \"harmonic\"\n\
             frequencies = [3.0, 0.0, 3.75]\ntree_gain = 100.0\nradius = 0.05\nclip = 30.0\n\
             precision = 16\n";
    folder.write("observer.toml", &text);
    for keys in ["", " --network-key"] {
        let report = cosim(&folder, &firmware(), &format!("observer.toml --steps 3000{keys}"));
        assert_eq!((&report["mismatches"], &report["steps"]), (&0.into(), &3_000.into()));
        for board in report["boards"].as_array().unwrap() {
            assert_eq!(board["switches"], 1);
        }
    }
    // From the start, through a reboot, and with an agent that is down when the observer starts.
    let reboot = "life=[{agent=2,from=2.0,to=2.2}]";
    let down = "life=[{agent=3,from=0.5,to=1.5},{agent=2,from=2.0,to=2.2}]";
    for (from, life, switches) in [("0.0", reboot, 0), ("1.0", down, 1)] {
        let arguments = format!(
            "paper --without-learning --set observer.preset=field --set observer.from={from} --set {life} \
             --steps 3000"
        );
        let report = cosim(&folder, &firmware(), &arguments);
        assert_eq!((&report["mismatches"], &report["steps"]), (&0.into(), &3_000.into()));
        assert_eq!(report["boards"][0]["switches"], switches);
    }
}

/// Loss, delay, duplicates, corruption, a partition, drifting clocks, missing measurements, a reboot and
/// a late joiner: the built-in scenario, with its times moved to the start.
#[test]
#[ignore = "requires the firmware and QEMU; run `cargo xtask test`"]
fn cosim_in_qemu_has_the_same_bits_in_the_field() {
    let folder = Folder::new("cosim-qemu-field");
    let mut text = host_sim::scenario::built_in("deployment").unwrap().to_owned();
    for (from, to) in [
        ("from = 32.0\nto = 32.5", "from = 2.2\nto = 2.4"),
        ("from = 0.0\nto = 3.0", "from = 0.0\nto = 0.3"),
        ("from = 26.0\nto = 26.8", "from = 1.6\nto = 1.9"),
        ("drift = -35.0, offset = 0.4", "drift = -3500.0, offset = 0.4, missed = 0.01"),
        ("drift = 20.0", "drift = 2000.0"),
        ("collect_from = 10.0", "collect_from = 0.4"),
        ("collect_to = 16.0", "collect_to = 1.0"),
        ("apply_at = 20.0", "apply_at = 1.2"),
        ("smoothing_window = 0.4", "smoothing_window = 0.02\nswitch_in = \"always\""),
        ("decimation = 20", "decimation = 2"),
        ("epochs = 60", "epochs = 4"),
    ] {
        assert!(text.contains(from), "{from}");
        text = text.replace(from, to);
    }
    folder.write("early.toml", &text);
    let report = cosim(&folder, &firmware(), "early.toml --steps 4000");
    assert!(report["first_mismatch"].is_null(), "{}", report["first_mismatch"]);
    let boards = report["boards"].as_array().unwrap();
    let of =
        |key: &str| boards.iter().map(|board| board[key].as_u64().unwrap()).collect::<Vec<_>>();
    assert_eq!((of("restarts"), of("switches")), (vec![0, 1, 1], vec![1, 1, 1]));
    let compared = of("compared");
    // Agent 2 is down for 300 steps, and misses one in a hundred and those that its clock lacks.
    assert_eq!((compared[0], compared[2]), (4_000, 3_700));
    assert!((3_600..3_680).contains(&compared[1]), "{compared:?}");
    // A new node in agent 2's place has the first package, without what was learned at 1.2 s.
    let text = text.replace("from = 1.6\nto = 1.9", "from = 1.6\nto = 1.9\nreplaced = true");
    folder.write("replaced.toml", &text);
    let replaced = cosim(&folder, &firmware(), "replaced.toml --steps 2500");
    assert_eq!((&replaced["mismatches"], &replaced["steps"]), (&0.into(), &2_500.into()));
    // The end of the run finds agent 2 down.
    let cut = cosim(&folder, &firmware(), "early.toml --steps 1700");
    assert_eq!((&cut["mismatches"], &cut["steps"]), (&0.into(), &1_700.into()));
    let serve = format!("cosim early.toml --serve nodes --firmware {} --steps 9", firmware());
    let error = folder.fail(&serve, 2);
    assert!(error.contains("leave out --serve"), "{error}");
    // Authentic frames exchange hello and sync, which simulated agents do not.
    let keys = format!("cosim early.toml --network-key --firmware {} --steps 9", firmware());
    let error = folder.fail(&keys, 2);
    assert!(error.contains("leave out --keys and --network-key"), "{error}");
}
