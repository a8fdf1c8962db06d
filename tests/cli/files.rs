//! Existing files, closed streams and signals, as commands handle them.

use std::fs;
use std::io::Read;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::cli::command_line::{Folder, object, short, texts};

const MEMORY: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../memory.x");
const TRAIN: &str = "train out/agent1_cycle1_samples.csv --scenario mine.toml --agent 1";

/// Creates a folder with a scenario, a run of it, and a package.
fn folder(name: &str) -> Folder {
    let folder = Folder::new(name);
    // The quality of its networks does not matter here.
    let text = short().text().replace("\nevents = ", "\nsamples = true\nevents = ");
    folder.write("mine.toml", &text);
    done(&folder.run("run mine.toml --out out"));
    fs::copy(folder.path("out/agent1_cycle1.weights"), folder.path("node.weights")).unwrap();
    folder
}

/// Returns the output of a command that succeeded, possibly with warnings.
fn done(output: &Output) -> String {
    let (standard, error) = texts(output);
    assert_eq!(output.status.code(), Some(0), "{standard}{error}");
    assert!(error.lines().all(|line| line.starts_with("warning: ")), "{error}");
    standard
}

/// Returns the program with these arguments, separated by blanks.
fn program(folder: &Folder, arguments: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_simulator-under-test"));
    command.args(arguments.split_whitespace()).current_dir(folder.path("."));
    command
}

/// Runs a shell command line in which `$HS` is the program; returns its output and exit code.
fn shell(folder: &Folder, line: &str) -> (String, Option<i32>) {
    let output = Command::new("sh")
        .args(["-c", line])
        .env("HS", env!("CARGO_BIN_EXE_simulator-under-test"))
        .current_dir(folder.path("."))
        .output()
        .unwrap();
    (texts(&output).0, output.status.code())
}

fn signal(child: &Child, name: &str) {
    let sent = Command::new("kill").args([&format!("-{name}"), &child.id().to_string()]).status();
    assert!(sent.unwrap().success());
}

