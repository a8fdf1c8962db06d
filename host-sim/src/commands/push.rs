//! `push`: sends a weight package to a running node.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use agent_core::package::PackageError;
use clap::Args;
use serde::Serialize;

use super::connection::{RETRY_POLICY, connect};
use super::key::NodeKeys;
use super::{CommandError, ErrorCode, Format, print_json, print_text};
use crate::commands::progress::ProgressBars;
use crate::engine::Progress as _;
use crate::interruption::{self, SecondSignal};
use crate::keys::KeyFolder;
use crate::packages::{PackageBytes, PackageFileError, bytes};
use crate::service::push::{Progress, PushError};
use crate::service::{Address, Client, LineError, ServiceError, hint, push};
use crate::terminal;

/// Interval between queries of a trial's progress.
const POLL_INTERVAL: Duration = Duration::from_millis(200);

/// Arguments of `push`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Node: unix:PATH or serial:/dev/tty...[@BAUD]
    endpoint: Address,
    /// Weight package
    package: PathBuf,
    /// Leave the verified package on the node without activating it
    #[arg(long, conflicts_with_all = ["activate", "confirm", "wait_confirmed"])]
    no_activate: bool,
    /// Activate the package on trial, starting with the next step [the default]
    #[arg(long)]
    activate: bool,
    /// Confirm the package at once, without a trial
    #[arg(long)]
    confirm: bool,
    /// Wait until the node has confirmed the package itself, after enough good steps
    #[arg(long)]
    wait_confirmed: bool,
    #[command(flatten)]
    keys: NodeKeys,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

#[derive(Serialize)]
struct Report {
    package: String,
    bytes: usize,
    version: u32,
    /// Offset at which the transfer started; `null` if the node already had the package.
    resumed_from: Option<usize>,
    activated: bool,
    confirmed: bool,
    elapsed_s: f64,
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    interruption::listen(SecondSignal::Exit);
    let start = Instant::now();
    let package = read(arguments)?;
    let refused = |error| failure(arguments, error);
    let keys = arguments.keys.read()?;
    let keys = keys.as_ref();
    let mut node = connect(&arguments.endpoint, keys)?;
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
                transfer(arguments, keys, node, &package, &mut report.resumed_from)
                    .map_err(refused)?;
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

/// Reads the file and rejects a damaged package. The node checks whether the package is for it.
fn read(arguments: &Arguments) -> Result<Vec<u8>, CommandError> {
    let path = &arguments.package;
    let bytes = bytes::read_file(path)?;
    match PackageBytes::new(&bytes) {
        Ok(_) => Ok(bytes),
        // The node may support newer formats than this program.
        Err(error @ PackageError::FormatVersion { .. }) => {
            terminal::warning(format_args!("{}: {error}; sending it unchecked", path.display()));
            Ok(bytes)
        }
        Err(error) => Err(PackageFileError::Package { path: path.clone(), error }.into()),
    }
}

/// Converts the error of a failed push, adding the file and a hint.
fn failure(arguments: &Arguments, error: PushError) -> CommandError {
    match error {
        PushError::Service(ServiceError::Refused(problem)) => {
            let (path, hint) = (&arguments.package, hint::of_refusal(problem));
            let text = format!(
                "{}: refused by the node: {problem}; the package in use is unchanged; {hint}",
                path.display()
            );
            CommandError::new(ErrorCode::PackageRefused, text).about(path)
        }
        PushError::Service(ServiceError::Line(LineError::Interrupted)) => CommandError::new(
            ErrorCode::Interrupted,
            "interrupted; the package in use is unchanged; repeat the push to resume it".to_owned(),
        ),
        error => error.into(),
    }
}

fn transfer(
    arguments: &Arguments,
    keys: Option<&KeyFolder>,
    first: Client,
    package: &[u8],
    resumed_from: &mut Option<usize>,
) -> Result<(Client, u32), PushError> {
    let bars = ProgressBars::new("pushing");
    let mut first = Some(first);
    let mut reconnect = || first.take().map_or_else(|| connect(&arguments.endpoint, keys), Ok);
    let total = package.len() as u64;
    let progress = &mut |progress| match progress {
        Progress::From(byte) => *resumed_from = Some(byte),
        Progress::Received(bytes) => bars.transferred(bytes as u64, total),
        Progress::Verifying => bars.finish(),
    };
    push::transfer_over(&mut reconnect, package, RETRY_POLICY, progress, interruption::stop())
}

/// Waits until the trial ends.
fn wait(node: &mut Client, package: &[u8]) -> Result<(), CommandError> {
    let bars = ProgressBars::new("on trial");
    loop {
        let status = push::status(node, RETRY_POLICY)?;
        let Some(used) = push::in_use(&status, package) else {
            return Err(CommandError::new(
                ErrorCode::Node,
                "the node reverted to another package during the trial; check its health with \
                 `host-sim node ENDPOINT`"
                    .to_owned(),
            ));
        };
        let Some((good, needed)) = used.trial else { return Ok(()) };
        bars.step(good.into(), needed.into());
        if interruption::requested() {
            return Err(CommandError::new(
                ErrorCode::Interrupted,
                "interrupted; the package is in use and still on trial".to_owned(),
            ));
        }
        std::thread::sleep(POLL_INTERVAL);
    }
}

fn text(arguments: &Arguments, report: &Report) -> String {
    let transfer = match report.resumed_from {
        None => "already on the node".to_owned(),
        Some(0) => format!("pushed, {} bytes", report.bytes),
        Some(byte) => format!("pushed, {} bytes, resumed at byte {byte}", report.bytes),
    };
    let state = match (report.activated, report.confirmed) {
        (_, true) => "in use and confirmed",
        (true, false) => "in use on trial, starting with the next step",
        (false, false) => "verified, waiting to be activated",
    };
    format!(
        "{}: version {} {transfer}; {state}\n{}, {:.2} s\n",
        arguments.endpoint, report.version, report.package, report.elapsed_s
    )
}
