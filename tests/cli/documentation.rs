//! The commands in the documentation: every line of every `sh` block is run, or it is known where
//! it is run.
//!
//! | block | what happens here |
//! | --- | --- |
//! | `sh` | the blocks of a page run in order in a folder of their own |
//! | `sh cosim` | run by [`cosim_in_qemu_runs_the_documented_commands`], which needs the firmware |
//! | `sh hardware` | needs a board: only its command line is checked |

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use super::command_line::{Folder, texts};

const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/..");

/// Commands that other parts of CI run, some of them in a shorter form, by their first words.
const RUN_BY_CI: [&str; 22] = [
    ".venv/bin/pip install './python[",
    "STORE_CUTS=all cargo test --release -p integration-tests",
    "STORE_HISTORIES=1000000 cargo test --release -p integration-tests",
    "cp -r firmware-template/boards/",
    "cargo test --workspace",
    "cargo test -p",
    "cargo bench -p",
    "cargo run -p firmware-template --example my_board",
    "cargo run --release -p host-sim --example",
    "cargo xtask test",
    "cargo xtask cross",
    "cargo xtask emulate",
    "cargo xtask firmware --board",
    "cargo xtask fuzz",
    "cargo xtask lint",
    "cargo xtask new",
    "cargo xtask page",
    "cargo xtask python",
    "cargo xtask size",
    "cargo xtask soak",
    "cargo xtask studies",
    "python3 -m venv .venv",
];

/// What follows the three backticks of a block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Run,
    Cosim,
    Hardware,
}

/// A block of commands: where it begins, and its lines without their comments.
#[derive(Debug)]
struct Block {
    place: String,
    kind: Kind,
    commands: Vec<String>,
}

/// The pages for readers. A board's README is not one of them: `cargo xtask cross` builds every board
/// as it says.
fn pages() -> Vec<PathBuf> {
    let mut pages = vec![Path::new(ROOT).join("README.md")];
    let root = Path::new(ROOT);
    pages.push(root.join("CONTRIBUTING.md"));
    pages.push(root.join("tests/README.md"));
    for entry in fs::read_dir(root.join("docs")).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|ending| ending == "md") {
            pages.push(path);
        }
    }
    pages.sort();
    pages
}

fn blocks(page: &Path) -> Vec<Block> {
    let text = fs::read_to_string(page).unwrap();
    let mut blocks = Vec::new();
    let mut open: Option<Option<Block>> = None;
    for (index, line) in text.lines().enumerate() {
        match (&mut open, line.strip_prefix("```")) {
            (None, Some(info)) => {
                let kind = match info {
                    "sh" => Some(Kind::Run),
                    "sh cosim" => Some(Kind::Cosim),
                    "sh hardware" => Some(Kind::Hardware),
                    other => {
                        assert!(!other.starts_with("sh"), "{}: {other}", page.display());
                        None
                    }
                };
                let place = format!("{}:{}", page.display(), index + 1);
                open = Some(kind.map(|kind| Block { place, kind, commands: Vec::new() }));
            }
            (Some(block), Some(_)) => {
                blocks.extend(block.take());
                open = None;
            }
            (Some(Some(block)), None) => {
                let command = line.split_once(" #").map_or(line, |(command, _)| command).trim();
                if !command.is_empty() {
                    block.commands.push(command.to_owned());
                }
            }
            _ => {}
        }
    }
    assert!(open.is_none(), "{}: a block does not end", page.display());
    blocks
}

/// The simulator's arguments in `command`, if it runs the simulator.
fn simulator_arguments(command: &str) -> Option<&str> {
    match command.strip_prefix("cargo run --release") {
        Some(rest) => rest.strip_prefix(" -- ").or(rest.is_empty().then_some("")),
        None => command.strip_prefix("host-sim "),
    }
}

/// A folder with what the commands expect in the checkout that they are run in.
fn checkout(name: &str) -> Folder {
    let folder = Folder::new(name);
    fs::copy(Path::new(ROOT).join("memory.x"), folder.path("memory.x")).unwrap();
    for name in [
        "experiment/tanks.csv",
        "experiment/tanks.toml",
        "relearning/relearning.toml",
        "wscc9/wscc9.toml",
    ] {
        let name = format!("host-sim/examples/{name}");
        let copy = folder.path(&name);
        fs::create_dir_all(copy.parent().unwrap()).unwrap();
        fs::copy(Path::new(ROOT).join(&name), copy).unwrap();
    }
    folder
}

/// Runs the simulator; its standard output goes where `> FILE` says, if it does.
fn run(folder: &Folder, command: &str, extra: &str) -> Output {
    let arguments = simulator_arguments(command).unwrap();
    let (arguments, file) = match arguments.split_once(" > ") {
        Some((arguments, file)) => (arguments, Some(file)),
        None => (arguments, None),
    };
    let output = folder.run(&format!("{arguments} {extra}"));
    if let Some(file) = file {
        fs::write(folder.path(file), &output.stdout).unwrap();
    }
    output
}

#[test]
fn documented_commands_work() {
    let mut ran = 0;
    for page in pages() {
        let name = page.file_stem().unwrap().to_str().unwrap().to_lowercase();
        let folder = checkout(&format!("documented-{name}"));
        for block in blocks(&page).iter().filter(|block| block.kind == Kind::Run) {
            for command in &block.commands {
                if RUN_BY_CI.iter().any(|known| command.starts_with(known)) {
                    continue;
                }
                let place = &block.place;
                assert!(
                    simulator_arguments(command).is_some(),
                    "{place}: `{command}` is run by no test; see this test's module"
                );
                let output = run(&folder, command, "");
                let (_, error) = texts(&output);
                assert!(output.status.success(), "{place}: {command}: {error}");
                ran += 1;
            }
        }
    }
    assert!(ran > 20, "only {ran} commands were found");
}

