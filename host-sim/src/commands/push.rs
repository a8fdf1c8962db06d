//! `push`: a weight package into a running node.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use agent_core::package::PackageError;
use clap::Args;
use serde::Serialize;

use super::node::{RETRY_POLICY, connect};
use super::{CommandError, ErrorCode, Format, print_json, print_text};
use crate::commands::progress::ProgressBars;
use crate::interruption::{self, Again};
use crate::packages::{PackageBytes, PackageFileError, bytes};
use crate::service::push::{Progress, PushError};
use crate::service::{Address, Client, LineError, ServiceError, hint, push};
use crate::terminal;

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
    let refused = |error| failure(arguments, error);
    let mut node = connect(&arguments.endpoint)?;
    let before = push::status(&mut node, RETRY_POLICY)?;
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
        Some(used) => (report.version, report.confirmed) = (used.version, used.trial.is_none()),
        None => {
            (node, report.version) =
                transfer(arguments, node, &package, &mut report.resumed_from).map_err(refused)?;
            report.activated = !arguments.no_activate;
            if report.activated {
                push::activate(&mut node, &package, RETRY_POLICY).map_err(refused)?;
            }
        }
    }
    if arguments.confirm {
        push::confirm(&mut node, RETRY_POLICY)?;
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

/// The file, unless it is known to be damaged: whether it is a package for this node, the node says.
fn read(arguments: &Arguments) -> Result<Vec<u8>, CommandError> {
    let path = &arguments.package;
    let bytes = bytes::read_file(path)?;
    match PackageBytes::new(&bytes) {
        Ok(_) => Ok(bytes),
        // A node may know more formats than this program.
        Err(error @ PackageError::FormatVersion { .. }) => {
            terminal::warning(format_args!("{}: {error}; sent as it is", path.display()));
            Ok(bytes)
        }
        Err(error) => Err(PackageFileError::Package { path: path.clone(), error }.into()),
    }
}

/// What a person is told about a push that has failed.
fn failure(arguments: &Arguments, error: PushError) -> CommandError {
    match error {
        PushError::Service(ServiceError::Refused(problem)) => {
            let (path, hint) = (&arguments.package, hint::of_refusal(problem));
            let text = format!(
                "{}: the node refuses: {problem}; what was in use stays in use; {hint}",
                path.display()
            );
            CommandError::new(ErrorCode::PackageRefused, text).about(path)
        }
        PushError::Service(ServiceError::Line(LineError::Interrupted)) => CommandError::new(
            ErrorCode::Interrupted,
            "interrupted; what was in use stays in use, and the same push goes on where this one \
             ended"
                .to_owned(),
        ),
        error => error.into(),
    }
}

fn transfer(
    arguments: &Arguments,
    first: Client,
    package: &[u8],
    resumed_from: &mut Option<usize>,
) -> Result<(Client, u32), PushError> {
    let bars = ProgressBars::new("pushing");
    let mut first = Some(first);
    let mut again = || first.take().map_or_else(|| connect(&arguments.endpoint), Ok);
    let total = package.len() as u64;
    let progress = &mut |progress| match progress {
        Progress::From(byte) => *resumed_from = Some(byte),
        Progress::Received(bytes) => bars.pushed(bytes as u64, total),
        Progress::Verifying => bars.finish(),
    };
    push::transfer_over(&mut again, package, RETRY_POLICY, progress, interruption::stop())
}

/// Waits for the end of the trial.
fn wait(node: &mut Client, package: &[u8]) -> Result<(), CommandError> {
    let bars = ProgressBars::new("on trial");
    loop {
        let status = push::status(node, RETRY_POLICY)?;
        let Some(used) = push::in_use(&status, package) else {
            return Err(CommandError::new(
                ErrorCode::Node,
                "the node has gone back to another package before the trial's end; see its health \
                 with `host-sim node ENDPOINT`"
                    .to_owned(),
            ));
        };
        let Some((good, needed)) = used.trial else { return Ok(()) };
        bars.stepped(good.into(), needed.into());
        if interruption::requested() {
            return Err(CommandError::new(
                ErrorCode::Interrupted,
                "interrupted; the package is in use and still on trial".to_owned(),
            ));
        }
        std::thread::sleep(LOOK);
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
