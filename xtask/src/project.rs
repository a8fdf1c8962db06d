//! Creates a separate project: a copy of a board's folder that builds anywhere.
//!
//! Two things in the folder refer to other folders and are rewritten: paths in `Cargo.toml` (the
//! node's crates, the build script), and the shared profile, which is copied into
//! `.cargo/config.toml`. The crates stay in this checkout, or are copied into the project.
//!
//! ```text
//! PATH/Cargo.toml, Cargo.lock, memory.x, src, README.md   the board's
//! PATH/.cargo/config.toml   target, runner, and the boards' profile
//! PATH/crates               with --copy-crates: agent-core, firmware-template, and their workspace
//! ```

use std::{
    fs, io,
    path::{Component, Path, PathBuf},
};

use toml_edit::{Array, DocumentMut, Item, TableLike, Value, value};

use crate::{
    boards::{self, Board},
    compiler::{self, Compiler},
    firmware,
    step::{Failure, cargo_in, target_folder, workspace},
};

/// Arguments of `cargo xtask new`.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Options {
    path: PathBuf,
    board: String,
    copy_crates: bool,
}

impl Options {
    /// Reads the arguments after the task; `None` if they are invalid.
    pub(crate) fn read(arguments: &[&str]) -> Option<Self> {
        let (mut path, mut board, mut copy_crates) = (None, boards::EMULATED, false);
        let mut arguments = arguments.iter();
        while let Some(&argument) = arguments.next() {
            match argument {
                "--board" => board = arguments.next()?,
                "--copy-crates" => copy_crates = true,
                name if name.starts_with('-') || path.is_some() => return None,
                name => path = Some(PathBuf::from(name)),
            }
        }
        Some(Self { path: path?, board: board.to_owned(), copy_crates })
    }
}

/// Creates a project.
///
/// # Errors
/// There is no such board, or the folder is not empty or cannot be written.
pub(crate) fn new(options: &Options) -> Result<(), Failure> {
    let Options { path, board, copy_crates } = options;
    let board = boards::find(board)?;
    if fs::read_dir(path).is_ok_and(|mut entries| entries.next().is_some()) {
        let what = format!("{} is not empty", path.display());
        return Err(Failure::new(what, "name a folder that does not exist yet"));
    }
    make(path, &board, *copy_crates)?;
    println!("{}: a node on {}; see its README.md for the next steps", path.display(), board.name);
    if !compiler::active_toolchain_has(&board.target) {
        println!(
            "note: the active toolchain cannot compile for {target} yet: rustup target add {target}",
            target = board.target
        );
        println!(
            "  without rustup, on Debian: `cargo xtask firmware --board {}` installs a compiler here; \
             then build the project with RUSTC={}/bin/rustc",
            board.name,
            compiler::sysroot_folder().display()
        );
    }
    Ok(())
}

/// Creates projects and builds them: one for the emulated board with the crates copied, and one for
/// each other board with the crates in this checkout.
///
/// # Errors
/// Same as for [`new`], or a build fails.
pub(crate) fn check(compiler: &Compiler, boards: &[Board]) -> Result<(), Failure> {
    for board in boards {
        let path = target_folder().join("projects").join(&board.name);
        match fs::remove_dir_all(&path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                return Err(failed(&path, &error));
            }
            _ => {}
        }
        make(&path, board, board.name == boards::EMULATED)?;
        // Its dependencies have been built for the board itself.
        let mut build = cargo_in(&path, "build");
        build.args(["--quiet", "--release", "--offline"]);
        firmware::build_with(
            compiler,
            board,
            &mut build,
            &format!("a project with {}", board.name),
        )?;
    }
    Ok(())
}

fn make(path: &Path, board: &Board, copy_crates: bool) -> Result<(), Failure> {
    copy_folder(&board.folder, path)?;
    let crates = if copy_crates { PathBuf::from("crates") } else { workspace().to_owned() };
    let mut manifest = boards::read(&board.folder.join("Cargo.toml"))?;
    redirect(manifest.as_table_mut(), &board.folder, &crates);
    if copy_crates {
        // They are a separate workspace, whose settings they inherit.
        manifest["workspace"]["exclude"] = value(Array::from_iter(["crates"]));
    }
    write(&path.join("Cargo.toml"), &manifest.to_string())?;
    let mut config = boards::read(&board.folder.join(".cargo/config.toml"))?;
    config["profile"] = boards::shared_config()?["profile"].clone();
    write(&path.join(".cargo/config.toml"), &config.to_string())?;
    write(&path.join(".gitignore"), "/target\n# Private keys above all.\n*.key\n*.weights\n")?;
    if copy_crates { copy_workspace(&path.join("crates")) } else { Ok(()) }
}

