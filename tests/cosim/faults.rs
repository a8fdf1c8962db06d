//! Nodes that hang, crash or send invalid messages: the run ends with an error that names the node,
//! and leaves nothing behind.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use agent_core::health::HealthCounters;
use agent_core::service::{PackageStatus, Response, Status, send};
use agent_core::wire::cobs::DELIMITER;
use host_sim::cosim::board::Board;
use host_sim::cosim::fault::NodeError;
use host_sim::cosim::qemu::{Channel, Qemu};
use host_sim::cosim::{CosimError, Setup, Start, cosimulate};
use host_sim::engine::Silent;
use host_sim::packages::PackageBytes;
use host_sim::scenario::Scenario;
use host_sim::service::{Line, push};

use crate::cli::command_line::Folder;
use crate::cosim::fake_node;
use crate::cosim::lockstep::{board, without_learning};
use crate::cosim::loop_node::{self, Quirks};

const TIMEOUT: Duration = Duration::from_millis(600);

fn failure(scenario: &Scenario, start: &mut Start<'_>) -> String {
    let setup = Setup::new(start, TIMEOUT, &Arc::default());
    cosimulate(scenario, 0, setup, None, &Silent).unwrap_err().to_string()
}

/// An emulator that is a shell script; it writes its process id and its pipes' folder to the file
/// `trace`.
struct FakeQemu {
    folder: Folder,
}

impl FakeQemu {
    fn new(name: &str, script: &str) -> Self {
        let folder = Folder::new(name);
        let trace = folder.path("trace");
        let text = format!(
            "#!/bin/sh\nfor a; do case $a in *arg=fifo*) in=${{a#*arg=fifo,arg=}};; esac; done\n\
             out=${{in#*,arg=}}; in=${{in%%,*}}\necho \"$$ ${{in%/*}}\" >> '{}'\n{script}\n",
            trace.display()
        );
        folder.write("qemu", &text);
        fs::set_permissions(folder.path("qemu"), fs::Permissions::from_mode(0o755)).unwrap();
        Self { folder }
    }

    fn qemu(&self) -> Qemu {
        Qemu {
            program: self.folder.path("qemu"),
            firmware: PathBuf::from("firmware.elf"),
            region: loop_node::region(),
            timeout: TIMEOUT,
            stop: Arc::default(),
        }
    }

    /// Returns the error of a run with this emulator as agent 2.
    fn failure(&self) -> String {
        let qemu = self.qemu();
        let start = &mut |index: usize, package: &PackageBytes| {
            if index != 1 {
                return Ok(board(Some(package), &Quirks::default(), false));
            }
            let started = qemu.start(Channel::Pipes, package);
            started.map_err(|fault| NodeError { agent: 2, board: "qemu".to_owned(), fault })
        };
        let error = failure(&without_learning(), start);
        self.assert_nothing_is_left();
        error
    }

    fn assert_nothing_is_left(&self) {
        let trace = fs::read_to_string(self.folder.path("trace")).unwrap();
        assert!(!trace.is_empty());
        for line in trace.lines() {
            let (id, folder) = line.split_once(' ').unwrap();
            // A process that has ended and has been waited for has no entry.
            assert!(!Path::new("/proc").join(id).exists(), "process {id} is left");
            assert!(!Path::new(folder).exists(), "{folder} is left");
        }
    }
}

#[test]
fn cosim_ends_with_a_node_that_never_starts() {
    let begun = Instant::now();
    let error = FakeQemu::new("cosim-hangs", "exec sleep 1000").failure();
    assert!(error.starts_with("agent 2 (qemu): no connection within 0.6 s"), "{error}");
    assert!(error.contains("--timeout"), "{error}");
    assert!(begun.elapsed() < Duration::from_secs(5));
}

#[test]
fn cosim_ends_with_a_node_that_opens_its_channel_and_says_nothing() {
    let script = "exec 3<\"$in\" 4>\"$out\"; exec sleep 1000";
    let error = FakeQemu::new("cosim-mute", script).failure();
    assert!(error.starts_with("agent 2 (qemu): no greeting within 0.6 s; "), "{error}");
}

#[test]
fn cosim_ends_with_a_node_that_dies() {
    let script = "exec 3<\"$in\" 4>\"$out\"; echo 'no such machine' >&2; exit 3";
    let error = FakeQemu::new("cosim-dies", script).failure();
    assert!(
        error.starts_with("agent 2 (qemu): the process has exited (exit status: 3)"),
        "{error}"
    );
    assert!(error.contains("no such machine"), "{error}");
    let error = FakeQemu::new("cosim-dies-early", "echo 'bad option'; exit 1").failure();
    assert!(error.contains("(exit status: 1) with the output:\nbad option"), "{error}");
}

