//! What the firmware takes of a microcontroller, held against budgets.

use std::{fs, path::Path};

use object::{Object, ObjectSection, ObjectSymbol, SectionFlags, elf};
use rustc_demangle::demangle;

use crate::{
    firmware,
    machine_code::Disassembler,
    stack::CallGraph,
    step::{Failure, ask, cargo},
};

/// Code and constants of the whole node on the emulated board. \[byte\]
const FLASH: u64 = 32 * 1024;
/// Static memory but for the samples. \[byte\]
const STATIC: u64 = 8 * 1024;
/// Stack, at worst. \[byte\]
const STACK: u64 = 4 * 1024;
/// The samples for training: 64 of a tick and two vectors of three. \[byte\]
const SAMPLES: u64 = 64 * 32;

/// One line of the table.
struct Figure {
    what: &'static str,
    found: u64,
    budget: u64,
}

/// Builds the emulated board's firmware, measures it, and prints the table.
///
/// # Errors
/// A budget that is exceeded, and whatever stands in the way of measuring.
pub(crate) fn size(debian: bool) -> Result<(), Failure> {
    let board = &firmware::BOARDS[0];
    let program = firmware::build(board, None, debian)?;
    let Sections { flash, memory, stack } = sections(&program)?;
    let listing = Disassembler::find(debian)?.listing(&program)?;
    let deepest = CallGraph::read(&listing).deepest("Reset").map_err(|reason| {
        Failure::new(
            format!("the stack of {} has no bound: {reason:?}", program.display()),
            "let the function that is named call nothing that leads back to it, and give its \
             frame a fixed size",
        )
    })?;
    println!("deepest calls, with the bytes of their frames:");
    for (name, frame) in &deepest.path {
        println!("    {frame:5}  {:#}", demangle(name));
    }
    for name in &deepest.indirect {
        println!("    calls what a register says, and is counted without it: {:#}", demangle(name));
    }
    let painted = stack.saturating_sub(stack_unused(&program)?);
    let figures = [
        Figure { what: "flash: text + rodata", found: flash, budget: FLASH },
        Figure { what: "RAM: static, samples apart", found: memory - SAMPLES, budget: STATIC },
        Figure { what: "stack, from the frames", found: deepest.depth.into(), budget: STACK },
        Figure { what: "stack, as painted", found: painted, budget: STACK },
    ];
    println!("\n{:30} {:>8} {:>8}", format!("{} [byte]", board.name), "found", "budget");
    for Figure { what, found, budget } in &figures {
        println!("{what:30} {found:8} {budget:8}");
    }
    match figures.iter().find(|figure| figure.found > figure.budget) {
        None => Ok(()),
        Some(Figure { what, found, budget }) => Err(Failure::new(
            format!("{what}: {found} bytes, the budget is {budget}"),
            "look for what has grown with `arm-none-eabi-nm --size-sort`; a budget is only changed \
             together with docs/performance.md",
        )),
    }
}

/// What the linker made of the program. \[byte\]
struct Sections {
    flash: u64,
    memory: u64,
    /// What is left for the stack.
    stack: u64,
}

fn sections(program: &Path) -> Result<Sections, Failure> {
    let failed =
        |reason: String| Failure::new(format!("{}: {reason}", program.display()), "build it again");
    let bytes = fs::read(program).map_err(|error| failed(error.to_string()))?;
    let file = object::File::parse(&*bytes).map_err(|error| failed(error.to_string()))?;
    let (mut flash, mut memory) = (0, 0);
    for section in file.sections() {
        let SectionFlags::Elf { sh_flags, .. } = section.flags() else { continue };
        if !sh_flags.contains(elf::SHF_ALLOC) {
            continue;
        }
        let holds_nothing = section.kind().is_bss();
        if !holds_nothing {
            flash += section.size();
        }
        if sh_flags.contains(elf::SHF_WRITE) {
            memory += section.size();
        }
    }
    let symbol = |name: &str| {
        let symbol = file.symbol_by_name(name).map(|symbol| symbol.address());
        symbol.ok_or_else(|| failed(format!("there is no {name}")))
    };
    let stack = symbol("_stack_start")?.saturating_sub(symbol("_stack_end")?);
    Ok(Sections { flash, memory, stack })
}

/// What a node never uses of its stack in the paper's experiment, with a package pushed at t = 20.
fn stack_unused(program: &Path) -> Result<u64, Failure> {
    println!("==> painted stack: the paper's experiment as a co-simulation");
    // Not optimised further than the tests, which have built it already.
    let mut command = cargo("run");
    command.args(["--quiet", "--package", "host-sim", "--", "cosim", "--format", "json"]);
    command.arg("--firmware").arg(program);
    let answer = ask(&mut command).unwrap_or_default();
    let figures = answer.split("\"stack_unused\":").skip(1).filter_map(|rest| {
        let digits: String = rest.chars().take_while(char::is_ascii_digit).collect();
        digits.parse().ok()
    });
    figures.min().ok_or_else(|| {
        Failure::new(
            "painted stack: the co-simulation says nothing of it",
            "see what `cargo run --release -- cosim` says",
        )
    })
}
