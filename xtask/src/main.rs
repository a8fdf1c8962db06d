//! Developer tasks, the same on a laptop and in CI: `cargo xtask help`.
//!
//! Every step prints its command and its duration. A step that cannot run fails with a hint; none
//! is skipped silently.
#![forbid(unsafe_code)]

mod attack;
mod background;
mod boards;
mod boot;
mod circles;
mod compiler;
mod cosim;
mod cross;
mod emulate;
mod features;
mod firmware;
mod fuzz;
mod host;
mod install;
mod machine_code;
mod packages;
mod page;
mod project;
mod python;
mod size;
mod soak;
mod stack;
mod step;
mod studies;
mod unreached;

use std::{process::ExitCode, time::Instant};

use background::Background;
use step::Failure;

const HELP: &str = "\
Usage: cargo xtask <task> [--debian]
       cargo xtask size [BOARD...] [--debian]
       cargo xtask firmware --board BOARD|all [--public-key HEX] [--in-the-loop]
                            [--feature FEATURE] [--debian]
       cargo xtask new PATH [--board BOARD] [--copy-crates]
       cargo xtask install [--prefix PREFIX] [--debian]
       cargo xtask soak [--steps N] [--seed S] [--debian]
       cargo xtask attack [--tries N] [--seed S] [--format text|json]
       cargo xtask fuzz [--seconds N] [TARGET...] [--debian]
       cargo xtask nodes [--debian]
       cargo xtask studies [--debian]
       cargo xtask page [--debian]
       cargo xtask python [--debian]

Tasks:
  test    run all tests: the workspace on the host, including doctests, `studies`, `python` and `page`,
          and at the same time `test-nodes`
  test-nodes  run `nodes`, `boot`, a co-simulation with the emulated board's firmware, and `soak`
  nodes   `cross`, `emulate`, and `size` of every board
  cross   compile the node's libraries for bare metal, check the machine code for fused
          multiply-add and calls of platform math libraries, build every board in
          firmware-template/boards and a project with it, and link the memory maps
  emulate run tests/on-target on emulated processors (QEMU): the results must equal the host's
          bit for bit, stay within the instruction budgets, and be unable to panic
  firmware  build a board's firmware; with --public-key it accepts only packages signed with
          the matching private key (`weights keygen` prints the public key), with --in-the-loop
          a co-simulation provides plant, clock and link over the service port, with --feature it
          has a feature of that board, such as `embassy` of the stm32f405
  new     copy a board (default: qemu-mps2-an386) into a separate project in the folder PATH;
          the node's crates stay in this checkout, or are copied too with --copy-crates
  install install the program as PREFIX/bin/host-sim and, for `host-sim cosim` outside of this
          project, the emulated board's firmware and memory map in PREFIX/share/host-sim;
          PREFIX defaults to ~/.local
  size    measure flash, RAM and stack of the firmware of each board, or of those named, and
          compare them with the budgets in its Cargo.toml
  boot    boot the firmware of the board stm32f405 on QEMU's netduinoplus2 and check what that
          machine supports: greeting, telemetry, steps with the host's bits, frames, a reset
  soak    run three nodes of the emulated board's firmware and the same code on the host, for N
          steps (default 20000), with package uploads, damaged messages and frames, sensor
          failures, resets and power losses drawn from the seed S (default 1): every byte must
          be correct and equal on both. `--steps 1000000` is the long run
  attack  play strangers with a radio, at the service port and with old or harmful packages
          against nodes, with N tries of each attack (default 1000000) drawn from the seed S
          (default 1), and print how many were accepted and how many did harm: every number
          must be 0
  lint    check module cycles, files that are not compiled, features of dependencies that would be built
          twice, formatting, clippy and documentation, and at the same time `lint-nodes`;
          warnings are errors
  lint-nodes  check formatting and clippy's lints of the fuzz targets, and clippy's lints of the boards,
          whose dependencies are built as for their firmware
  fuzz    run each fuzz target in fuzz/fuzz_targets, or those named, for N seconds (default 10)
          from its corpus in fuzz/corpus; a finding is a failure. `--seconds 1800` is the
          long run. Additions to a corpus are kept in target/fuzz/corpus for later runs.
          Requires the stable toolchain and a C++ compiler (for libFuzzer), but not cargo-fuzz;
          with cargo-fuzz and a nightly toolchain, `cargo +nightly fuzz run TARGET` adds the
          address sanitizer.
  studies run one small study in one go, by the script for Slurm arrays, with GNU parallel, and on
          a Dask cluster of two workers: the tables must have the same bytes
  page    open pages about results (`run --report`, `report FOLDER`) in a headless Chromium and
          check values, zoom, accessibility and width; screenshots are in target/page
  python  build the Python module's wheel, install it into target/python, and run its tests, its type
          checks and its notebook
  help    print this text

