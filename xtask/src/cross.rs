//! Cross-builds the node's crates: they compile, their machine code contains nothing that could
//! change the bits, and every board links with its own memory map.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use object::{Object, ObjectSymbol};

use crate::{
    boards::{self, Board},
    compiler::{self, Compiler, cross_folder},
    firmware::{self, Variant},
    machine_code::{BINUTILS, Disassembler, Findings},
    packages, project,
    step::{Failure, cargo, on_path, run, workspace},
};

struct Target {
    triple: &'static str,
    /// The core has fused multiply-add instructions, so the build is checked for using none.
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

/// A library whose machine code is inspected.
struct Artifact {
    package: &'static str,
    /// The crate of the package, and its features, for cargo.
    selection: &'static [&'static str],
}

/// The features of firmware-template, and with them of agent-core; signatures without the operator's key, which
/// firmware-template would need.
const NODE_FEATURES: &str = "firmware-template/authentic-frames,firmware-template/exchange,\
                             firmware-template/field,agent-core/signature";

const ARTIFACTS: [Artifact; 4] = [
    Artifact { package: "integrity", selection: &["--lib", "--features", "seals"] },
    Artifact { package: "inner-network", selection: &["--lib"] },
    Artifact {
        package: "agent-core",
        // Features only add code: with them the library contains everything it has without them.
        selection: &["--lib", "--features", "authentic-frames,exchange,field,signature"],
    },
    Artifact { package: "firmware-template", selection: &["--lib", "--features", NODE_FEATURES] },
];

