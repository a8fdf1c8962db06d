//! The boards of the template: one folder each in `firmware-template/boards`.
//!
//! Every folder there with a `Cargo.toml` is a board, so copying a folder adds one. The tasks read
//! its properties from the folder:
//!
//! | file | property |
//! | --- | --- |
//! | `.cargo/config.toml`, `build.target` | the target |
//! | `Cargo.toml`, `package.name` | the name of the program |
//! | `Cargo.toml`, `[features]` | besides those of all boards (`authentic-frames`, `signature`, `in-the-loop`): further variants of the program |
//! | `Cargo.toml`, `[package.metadata.budget]` | limits for flash, static RAM and stack in bytes |
//! | `memory.x` | the memory map |
//!
//! The shared profile and target folder are in `boards/.cargo/config.toml`.

use std::{
    fs,
    path::{Path, PathBuf},
};

use toml_edit::{DocumentMut, Item, TableLike};

use crate::step::{Failure, workspace};

/// The board that can be emulated.
pub(crate) const EMULATED: &str = "qemu-mps2-an386";

/// A board of the template.
#[derive(Debug)]
pub(crate) struct Board {
    /// Name of the folder.
    pub(crate) name: String,
    pub(crate) folder: PathBuf,
    /// Name of the package, and therefore of the program.
    pub(crate) package: String,
    pub(crate) target: String,
    /// Features of its own, each a variant of the program.
    pub(crate) features: Vec<String>,
    pub(crate) budget: Budget,
}

/// Features that every board may have.
const SHARED_FEATURES: [&str; 6] =
    ["default", "authentic-frames", "exchange", "field", "signature", "in-the-loop"];

/// Limits for a board's firmware. \[byte\]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Budget {
    /// Code and constants.
    pub(crate) flash: u64,
    /// Static memory.
    pub(crate) ram: u64,
    /// Worst-case stack.
    pub(crate) stack: u64,
}

impl Board {
    /// Reads the board in this folder.
    fn read(folder: PathBuf) -> Result<Self, Failure> {
        let manifest = read(&folder.join("Cargo.toml"))?;
        let config = read(&folder.join(".cargo/config.toml"))?;
        let text = |document: &DocumentMut, file: &str, path: &[&str]| {
            let found = get(document, path).and_then(Item::as_str).map(str::to_owned);
            found.ok_or_else(|| missing(&folder.join(file), path, "a string"))
        };
        let bytes = |what: &str| {
            let path = ["package", "metadata", "budget", what];
            let found = get(&manifest, &path).and_then(Item::as_integer);
            let found = found.and_then(|bytes| u64::try_from(bytes).ok());
            found.ok_or_else(|| missing(&folder.join("Cargo.toml"), &path, "a number of bytes"))
        };
        let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let package = text(&manifest, "Cargo.toml", &["package", "name"])?;
        let target = text(&config, ".cargo/config.toml", &["build", "target"])?;
        let budget = Budget { flash: bytes("flash")?, ram: bytes("ram")?, stack: bytes("stack")? };
        if !folder.join("memory.x").exists() {
            return Err(Failure::new(
                format!("{}: no memory map", folder.join("memory.x").display()),
                "copy the memory.x of a similar board and adapt it",
            ));
        }
        let features = get(&manifest, &["features"]).and_then(Item::as_table_like);
        let names = features.into_iter().flat_map(TableLike::iter).map(|(name, _)| name);
        let own = names.filter(|name| !SHARED_FEATURES.contains(name)).map(str::to_owned);
        Ok(Self { features: own.collect(), name, folder, package, target, budget })
    }

    /// Returns the path of the memory map.
    pub(crate) fn memory_map(&self) -> PathBuf {
        self.folder.join("memory.x")
    }
}

/// Returns the folder of all boards.
pub(crate) fn folder() -> PathBuf {
    workspace().join("firmware-template/boards")
}

/// Returns all boards, in alphabetical order.
///
/// # Errors
/// A board's folder is incomplete.
pub(crate) fn all() -> Result<Vec<Board>, Failure> {
    all_in(&folder())
}

fn all_in(boards: &Path) -> Result<Vec<Board>, Failure> {
    let entries = fs::read_dir(boards).map_err(|error| {
        Failure::new(format!("{}: {error}", boards.display()), "check out the complete repository")
    })?;
    let mut folders: Vec<PathBuf> = entries
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| path.join("Cargo.toml").is_file())
        .collect();
    folders.sort();
    folders.into_iter().map(Board::read).collect()
}

/// Returns the board with this name.
///
/// # Errors
/// There is no such board, or a folder is incomplete.
pub(crate) fn find(name: &str) -> Result<Board, Failure> {
    let mut boards = all()?;
    match boards.iter().position(|board| board.name == name) {
        Some(index) => Ok(boards.swap_remove(index)),
        None => {
            let names: Vec<&str> = boards.iter().map(|board| board.name.as_str()).collect();
            Err(Failure::new(
                format!("there is no board {name} in firmware-template/boards"),
                format!("choose one of {}, or copy one of the folders", names.join(", ")),
            ))
        }
    }
}

/// Returns the targets of these boards, without duplicates.
pub(crate) fn targets(boards: &[Board]) -> Vec<&str> {
    let mut targets: Vec<&str> = boards.iter().map(|board| board.target.as_str()).collect();
    targets.sort_unstable();
    targets.dedup();
    targets
}

