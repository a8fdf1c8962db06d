//! Links the board that is built with its own memory map.
//!
//! cortex-m-rt's linker script says `INCLUDE memory.x`, and linkers look for that name in the
//! working directory first. Cargo works at the top of the workspace, where the map of *one* board
//! lies, so any other board would be linked with a foreign map without a word. The script that is
//! handed to the linker is therefore cortex-m-rt's with the board's map named by its full path.

use std::{
    env,
    error::Error,
    fs,
    path::{Path, PathBuf},
};

/// The features that select a board. Its memory map is `boards/<board>.x`, if there is one, and
/// otherwise the one at the top.
const BOARDS: [&str; 3] = [EMULATED, "stm32f405", "nrf52840"];

/// A board without a peripheral access crate.
const EMULATED: &str = "qemu-mps2-an386";

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed=build.rs");
    if env::var("CARGO_CFG_TARGET_OS")? != "none" {
        return Ok(());
    }
    let mut boards = BOARDS.into_iter().filter(|board| {
        let variable = board.to_uppercase().replace('-', "_");
        env::var_os(format!("CARGO_FEATURE_{variable}")).is_some()
    });
    let Some(board) = boards.next() else { return Ok(()) };
    if boards.next().is_some() {
        return Err("two boards were asked for; name one with --features".into());
    }
    let out = PathBuf::from(env::var("OUT_DIR")?);
    let own_map = Path::new("boards").join(format!("{board}.x"));
    let map = if own_map.exists() { &own_map } else { Path::new("../memory.x") };
    let map = fs::canonicalize(map).map_err(|error| format!("{}: {error}", map.display()))?;
    println!("cargo::rerun-if-changed={}", map.display());

    let script = out.join("board.x");
    let runtime = runtime_script(&out)?;
    println!("cargo::rerun-if-changed={}", runtime.display());
    let text = fs::read_to_string(&runtime)?;
    let (before, after) = text
        .split_once("INCLUDE memory.x")
        .ok_or_else(|| format!("{} does not include memory.x", runtime.display()))?;
    fs::write(&script, format!("{before}INCLUDE \"{}\"{after}", map.display()))?;
    if board == EMULATED {
        // cortex-m-rt includes it for the names of a chip's interrupts, of which it uses none.
        fs::write(out.join("device.x"), "")?;
        println!("cargo::rustc-link-search={}", out.display());
    }
    println!("cargo::rustc-link-arg-bins=--nmagic");
    println!("cargo::rustc-link-arg-bins=-T{}", script.display());
    Ok(())
}

/// The linker script that cortex-m-rt's build script, which cargo runs before this one, has left
/// among the outputs of build scripts; the newest, if there are several.
fn runtime_script(out: &Path) -> Result<PathBuf, Box<dyn Error>> {
    let outputs = out.ancestors().find(|folder| folder.ends_with("build"));
    let outputs = outputs.ok_or("cargo puts build scripts' outputs where this does not look")?;
    let mut newest = None;
    let mut folders = vec![outputs.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder)? {
            let path = entry?.path();
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if path.is_dir() {
                // With one folder for each build script, or one for each package around them.
                if path.to_string_lossy().contains("cortex-m-rt") {
                    folders.push(path);
                }
            } else if name == "link.x" {
                let time = fs::metadata(&path)?.modified()?;
                if newest.as_ref().is_none_or(|(newest, _)| *newest < time) {
                    newest = Some((time, path));
                }
            }
        }
    }
    let (_, path) = newest.ok_or("cortex-m-rt has left no linker script")?;
    Ok(path)
}
