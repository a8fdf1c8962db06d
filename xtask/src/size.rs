//! Measures the firmware's use of a microcontroller and checks it against the budgets in each
//! board's `Cargo.toml`.

use std::{fs, path::Path};

use object::{Object, ObjectSection, ObjectSymbol, SectionFlags, elf};
use rustc_demangle::demangle;

use crate::{
    boards::{self, Board},
    compiler::Compiler,
    firmware::{self, Variant},
    machine_code::Disassembler,
    stack::{CallGraph, Deepest},
    step::{Failure, ask},
};

/// Index of `Reset` in the vector table; the later entries preempt it.
const RESET: usize = 1;
/// Stack used by the processor itself for an exception, with and without a floating-point unit
/// (Armv7-M Architecture Reference Manual, B1.5.6 and B1.5.7), including alignment to 8 bytes.
/// \[byte\]
const EXCEPTION_FRAMES: [u32; 2] = [104 + 4, 32 + 4];

/// One line of the table.
struct Figure {
    what: &'static str,
    found: u64,
    budget: u64,
}

/// Builds the firmware of the named boards, or of all, measures it, and prints the table.
///
/// # Errors
/// A budget is exceeded, or a measurement fails.
pub(crate) fn size(names: &[&str], debian: bool) -> Result<(), Failure> {
    let boards = match names {
        [] => boards::all()?,
        names => names.iter().map(|name| boards::find(name)).collect::<Result<_, _>>()?,
    };
    let compiler = Compiler::find(&boards::targets(&boards), debian)?;
    let disassembler = Disassembler::find(debian)?;
    let mut table = format!("{:36} {:>8} {:>8}\n", "[byte]", "found", "budget");
    let mut exceeded = None;
    for board in &boards {
        let program = firmware::build(&compiler, board, &Variant::default())?;
        for Figure { what, found, budget } in measure(board, &program, &disassembler)? {
            let what = format!("{}: {what}", board.name);
            if found > budget {
                exceeded.get_or_insert_with(|| {
                    format!("{what}: {found} bytes exceed the budget of {budget}")
                });
            }
            table += &format!("{what:36} {found:8} {budget:8}\n");
        }
    }
    print!("\n{table}");
    match exceeded {
        None => Ok(()),
        Some(what) => Err(Failure::new(
            what,
            "use `arm-none-eabi-nm --size-sort` to find what grew; change a budget, in the board's \
             Cargo.toml, only together with docs/performance.md",
        )),
    }
}

fn measure(
    board: &Board,
    program: &Path,
    disassembler: &Disassembler,
) -> Result<Vec<Figure>, Failure> {
    let Content { flash, memory, stack, vectors } = content(program)?;
    let graph = CallGraph::read(&disassembler.listing(program)?);
    let unbounded = |reason| {
        Failure::new(
            format!("the stack of {} is unbounded: {reason:?}", program.display()),
            "remove the recursion of the named function, or give its \
             frame a fixed size",
        )
    };
    let deepest = graph.deepest("Reset").map_err(unbounded)?;
    show(&board.name, "calls", &deepest);
    // All interrupts have the same priority, so one of them can preempt the program but not another
    // one.
    let handlers = vectors.iter().skip(RESET + 1).filter_map(|&vector| graph.at(vector.into()));
    let mut interrupt: Option<Deepest> = None;
    for handler in handlers {
        let found = graph.deepest(handler).map_err(unbounded)?;
        if interrupt.as_ref().is_none_or(|deepest| deepest.depth < found.depth) {
            interrupt = Some(found);
        }
    }
    let [with_unit, without] = EXCEPTION_FRAMES;
    let frame = if board.target.ends_with("hf") { with_unit } else { without };
    // A board without interrupts has a single empty entry for them.
    let interrupt = interrupt.filter(|deepest| deepest.path.len() > 1 || deepest.depth > 0);
    let preempted = interrupt.map_or(0, |deepest| {
        show(&board.name, "interrupt", &deepest);
        frame + deepest.depth
    });
    let budget = board.budget;
    let mut figures = vec![
        Figure { what: "flash", found: flash, budget: budget.flash },
        Figure { what: "static RAM", found: memory, budget: budget.ram },
        Figure {
            what: "stack, worst case",
            found: (deepest.depth + preempted).into(),
            budget: budget.stack,
        },
    ];
    if board.name == boards::EMULATED {
        let painted = stack.saturating_sub(stack_unused(program)?);
        figures.push(Figure { what: "stack, as painted", found: painted, budget: budget.stack });
    }
    Ok(figures)
}

/// Prints the deepest call path.
fn show(board: &str, what: &str, deepest: &Deepest) {
    println!("{board}: deepest {what}, with frame sizes in bytes:");
    for (name, frame) in &deepest.path {
        println!("    {frame:5}  {:#}", demangle(name));
    }
    for name in &deepest.indirect {
        println!("    makes an indirect call, which is not counted: {:#}", demangle(name));
    }
}

/// The contents of the linked program. \[byte\]
struct Content {
    flash: u64,
    memory: u64,
    /// Space left for the stack.
    stack: u64,
    /// The entries of the vector table.
    vectors: Vec<u32>,
}

fn content(program: &Path) -> Result<Content, Failure> {
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
        symbol.ok_or_else(|| failed(format!("symbol {name} not found")))
    };
    let stack = symbol("_stack_start")?.saturating_sub(symbol("_stack_end")?);
    let table = file.section_by_name(".vector_table").and_then(|section| section.data().ok());
    let (words, _) = table.unwrap_or_default().as_chunks();
    let vectors = words.iter().map(|word| u32::from_le_bytes(*word)).collect();
    Ok(Content { flash, memory, stack, vectors })
}

/// Returns the stack that a node never uses in the paper's experiment, with a package pushed at t =
/// 20.
fn stack_unused(program: &Path) -> Result<u64, Failure> {
    println!("==> painted stack: the paper's experiment as a co-simulation");
    let mut command = std::process::Command::new(crate::host::simulator()?);
    command.current_dir(crate::step::workspace()).args(["cosim", "--format", "json"]);
    command.arg("--firmware").arg(program);
    let answer = ask(&mut command).unwrap_or_default();
    let figures = answer.split("\"stack_unused\":").skip(1).filter_map(|rest| {
        let digits: String = rest.chars().take_while(char::is_ascii_digit).collect();
        digits.parse().ok()
    });
    figures.min().ok_or_else(|| {
        Failure::new(
            "painted stack: the co-simulation did not report it",
            "check the output of `cargo run --release -- cosim`",
        )
    })
}