/// Returns the settings shared by all boards, from `boards/.cargo/config.toml`.
///
/// # Errors
/// The file cannot be read or has no profile.
pub(crate) fn shared_config() -> Result<DocumentMut, Failure> {
    let path = folder().join(".cargo/config.toml");
    let config = read(&path)?;
    match get(&config, &["profile", "release"]) {
        Some(_) => Ok(config),
        None => Err(missing(&path, &["profile", "release"], "a table")),
    }
}

/// Returns arguments that give cargo's release profile the settings of the boards, for crates
/// outside their folder.
///
/// # Errors
/// Same as for [`shared_config`].
pub(crate) fn profile() -> Result<Vec<String>, Failure> {
    let config = shared_config()?;
    let mut settings = Vec::new();
    if let Some(profile) = get(&config, &["profile", "release"]).and_then(Item::as_table_like) {
        flatten("profile.release", profile, &mut settings);
    }
    let mut arguments = vec!["--release".to_owned()];
    for setting in settings {
        arguments.extend(["--config".to_owned(), setting]);
    }
    Ok(arguments)
}

/// Collects `key = value` for all values in a table, with their full keys.
fn flatten(prefix: &str, table: &dyn TableLike, found: &mut Vec<String>) {
    for (key, item) in table.iter() {
        let key = format!("{prefix}.{key}");
        match item.as_table_like() {
            Some(inner) => flatten(&key, inner, found),
            None => found.push(format!("{key}={}", item.to_string().trim())),
        }
    }
}

fn get<'a>(document: &'a DocumentMut, path: &[&str]) -> Option<&'a Item> {
    path.iter().try_fold(document.as_item(), |item, key| item.get(key))
}

/// Reads a TOML file.
///
/// # Errors
/// The file cannot be read or is invalid TOML.
pub(crate) fn read(path: &Path) -> Result<DocumentMut, Failure> {
    let failed = |problem: String| {
        Failure::new(
            format!("{}: {problem}", path.display()),
            "compare it with the other boards in firmware-template/boards",
        )
    };
    let text = fs::read_to_string(path).map_err(|error| failed(error.to_string()))?;
    text.parse().map_err(|error: toml_edit::TomlError| failed(error.to_string()))
}

fn missing(file: &Path, path: &[&str], kind: &str) -> Failure {
    Failure::new(
        format!("{}: {} is not {kind}", file.display(), path.join(".")),
        "compare it with the other boards in firmware-template/boards",
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the message for a board with these files.
    fn refusal(manifest: &str, config: Option<&str>, map: Option<&str>) -> String {
        let boards = std::env::temp_dir().join(format!(
            "boards-{}-{}",
            std::process::id(),
            manifest.len() + 7 * config.map_or(0, str::len) + map.map_or(0, |_| 1)
        ));
        let folder = boards.join("mine");
        fs::create_dir_all(folder.join(".cargo")).unwrap();
        fs::write(folder.join("Cargo.toml"), manifest).unwrap();
        for (name, text) in [(".cargo/config.toml", config), ("memory.x", map)] {
            if let Some(text) = text {
                fs::write(folder.join(name), text).unwrap();
            }
        }
        let found = all_in(&boards);
        fs::remove_dir_all(&boards).unwrap();
        match found {
            Ok(boards) => boards[0].name.clone(),
            Err(failure) => failure.what,
        }
    }

    #[test]
    fn an_incomplete_folder_reports_what_is_missing() {
        const MANIFEST: &str = "package.name = \"node\"\n[package.metadata.budget]\n\
                                flash = 1\nram = 2\nstack = 3\n";
        const CONFIG: &str = "build.target = \"thumbv6m-none-eabi\"\n";
        assert_eq!(refusal(MANIFEST, Some(CONFIG), Some("")), "mine");
        let no_map = refusal(MANIFEST, Some(CONFIG), None);
        assert!(no_map.ends_with("mine/memory.x: no memory map"), "{no_map}");
        let no_config = refusal(MANIFEST, None, Some(""));
        assert!(no_config.contains("mine/.cargo/config.toml: "), "{no_config}");
        let no_target = refusal(MANIFEST, Some("[build]\n"), Some(""));
        assert!(no_target.ends_with("config.toml: build.target is not a string"), "{no_target}");
        let no_budget = refusal(&MANIFEST.replace("ram = 2", ""), Some(CONFIG), Some(""));
        assert!(
            no_budget.ends_with("package.metadata.budget.ram is not a number of bytes"),
            "{no_budget}"
        );
    }

    #[test]
    fn every_board_of_the_template_is_complete() {
        let boards = all().unwrap();
        assert!(boards.iter().any(|board| board.name == EMULATED));
        for Board { name, package, .. } in &boards {
            assert_eq!(name, package, "the package has the name of its folder");
        }
        let features = |name: &str| {
            boards.iter().find(|board| board.name == name).map(|board| board.features.join(" "))
        };
        assert_eq!(features("stm32f405").as_deref(), Some("embassy"));
        assert_eq!(features("nrf52840").as_deref(), Some(""));
    }

    #[test]
    fn an_unknown_board_is_refused_with_the_known_ones() {
        let failure = find("stm32").unwrap_err();
        assert_eq!(failure.what, "there is no board stm32 in firmware-template/boards");
        assert!(failure.hint.contains("qemu-mps2-an386"), "{}", failure.hint);
    }

    #[test]
    fn the_shared_profile_becomes_arguments() {
        let arguments = profile().unwrap();
        assert_eq!(arguments[0], "--release");
        assert!(arguments.contains(&"profile.release.lto=\"fat\"".to_owned()), "{arguments:?}");
    }
}
