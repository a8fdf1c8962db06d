//! The node's crates on bare metal: they build, their machine code holds nothing that would
//! change the bits, and the memory map links.

use std::{fs, path::PathBuf, process::Command, time::Instant};

use crate::{
    compiler::{self, Compiler, cross_folder},
    machine_code::{BINUTILS, Disassembler},
    packages,
    step::{Failure, cargo, on_path, run, workspace},
};

struct Target {
    triple: &'static str,
    /// The core has fused multiply-add, so its absence has to be shown.
    fused: bool,
}

const TARGETS: [Target; 4] = [
    Target { triple: "thumbv7em-none-eabihf", fused: true },
    Target { triple: "thumbv6m-none-eabi", fused: false },
    Target { triple: "thumbv8m.main-none-eabihf", fused: true },
    Target { triple: "riscv32imac-unknown-none-elf", fused: false },
];

/// A library whose machine code is read.
struct Artifact {
    package: &'static str,
    /// Which of the package's crates, for cargo.
    selection: &'static [&'static str],
    file: &'static str,
    /// Its code may be generic throughout, so that there is none before somebody uses it.
    generic: bool,
}

const ARTIFACTS: [Artifact; 3] = [
    Artifact {
        package: "agent-core",
        selection: &["--lib"],
        file: "libagent_core.rlib",
        generic: false,
    },
    Artifact {
        package: "firmware-template",
        selection: &["--lib"],
        file: "libfirmware_template.rlib",
        generic: true,
    },
    Artifact {
        package: "firmware-template",
        selection: &["--example", "concrete_node"],
        file: "examples/libconcrete_node.rlib",
        generic: false,
    },
];

/// Builds for every target and checks the results.
///
/// # Errors
/// The first step that fails.
pub(crate) fn cross(debian: bool) -> Result<(), Failure> {
    let compiler = Compiler::find(&TARGETS.map(|target| target.triple), debian)?;
    let disassembler = Disassembler::find(debian)?;
    let mut build = cargo("build");
    build.args(["--quiet", "--release", "--package", "agent-core", "--package"]);
    build.arg("firmware-template").args(TARGETS.iter().flat_map(|to| ["--target", to.triple]));
    run(
        "cross-build",
        compiler.apply(&mut build),
        "the node's crates must build without std; the error above names the line",
    )?;
    for target in TARGETS.iter().filter(|target| target.fused) {
        for artifact in &ARTIFACTS {
            inspect(&compiler, &disassembler, target, artifact)?;
        }
    }
    memory_map(debian)
}

/// Fails if the machine code of `artifact` holds a fused multiply-add or asks for platform
/// mathematics, or if there is nothing to look at.
fn inspect(
    compiler: &Compiler,
    disassembler: &Disassembler,
    target: &Target,
    artifact: &Artifact,
) -> Result<(), Failure> {
    let mut build = cargo("rustc");
    build.args(["--quiet", "--release", "--target", target.triple]);
    build.args(["--package", artifact.package]).args(artifact.selection);
    // The release profile leaves all work to link-time optimisation, and libraries then hold
    // no machine code at all.
    build.args(["--", "-Clinker-plugin-lto=no", "-Cembed-bitcode=no"]);
    let name = format!("machine code {} {}", target.triple, artifact.file);
    run(&name, compiler.apply(&mut build), "the error above names the line")?;

    let start = Instant::now();
    let file = cross_folder().join(target.triple).join("release").join(artifact.file);
    let found = disassembler.read(&file)?;
    if !found.forbidden.is_empty() {
        return Err(Failure::new(
            format!("{name}: {}", found.forbidden.join("; ")),
            "write a * b + c instead of mul_add, a comparison instead of min and max, and call \
             the functions of agent-core or the crate libm by their path",
        ));
    }
    if found.instructions == 0 && !artifact.generic {
        return Err(Failure::new(
            format!("{name}: no instruction to look at"),
            "see that the crate still has code that is not generic, and how it is compiled",
        ));
    }
    println!(
        "    {} instructions, no fused multiply-add, no platform mathematics{}, {:.1} s",
        found.instructions,
        if found.instructions == 0 { " (all generic: see concrete_node)" } else { "" },
        start.elapsed().as_secs_f64()
    );
    Ok(())
}

/// Links nothing but one section with `memory.x`, whose assertions the linker then checks.
fn memory_map(debian: bool) -> Result<(), Failure> {
    let script = cross_folder().join("memory-map.ld");
    fs::write(&script, "INCLUDE memory.x\nSECTIONS { .data : { *(.data) } > RAM }\n")
        .map_err(|error| Failure::new(format!("{}: {error}", script.display()), "free the disk"))?;
    let (program, flavor) = linker(debian)?;
    run(
        "memory map",
        Command::new(program)
            .current_dir(workspace())
            .args(flavor)
            // Any file will do as content.
            .args(["-m", "armelf", "--format=binary", "rustfmt.toml", "--format=default", "-T"])
            .arg(&script)
            .arg("-o")
            .arg(cross_folder().join("memory-map.elf")),
        "the message names the assertion in memory.x that does not hold",
    )
}

/// A linker for Arm: GNU's, or the one that comes with Rust.
fn linker(debian: bool) -> Result<(PathBuf, &'static [&'static str]), Failure> {
    const GNU: &str = "arm-none-eabi-ld";
    if on_path(GNU) {
        return Ok((GNU.into(), &[]));
    }
    if let Some(lld) = compiler::toolchain_programs().map(|bin| bin.join("rust-lld"))
        && lld.exists()
    {
        return Ok((lld, &["-flavor", "gnu"]));
    }
    if packages::allowed(debian) {
        packages::install(&[BINUTILS])?;
        return Ok((GNU.into(), &[]));
    }
    Err(Failure::new("nothing here links for Arm", format!("install {BINUTILS}")))
}
