//! A project of one's own, made of the template's files and nothing else.
//!
//! ```text
//! PATH/Cargo.toml           the workspace's, less what only this repository needs
//! PATH/memory.x             the board's memory map
//! PATH/.cargo/config.toml   target and runner
//! PATH/agent-core           manifest and sources
//! PATH/node                 firmware-template, with the board's program as `main.rs`
//! ```

mod manifest;

use std::{
    fs, io,
    path::{Path, PathBuf},
    process::Command,
};

use crate::{
    compiler::{Compiler, cross_folder},
    firmware::{BOARDS, Board, EMULATED},
    step::{Failure, run, target_folder, workspace},
};

/// What `cargo xtask new` is asked for.
#[derive(Debug)]
pub(crate) struct Options {
    path: PathBuf,
    board: &'static Board,
}

impl Options {
    /// Reads the arguments after the task; `None` if they are none.
    pub(crate) fn read(arguments: &[&str]) -> Option<Self> {
        let (path, name) = match *arguments {
            [path] => (path, EMULATED),
            [path, "--board", name] | ["--board", name, path] => (path, name),
            _ => return None,
        };
        let board = BOARDS.iter().find(|board| board.name == name)?;
        (!path.starts_with('-')).then(|| Self { path: path.into(), board })
    }
}

/// Makes a project.
///
/// # Errors
/// The folder holds something already, or cannot be written.
pub(crate) fn new(options: &Options) -> Result<(), Failure> {
    let Options { path, board } = options;
    if fs::read_dir(path).is_ok_and(|mut entries| entries.next().is_some()) {
        let what = format!("{} is not empty", path.display());
        return Err(Failure::new(what, "name a folder that does not exist yet"));
    }
    make(path, board)?;
    println!("{}: a node on {}; its README.md says how to go on", path.display(), board.name);
    Ok(())
}

/// Makes a project for each board and builds it, offline: the workspace's own build has brought
/// everything that they need.
///
/// # Errors
/// As [`new`], or one does not build.
pub(crate) fn check(debian: bool) -> Result<(), Failure> {
    for board in &BOARDS {
        let path = target_folder().join("projects").join(board.name);
        match fs::remove_dir_all(&path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                return Err(failed(&path, &error));
            }
            _ => {}
        }
        make(&path, board)?;
        let compiler = Compiler::find(&[board.target], debian)?;
        let mut build = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
        build.current_dir(&path).args(["build", "--quiet", "--release", "--offline"]);
        run(
            &format!("a project of one's own for {}", board.name),
            // One folder for all, since they share most of what they are made of.
            compiler.apply(&mut build).env("CARGO_TARGET_DIR", cross_folder().join("projects")),
            "see what xtask/src/project leaves out that the error above misses",
        )?;
    }
    Ok(())
}

fn make(path: &Path, board: &Board) -> Result<(), Failure> {
    let top = workspace();
    let template = top.join("firmware-template");
    let node = path.join("node");
    copy_sources(&top.join("agent-core/src"), &path.join("agent-core/src"))?;
    copy_sources(&template.join("src"), &node.join("src"))?;
    copy_sources(&template.join("examples"), &node.join("examples"))?;
    copy(&template.join("build.rs"), &node.join("build.rs"))?;
    copy(&template.join(format!("src/bin/{}.rs", board.name)), &node.join("src/main.rs"))?;
    copy(&board.memory_map(), &path.join("memory.x"))?;
    for file in ["Cargo.lock", "rustfmt.toml", "LICENSE-APACHE", "LICENSE-MIT"] {
        copy(&top.join(file), &path.join(file))?;
    }

    let node_manifest = manifest::node(&read(&template.join("Cargo.toml"))?, board)?;
    let core_manifest = manifest::core(&read(&top.join("agent-core/Cargo.toml"))?)?;
    let used = [&node_manifest, &core_manifest];
    let workspace_manifest = manifest::workspace(&read(&top.join("Cargo.toml"))?, used)?;
    write(&node.join("Cargo.toml"), &node_manifest.to_string())?;
    write(&path.join("agent-core/Cargo.toml"), &core_manifest.to_string())?;
    write(&path.join("Cargo.toml"), &workspace_manifest.to_string())?;

    let Board { name, target, runner, port, .. } = *board;
    let config =
        format!("[build]\ntarget = \"{target}\"\n\n[target.{target}]\nrunner = \"{runner}\"\n");
    write(&path.join(".cargo/config.toml"), &config)?;
    write(&path.join(".gitignore"), "/target\n# Private keys above all.\n*.key\n*.weights\n")?;
    let program = runner.split(' ').next().unwrap_or_default();
    let readme = include_str!("README.md")
        .replace("{board}", name)
        .replace("{target}", target)
        .replace("{port}", port)
        .replace("{program}", program);
    write(&path.join("README.md"), &readme)
}

/// Copies a folder with all below it, but for the programs of boards and what is hidden.
fn copy_sources(from: &Path, to: &Path) -> Result<(), Failure> {
    for entry in fs::read_dir(from).map_err(|error| failed(from, &error))? {
        let path = entry.map_err(|error| failed(from, &error))?.path();
        let name = path.file_name().unwrap_or_default();
        if name == "bin" || name.to_string_lossy().starts_with('.') {
            continue;
        }
        let target = to.join(name);
        if path.is_dir() { copy_sources(&path, &target)? } else { copy(&path, &target)? }
    }
    Ok(())
}

fn copy(from: &Path, to: &Path) -> Result<(), Failure> {
    write(to, &read(from)?)
}

fn read(path: &Path) -> Result<String, Failure> {
    fs::read_to_string(path).map_err(|error| failed(path, &error))
}

fn write(path: &Path, text: &str) -> Result<(), Failure> {
    let folder = path.parent().unwrap_or(path);
    fs::create_dir_all(folder).map_err(|error| failed(folder, &error))?;
    fs::write(path, text).map_err(|error| failed(path, &error))
}

fn failed(path: &Path, error: &io::Error) -> Failure {
    Failure::new(format!("{}: {error}", path.display()), "see that it can be read and written")
}
