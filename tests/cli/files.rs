//! Existing files and folders, as commands handle them.

use std::fs;
use std::io::Read;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::cli::command_line::{Folder, object, short, texts};

const MEMORY: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../memory.x");
const TRAIN: &str = "train out/agent1_cycle1_samples.csv --scenario mine.toml --agent 1";

/// Creates a folder with a scenario, a run of it, and a package.
pub(super) fn folder(name: &str) -> Folder {
    let folder = Folder::new(name);
    // The quality of its networks does not matter here.
    let text = short().text().replace("\nevents = ", "\nsamples = true\nevents = ");
    folder.write("mine.toml", &text);
    done(&folder.run("run mine.toml --out out"));
    fs::copy(folder.path("out/agent1_cycle1.weights"), folder.path("node.weights")).unwrap();
    folder
}

/// Returns the output of a command that succeeded, possibly with warnings.
pub(super) fn done(output: &Output) -> String {
    let (standard, error) = texts(output);
    assert_eq!(output.status.code(), Some(0), "{standard}{error}");
    assert!(error.lines().all(|line| line.starts_with("warning: ")), "{error}");
    standard
}

/// Returns the program with these arguments, separated by blanks.
pub(super) fn program(folder: &Folder, arguments: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_simulator-under-test"));
    command.args(arguments.split_whitespace()).current_dir(folder.path("."));
    command
}

/// Runs a shell command line in which `$HS` is the program; returns its output and exit code.
pub(super) fn shell(folder: &Folder, line: &str) -> (String, Option<i32>) {
    let output = Command::new("sh")
        .args(["-c", line])
        .env("HS", env!("CARGO_BIN_EXE_simulator-under-test"))
        .current_dir(folder.path("."))
        .output()
        .unwrap();
    (texts(&output).0, output.status.code())
}

/// Returns the names of all entries of a folder, including hidden ones.
pub(super) fn names(folder: &Folder, name: &str) -> Vec<String> {
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
    for (out, advice) in [
        ("blocked/below.weights", "blocked is not a folder; choose another one"),
        ("/proc/no/x.weights", "check that"),
    ] {
        let error = folder.fail(&format!("{endless} --out {out}"), 1);
        assert!(error.contains(out) && error.contains(advice), "{error}");
    }
    assert!(folder.fail(&format!("{endless} --out blocked"), 2).contains("blocked"));
    assert!(folder.fail(&format!("{endless} --out out"), 2).contains("is a folder"));
}

/// Returns the arguments, except `--out`, of a training on noise that takes hours.
pub(super) fn endless(folder: &Folder) -> String {
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

/// An endless file ends every command that reads one, soon.
#[cfg(target_os = "linux")]
#[test]
fn endless_files_are_refused() {
    let folder = Folder::new("endless-files");
    folder.write("mine.toml", &short().text());
    let recorded = "name = \"own\"\n[plant]\nmodel = \"recording\"\nfile = \"/dev/zero\"\nstates = [\"x\"]\n\
                    [time]\nduration = 1.0\nstep = 0.5\n";
    folder.write("recorded.toml", recorded);
    fs::create_dir(folder.path("results")).unwrap();
    symlink("/dev/zero", folder.path("results/results.json")).unwrap();
    fs::create_dir(folder.path("table")).unwrap();
    symlink("/dev/zero", folder.path("table/results.csv")).unwrap();
    for command in [
        "sweep --summarise /dev/zero",
        "sweep --summarise /dev/zero --format json",
        "sweep --summarise table/results.csv",
        "sweep mine.toml --points /dev/zero",
        "run /dev/zero",
        "check recorded.toml",
        "train /dev/zero --scenario paper --agent 1 --out new.weights",
        "run mine.toml --weights /dev/zero",
        "weights inspect /dev/zero",
        "weights import /dev/zero --scenario paper --agent 1 --out new.weights",
        "report results",
        "report table",
    ] {
        let mut child = folder.start(command);
        let start = Instant::now();
        let status = loop {
            if let Some(status) = child.try_wait().unwrap() {
                break status;
            }
            if start.elapsed() > Duration::from_secs(30) {
                child.kill().unwrap();
                panic!("{command}: still reads");
            }
            std::thread::sleep(Duration::from_millis(20));
        };
        assert_eq!(status.code(), Some(2), "{command}");
    }
    let message = folder.fail("sweep --summarise /dev/zero", 2);
    assert!(message.contains("/dev/zero: is binary data, not text"), "{message}");
}
