//! Developer tasks, the same on a laptop and in CI: `cargo xtask help`.
//!
//! Every step prints the command that it runs and how long that took. A step that cannot run
//! fails and says what to do about it; none is left out silently.
#![forbid(unsafe_code)]

mod boards;
mod boot;
mod circles;
mod compiler;
mod cosim;
mod cross;
mod emulate;
mod firmware;
mod fuzz;
mod host;
mod install;
mod machine_code;
mod packages;
mod project;
mod size;
mod soak;
mod stack;
mod step;

use std::{process::ExitCode, time::Instant};

use step::Failure;

const HELP: &str = "\
Usage: cargo xtask <task> [--debian]
       cargo xtask size [BOARD...] [--debian]
       cargo xtask firmware --board BOARD|all [--public-key HEX] [--in-the-loop] [--debian]
       cargo xtask new PATH [--board BOARD] [--copy-crates]
       cargo xtask install [--prefix PREFIX] [--debian]
       cargo xtask soak [--steps N] [--seed S] [--debian]
       cargo xtask fuzz [--seconds N] [TARGET...] [--debian]

Tasks:
  test    every test there is: the workspace on the host, doctests included, then `cross`,
          `emulate`, `size`, `boot`, a co-simulation with the emulated board's firmware, and `soak`
  cross   compile the node's libraries for bare metal, look for fused multiply-add and platform
          mathematics in the machine code, build every board in firmware-template/boards and
          a project with it, link the memory maps
  emulate the examination in tests/on-target on emulated processors (QEMU): the bits that the
          host computes, instructions within their budgets, no way to panic
  firmware  build a board's firmware; with --public-key so that it takes only packages signed
          with the private half (`weights keygen` prints the key), with --in-the-loop so that
          a co-simulation plays plant, clock and link over the service port
  new     copy a board (qemu-mps2-an386 if none is named) into a project of your own in the
          folder PATH, which builds on its own; the node's crates stay in this checkout, or
          are copied, too, with --copy-crates
  install put the program at PREFIX/bin/host-sim and, for `host-sim cosim` outside of this project,
          the emulated board's firmware and memory map in PREFIX/share/host-sim; PREFIX is
          ~/.local if none is named
  size    what the firmware of each board, or those named, takes of flash, RAM and stack,
          against the budgets in its Cargo.toml
  boot    the firmware of the board stm32f405 on QEMU's netduinoplus2, as far as that machine
          goes: greeting, telemetry, steps with the host's bits, frames, a reset
  soak    three nodes of the emulated board's firmware beside the same code on the host, for N
          steps (20000), with packages pushed, messages and frames damaged, sensors failing,
          resets and losses of power, all drawn from the seed S (1): every byte must be the
          same, and right. `--steps 1000000` is the long form
  lint    circles among modules, formatting, clippy and documentation; warnings are errors
  fuzz    run each fuzz target in fuzz/fuzz_targets, or those named, for N seconds (10)
          from its corpus in fuzz/corpus; a finding is a failure. `--seconds 1800` is the
          long form. What a run adds to a corpus stays in target/fuzz/corpus, for the next.
          This takes the stable toolchain and a C++ compiler (for libFuzzer), no cargo-fuzz;
          with cargo-fuzz and a nightly toolchain, `cargo +nightly fuzz run TARGET` adds the
          address sanitizer.
  help    this text

Boards are the folders in firmware-template/boards; CONTRIBUTING.md says how to add one.
Bare-metal targets come from the active Rust toolchain (`rustup target add ...`). Where it
has none, Debian's compiler packages take its place if --debian is given, if the environment
has CI=true, or for root on Debian: what is missing is installed with apt-get.
With CI=true, a Cargo.lock that is out of date is an error.";

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let debian = arguments.iter().any(|argument| argument == "--debian");
    let names: Vec<&str> =
        arguments.iter().map(String::as_str).filter(|&name| name != "--debian").collect();

    let start = Instant::now();
    let outcome = match names[..] {
        ["test"] => test(debian),
        ["cross"] => cross::cross(debian),
        ["size", ref rest @ ..] if rest.iter().all(|name| !name.starts_with('-')) => {
            size::size(rest, debian)
        }
        ["boot"] => boot::boot(debian),
        ["emulate"] => emulate::emulate(debian),
        ["lint"] => circles::check(step::workspace())
            .and_then(|()| host::lint())
            .and_then(|()| fuzz::lint(debian)),
        ["firmware", ref rest @ ..] => match firmware::Options::read(rest) {
            Some(options) => firmware::firmware(&options, debian),
            None => return usage(),
        },
        ["new", ref rest @ ..] => match project::Options::read(rest) {
            Some(options) => project::new(&options),
            None => return usage(),
        },
        ["install", ref rest @ ..] => match install::Options::read(rest) {
            Some(options) => install::install(&options, debian),
            None => return usage(),
        },
        ["soak", ref rest @ ..] => match soak::Options::read(rest) {
            Some(options) => soak::soak(&options, debian),
            None => return usage(),
        },
        ["fuzz", ref rest @ ..] => match fuzz::Options::read(rest) {
            Some(options) => fuzz::fuzz(&options, debian),
            None => return usage(),
        },
        ["help" | "--help" | "-h"] => {
            println!("{HELP}");
            return ExitCode::SUCCESS;
        }
        _ => return usage(),
    };
    let seconds = start.elapsed().as_secs_f64();
    match outcome {
        Ok(()) => {
            println!("xtask {}: ok, {seconds:.1} s", names[0]);
            ExitCode::SUCCESS
        }
        Err(Failure { what, hint }) => {
            eprintln!("xtask {}: FAILED after {seconds:.1} s: {what}", names[0]);
            eprintln!("  hint: {hint}");
            ExitCode::FAILURE
        }
    }
}

/// Everything that runs code of this workspace.
fn test(debian: bool) -> Result<(), Failure> {
    let count = host::test()?;
    cross::cross(debian)?;
    emulate::emulate(debian)?;
    size::size(&[], debian)?;
    boot::boot(debian)?;
    cosim::test(debian)?;
    soak::soak(&soak::Options::default(), debian)?;
    println!("tests: {count}");
    Ok(())
}

/// What a command line gets that is none.
fn usage() -> ExitCode {
    eprintln!("{HELP}");
    ExitCode::from(2)
}
