//! `node`: simple requests to a running node.

use agent_core::AgentId;
use agent_core::service::{Request, Status};
use clap::{Args, ValueEnum};

use super::board_report::BoardReport;
use super::connection::{RETRY_POLICY, connect};
use super::health;
use super::key::NodeKeys;
use super::node_keys;
use super::node_report::{self, NodeReport};
use super::{CommandError, Format, print_json, print_text};
use crate::interruption::{self, SecondSignal};
use crate::service::provision;
use crate::service::push::{self, done};
use crate::service::{Address, Message};

/// Arguments of `node`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Node: unix:PATH or serial:/dev/tty...[@BAUD]
    endpoint: Address,
    /// Request to the node
    #[arg(value_enum, default_value_t)]
    action: Action,
    /// For `provision`: the agent that the node is to be
    #[arg(long, value_name = "N", required_if_eq("action", "provision"))]
    agent: Option<AgentId>,
    #[command(flatten)]
    keys: NodeKeys,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum Action {
    /// Print its status
    #[default]
    Status,
    /// Confirm the package on trial
    Confirm,
    /// Return to the package in use before the one on trial
    Revert,
    /// Restart, as after power-on
    Reset,
    /// Discard journal entries that cannot be read, so that updates can continue
    ForgetUnreadable,
    /// Give it the keys of --keys and make it --agent; its first keys cross the line in the clear
    Provision,
    /// Give it the network and operator keys of --keys, after `keygen --rotate` or
    /// `--rotate-operator`
    Rotate,
    /// Make it forget keys, agent and packages, and restart
    FactoryReset,
}

impl Action {
    /// Returns its name on the command line, if it needs keys.
    fn needs_keys(self) -> Option<&'static str> {
        match self {
            Self::Provision => Some("provision"),
            Self::Rotate => Some("rotate"),
            Self::FactoryReset => Some("factory-reset"),
            _ => None,
        }
    }
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    interruption::listen(SecondSignal::Exit);
    let action = arguments.action;
    if arguments.agent.is_some() && action != Action::Provision {
        return Err(CommandError::usage("--agent is for `provision` only"));
    }
    let keys = arguments.keys.read()?;
    let missing = action.needs_keys().filter(|_| keys.is_none());
    if let Some(name) = missing {
        let text = format!("`{name}` needs the node's keys; pass their folder with --keys FOLDER");
        return Err(CommandError::usage(text));
    }
    let mut client = connect(&arguments.endpoint, keys.as_ref())?;
    let node = &mut client;
    match (action, &keys) {
        (Action::Provision, Some(keys)) => {
            let agent = arguments.agent.unwrap_or_default();
            node_keys::provision(node, keys, &arguments.keys.passphrase, agent)?;
        }
        (Action::Rotate, Some(keys)) => {
            node_keys::rotate(node, keys)?;
        }
        (Action::FactoryReset, _) => node_keys::factory_reset(node)?,
        (Action::Status | Action::Provision | Action::Rotate, _) => {}
        (Action::Confirm, _) => {
            node.request(&Request::Confirm, RETRY_POLICY, &mut |_| {}, "a confirmation", done)?;
        }
        (Action::Revert, _) => {
            let in_use = |m: &Message<'_>| matches!(m, Message::InUse { .. }).then_some(());
            node.request(
                &Request::Revert,
                RETRY_POLICY,
                &mut |_| {},
                "the package in use",
                in_use,
            )?;
        }
        (Action::ForgetUnreadable, _) => {
            let request = Request::ForgetUnreadable;
            node.request(&request, RETRY_POLICY, &mut |_| {}, "a confirmation", done)?;
        }
        (Action::Reset, _) => {
            node.request(&Request::Reset, RETRY_POLICY, &mut |_| {}, "a confirmation", done)?;
        }
    }
    let mut board = BoardReport::default();
    let status = push::status_and(node, RETRY_POLICY, &mut |message| board.record(message))?;
    let report = push::report(node, RETRY_POLICY)?;
    let session = provision::session(node, RETRY_POLICY)?;
    match arguments.format {
        Format::Json => {
            print_json(&NodeReport::new(&board.with(&status), report.as_ref(), session.as_ref()))
        }
        Format::Text => {
            let told = node_keys::text(session.as_ref());
            let more = report.as_ref().map(node_report::text).unwrap_or_default();
            print_text(&(text(&arguments.endpoint, &status) + &more + &told + &board.text()))
        }
    }
}

/// Formats a node's status.
pub(super) fn text(address: &Address, status: &Status) -> String {
    let firmware = &status.firmware;
    let [major, minor, patch] = firmware.version;
    let mut text = format!(
        "{address}: firmware {major}.{minor}.{patch}, {} state components, room for {} features and \
         {} neighbours{}\n",
        firmware.dimension,
        firmware.features,
        firmware.neighbours,
        if firmware.signed_only { ", signed packages only" } else { "" },
    );
    match &status.package {
        None => {
            // Only steps produce samples, and without a package only a built-in agent steps.
            text += if status.samples > 0 {
                "  no package in use: running the agent built into the firmware, without a network\n"
            } else {
                "  no package in use: not observing, unless an agent is built into the firmware\n"
            };
            text += &format!("  next step: tick {}\n", status.tick);
        }
        Some(package) => {
            let trial = package.trial.map_or("confirmed".to_owned(), |(good, needed)| {
                format!("on trial, {good} of {needed} good steps in a row")
            });
            text += &format!(
                "  agent {}, package version {} ({:#010x}) in {}, {trial}{}\n",
                package.agent,
                package.version,
                package.checksum,
                package.slot,
                if package.network_in_use { "" } else { ", network not in use" },
            );
            let seconds = status.tick as f64 * f64::from(package.step_size);
            text += &format!("  next step: tick {} (t = {seconds:.3} s)\n", status.tick);
        }
    }
    if status.staged {
        text += "  a package is waiting to be activated\n";
    }
    if let Some(upload) = status.upload {
        text += &format!("  an unfinished upload has {} bytes\n", upload.received);
    }
    for (slot, refusal) in ["A", "B"].iter().zip(status.refused_at_start) {
        if let Some(refusal) = refusal {
            text += &format!("  the package in slot {slot} was refused at start-up: {refusal}\n");
        }
    }
    if let Some(bytes) = status.stack_unused {
        text += &format!("  {bytes} bytes of stack never used\n");
    }
    let counts = [
        ("samples kept", status.samples),
        ("damaged messages", status.messages_damaged),
        ("measurements missing", status.measurements_missing),
        ("broadcasts lost", status.broadcasts_lost),
    ];
    let counts = counts.iter().filter(|(_, count)| *count > 0);
    let counts: Vec<_> = counts.map(|(what, count)| format!("{what}: {count}")).collect();
    if !counts.is_empty() {
        text += &format!("  {}\n", counts.join(", "));
    }
    text += &format!("  health: {}\n", health::line(&status.health));
    text
}
