//! Runs the program `tests/on-target` on emulated processors: it must compute the same bits as the
//! host, stay within the instruction budgets, and be unable to panic.

use std::{
    fmt::Write as _,
    io::Read,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    thread,
    time::{Duration, Instant},
};

use crate::{
    boards,
    compiler::{Compiler, cross_folder},
    cross,
    machine_code::Disassembler,
    packages,
    step::{Failure, cargo, on_path, run},
};

/// Instruction budget of a Cortex-M4F for the network of the paper's size and its outer weights.
///
/// The aim is 2,600, which `opt-level = 2` for the whole firmware reaches at 17 KB more of flash:
/// see docs/decisions/0011-small-firmware.md.
const FORWARD_M4F: u32 = 2_650;
/// Instruction budget of a Cortex-M4F for a step without a broadcast.
const STEP_M4F: u32 = 4_000;
/// Instruction budget of a Cortex-M4F for a complete turn of a node.
const TURN_M4F: u32 = 14_800;
/// Instruction budget of a Cortex-M4F for sealing or opening an authentic frame.
const TAG_M4F: u32 = 3_000;
/// Instruction budget of a Cortex-M4F for a turn of a node that is flooded, from the beginning of its
/// period: a period of 1 ms at 64 MHz, so that no step is missed.
const FLOOD_M4F: u32 = 64_000;
/// Instruction budgets of a Cortex-M4F for a step of the field observer at the centre of a star of three,
/// without harmonic disturbances.
const FIELD_RATE_M4F: u32 = 5_500;
const FIELD_MODEL_M4F: u32 = 15_000;
/// Instruction budget of a Cortex-M0, which computes floats in software, for a step.
const STEP_M0: u32 = 190_000;

/// An emulated board and its build settings.
struct Machine {
    emulator: &'static str,
    name: &'static str,
    core: &'static str,
    triple: &'static str,
    /// Compiled at other optimisation levels than the firmware: the network for size, the rest for
    /// speed. Inlining and instruction order differ, and the bits must not.
    swapped: bool,
    /// Whether the program's machine code is inspected.
    inspected: bool,
    /// What runs instead of the examination: in a program of its own, because a second node would change
    /// the machine code of the first.
    feature: Option<&'static str>,
    /// Budgets of figures, by the program's name for them.
    budgets: &'static [(&'static str, u32)],
}

const MACHINES: [Machine; 8] = [
    Machine {
        core: "Cortex-M4F, swapped levels",
        swapped: true,
        inspected: true,
        budgets: &[],
        ..arm("mps2-an386", "thumbv7em-none-eabihf")
    },
    Machine {
        core: "Cortex-M4F",
        inspected: true,
        budgets: &[
            ("forward", FORWARD_M4F),
            ("step", STEP_M4F),
            ("turn", TURN_M4F),
            ("tag", TAG_M4F),
            ("tag-check", TAG_M4F),
        ],
        ..arm("mps2-an386", "thumbv7em-none-eabihf")
    },
    Machine {
        core: "Cortex-M4F, flooded",
        feature: Some("flood"),
        budgets: &[("flood", FLOOD_M4F)],
        ..arm("mps2-an386", "thumbv7em-none-eabihf")
    },
    Machine {
        core: "Cortex-M4F, field observer",
        feature: Some("field"),
        budgets: &[("field-rate", FIELD_RATE_M4F), ("field-model", FIELD_MODEL_M4F)],
        ..arm("mps2-an386", "thumbv7em-none-eabihf")
    },
    Machine { core: "Cortex-M7", ..arm("mps2-an500", "thumbv7em-none-eabihf") },
    Machine { core: "Cortex-M33", ..arm("mps2-an505", "thumbv8m.main-none-eabihf") },
    Machine {
        core: "Cortex-M0",
        budgets: &[("step", STEP_M0)],
        ..arm("microbit", "thumbv6m-none-eabi")
    },
    Machine {
        emulator: "qemu-system-riscv32",
        core: "RV32IMAC",
        ..arm("virt", "riscv32imac-unknown-none-elf")
    },
];

const fn arm(name: &'static str, triple: &'static str) -> Machine {
    Machine {
        emulator: "qemu-system-arm",
        name,
        core: "",
        triple,
        swapped: false,
        inspected: false,
        feature: None,
        budgets: &[],
    }
}

/// Debian's packages with the emulators.
const PACKAGES: [&str; 2] = ["qemu-system-arm", "qemu-system-misc"];