#[test]
fn cosim_ends_with_a_node_that_prints_garbage() {
    let script = "exec 3<\"$in\" 4>\"$out\"; while printf 'garbage\\000' >&4; do sleep 0.02; done";
    let error = FakeQemu::new("cosim-garbage", script).failure();
    assert!(error.starts_with("agent 2 (qemu): no greeting within 0.6 s, only "), "{error}");
    assert!(error.contains("unreadable messages"), "{error}");
}

#[test]
fn cosim_says_what_to_install_where_there_is_no_emulator() {
    let mut qemu = FakeQemu::new("cosim-none", "").qemu();
    qemu.program = "qemu-system-that-is-not-there".into();
    let start = &mut |index: usize, package: &PackageBytes| {
        let started = qemu.start(Channel::Uart, package);
        started.map_err(|fault| NodeError { agent: index + 1, board: "qemu".to_owned(), fault })
    };
    let error = failure(&without_learning(), start);
    assert!(error.contains("qemu-system-arm") && error.contains("cargo xtask test"), "{error}");
}

/// Returns the first message of a node that uses `package`.
fn hello(package: &PackageBytes) -> Status {
    let status = fake_node::status();
    let in_use = status.package.map(|used| PackageStatus {
        agent: package.package().node.agent,
        version: 1,
        checksum: push::checksum(package.as_bytes()),
        ..used
    });
    Status { package: in_use, ..status }
}

/// Returns the error of a run whose last node greets with `status`, acknowledges two requests,
/// sends `rest`, and disconnects.
fn scripted(change: impl Fn(&mut Status), rest: &[u8]) -> String {
    use std::io::Write;
    let mut held = Vec::new();
    let start = &mut |index: usize, package: &PackageBytes| {
        if index != 2 {
            return Ok(board(Some(package), &Quirks::default(), false));
        }
        let (here, mut there) = UnixStream::pair().unwrap();
        let mut status = hello(package);
        change(&mut status);
        let mut bytes = vec![DELIMITER];
        let mut say = |response: Response<'_, Vec<f32>>| {
            send(&response, |piece| bytes.extend_from_slice(piece));
        };
        say(Response::Hello(status));
        say(Response::Done);
        say(Response::Done);
        bytes.extend_from_slice(rest);
        there.write_all(&bytes).unwrap();
        // With `rest` sent it disconnects; otherwise it stays connected without sending.
        if !rest.is_empty() {
            there.shutdown(std::net::Shutdown::Write).unwrap();
        }
        held.push(there);
        Ok(Board::new(Line::over_socket(here, &Arc::default()).unwrap(), "script", false))
    };
    failure(&without_learning(), start)
}

fn framed(response: &Response<'_, Vec<f32>>) -> Vec<u8> {
    let mut bytes = Vec::new();
    send(response, |piece| bytes.extend_from_slice(piece));
    bytes
}

#[test]
fn cosim_ends_with_a_node_that_sends_invalid_messages() {
    let error = scripted(|_| {}, &[1, 2, 3, 4, 5, 6, 7, DELIMITER]);
    assert!(error.starts_with("agent 3 (script): received an unrecognised message: "), "{error}");
    let error = scripted(|_| {}, &framed(&Response::InUse { version: Some(2) }));
    let expected = "agent 3 (script): received a report that version 2 is in use instead of a \
                    state after its step";
    assert!(error.starts_with(expected), "{error}");
    let error = scripted(
        |_| {},
        &framed(&Response::Health { tick: 0, counters: HealthCounters::default() }),
    );
    assert!(error.starts_with("agent 3 (script): the connection was closed"), "{error}");
    let error = scripted(|_| {}, &[]);
    assert!(error.starts_with("agent 3 (script): no state after its step within 0.6"), "{error}");
}

#[test]
fn cosim_reports_what_the_firmware_cannot_hold() {
    let error = scripted(|status| status.firmware.features = 4, &[0]);
    assert!(error.contains("the agent has 5 features, but the firmware has room for 4"), "{error}");
    let error = scripted(|status| status.firmware.dimension = 4, &[0]);
    assert!(error.contains("3 state components, but the firmware has room for 4"), "{error}");
    let error = scripted(|status| status.protocol = 9, &[0]);
    assert!(error.contains("protocol version 9"), "{error}");
    let error = scripted(|status| status.firmware.signed_only = true, &[0]);
    assert!(error.contains("accepts only signed packages"), "{error}");
}

#[test]
fn cosim_refuses_scenarios_that_nodes_cannot_run() {
    let start = &mut |_, _: &PackageBytes| unreachable!();
    let mut watched = without_learning();
    let recommended = agent_core::health::HealthSettings::RECOMMENDED;
    watched.health =
        Some(agent_core::health::HealthSettings { restart_after: None, ..recommended });
    let error = failure(&watched, start);
    assert!(error.contains("plausible_margin = 10.0, restart_after = 10"), "{error}");
    let mut bare = without_learning();
    bare.network = None;
    assert!(failure(&bare, start).contains("add [network]"));
    assert!(matches!(host_sim::cosim::prepared(&bare), Err(CosimError::NoNetwork { .. })));
}
