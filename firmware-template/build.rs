//! Hands the linker the memory map of the board that is built, and the script that includes it.

use std::{env, error::Error, fs, path::Path};

/// The memory map of each board, by the name of its feature.
const MEMORY_MAPS: [(&str, &str); 1] = [("QEMU_MPS2_AN386", "../memory.x")];

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed=build.rs");
    if env::var("CARGO_CFG_TARGET_OS")? != "none" {
        return Ok(());
    }
    let mut boards = MEMORY_MAPS
        .iter()
        .filter(|(board, _)| env::var_os(format!("CARGO_FEATURE_{board}")).is_some());
    let Some((_, map)) = boards.next() else { return Ok(()) };
    if boards.next().is_some() {
        return Err("two boards were asked for; name one with --features".into());
    }
    let out = env::var("OUT_DIR")?;
    fs::copy(map, Path::new(&out).join("memory.x"))?;
    // cortex-m-rt includes it for the names of a chip's interrupts, of which this board uses none.
    fs::write(Path::new(&out).join("device.x"), "")?;
    println!("cargo::rerun-if-changed={map}");
    println!("cargo::rustc-link-search={out}");
    for argument in ["--nmagic", "-Tlink.x"] {
        println!("cargo::rustc-link-arg-bins={argument}");
    }
    Ok(())
}
