//! Runs the examination and prints a line for every section and figure:
//!
//! ```text
//! section <name> <digest> <ok or the golden digest>
//! instructions <figure> <mean> <largest> <how often>
//! ```
//!
//! On bare metal it prints over semihosting and counts instructions; on a host it prints to
//! standard output. The exit code is 0 if all digests equal the golden ones.
#![cfg_attr(target_os = "none", no_std, no_main)]

#[cfg(target_os = "none")]
mod bare;

#[cfg(not(target_os = "none"))]
fn main() -> std::process::ExitCode {
    let mut equal = true;
    let outcome = on_target::examine(&mut on_target::NoMeter, |section| {
        let on_target::Section { name, digest, golden } = *section;
        if digest == golden {
            println!("section {name} {digest:016x} ok");
        } else {
            equal = false;
            println!("section {name} {digest:016x} {golden:016x}");
        }
    });
    if let Err(unusable) = outcome {
        println!("{}", unusable.what);
        equal = false;
    }
    if equal { std::process::ExitCode::SUCCESS } else { std::process::ExitCode::FAILURE }
}
