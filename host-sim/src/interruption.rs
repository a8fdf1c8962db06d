//! Handles Ctrl-C and termination signals. Commands poll for a request at points where they can
//! stop cleanly.
//!
//! A command that does not call [`listen`] ends at once: its temporary files are removed, existing
//! files stay unchanged, and the exit code is 128 plus the signal's number, 130 for Ctrl-C and 143
//! for a request to terminate. Under `nohup`, closing the terminal does not end it.

use std::sync::atomic::{AtomicI32, AtomicU8, Ordering};
use std::sync::{Arc, LazyLock, Once};

use crate::files::output::temporary;
use crate::stop::Stop;
use crate::terminal;

/// Requested by the first signal.
static STOP: LazyLock<Arc<Stop>> = LazyLock::new(Arc::default);
/// Number of the first signal received.
static SIGNAL: AtomicI32 = AtomicI32::new(0);
/// A [`SecondSignal`], or [`END`].
static RESPONSE: AtomicU8 = AtomicU8::new(END);

/// No command is listening: the first signal ends the process.
const END: u8 = 0;
const EXIT: u8 = 1;
const WAIT: u8 = 2;

/// Signal numbers defined by POSIX.
const HANG_UP: i32 = 1;
const INTERRUPT: i32 = 2;
const TERMINATE: i32 = 15;

/// What a second signal does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SecondSignal {
    /// Ends the process at once.
    Exit,
    /// Nothing: the command is removing processes and files, which takes little time.
    Wait,
}

/// The signal that requested the end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Signal {
    /// Ctrl-C.
    Interrupt,
    /// A request to terminate, as sent by `kill` and service managers.
    Terminate,
    /// The terminal was closed.
    HangUp,
}

impl Signal {
    /// Returns its name in reports.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Interrupt => "interrupt",
            Self::Terminate => "terminate",
            Self::HangUp => "hangup",
        }
    }
}

/// Installs the signal handlers, which remove temporary files before they end the process. Only the
/// first call has an effect.
pub fn install() {
    static INSTALLED: Once = Once::new();
    INSTALLED.call_once(|| {
        if let Err(error) = handle_signals() {
            terminal::warning(format_args!(
                "cannot handle signals, so Ctrl-C will end the program without a result: {error}"
            ));
        }
    });
}

#[cfg(unix)]
fn handle_signals() -> std::io::Result<()> {
    let mut signals = signal_hook::iterator::Signals::new([INTERRUPT, TERMINATE])?;
    if !hang_up_is_ignored() {
        signals.add_signal(HANG_UP)?;
    }
    std::thread::Builder::new()
        .name("signals".to_owned())
        .spawn(move || signals.forever().for_each(received))?;
    Ok(())
}

/// Whether this process was started to survive its terminal, as far as the system reports.
#[cfg(unix)]
fn hang_up_is_ignored() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    // One bit per signal, the first signal lowest.
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_some_and(|mask| mask >> (HANG_UP - 1) & 1 == 1)
}

#[cfg(not(unix))]
fn handle_signals() -> Result<(), ctrlc::Error> {
    ctrlc::set_handler(|| received(INTERRUPT))
}

fn received(signal: i32) {
    let is_second = STOP.is_requested();
    match RESPONSE.load(Ordering::Relaxed) {
        WAIT => {}
        EXIT if !is_second => {}
        _ => {
            temporary::remove_all();
            std::process::exit(128 + signal);
        }
    }
    if !is_second {
        SIGNAL.store(signal, Ordering::Relaxed);
        STOP.request();
    }
}

/// Makes signals set a flag instead of ending the process.
pub fn listen(second: SecondSignal) {
    let response = match second {
        SecondSignal::Exit => EXIT,
        SecondSignal::Wait => WAIT,
    };
    RESPONSE.store(response, Ordering::Relaxed);
    install();
}

/// Returns whether a signal has been received.
#[must_use]
pub fn requested() -> bool {
    STOP.is_requested()
}

/// Returns the signal received, if any.
#[must_use]
pub fn signal() -> Option<Signal> {
    requested().then(|| match SIGNAL.load(Ordering::Relaxed) {
        HANG_UP => Signal::HangUp,
        TERMINATE => Signal::Terminate,
        _ => Signal::Interrupt,
    })
}

/// Returns the stop request that signals set.
#[must_use]
pub fn stop() -> &'static Arc<Stop> {
    &STOP
}