/// Waits until `condition` holds.
fn wait_until(what: &str, condition: impl Fn() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(60);
    while !condition() {
        assert!(Instant::now() < deadline, "{what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Returns the names of all entries of a folder, including hidden ones.
fn names(folder: &Folder, name: &str) -> Vec<String> {
    let entries = fs::read_dir(folder.path(name)).unwrap();
    let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let mut names: Vec<_> = names.collect();
    names.sort();
    names
}

#[test]
fn commands_do_not_overwrite_files_of_other_kinds() {
    let folder = folder("other-kinds");
    folder.succeed("weights keygen --out operator");
    folder.succeed("weights export node.weights --out net.npz");
    fs::copy(MEMORY, folder.path("memory.x")).unwrap();
    folder.write("notes.txt", "mine\n");
    let image = "weights image node.weights --slot a --memory memory.x";
    for format in ["bin", "hex", "uf2 --family rp2040"] {
        folder.succeed(&format!("{image} --format {format} --out image"));
        // Files of its own kind are replaced.
        folder.succeed(&format!("{image} --format {format} --out image"));
        fs::rename(folder.path("image"), folder.path(&format!("image.{}", &format[..3]))).unwrap();
    }
    let files = [
        "node.weights",
        "memory.x",
        "mine.toml",
        "operator.key",
        "operator.pub",
        "net.npz",
        "notes.txt",
        "out/traces.csv",
        "out/errors.svg",
        "out/errors.png",
        "out/run.json",
    ];
    let before: Vec<_> = files.iter().map(|file| fs::read(folder.path(file)).unwrap()).collect();
    for format in ["bin", "hex", "uf2 --family rp2040"] {
        let own = format!("image.{}", &format[..3]);
        let images = ["image.bin", "image.hex", "image.uf2"];
        for file in files.iter().chain(&images).filter(|file| **file != own) {
            let error = folder.fail(&format!("{image} --format {format} --out {file}"), 2);
            let other_ending = format!("--format is {}", &format[..3]);
            assert!(
                error.contains("refusing to overwrite") || error.contains(&other_ending),
                "{error}"
            );
        }
    }
    for file in files.iter().filter(|file| **file != "node.weights") {
        for command in [
            format!("{TRAIN} --out {file}"),
            format!("weights sign node.weights --key operator.key --out {file}"),
            format!("weights import net.npz --base node.weights --out {file}"),
        ] {
            let error = folder.fail(&command, 2);
            assert!(error.contains("not a weight package; refusing to overwrite"), "{error}");
        }
    }
    fs::write(folder.path("archive.npz"), b"PK\x03\x04 photographs").unwrap();
    folder.fail("weights export node.weights --out archive.npz", 2);
    assert!(folder.fail("weights export node.weights --out out", 2).contains("out"));
    let error = folder.fail(&format!("{image} --format bin --out out"), 2);
    assert!(error.contains("is a folder"), "{error}");
    for (file, before) in files.iter().zip(&before) {
        assert_eq!(&fs::read(folder.path(file)).unwrap(), before, "{file}");
    }
}

#[test]
fn commands_write_through_links_and_to_devices() {
    let folder = folder("links");
    folder.succeed("weights keygen --out operator");
    fs::create_dir(folder.path("versions")).unwrap();
    let target = folder.path("versions/3.weights");
    fs::copy(folder.path("node.weights"), &target).unwrap();
    fs::set_permissions(&target, fs::Permissions::from_mode(0o600)).unwrap();
    symlink("versions/3.weights", folder.path("current.weights")).unwrap();
    folder.succeed("weights sign current.weights --key operator.key");
    assert!(fs::symlink_metadata(folder.path("current.weights")).unwrap().is_symlink());
    assert_eq!(fs::metadata(&target).unwrap().permissions().mode() & 0o777, 0o600);
    assert!(
        folder.succeed("weights inspect versions/3.weights").contains("signed                 yes")
    );
    done(&folder.run(&format!("{TRAIN} --out /dev/null")));
    let piped =
        shell(&folder, &format!("mkfifo pipe; cat pipe > copy & $HS {TRAIN} --out pipe && wait"));
    assert_eq!(piped.1, Some(0));
    folder.succeed("weights inspect copy");
    // Together with the report, in the order of writing.
    let image = format!(
        "$HS weights image node.weights --slot a --memory {MEMORY} --format hex --out /dev/stdout"
    );
    let (printed, code) = shell(&folder, &format!("{image} >both && cat both"));
    assert_eq!((code, printed.matches(":00000001FF").count()), (Some(0), 1), "{printed}");
    assert!(printed.starts_with(':') && printed.contains("Written to /dev/stdout"), "{printed}");
    #[cfg(target_os = "linux")]
    {
        let error = folder.fail("weights sign node.weights --key operator.key --out /dev/full", 1);
        assert!(error.contains("/dev/full: No space left"), "{error}");
    }
}

#[test]
fn checks_outputs_before_the_work() {
    let folder = folder("unwritable");
    // A training that would take hours.
    let endless = endless(&folder);
    folder.write("blocked", "a file\n");
    for out in ["blocked/below.weights", "/proc/no/x.weights"] {
        let error = folder.fail(&format!("{endless} --out {out}"), 1);
        assert!(error.contains(out) && error.contains("check that"), "{error}");
    }
    assert!(folder.fail(&format!("{endless} --out blocked"), 2).contains("blocked"));
    assert!(folder.fail(&format!("{endless} --out out"), 2).contains("is a folder"));
}

/// Returns the arguments, except `--out`, of a training on noise that takes hours.
fn endless(folder: &Folder) -> String {
    let mut text = folder.succeed("scenario paper");
    for (from, to) in [
        ("epochs = 25", "epochs = 1000000"),
        ("failures = 6", "failures = 1000000"),
        ("initial = { fill = 0.1 }", "initial = { random = \"glorot\" }"),
        ("goal = 1e-2", "goal = 0.0"),
    ] {
        assert!(text.contains(from), "{from}");
        text = text.replace(from, to);
    }
    folder.write("endless.toml", &text);
    let mut samples = "time,xhat1,xhat2,xhat3,dxhat1,dxhat2,dxhat3\n".to_owned();
    for row in 0..6000 {
        let noise =
            |place: u32| f64::from((row * 7 + place).wrapping_mul(2_654_435_769) >> 8) / 1e6;
        let values: Vec<String> = (0..6).map(|place| noise(place).to_string()).collect();
        samples += &format!("{},{}\n", f64::from(row) * 0.001, values.join(","));
    }
    folder.write("noise.csv", &samples);
    "train noise.csv --scenario endless.toml --agent 1 --recipe paper".to_owned()
}

#[test]
fn interrupted_training_keeps_the_best_epoch() {
    let folder = Folder::new("told-to-end");
    let endless = endless(&folder);
    for (name, reason) in [("TERM", "terminate"), ("INT", "interrupt"), ("HUP", "hangup")] {
        let child = program(&folder, &format!("{endless} --out {name}.weights --format json"))
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        // The temporary file exists once the work starts.
        wait_until("no training begins", || {
            names(&folder, ".").iter().any(|n| n.starts_with(".host"))
        });
        std::thread::sleep(Duration::from_millis(300));
        signal(&child, name);
        let output = child.wait_with_output().unwrap();
        let standard = done(&output);
        assert_eq!(object(&standard)["stopped"], reason, "{standard}");
        folder.succeed(&format!("weights verify {name}.weights"));
    }
    assert!(!names(&folder, ".").iter().any(|name| name.starts_with(".host")));
}

#[test]
fn interrupted_run_keeps_previous_results() {
    let folder = Folder::new("run-told-to-end");
    folder.succeed("run paper --out out --without-learning --seed 3");
    let before = folder.files("out");
    let mut long = folder.succeed("scenario paper");
    assert!(long.contains("duration = 40.0"));
    long = long
        .replace("duration = 40.0", "duration = 400000.0")
        .replace("trace_stride = 1", "trace_stride = 0");
    folder.write("long.toml", &long.replace("to = 40.0", "to = 400000.0"));
    for (name, code) in [("TERM", 143), ("INT", 130)] {
        let mut child = program(&folder, "run long.toml --out out --without-learning")
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let is_staged = || names(&folder, "out").iter().any(|name| name.starts_with(".host"));
        wait_until("no run begins", is_staged);
        signal(&child, name);
        assert_eq!(child.wait().unwrap().code(), Some(code), "{name}");
        assert!(folder.files("out") == before, "{name}");
    }
}

#[test]
fn output_folder_contains_exactly_one_run() {
    let folder = Folder::new("one-run");
    folder.write("mine.toml", &short().text());
    folder.succeed("run mine.toml --out out --seed 1");
    let manifest: Value = serde_json::from_slice(&folder.files("out")["run.json"]).unwrap();
    assert_eq!((&manifest["scenario"], &manifest["seed"]), (&"scenario_builder".into(), &1.into()));
    let listed: Vec<_> = manifest["files"]
        .as_array()
        .unwrap()
        .iter()
        .map(|name| name.as_str().unwrap().to_owned())
        .collect();
    let there: Vec<_> =
        names(&folder, "out").into_iter().filter(|name| name != "run.json").collect();
    assert_eq!(listed, there);
    // Each of them is detected before the work.
    for name in &there {
        let other = folder.path(&format!("other/{name}"));
        fs::create_dir_all(folder.path("other")).unwrap();
        fs::write(&other, "mine\n").unwrap();
        let error = folder.fail("run mine.toml --out other", 2);
        assert!(error.contains(name.as_str()) && error.contains("refusing"), "{error}");
        assert_eq!(fs::read(&other).unwrap(), b"mine\n");
        fs::remove_file(other).unwrap();
    }
    // Without learning, the packages of the previous run are removed; a user's file is kept.
    folder.write("out/mine.txt", "mine\n");
    let text = folder.succeed("run mine.toml --out out --without-learning");
    assert!(text.contains("Not from this run: mine.txt\n"), "{text}");
    assert!(!names(&folder, "out").iter().any(|name| name.ends_with(".weights")));
    // By default it uses another folder.
    folder.succeed("run mine.toml");
    let learned = folder.files("out/scenario_builder");
    folder.succeed("run mine.toml --without-learning");
    assert!(folder.files("out/scenario_builder") == learned);
    assert!(
        names(&folder, "out/scenario_builder-without-learning").contains(&"agents.csv".to_owned())
    );
}

#[test]
fn reproduce_and_run_do_not_share_a_folder() {
    let folder = Folder::new("no-mixing");
    folder.write("mine.toml", &short().text());
    fs::create_dir(folder.path("out")).unwrap();
    let held = fs::File::open(folder.path("out")).unwrap();
    held.try_lock().unwrap();
    for command in ["reproduce --out out", "run mine.toml --out out"] {
        let error = folder.fail(command, 1);
        assert!(error.contains("another command is writing"), "{error}");
    }
    drop(held);
    folder.succeed("run mine.toml --out out");
}

#[test]
fn closed_streams_do_not_lose_results() {
    let folder = folder("streams");
    // Few samples, which causes a warning.
    folder.succeed("run paper --out paper-run");
    let samples = fs::read_to_string(folder.path("paper-run/agent1_cycle1_samples.csv")).unwrap();
    let few: Vec<_> = samples.lines().take(402).collect();
    folder.write("few.csv", &(few.join("\n") + "\n"));
    let train = "$HS train few.csv --scenario paper --agent 1 --out";
    let (said, _) = shell(&folder, &format!("{train} warned.weights 2>&1 >/dev/null"));
    assert!(said.starts_with("warning: "), "{said}");
    for (line, code, made) in [
        (format!("{train} a.weights 2>/dev/full"), 0, "a.weights"),
        (format!("{train} b.weights 2>&-"), 0, "b.weights"),
        (format!("{train} c.weights >&- 2>&-"), 0, "c.weights"),
        (format!("{train} d.weights >/dev/full 2>&1"), 1, "d.weights"),
        (
            format!("{{ {train} e.weights; echo $? >e.code; }} | true; exit $(cat e.code)"),
            0,
            "e.weights",
        ),
        (
            format!(
                "{{ {train} f.weights 2>&1 >/dev/null; echo $? >f.code; }} | true; exit $(cat f.code)"
            ),
            0,
            "f.weights",
        ),
        ("$HS run mine.toml --out g >/dev/full 2>/dev/full".to_owned(), 1, "g/traces.csv"),
        ("$HS run none.toml --format json >/dev/full 2>/dev/full".to_owned(), 2, "few.csv"),
        ("$HS --nonsense 2>/dev/full".to_owned(), 2, "few.csv"),
        ("$HS --help >/dev/full 2>/dev/full".to_owned(), 1, "few.csv"),
        ("$HS scenario paper >/dev/full 2>/dev/full".to_owned(), 1, "few.csv"),
    ] {
        if !cfg!(target_os = "linux") && line.contains("/dev/full") {
            continue;
        }
        assert_eq!(shell(&folder, &line).1, Some(code), "{line}");
        assert!(folder.path(made).exists(), "{line}");
    }
    // Errors keep exit code 2 if the reader is gone.
    let line =
        "{ $HS weights verify few.csv --format json; echo $? >code; } | true; exit $(cat code)";
    assert_eq!(shell(&folder, line).1, Some(2));
}

#[test]
fn json_errors_have_code_text_file_and_line() {
    let folder = folder("json-errors");
    folder.write("wrong.toml", &short().text().replace("duration = 0.8", "duration = -0.8"));
    fs::create_dir(folder.path("other")).unwrap();
    folder.write("other/agents.csv", "mine\n");
    let line = short().text().lines().position(|line| line.starts_with("duration")).unwrap() + 1;
    for (arguments, exit, code, file, line) in [
        ("run wrong.toml", 2, "invalid-scenario", Some("wrong.toml"), Some(line)),
        ("run none.toml", 2, "invalid-scenario", Some("none.toml"), None),
        ("run mine.toml --out other", 2, "output-refused", Some("other/agents.csv"), None),
        ("run mine.toml --out node.weights", 1, "output-failed", Some("node.weights"), None),
        ("run mine.toml --nonsense", 2, "usage", None, None),
        ("run", 2, "usage", None, None),
        ("reproduce --recipe best", 2, "usage", None, None),
        (
            "train none.csv --scenario mine.toml --agent 1 --out x",
            2,
            "invalid-samples",
            Some("none.csv"),
            None,
        ),
        ("train none.csv --scenario mine.toml --agent 9 --out x", 2, "usage", None, None),
        ("weights inspect mine.toml", 2, "invalid-package", Some("mine.toml"), None),
        ("weights verify mine.toml", 2, "invalid-package", None, None),
        ("weights diff node.weights none", 2, "invalid-package", Some("none"), None),
        ("weights sign node.weights --key mine.toml", 2, "invalid-key", Some("mine.toml"), None),
        (
            "weights keygen --out node.weights/below",
            1,
            "output-failed",
            Some("node.weights/below.pub"),
            None,
        ),
        ("weights export node.weights --out x.txt", 2, "invalid-network", Some("x.txt"), None),
        (
            "weights import x.npz --base node.weights --out y",
            2,
            "invalid-network",
            Some("x.npz"),
            None,
        ),
        (
            "weights image node.weights --slot a --memory mine.toml",
            2,
            "invalid-memory-map",
            Some("mine.toml"),
            Some(1),
        ),
        ("monitor unix:none", 1, "node-unreachable", None, None),
        ("push unix:none none", 2, "invalid-package", Some("none"), None),
        ("node unix:none", 1, "node-unreachable", None, None),
        ("cosim none.toml", 2, "invalid-scenario", Some("none.toml"), None),
    ] {
        let output = folder.run(&format!("{arguments} --format json"));
        let (standard, said) = texts(&output);
        assert_eq!(output.status.code(), Some(exit), "{arguments}: {standard}{said}");
        let error = &object(&standard)["error"];
        assert_eq!(error["code"], code, "{arguments}: {error}");
        assert!(error["text"].as_str().is_some_and(|text| !text.is_empty()), "{arguments}");
        if file.is_some() || code == "usage" {
            assert_eq!(error["file"].as_str(), file, "{arguments}: {error}");
        }
        if line.is_some() {
            assert_eq!(
                error["line"].as_u64(),
                line.map(|line| line as u64),
                "{arguments}: {error}"
            );
        }
        assert!(said.starts_with("error: "), "{arguments}: {said}");
    }
}

#[test]
fn control_characters_from_files_are_escaped() {
    let folder = folder("escapes");
    // In TOML syntax.
    let name = r#""\u001b[2J\r\nok\u009b\u202e""#;
    let recipe = short().text().replace("\"short\"", name);
    let recipe = recipe.replace("recipes.short", &format!("recipes.{name}"));
    assert_eq!(recipe.matches(name).count(), 2);
    folder.write("evil.toml", &recipe);
    let evil = "no\u{1b}[2J\u{7f}\u{202e}.toml";
    for arguments in [
        vec!["run", "evil.toml"],
        vec!["weights", "inspect", "out/scenario_builder/agent1_cycle1.weights"],
        vec!["run", evil],
        vec!["run", evil, "--format", "json"],
        vec!["weights", "inspect", evil],
        vec!["weights", "keygen", "--out", evil],
        vec!["scenario", evil],
        vec!["train", evil, "--scenario", evil, "--agent", "1", "--out", evil],
        vec![evil],
    ] {
        let output = program(&folder, "").args(&arguments).output().unwrap();
        let (standard, error) = texts(&output);
        for c in (standard + &error).chars() {
            let plain = !c.is_control() && c != '\u{202e}';
            assert!(plain || c == '\n' || c == '\t', "{c:?} of {arguments:?}");
        }
    }
}

#[test]
fn built_in_names_take_precedence_over_files() {
    let folder = Folder::new("hidden");
    fs::create_dir(folder.path("paper")).unwrap();
    let listed = |output: std::process::Output| {
        assert_eq!(output.status.code(), Some(0));
        (object(&texts(&output).0), texts(&output).1)
    };
    let run = "run paper --format json --without-learning --out out";
    let (report, said) = listed(folder.run(run));
    assert_eq!((&report["scenario"], said.as_str()), (&"paper".into(), ""));
    // A file with that name needs a folder in its path.
    fs::remove_dir(folder.path("paper")).unwrap();
    folder.write("paper", &short().text());
    let (report, said) = listed(folder.run(run));
    assert_eq!(report["scenario"], "paper");
    assert!(said.contains("write ./paper to use the file"), "{said}");
    let (report, said) = listed(folder.run("run ./paper --format json --out other"));
    assert_eq!((&report["scenario"], said.as_str()), (&"scenario_builder".into(), ""));
    let error = folder.fail("run papper", 2);
    assert!(
        error.contains("pass paper, ") && error.contains("host-sim scenario paper > mine.toml"),
        "{error}"
    );
}

#[test]
fn does_not_build_firmware_outside_a_project() {
    // Unlike the folders of other tests, not inside this project.
    let outside = tempfile::tempdir().unwrap();
    let mut child = Command::new(env!("CARGO_BIN_EXE_simulator-under-test"))
        .args(["cosim", "paper"])
        .current_dir(&outside)
        .env("CARGO", "/bin/false")
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut said = String::new();
    child.stderr.take().unwrap().read_to_string(&mut said).unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(2), "{said}");
    for way in ["--firmware", "--memory", "cargo xtask install"] {
        assert!(said.contains(way), "{said}");
    }
    assert!(!said.contains("building"), "{said}");
}