/// How a library is compiled for inspection: name, arguments for rustc.
type Variation = (&'static str, &'static [&'static str]);

/// The boards' profile leaves code generation to link-time optimisation, so a library contains no
/// machine code; both variations disable that.
///
/// The optimised one is what runs, but lacks generic and small functions, which are compiled into
/// their callers. The complete one has every function that can be compiled here; fused instructions
/// and foreign calls appear in both, because rustc never contracts operations by itself.
const VARIATIONS: [Variation; 2] = [
    ("optimised", &["-Clinker-plugin-lto=no", "-Cembed-bitcode=no"]),
    (
        "complete",
        &["-Clinker-plugin-lto=no", "-Cembed-bitcode=no", "-Copt-level=0", "-Clink-dead-code"],
    ),
];

/// Installs what is missing to build for nodes, where that is allowed.
///
/// # Errors
/// Something is missing and cannot be installed.
pub(crate) fn install_tools(debian: bool) -> Result<(), Failure> {
    let boards = boards::all()?;
    let mut wanted = triples().to_vec();
    wanted.extend(boards::targets(&boards));
    compiler::install_for(&wanted, debian)?;
    Disassembler::find(debian)?;
    Linker::find(debian)?;
    Ok(())
}

/// Builds for every target and checks the results.
///
/// # Errors
/// The first step that fails.
pub(crate) fn cross(debian: bool) -> Result<(), Failure> {
    let boards = boards::all()?;
    let mut wanted = triples().to_vec();
    wanted.extend(boards::targets(&boards));
    let compiler = Compiler::find(&wanted, debian)?;
    let (disassembler, linker) = (Disassembler::find(debian)?, Linker::find(debian)?);
    // With all features. `emulate` builds the crates without them for every target, and the libraries below are
    // compiled with them for the others. Built rather than checked: `emulate` then has its dependencies.
    let mut libraries = cargo("build");
    libraries.args(["--quiet", "--package", "agent-core", "--package", "firmware-template"]);
    libraries.args(["--lib", "--features", NODE_FEATURES]).args(boards::profile()?);
    let others = TARGETS.iter().filter(|target| !target.fused);
    libraries.args(others.flat_map(|target| ["--target", target.triple]));
    run(
        "libraries for the other targets",
        compiler.apply(&mut libraries),
        "see the error above; the node's crates must compile without std",
    )?;
    for target in TARGETS.iter().filter(|target| target.fused) {
        for variation in VARIATIONS {
            let mut instructions = 0;
            for artifact in &ARTIFACTS {
                instructions +=
                    inspect(&compiler, (&disassembler, &linker), target, artifact, variation)?;
            }
            println!(
                "machine code {}, {}: {instructions} instructions, no fused multiply-add, \
                 no platform mathematics",
                target.triple, variation.0
            );
        }
    }
    for board in &boards {
        for variant in Variant::all(board) {
            let program = firmware::build(&compiler, board, &variant)?;
            let found = disassembler.read(&program)?;
            allow(&format!("machine code of {}", board.name), &found)?;
            linker.check_map(board, &program)?;
            let name = program.file_stem().unwrap_or_default().display();
            println!("machine code of {name}: {} instructions, none fused", found.instructions);
        }
    }
    project::check(&compiler, &boards)
}

/// Fails if `found` contains anything that changes bits.
///
/// # Errors
/// Forbidden instructions or calls were found.
fn allow(name: &str, found: &Findings) -> Result<(), Failure> {
    if found.forbidden.is_empty() {
        return Ok(());
    }
    Err(Failure::new(
        format!("{name}: {}", found.forbidden.join("; ")),
        "write a * b + c instead of mul_add, a comparison instead of min and max, and call \
         the functions of agent-core or the libm crate by their path",
    ))
}

/// Compiles and inspects `artifact`; returns its number of instructions.
///
/// # Errors
/// A fused multiply-add, a call of platform mathematics, or no code where there must be some.
fn inspect(
    compiler: &Compiler,
    (disassembler, linker): (&Disassembler, &Linker),
    target: &Target,
    artifact: &Artifact,
    (variation, flags): Variation,
) -> Result<usize, Failure> {
    let name = format!("machine code {}, {variation}, {}", target.triple, artifact.package);
    // One for each, because cargo does not compile again what it has compiled.
    let file = format!("{}-{variation}-{}-{}.o", target.triple, artifact.package, compiler.name());
    let file = cross_folder().join(file);
    let mut build = cargo("rustc");
    build.args(["--quiet", "--target", target.triple]).args(boards::profile()?);
    build.args(["--package", artifact.package]).args(artifact.selection).arg("--").args(flags);
    build.arg(format!("--emit=link,obj={}", file.display()));
    run(&name, compiler.apply(&mut build), "see the error above")?;
    let found = disassembler.read(&linker.merged(&file)?)?;
    allow(&name, &found)?;
    // If everything is generic or small, all optimised code is in the firmware.
    let may_be_empty = variation == "optimised" && artifact.package == "firmware-template";
    if found.instructions == 0 && !(may_be_empty && artifact.selection == ["--lib"]) {
        return Err(Failure::new(
            format!("{name}: there are no instructions"),
            "check that the crate has non-generic code and how it is compiled",
        ));
    }
    println!("    {} instructions", found.instructions);
    Ok(found.instructions)
}

/// A linker for Arm: GNU's, or the one included with Rust.
struct Linker {
    program: PathBuf,
    flavor: &'static [&'static str],
}

impl Linker {
    fn find(debian: bool) -> Result<Self, Failure> {
        const GNU: &str = "arm-none-eabi-ld";
        let gnu = Self { program: GNU.into(), flavor: &[] };
        if on_path(GNU) {
            return Ok(gnu);
        }
        if let Some(program) = compiler::toolchain_programs().map(|bin| bin.join("rust-lld"))
            && program.exists()
        {
            return Ok(Self { program, flavor: &["-flavor", "gnu"] });
        }
        if packages::allowed(debian) {
            packages::install(&[BINUTILS])?;
            return Ok(gnu);
        }
        Err(Failure::new("no linker for Arm found", format!("install {BINUTILS}")))
    }

    /// Puts the code of an object, which is in a section for each function, into a single one: GNU's disassembler
    /// takes a time that grows with the square of their number. Returns the new object.
    ///
    /// # Errors
    /// The linker failed.
    fn merged(&self, object: &Path) -> Result<PathBuf, Failure> {
        let (script, merged) = (cross_folder().join("merge.ld"), object.with_extension("merged.o"));
        write(&script, "SECTIONS { .text : { *(.text .text.*) } }\n")?;
        let mut link = Command::new(&self.program);
        link.args(self.flavor).args(["-r", "-T"]).arg(&script).arg("-o").arg(&merged).arg(object);
        run("one section of code", &mut link, "delete the target folder and try again")?;
        Ok(merged)
    }

    /// Links an arbitrary file with only the board's memory map, which checks the map's assertions,
    /// and compares all symbols of the map with those of the board's program, to verify that it was
    /// linked with its own map.
    fn check_map(&self, board: &Board, program: &Path) -> Result<(), Failure> {
        let map = board.memory_map();
        let script = cross_folder().join("memory-map.ld");
        let text =
            format!("INCLUDE \"{}\"\nSECTIONS {{ .data : {{ *(.data) }} > RAM }}\n", map.display());
        write(&script, &text)?;
        let linked = cross_folder().join("memory-map.elf");
        run(
            &format!("memory map of {}", board.name),
            Command::new(&self.program)
                .current_dir(workspace())
                .args(self.flavor)
                .args(["-m", "armelf", "--format=binary", "rustfmt.toml", "--format=default", "-T"])
                .arg(&script)
                .arg("-o")
                .arg(&linked),
            "the message names the failed assertion in memory.x",
        )?;
        let (wanted, found) = (weights_symbols(&linked)?, weights_symbols(program)?);
        if wanted.is_empty() || wanted != found {
            return Err(Failure::new(
                format!(
                    "{} is not linked with {}: found {found:x?}, expected {wanted:x?}",
                    program.display(),
                    map.display()
                ),
                "see that the board's folder is a workspace of its own and has no other memory.x \
                 above it that the linker finds first",
            ));
        }
        Ok(())
    }
}

/// Writes a linker's script.
fn write(script: &Path, text: &str) -> Result<(), Failure> {
    fs::write(script, text).map_err(|error| {
        let what = format!("{}: {error}", script.display());
        Failure::new(what, "check that the disk has free space")
    })
}

/// Returns the symbols that a memory map defines, in alphabetical order.
fn weights_symbols(program: &Path) -> Result<Vec<(String, u64)>, Failure> {
    let failed =
        |reason: String| Failure::new(format!("{}: {reason}", program.display()), "build it again");
    let bytes = fs::read(program).map_err(|error| failed(error.to_string()))?;
    let file = object::File::parse(&*bytes).map_err(|error| failed(error.to_string()))?;
    let mut symbols: Vec<(String, u64)> = file
        .symbols()
        .filter_map(|symbol| Some((symbol.name().ok()?.to_owned(), symbol.address())))
        .filter(|(name, _)| name.starts_with("_weights_"))
        .collect();
    symbols.sort();
    Ok(symbols)
}