/// Ten times longer than any machine takes.
const TIMEOUT: Duration = Duration::from_secs(120);

/// Runs the program on every machine.
///
/// # Errors
/// A digest differs from the golden one, a budget is exceeded, a machine hangs, the program can
/// panic, or something required is missing.
pub(crate) fn emulate(debian: bool) -> Result<(), Failure> {
    let compiler = Compiler::find(&cross::triples(), debian)?;
    let disassembler = Disassembler::find(debian)?;
    find_emulators(debian)?;
    let mut table = String::from(
        "machine     core                     sections  instructions, mean (largest): forward, \
         step, with broadcast, frame, package, turn, turn with outer weights reported, authentic frame \
         sealed, opened, sealed request opened\n",
    );
    for machine in &MACHINES {
        let program = build(&compiler, machine)?;
        if machine.inspected {
            inspect(&disassembler, machine, &program)?;
        }
        let report = examine(machine, &program)?;
        let _ = writeln!(table, "{:11} {:24} {report}", machine.name, machine.core);
    }
    print!("{table}");
    Ok(())
}

/// Checks that the emulators are installed, or installs them where that is allowed.
///
/// # Errors
/// The emulators are missing.
pub(crate) fn find_emulators(debian: bool) -> Result<(), Failure> {
    if MACHINES.iter().all(|machine| on_path(machine.emulator)) {
        return Ok(());
    }
    if packages::allowed(debian) {
        return packages::install(&PACKAGES);
    }
    let programs = ["qemu-system-arm", "qemu-system-riscv32"].join(" or ");
    Err(Failure::new(
        format!("{programs} not found"),
        format!("install {} (or, on Debian: cargo xtask ... --debian)", PACKAGES.join(" ")),
    ))
}

fn build(compiler: &Compiler, machine: &Machine) -> Result<PathBuf, Failure> {
    let mut build = cargo("build");
    build.args(["--quiet", "--package", "on-target", "--bin", "on-target"]);
    build.args(["--target", machine.triple]).args(boards::profile()?);
    if let Some(feature) = machine.feature {
        build.args(["--features", feature]);
    }
    if machine.swapped {
        // The crates of others are those of the next machine.
        for package in ["agent-core", "firmware-template", "on-target"] {
            build.args(["--config", &format!("profile.release.package.{package}.opt-level=3")]);
        }
        build.args(["--config", "profile.release.package.inner-network.opt-level=\"s\""]);
    }
    run(
        &format!("examination for {}", machine.core),
        compiler.apply(&mut build),
        "see the error above; the program must build and link for every machine",
    )?;
    Ok(cross_folder().join(machine.triple).join("release/on-target"))
}

/// Checks a node's program for panics and for code that would change the bits.
fn inspect(disassembler: &Disassembler, machine: &Machine, program: &Path) -> Result<(), Failure> {
    let found = disassembler.read(program)?;
    let name = format!("machine code of the examination, {}", machine.core);
    if !found.panics.is_empty() {
        return Err(Failure::new(
            format!("{name}: the program can panic: it contains {}", found.panics.join(", ")),
            "find their callers (objdump -d, addr2line -i) and make them return an \
             Option or a Result instead",
        ));
    }
    if !found.forbidden.is_empty() || found.instructions == 0 {
        return Err(Failure::new(
            format!("{name}: {} instructions; {}", found.instructions, found.forbidden.join("; ")),
            "write a * b + c instead of mul_add, a comparison instead of min and max",
        ));
    }
    println!("{name}: {} instructions, none of them panicking or fused", found.instructions);
    Ok(())
}

