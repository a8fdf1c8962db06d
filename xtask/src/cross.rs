//! The node's crates on bare metal: they build, their machine code holds nothing that would
//! change the bits, and the memory map links.

use std::{fs, path::PathBuf, process::Command};

use crate::{
    compiler::{self, Compiler, cross_folder},
    firmware,
    machine_code::{BINUTILS, Disassembler, Findings},
    packages, project,
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

/// Every target of the node's crates.
pub(crate) fn triples() -> [&'static str; TARGETS.len()] {
    TARGETS.map(|target| target.triple)
}

/// A library whose machine code is read.
struct Artifact {
    package: &'static str,
    /// Which of the package's crates, and with what features, for cargo.
    selection: &'static [&'static str],
    file: &'static str,
}

const ARTIFACTS: [Artifact; 2] = [
    Artifact {
        package: "agent-core",
        // Features only add code: this has all that the library has without them.
        selection: &["--lib", "--features", "signature"],
        file: "libagent_core.rlib",
    },
    Artifact {
        package: "firmware-template",
        selection: &["--lib"],
        file: "libfirmware_template.rlib",
    },
];

/// How a library is compiled for reading: name, arguments for rustc.
type Variant = (&'static str, &'static [&'static str]);

/// The release profile leaves all work to link-time optimisation, and a library then holds no
/// machine code at all; both variants undo that.
///
/// The optimised one is what runs, but holds neither generic nor small functions, which are
/// left to whoever calls them. The complete one has every function that can be compiled here;
/// what is fused or foreign is so in both, since rustc never contracts operations by itself.
const VARIANTS: [Variant; 2] = [
    ("optimised", &["-Clinker-plugin-lto=no", "-Cembed-bitcode=no"]),
    (
        "complete",
        &["-Clinker-plugin-lto=no", "-Cembed-bitcode=no", "-Copt-level=0", "-Clink-dead-code"],
    ),
];

/// Builds for every target and checks the results.
///
/// # Errors
/// The first step that fails.
pub(crate) fn cross(debian: bool) -> Result<(), Failure> {
    let compiler = Compiler::find(&triples(), debian)?;
    let disassembler = Disassembler::find(debian)?;
    for features in [&[][..], &["--features", "agent-core/signature"]] {
        let mut build = cargo("build");
        build.args(["--quiet", "--release", "--package", "agent-core", "--package"]);
        build.arg("firmware-template").args(features);
        build.args(TARGETS.iter().flat_map(|to| ["--target", to.triple]));
        run(
            "cross-build",
            compiler.apply(&mut build),
            "the node's crates must build without std; the error above names the line",
        )?;
    }
    for target in TARGETS.iter().filter(|target| target.fused) {
        for variant in VARIANTS {
            let mut instructions = 0;
            for artifact in &ARTIFACTS {
                instructions += inspect(&compiler, &disassembler, target, artifact, variant)?;
            }
            println!(
                "machine code {}, {}: {instructions} instructions, no fused multiply-add, \
                 no platform mathematics",
                target.triple, variant.0
            );
        }
    }
    for board in &firmware::BOARDS {
        let program = firmware::build(board, None, debian)?;
        let found = disassembler.read(&program)?;
        allow(&format!("machine code of {}", board.name), &found)?;
        println!("machine code of {}: {} instructions, none fused", board.name, found.instructions);
    }
    project::check(debian)?;
    memory_map(debian)
}

/// # Errors
/// Something was found that changes bits.
fn allow(name: &str, found: &Findings) -> Result<(), Failure> {
    if found.forbidden.is_empty() {
        return Ok(());
    }
    Err(Failure::new(
        format!("{name}: {}", found.forbidden.join("; ")),
        "write a * b + c instead of mul_add, a comparison instead of min and max, and call \
         the functions of agent-core or the crate libm by their path",
    ))
}

/// Compiles and reads `artifact`; returns how many instructions it has.
///
/// # Errors
/// A fused multiply-add, platform mathematics, or nothing to look at where there must be.
fn inspect(
    compiler: &Compiler,
    disassembler: &Disassembler,
    target: &Target,
    artifact: &Artifact,
    (variant, flags): Variant,
) -> Result<usize, Failure> {
    let name = format!("machine code {}, {variant}, {}", target.triple, artifact.file);
    let mut build = cargo("rustc");
    build.args(["--quiet", "--release", "--target", target.triple]);
    build.args(["--package", artifact.package]).args(artifact.selection).arg("--").args(flags);
    run(&name, compiler.apply(&mut build), "the error above names the line")?;

    let file = cross_folder().join(target.triple).join("release").join(artifact.file);
    let found = disassembler.read(&file)?;
    allow(&name, &found)?;
    // Where everything is generic or small, the optimised code is all in the firmware.
    let may_be_empty = variant == "optimised" && artifact.package != "agent-core";
    if found.instructions == 0 && !(may_be_empty && artifact.selection == ["--lib"]) {
        return Err(Failure::new(
            format!("{name}: no instruction to look at"),
            "see that the crate has code that is not generic, and how it is compiled",
        ));
    }
    println!("    {} instructions", found.instructions);
    Ok(found.instructions)
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
