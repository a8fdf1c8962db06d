//! Developer tasks, the same on a laptop and in CI: `cargo xtask help`.
//!
//! Every step prints the command that it runs and how long that took. A step that cannot run
//! fails and says what to do about it; none is left out silently.
#![forbid(unsafe_code)]

mod compiler;
mod cross;
mod host;
mod machine_code;
mod packages;
mod step;

use std::{process::ExitCode, time::Instant};

use step::Failure;

const HELP: &str = "\
Usage: cargo xtask <task> [--debian]

Tasks:
  test    every test there is: the workspace on the host, doctests included, then `cross`
  cross   build the node's libraries for bare metal, look for fused multiply-add and
          platform mathematics in the machine code, link the memory map
  lint    formatting, clippy and documentation, warnings are errors
  help    this text

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
        ["test"] => {
            host::test().and_then(|count| cross::cross(debian).map(|()| println!("tests: {count}")))
        }
        ["cross"] => cross::cross(debian),
        ["lint"] => host::lint(),
        ["help" | "--help" | "-h"] => {
            println!("{HELP}");
            return ExitCode::SUCCESS;
        }
        _ => {
            eprintln!("{HELP}");
            return ExitCode::from(2);
        }
    };
    let seconds = start.elapsed().as_secs_f64();
    match outcome {
        Ok(()) => {
            println!("xtask {}: ok, {seconds:.1} s", names[0]);
            ExitCode::SUCCESS
        }
        Err(Failure { what, mend }) => {
            eprintln!("xtask {}: FAILED after {seconds:.1} s: {what}", names[0]);
            eprintln!("  mend: {mend}");
            ExitCode::FAILURE
        }
    }
}