#[test]
fn documented_commands_for_hardware_are_understood() {
    let folder = checkout("documented-hardware");
    let blocks = pages().iter().flat_map(|page| blocks(page)).collect::<Vec<_>>();
    let hardware: Vec<_> = blocks.iter().filter(|block| block.kind == Kind::Hardware).collect();
    assert!(!hardware.is_empty());
    let check = |block: &Block, command: &String| {
        // No firmware is built for nodes that are not started.
        let is_cosim = command.starts_with("host-sim cosim");
        let firmware = if is_cosim { "--firmware memory.x" } else { "" };
        let (told, _) = texts(&run(&folder, command, &format!("--format json {firmware}")));
        let told: serde_json::Value = serde_json::from_str(&told).unwrap();
        let code = told["error"]["code"].as_str();
        assert!(code.is_some_and(|code| code != "usage"), "{}: {command}: {told}", block.place);
    };
    // At the same time, because most wait for a node.
    std::thread::scope(|scope| {
        for block in hardware {
            for command in &block.commands {
                scope.spawn(|| check(block, command));
            }
        }
    });
}

/// A command that runs until it is killed.
struct Background(Child);

impl Drop for Background {
    fn drop(&mut self) {
        let process = self.0.id().to_string();
        let _ = Command::new("kill").args(["-INT", &process]).status();
        let _ = self.0.wait();
    }
}

#[cfg(unix)]
#[test]
#[ignore = "needs the firmware and QEMU; cargo xtask test runs it"]
fn cosim_in_qemu_runs_the_documented_commands() {
    let firmware = std::env::var("QEMU_MPS2_AN386_FIRMWARE").expect("the firmware's ELF file");
    let mut ran = 0;
    for page in pages() {
        let name = page.file_stem().unwrap().to_str().unwrap().to_lowercase();
        let folder = checkout(&format!("documented-cosim-{name}"));
        for block in blocks(&page).iter().filter(|block| block.kind == Kind::Cosim) {
            let mut background = Vec::new();
            for command in &block.commands {
                let is_cosim = command.starts_with("host-sim cosim");
                let extra = if is_cosim { format!("--firmware {firmware}") } else { String::new() };
                let place = &block.place;
                ran += 1;
                if let Some(command) = command.strip_suffix(" &") {
                    let arguments = simulator_arguments(command).unwrap();
                    background.push(Background(start(&folder, &format!("{arguments} {extra}"))));
                    wait_for(&folder.path("nodes/agent-1.sock"));
                    continue;
                }
                let output = run(&folder, command, &extra);
                let (_, error) = texts(&output);
                assert!(output.status.success(), "{place}: {command}: {error}");
            }
        }
    }
    assert!(ran > 5, "only {ran} commands were found");
}

/// Starts the simulator without anyone who reads what it says.
fn start(folder: &Folder, arguments: &str) -> Child {
    Command::new(env!("CARGO_BIN_EXE_simulator-under-test"))
        .args(arguments.split_whitespace())
        .current_dir(folder.path("."))
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

/// Waits until a file is there, at most a minute.
fn wait_for(path: &Path) {
    for _ in 0..600 {
        if path.exists() {
            return;
        }
        std::thread::sleep(Duration::from_millis(100));
    }
    panic!("{} does not appear", path.display());
}

#[test]
fn links_between_pages_lead_somewhere() {
    let mut pages = pages();
    for name in ["ARCHITECTURE.md", "CHANGELOG.md", "docs/decisions/README.md"] {
        pages.push(Path::new(ROOT).join(name));
    }
    for page in pages {
        let text = fs::read_to_string(&page).unwrap();
        let is_mark =
            |line: &str| ["<<<<<<< ", ">>>>>>> "].iter().any(|mark| line.starts_with(mark));
        assert!(!text.lines().any(is_mark), "{}: an unfinished merge", page.display());
        for (_, rest) in text.match_indices("](").map(|(at, _)| text.split_at(at + 2)) {
            let target = rest.split(')').next().unwrap();
            if target.starts_with("http") || target.starts_with('#') {
                continue;
            }
            let file = target.split('#').next().unwrap();
            let path = page.parent().unwrap().join(file);
            assert!(path.exists(), "{}: {target}", page.display());
        }
    }
}

#[test]
fn every_page_is_in_its_index() {
    for (folder, index) in
        [("docs", "docs/README.md"), ("docs/decisions", "docs/decisions/README.md")]
    {
        let index_text = fs::read_to_string(Path::new(ROOT).join(index)).unwrap();
        for entry in fs::read_dir(Path::new(ROOT).join(folder)).unwrap() {
            let name = entry.unwrap().file_name().into_string().unwrap();
            if name.ends_with(".md") && name != "README.md" {
                assert!(index_text.contains(&format!("]({name})")), "{index} lacks {name}");
            }
        }
    }
}

#[test]
fn pictures_are_what_the_simulator_draws() {
    let folder = Folder::new("documented-pictures");
    folder.succeed("run paper --out drawn");
    for name in ["errors.svg", "events.svg"] {
        let shown = fs::read(Path::new(ROOT).join("docs/pictures").join(name)).unwrap();
        let drawn = fs::read(folder.path("drawn").join(name)).unwrap();
        assert!(shown == drawn, "docs/pictures/{name}: copy the one of `run paper`");
    }
}
