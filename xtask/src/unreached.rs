//! Checks that every source file is a module of its crate: cargo compiles, formats and tests only those. Boards, fuzz
//! targets, examples and benchmarks are programs of one file each, which their manifests name.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use crate::step::Failure;

/// The folders to check, with all folders below them.
const SOURCES: [&str; 8] = [
    "agent-core/src",
    "agent-core/inner-network/src",
    "agent-core/integrity/src",
    "host-sim/src",
    "firmware-template/src",
    "python/src",
    "tests",
    "xtask/src",
];

/// Names of files that no `mod` has to name: roots of crates, and of the programs that cargo builds.
const ROOTS: [&str; 4] = ["lib", "main", "build", "integration"];

/// Checks every file.
///
/// # Errors
/// A file cannot be read, or no `mod` names it.
pub(crate) fn check(root: &Path) -> Result<(), Failure> {
    let mut found = BTreeSet::new();
    for source in SOURCES {
        let folder = root.join(source);
        unreached(&folder, &mut found).map_err(|error| {
            Failure::new(format!("{}: {error}", folder.display()), "check that it is readable")
        })?;
    }
    if found.is_empty() {
        return Ok(());
    }
    let names: Vec<_> =
        found.iter().map(|path| path.strip_prefix(root).unwrap_or(path).display()).collect();
    let names = names.iter().map(|name| format!("  {name}\n")).collect::<String>();
    Err(Failure::new(
        format!("source files that are not compiled:\n{}", names.trim_end()),
        "name each as `mod` in the mod.rs of its folder, or remove it",
    ))
}

/// Adds the files in `folder`, and in those below, that no file beside or above them names.
fn unreached(folder: &Path, found: &mut BTreeSet<PathBuf>) -> Result<(), std::io::Error> {
    let (mut files, mut text) = (Vec::new(), String::new());
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        // Programs are crates of their own; `target` has generated sources.
        if path.is_dir() && !path.ends_with("bin") && !path.ends_with("target") {
            unreached(&path, found)?;
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            text += &fs::read_to_string(&path)?;
            files.push(path);
        }
    }
    // `folder.rs` beside the folder is the module that the files belong to.
    text += &fs::read_to_string(folder.with_extension("rs")).unwrap_or_default();
    for path in files {
        let name = path.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
        let is_named = match name {
            // The module of the folder, which a file above it names.
            "mod" => is_named(&text_above(folder)?, own_name(folder)),
            name => ROOTS.contains(&name) || is_named(&text, name),
        };
        if !is_named {
            found.insert(path);
        }
    }
    Ok(())
}

fn own_name(folder: &Path) -> &str {
    folder.file_name().and_then(|name| name.to_str()).unwrap_or_default()
}

/// Returns the text of the files beside a folder, and of the module that these belong to.
fn text_above(folder: &Path) -> Result<String, std::io::Error> {
    let Some(above) = folder.parent() else { return Ok(String::new()) };
    let mut text = fs::read_to_string(above.with_extension("rs")).unwrap_or_default();
    for entry in fs::read_dir(above)? {
        let path = entry?.path();
        if path.extension().is_some_and(|extension| extension == "rs") {
            text += &fs::read_to_string(path)?;
        }
    }
    Ok(text)
}

/// Whether `text` has a `mod` of this name, or the path of its file.
fn is_named(text: &str, name: &str) -> bool {
    let path = format!("path = \"{name}.rs\"");
    text.contains(&format!("mod {name};")) || text.contains(&path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_without_a_mod_are_found() {
        let folder = std::env::temp_dir().join(format!("unreached-{}", std::process::id()));
        fs::create_dir_all(folder.join("inner")).unwrap();
        fs::create_dir_all(folder.join("lost")).unwrap();
        fs::create_dir_all(folder.join("kept")).unwrap();
        for (name, text) in [
            ("lost/mod.rs", "mod part;"),
            ("lost/part.rs", ""),
            ("kept/mod.rs", ""),
            ("lib.rs", "mod kept;\nmod inner;\n#[path = \"other_tests.rs\"]\nmod tests;"),
            ("other_tests.rs", ""),
            ("inner.rs", "pub(crate) mod used;"),
            ("inner/used.rs", ""),
            ("inner/forgotten.rs", "// mod forgotten_too"),
        ] {
            fs::write(folder.join(name), text).unwrap();
        }
        let mut found = BTreeSet::new();
        unreached(&folder, &mut found).unwrap();
        let expected = ["inner/forgotten.rs", "lost/mod.rs"].map(|name| folder.join(name));
        assert_eq!(found.into_iter().collect::<Vec<_>>(), expected);
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn every_file_of_this_project_is_compiled() {
        assert!(check(crate::step::workspace()).is_ok());
    }
}
