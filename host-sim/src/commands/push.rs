//! `push`: a weight package into a running node.

use std::io::Read;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::Args;
use serde::Serialize;

use super::node::{PATIENCE, connect};
use super::{CommandError, Format, print_json, print_text};
use crate::interruption::{self, Again};
use crate::packages::{PackageBytes, PackageFileError};
use crate::progress::ProgressBars;
use crate::service::push::{Progress, PushError};
use crate::service::{Address, Conversation, LineError, ServiceError, push};
use crate::terminal;

/// Longest file that is sent: more than any slot holds. \[byte\]
const LENGTH_MAX: u64 = 1 << 20;

/// Between two looks at how a trial goes on.
const LOOK: Duration = Duration::from_millis(200);

/// Arguments of `push`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// The node: unix:PATH or serial:/dev/tty...[@BAUD]
    endpoint: Address,
    /// The package
    package: PathBuf,
    /// Leaves the package waiting in the node, verified and not in use
    #[arg(long, conflicts_with_all = ["activate", "confirm", "wait_confirmed"])]
    no_activate: bool,
    /// Has it used from the next step on, on trial [the default]
    #[arg(long)]
    activate: bool,
    /// Ends its trial at once: the package stays in use
    #[arg(long)]
    confirm: bool,
    /// Waits until the node has confirmed it by itself, after enough good steps
    #[arg(long)]
    wait_confirmed: bool,
    /// How the result is printed on standard output
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

#[derive(Serialize)]
struct Report {
    package: String,
    bytes: usize,
    version: u32,
    /// Where the transfer went on; `null` if the package was there already.
    resumed_from: Option<usize>,
    activated: bool,
    confirmed: bool,
    elapsed_s: f64,
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    interruption::listen(Again::Exit);
    let start = Instant::now();
    let package = read(arguments)?;
    let refused = |error: PushError| match error {
        error if error.is_refusal() => CommandError::Refusal {
            path: arguments.package.clone(),
            refusal: error.to_string(),
            mend: mend(&error),
        },
        error => error.into(),
    };
    let mut node = connect(&arguments.endpoint)?;
    let before = push::status(&mut node, PATIENCE)?;
    let mut report = Report {
        package: arguments.package.display().to_string(),
        bytes: package.len(),
        version: 0,
        resumed_from: None,
        activated: true,
        confirmed: false,
        elapsed_s: 0.0,
    };
    match push::in_use(&before, &package) {
        Some(used) => report.version = used.version,
        None => {
            (node, report.version) =
                transfer(arguments, node, &package, &mut report.resumed_from).map_err(refused)?;
            report.activated = !arguments.no_activate;
            if report.activated {
                push::activate(&mut node, &package, PATIENCE).map_err(refused)?;
            }
        }
    }
    if arguments.confirm {
        push::confirm(&mut node, PATIENCE)?;
        report.confirmed = true;
    } else if arguments.wait_confirmed {
        wait(&mut node, &package)?;
        report.confirmed = true;
    }
    report.elapsed_s = start.elapsed().as_secs_f64();
    match arguments.format {
        Format::Json => print_json(&report),
        Format::Text => print_text(&text(arguments, &report)),
    }
}

/// The file as it is: whether it is a package, the node says. What is known here is only a warning.
fn read(arguments: &Arguments) -> Result<Vec<u8>, CommandError> {
    let path = &arguments.package;
    let mut bytes = Vec::new();
    std::fs::File::open(path)
        .and_then(|file| file.take(LENGTH_MAX + 1).read_to_end(&mut bytes))
        .map_err(|error| PackageFileError::Read { path: path.clone(), error })?;
    if bytes.len() as u64 > LENGTH_MAX {
        return Err(PackageFileError::TooLong { path: path.clone() }.into());
    }
    if let Err(error) = PackageBytes::new(&bytes) {
        terminal::warning(format_args!("{}: {error}; a node will refuse it", path.display()));
    }
    Ok(bytes)
}

fn transfer(
    arguments: &Arguments,
    first: Conversation,
    package: &[u8],
    resumed_from: &mut Option<usize>,
) -> Result<(Conversation, u32), PushError> {
    let bars = ProgressBars::new("pushing");
    let mut first = Some(first);
    let mut again = || first.take().map_or_else(|| connect(&arguments.endpoint), Ok);
    let total = package.len() as u64;
    push::transfer_over(&mut again, package, PATIENCE, &mut |progress| match progress {
        Progress::From(byte) => *resumed_from = Some(byte),
        Progress::Received(bytes) => bars.pushed(bytes as u64, total),
        Progress::Verifying => bars.finish(),
    })
}

/// Waits for the end of the trial.
fn wait(node: &mut Conversation, package: &[u8]) -> Result<(), CommandError> {
    let bars = ProgressBars::new("on trial");
    loop {
        let status = push::status(node, PATIENCE)?;
        let Some(used) = push::in_use(&status, package) else {
            return Err(CommandError::Node(
                "the node has gone back to another package before the trial's end; see its health \
                 with `host-sim node ENDPOINT`"
                    .to_owned(),
            ));
        };
        let Some((good, needed)) = used.trial else { return Ok(()) };
        bars.stepped(good.into(), needed.into());
        if interruption::requested() {
            return Err(ServiceError::from(LineError::Interrupted).into());
        }
        std::thread::sleep(LOOK);
    }
}

fn mend(error: &PushError) -> &'static str {
    use agent_core::service::Problem;
    use agent_core::store::StoreError;
    match error {
        PushError::Service(ServiceError::Refused(Problem::Store(StoreError::OnTrial))) => {
            "decide about the package on trial with `host-sim node ENDPOINT confirm` or `revert`"
        }
        PushError::Service(ServiceError::Refused(Problem::Store(StoreError::Length {
            ..
        }))) => "train a smaller network, or give the node larger slots in memory.x",
        _ => "train, sign or number it anew",
    }
}

fn text(arguments: &Arguments, report: &Report) -> String {
    let way = match report.resumed_from {
        None => "was there already".to_owned(),
        Some(0) => format!("pushed, {} bytes", report.bytes),
        Some(byte) => format!("pushed, {} bytes, gone on from byte {byte}", report.bytes),
    };
    let state = match (report.activated, report.confirmed) {
        (_, true) => "in use and confirmed",
        (true, false) => "in use from the next step on, on trial",
        (false, false) => "verified, and waits for its activation",
    };
    format!(
        "{}: version {} {way}; {state}\n{}, {:.2} s\n",
        arguments.endpoint, report.version, report.package, report.elapsed_s
    )
}