/// Runs `program` and evaluates its output; returns its part of the table.
fn examine(machine: &Machine, program: &Path) -> Result<String, Failure> {
    let name = format!("{} ({})", machine.name, machine.core);
    let mut command = Command::new(machine.emulator);
    command
        .args(["-M", machine.name, "-nographic", "-monitor", "none", "-serial", "none"])
        // The boards' clocks count instructions.
        .args(["-icount", "shift=6", "-semihosting-config", "enable=on,target=native"])
        .arg("-kernel")
        .arg(program)
        .stdin(Stdio::null())
        .stdout(Stdio::piped());
    if machine.triple.starts_with("riscv") {
        command.args(["-bios", "none"]);
    }
    println!("==> examination on {name}");
    let start = Instant::now();
    let failed = |reason: String| Failure::new(format!("{name}: {reason}"), HINT);
    let child = command.spawn().map_err(|error| failed(error.to_string()))?;
    let (code, output) = wait(child, TIMEOUT).map_err(failed)?;
    print!("{output}");
    let report = Report::read(&output);
    if let Some(section) = report.wrong {
        return Err(failed(format!("the digest of section {section} differs from the host's")));
    }
    if code != Some(0) || (report.sections == 0 && machine.feature.is_none()) {
        return Err(failed(format!("the examination ended with exit code {code:?}: {output}")));
    }
    for &(figure, budget) in machine.budgets {
        match report.figures.iter().find(|found| found.name == figure) {
            Some(found) if found.largest <= budget => {}
            Some(found) => {
                return Err(Failure::new(
                    format!(
                        "{name}: {figure} takes up to {} instructions, exceeding {budget}",
                        found.largest
                    ),
                    "look for what became slower in the machine code",
                ));
            }
            None => return Err(failed(format!("no instruction count for {figure}"))),
        }
    }
    println!("<== examination on {name}: ok, {:.1} s", start.elapsed().as_secs_f64());
    Ok(report.to_string())
}

const HINT: &str = "run `cargo test -p on-target`, which compares the host with the same digests";

/// Waits for `child` to exit, at most for `timeout`; returns exit code and output.
fn wait(mut child: Child, timeout: Duration) -> Result<(Option<i32>, String), String> {
    let mut stdout = child.stdout.take().ok_or("its output cannot be read")?;
    let reader = thread::spawn(move || {
        let mut bytes = Vec::new();
        stdout.read_to_end(&mut bytes).map(|_| String::from_utf8_lossy(&bytes).into_owned())
    });
    let start = Instant::now();
    let status = loop {
        match child.try_wait() {
            Ok(Some(status)) => break status,
            Ok(None) if start.elapsed() < timeout => thread::sleep(Duration::from_millis(20)),
            outcome => {
                // If it has exited in the meantime, killing it fails harmlessly.
                let _ = child.kill();
                let _ = child.wait();
                return Err(match outcome {
                    Err(error) => error.to_string(),
                    _ => format!("timed out after {timeout:?}"),
                });
            }
        }
    };
    let output = reader.join().map_err(|_| "its output cannot be read")?;
    Ok((status.code(), output.map_err(|error| error.to_string())?))
}

/// The output of the program.
#[derive(Debug, Default, PartialEq, Eq)]
struct Report {
    sections: usize,
    /// The first section whose digest differs.
    wrong: Option<String>,
    figures: Vec<Figure>,
}

#[derive(Debug, PartialEq, Eq)]
struct Figure {
    name: String,
    mean: u32,
    largest: u32,
}

impl Report {
    fn read(output: &str) -> Self {
        let mut report = Self::default();
        for line in output.lines() {
            match line.split_whitespace().collect::<Vec<_>>()[..] {
                ["section", _, _, "ok"] => report.sections += 1,
                ["section", name, ..] => {
                    report.wrong.get_or_insert_with(|| name.to_owned());
                }
                ["instructions", name, mean, largest, _] => {
                    if let (Ok(mean), Ok(largest)) = (mean.parse(), largest.parse()) {
                        report.figures.push(Figure { name: name.to_owned(), mean, largest });
                    }
                }
                _ => {}
            }
        }
        report
    }
}

impl std::fmt::Display for Report {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:8}", self.sections)?;
        for Figure { mean, largest, .. } in &self.figures {
            write!(f, "  {mean} ({largest})")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hanging_process_is_killed() {
        let start = |command: &mut Command| command.stdout(Stdio::piped()).spawn().unwrap();
        let hang = wait(start(Command::new("sleep").arg("60")), Duration::from_millis(50));
        assert_eq!(hang, Err("timed out after 50ms".to_owned()));
        let end = wait(start(Command::new("echo").arg("done")), Duration::from_secs(60));
        assert_eq!(end, Ok((Some(0), "done\n".to_owned())));
    }

    #[test]
    fn reports_are_read_line_by_line() {
        let output = "section a 00ff ok\nnoise\nsection b 00ff 00fe\nsection c 1 2\n\
                      instructions step 3000 3300 17\ninstructions step many 1 1\n";
        let step = Figure { name: "step".to_owned(), mean: 3_000, largest: 3_300 };
        let wrong = Some("b".to_owned());
        let expected = Report { sections: 1, wrong, figures: vec![step] };
        assert_eq!(Report::read(output), expected);
        assert_eq!(expected.to_string(), "       1  3000 (3300)");
    }
}