/// The crates of a node, from the root of the workspace.
const NODE_CRATES: [&str; 4] =
    ["agent-core", "agent-core/inner-network", "agent-core/integrity", "firmware-template"];

/// Copies the node's crates and the parts of the workspace that their manifests use.
fn copy_workspace(to: &Path) -> Result<(), Failure> {
    let top = workspace();
    copy_folder(&top.join("agent-core"), &to.join("agent-core"))?;
    let template = Path::new("firmware-template");
    for part in ["src", "examples"] {
        copy_folder(&top.join(template).join(part), &to.join(template).join(part))?;
    }
    let files = ["firmware-template/Cargo.toml", "firmware-template/boards/build.rs"];
    for file in files.into_iter().chain(["rustfmt.toml", "LICENSE-APACHE", "LICENSE-MIT"]) {
        copy(&top.join(file), &to.join(file))?;
    }
    let mut manifest: DocumentMut = boards::read(&top.join("Cargo.toml"))?;
    manifest["workspace"]["members"] = value(Array::from_iter(NODE_CRATES));
    if let Some(workspace) = manifest["workspace"].as_table_like_mut() {
        workspace.remove("default-members");
        workspace.remove("exclude");
    }
    write(&to.join("Cargo.toml"), &manifest.to_string())
}

/// Redirects every path in a manifest that points outside `folder` to the same place below `crates`.
fn redirect(table: &mut dyn TableLike, folder: &Path, crates: &Path) {
    for (key, item) in table.iter_mut() {
        let is_path = ["path", "build"].contains(&key.get());
        match item {
            Item::Value(Value::String(text)) if is_path && text.value().starts_with("..") => {
                if let Some(place) = below_workspace(&folder.join(text.value())) {
                    *item = value(crates.join(place).display().to_string());
                }
            }
            _ => {
                if let Some(inner) = item.as_table_like_mut() {
                    redirect(inner, folder, crates);
                }
            }
        }
    }
}

/// Returns the part of a path below the workspace, without `..`.
fn below_workspace(path: &Path) -> Option<PathBuf> {
    let mut plain = PathBuf::new();
    for component in path.components() {
        match component {
            Component::ParentDir => {
                plain.pop();
            }
            other => plain.push(other),
        }
    }
    plain.strip_prefix(workspace()).ok().map(Path::to_owned)
}

/// Copies a folder recursively, except for build output.
fn copy_folder(from: &Path, to: &Path) -> Result<(), Failure> {
    for entry in fs::read_dir(from).map_err(|error| failed(from, &error))? {
        let path = entry.map_err(|error| failed(from, &error))?.path();
        let name = path.file_name().unwrap_or_default();
        let target = to.join(name);
        if path.is_dir() && name != "target" {
            copy_folder(&path, &target)?;
        } else if path.is_file() {
            copy(&path, &target)?;
        }
    }
    Ok(())
}

fn copy(from: &Path, to: &Path) -> Result<(), Failure> {
    write(to, &fs::read_to_string(from).map_err(|error| failed(from, &error))?)
}

fn write(path: &Path, text: &str) -> Result<(), Failure> {
    let folder = path.parent().unwrap_or(path);
    fs::create_dir_all(folder).map_err(|error| failed(folder, &error))?;
    fs::write(path, text).map_err(|error| failed(path, &error))
}

fn failed(path: &Path, error: &io::Error) -> Failure {
    Failure::new(format!("{}: {error}", path.display()), "check that it is readable and writable")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_are_read_in_any_order() {
        let expected = |board: &str, copy_crates| {
            Some(Options { path: "../mine".into(), board: board.to_owned(), copy_crates })
        };
        assert_eq!(Options::read(&["../mine"]), expected(boards::EMULATED, false));
        let all = ["--copy-crates", "--board", "b", "../mine"];
        assert_eq!(Options::read(&all), expected("b", true));
        for wrong in [&[][..], &["--board", "b"], &["a", "b"], &["a", "--bord"], &["a", "--board"]]
        {
            assert_eq!(Options::read(wrong), None, "{wrong:?}");
        }
    }

    #[test]
    fn paths_out_of_the_folder_lead_to_the_crates() {
        let text = "package.build = \"../build.rs\"\nbin = { path = \"src/main.rs\" }\n\
                    [dependencies]\ncore = { path = \"../../../agent-core\" }\nother = \"1\"\n";
        let mut manifest: DocumentMut = text.parse().unwrap();
        let folder = workspace().join("firmware-template/boards/mine");
        redirect(manifest.as_table_mut(), &folder, Path::new("crates"));
        let expected = text
            .replace("../build.rs", "crates/firmware-template/boards/build.rs")
            .replace("../../../agent-core", "crates/agent-core");
        let plain = |text: &str| text.replace(' ', "");
        assert_eq!(plain(&manifest.to_string()), plain(&expected));
    }
}