Boards are the folders in firmware-template/boards; CONTRIBUTING.md says how to add one.
Bare-metal targets come from the active Rust toolchain (`rustup target add ...`). If it lacks
them, Debian's compiler packages are used if --debian is given, if the environment has
CI=true, or for root on Debian: missing packages are installed with apt-get.
With CI=true, an outdated Cargo.lock is an error.";

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
        ["nodes"] => nodes(debian),
        ["test-nodes"] => test_nodes(debian),
        ["studies"] => studies::studies(debian),
        ["page"] => page::page(debian),
        ["python"] => python::python(debian),
        ["boot"] => boot::boot(debian),
        ["emulate"] => emulate::emulate(debian),
        ["lint"] => lint(debian),
        ["lint-nodes"] => firmware::lint(debian).and_then(|()| fuzz::lint(debian)),
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
        ["attack", ref rest @ ..] => match attack::Options::read(rest) {
            Some(options) => attack::attack(&options, debian),
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
        Err(failure) => {
            eprintln!("xtask {}: FAILED after {seconds:.1} s: {failure}", names[0]);
            ExitCode::FAILURE
        }
    }
}

/// Runs everything that executes code of this workspace.
fn test(debian: bool) -> Result<(), Failure> {
    // Before anything links that a package could replace.
    cross::install_tools(debian)?;
    emulate::find_emulators(debian)?;
    let nodes = Background::start("test-nodes", debian)?;
    let count = nodes.finish_after(test_host(debian))?;
    println!("tests: {count}");
    Ok(())
}

/// Runs everything that needs no compiler for nodes.
fn test_host(debian: bool) -> Result<host::TestCount, Failure> {
    host::build_tests()?;
    // Downloads and single processes, which leave processors idle.
    let python = Background::start_giving_way("python", debian)?;
    let count = python.finish_after(host::test())?;
    let page = Background::start("page", debian)?;
    page.finish_after(studies::studies(debian))?;
    Ok(count)
}

/// Checks everything that is read rather than run.
fn lint(debian: bool) -> Result<(), Failure> {
    // Before anything links that a package could replace.
    firmware::install_for_lint(debian)?;
    fuzz::prepare(debian)?;
    let nodes = Background::start("lint-nodes", debian)?;
    let host = circles::check(step::workspace())
        .and_then(|()| unreached::check(step::workspace()))
        .and_then(|()| features::check())
        .and_then(|()| host::lint());
    nodes.finish_after(host)
}

/// Runs everything that needs compilers and emulators for nodes.
fn test_nodes(debian: bool) -> Result<(), Failure> {
    nodes(debian)?;
    boot::boot(debian)?;
    cosim::test(debian)?;
    soak::soak(&soak::Options::default(), debian)
}

/// Runs `cross`, `emulate`, and `size` of every board.
fn nodes(debian: bool) -> Result<(), Failure> {
    cross::cross(debian)?;
    emulate::emulate(debian)?;
    size::size(&[], debian)
}

/// Prints the help after an invalid command line.
fn usage() -> ExitCode {
    eprintln!("{HELP}");
    ExitCode::from(2)
}
