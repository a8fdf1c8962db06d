//! Links a board with the linker script of cortex-m-rt and the memory map in the board's folder: the
//! build script of every board (`build = "../build.rs"`).
//!
//! The script says `INCLUDE memory.x`, and linkers look for that name first where cargo starts them:
//! in the folder of the workspace. A board that is its own workspace so gets its own map, whatever was
//! built before it.

use std::{env, error::Error, fs, path::Path, process::ExitCode};

fn main() -> ExitCode {
    match link() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // Cargo shows what is printed like this as an error of the board.
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
            "this is firmware, and it was built for this computer; call cargo in {folder}, where \
             .cargo/config.toml names the target, or give --target"
        )
        .into());
    }
    let manifest = fs::read_to_string("Cargo.toml")?;
    if !manifest.lines().any(|line| line.trim() == "[workspace]") {
        return Err(format!(
            "{folder}/Cargo.toml has no [workspace], so the linker may find another board's memory.x; \
             add that line"
        )
        .into());
    }
    match fs::read_to_string("memory.x") {
        Ok(map) if map.contains("MEMORY") => {}
        Ok(_) => return Err(format!("{folder}/memory.x has no MEMORY regions").into()),
        Err(error) => {
            return Err(format!(
                "{folder}/memory.x: {error}; copy the one of a similar board and adapt it"
            )
            .into());
        }
    }
    println!("cargo::rustc-link-arg-bins=--nmagic");
    println!("cargo::rustc-link-arg-bins=-Tlink.x");
    // A second-stage boot loader, for chips that have one.
    if Path::new("boot2.x").exists() {
        println!("cargo::rerun-if-changed=boot2.x");
        println!("cargo::rustc-link-arg-bins=-Tboot2.x");
    }
    Ok(())
}
