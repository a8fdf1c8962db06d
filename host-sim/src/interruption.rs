//! Ctrl-C, and being told to end: a wish that commands look for at points where they can stop in
//! good order.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

static REQUESTED: AtomicBool = AtomicBool::new(false);

/// When the first request came.
static SINCE: OnceLock<Instant> = OnceLock::new();

/// What a second wish does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Again {
    /// Ends the process at once.
    Exit,
    /// Nothing: there are processes and files to be removed, and that does not take long.
    Wait,
}

/// From here on, the wish is noted in place of the process's end.
pub fn listen(again: Again) {
    let handler = ctrlc::set_handler(move || {
        SINCE.get_or_init(Instant::now);
        if REQUESTED.swap(true, Ordering::Relaxed) && again == Again::Exit {
            std::process::exit(130);
        }
    });
    if let Err(error) = handler {
        eprintln!("warning: Ctrl-C will end this without a result: {error}");
    }
}

/// Whether somebody has asked for the end.
#[must_use]
pub fn requested() -> bool {
    REQUESTED.load(Ordering::Relaxed)
}

/// Whether somebody asked for the end at least `time` ago: what is under way may have that long to
/// finish in good order.
#[must_use]
pub fn requested_for(time: Duration) -> bool {
    requested() && SINCE.get().is_none_or(|since| since.elapsed() >= time)
}
