//! The build script of every board (`build = "../build.rs"`): links it with the linker script of
//! cortex-m-rt and the memory map in the board's folder.
//!
//! The script contains `INCLUDE memory.x`, and linkers first look for that file in the folder where
//! cargo runs them: the root of the workspace. A board that is its own workspace therefore gets its
//! own map, whatever was built before.

use std::{env, error::Error, fs, path::Path, process::ExitCode};

fn main() -> ExitCode {
    match link() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // Cargo reports this as a build error of the board.
            println!("cargo::error={error}");
            ExitCode::FAILURE
        }
    }
}

fn link() -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed=memory.x");
    println!("cargo::rerun-if-changed=Cargo.toml");
    let folder = env::var("CARGO_MANIFEST_DIR")?;
    if env::var("CARGO_CFG_TARGET_OS")? != "none" {
        return Err(format!(
            "this is firmware, but the target is the host; run cargo in {folder}, where \
             .cargo/config.toml names the target, or give --target"
        )
        .into());
    }
    let manifest = fs::read_to_string("Cargo.toml")?;
    if !manifest.lines().any(|line| line.trim() == "[workspace]") {
        return Err(format!(
            "{folder}/Cargo.toml has no [workspace], so the linker may find another board's memory.x; \
             add that section"
        )
        .into());
    }
    match fs::read_to_string("memory.x") {
        Ok(map) if map.contains("MEMORY") => {}
        Ok(_) => return Err(format!("{folder}/memory.x has no MEMORY regions").into()),
        Err(error) => {
            return Err(format!(
                "{folder}/memory.x: {error}; copy and adapt that of a similar board"
            )
            .into());
        }
    }
    println!("cargo::rustc-link-arg-bins=--nmagic");
    println!("cargo::rustc-link-arg-bins=-Tlink.x");
    // The second-stage bootloader, for chips that have one.
    if Path::new("boot2.x").exists() {
        println!("cargo::rerun-if-changed=boot2.x");
        println!("cargo::rustc-link-arg-bins=-Tboot2.x");
    }
    Ok(())
}
