//! Runs the examination without an operating system.

#[cfg_attr(target_arch = "arm", path = "cortex_m.rs")]
#[cfg_attr(target_arch = "riscv32", path = "riscv.rs")]
mod board;
mod counter;
mod text;

use semihosting::process::exit;

use counter::Counter;
use text::Line;

/// Exit codes; 0 is success.
const MISMATCH: i32 = 1;
const UNUSABLE: i32 = 2;
const PANIC: i32 = 101;

/// Called by the runtime crates once memory is set up.
fn run() -> ! {
    let Some(mut counter) = board::clock().and_then(Counter::calibrated) else {
        Line::new().text("instructions cannot be counted").print();
        exit(UNUSABLE)
    };
    #[cfg(feature = "flood")]
    let (equal, outcome) = (true, on_target::flood::flood(&mut counter));
    #[cfg(feature = "field")]
    let (equal, outcome) = (true, on_target::field::field(&mut counter));
    #[cfg(not(any(feature = "flood", feature = "field")))]
    let (equal, outcome) = examined(&mut counter);
    match outcome {
        Ok(figures) => {
            for (figure, statistics) in figures.iter().filter(|(_, found)| found.count > 0) {
                Line::new()
                    .text("instructions ")
                    .text(figure.name())
                    .text(" ")
                    .decimal(statistics.mean())
                    .text(" ")
                    .decimal(statistics.max)
                    .text(" ")
                    .decimal(statistics.count)
                    .print();
            }
            exit(if equal { 0 } else { MISMATCH })
        }
        Err(unusable) => {
            Line::new().text(unusable.what).print();
            exit(UNUSABLE)
        }
    }
}

/// Runs the examination and prints its sections; returns also whether all digests are the golden ones.
#[cfg(not(any(feature = "flood", feature = "field")))]
fn examined(
    meter: &mut impl on_target::Meter,
) -> (bool, Result<on_target::Figures, on_target::Unusable>) {
    let mut equal = true;
    let outcome = on_target::examine(meter, |section| {
        let &on_target::Section { name, digest, golden } = section;
        let line = Line::new().text("section ").text(name).text(" ").hexadecimal(digest).text(" ");
        if digest == golden {
            line.text("ok").print();
        } else {
            equal = false;
            line.hexadecimal(golden).print();
        }
    });
    (equal, outcome)
}

/// Never called: `cargo xtask emulate` verifies that nothing can panic.
#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    exit(PANIC)
}
