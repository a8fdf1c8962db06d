//! Selects the linker scripts and arguments for the machine of a target. Nothing is needed on a
//! host.

use std::{env, path::Path};

fn main() {
    let folder = env::var("CARGO_MANIFEST_DIR").unwrap_or_default();
    let machines = Path::new(&folder).join("machines");
    let target = env::var("TARGET").unwrap_or_default();
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-changed={}", machines.display());
    // `link.x` belongs to the runtime crate. For Arm it includes `memory.x`, which the linker finds
    // where cargo runs it: at the root of the workspace, the map of the default board.
    let arguments: &[&str] = match target.as_str() {
        "thumbv7em-none-eabihf" => &["--nmagic", "-Tlink.x"],
        // The same addresses, but with 16 KiB of RAM.
        "thumbv6m-none-eabi" => &["--nmagic", "--defsym=_stack_start=0x20004000", "-Tlink.x"],
        "thumbv8m.main-none-eabihf" => &["--nmagic", "-Tmps2-an505.x"],
        "riscv32imac-unknown-none-elf" => &["-Tvirt.x", "-Tlink.x"],
        _ => return,
    };
    println!("cargo:rustc-link-search={}", machines.display());
    for argument in arguments {
        println!("cargo:rustc-link-arg-bins={argument}");
    }
}
