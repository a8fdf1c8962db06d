//! Served co-simulations: the effects of clients, files and crashing nodes.

use std::collections::{BTreeMap, VecDeque};
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::Shutdown;
use std::os::unix::fs::PermissionsExt as _;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use agent_core::service::{Request, receive, send};
use agent_core::wire::cobs::Decoder;
use host_sim::cosim::board::Board;
use host_sim::cosim::{CosimReport, Notice, Service, Setup, cosimulate};
use host_sim::engine::Silent;
use host_sim::packages::PackageBytes;
use host_sim::scenario::{PAPER, Scenario};
use host_sim::service::{Line, Message};
use nix::sys::signal::Signal;

use crate::cli::command_line::{Folder, object, texts};
use crate::cli::node_commands::{LONG, ended, signal, wait_until};
use crate::cosim::loop_node::{self, Quirks};
use crate::trial::mutants::Parts;

/// Runs the paper's scenario as a service while `visit` runs with the nodes' ends of their lines;
/// returns the report and the notices.
fn served(
    folder: &Folder,
    speed: f64,
    visit: impl FnOnce(&Mutex<BTreeMap<usize, UnixStream>>),
) -> (CosimReport, Vec<String>) {
    served_with(folder, "", speed, &Quirks::default(), |lines, _| visit(lines))
}

/// Like [`served`], with these tables added to the scenario and such nodes; `visit` also gets the packages with
/// which they start.
fn served_with(
    folder: &Folder,
    tables: &str,
    speed: f64,
    quirks: &Quirks,
    visit: impl FnOnce(&Mutex<BTreeMap<usize, UnixStream>>, &Mutex<BTreeMap<usize, PackageBytes>>),
) -> (CosimReport, Vec<String>) {
    let mut scenario = Scenario::parse("paper", &format!("{PAPER}\n{tables}")).unwrap();
    scenario.learning.clear();
    scenario.run_steps = Some(1 << 40);
    let stop = Arc::new(AtomicBool::new(false));
    let service = Service { folder: folder.path("nodes"), speed, stop: stop.clone() };
    let (lines, notices) = (Mutex::new(BTreeMap::new()), Mutex::new(Vec::new()));
    let packages = Mutex::new(BTreeMap::new());
    let report = std::thread::scope(|scope| {
        let run = scope.spawn(|| {
            let start = &mut |index: usize, package: &PackageBytes| {
                let socket = loop_node::spawn(Some(package), quirks);
                packages.lock().unwrap().insert(index, package.clone());
                lines.lock().unwrap().insert(index, socket.try_clone().unwrap());
                Ok(Board::new(Line::over_socket(socket, &Arc::default()).unwrap(), "thread", false))
            };
            let notice = &mut |notice: &Notice<'_>| {
                notices.lock().unwrap().push(match notice {
                    Notice::Ended(error) => error.to_string(),
                    other => format!("{other:?}"),
                });
            };
            let mut setup = Setup::new(start, LONG, &Arc::default());
            setup.notice = Some(notice);
            cosimulate(&scenario, 0, setup, Some(&service), &Silent).unwrap()
        });
        wait_until("nodes can be reached", || {
            notices.lock().unwrap().first().is_some_and(|notice| notice == "Reachable")
        });
        // Ends the run even if the visit panics.
        struct End(Arc<AtomicBool>);
        impl Drop for End {
            fn drop(&mut self) {
                self.0.store(true, Ordering::Relaxed);
            }
        }
        let end = End(stop);
        visit(&lines, &packages);
        drop(end);
        run.join().unwrap()
    });
    (report, notices.into_inner().unwrap())
}

#[test]
fn nodes_of_the_field_observer_are_served_without_end() {
    let folder = Folder::new("serve-field");
    let field = "[observer]\npreset = \"field\"\n";
    let (report, _) = served_with(&folder, field, 1.0, &Quirks::default(), |_, _| {
        folder.succeed("monitor nodes/agent-2.sock --every 1 --count 20");
    });
    assert_eq!((&report.first_mismatch, report.mismatches), (&None, 0));
}

#[test]
fn the_death_of_a_node_ends_its_line_only() {
    let folder = Folder::new("serve-death");
    let (report, notices) = served(&folder, 1.0, |lines| {
        folder.succeed("monitor nodes/agent-2.sock --every 1 --count 20");
        lines.lock().unwrap()[&1].shutdown(Shutdown::Both).unwrap();
        // The others continue, and still receive what the simulated agent broadcasts in its place.
        folder.succeed("monitor nodes/agent-1.sock --every 1 --count 200");
        folder.succeed("monitor nodes/agent-3.sock --every 1 --count 200");
        let error = folder.fail("node nodes/agent-2.sock", 1);
        assert!(error.contains("closed by the other end"), "{error}");
    });
    assert_eq!((&report.first_mismatch, report.mismatches), (&None, 0));
    for agent in [1, 3] {
        let board = &report.boards[agent - 1];
        assert_eq!((board.compared, &board.parted, &board.ended), (report.steps, &None, &None));
    }
    let dead = &report.boards[1];
    assert!(dead.ended.as_ref().unwrap().contains("the connection was closed"), "{dead:?}");
    assert!(dead.compared >= 20 && dead.compared < report.steps, "{dead:?}");
    let death = "agent 2 (thread): the connection was closed";
    assert_eq!(notices.iter().filter(|notice| notice.starts_with(death)).count(), 1, "{notices:?}");
}

#[test]
fn a_node_that_has_ended_is_started_again_by_a_reset() {
    let folder = Folder::new("serve-restart");
    let (report, notices) = served(&folder, 1.0, |lines| {
        lines.lock().unwrap()[&2].shutdown(Shutdown::Both).unwrap();
        wait_until("the node has ended", || {
            folder.run("node nodes/agent-3.sock").status.code() == Some(1)
        });
        let status = folder.succeed("node nodes/agent-3.sock reset");
        assert!(status.contains("agent 3, package version 1"), "{status}");
        folder.succeed("monitor nodes/agent-3.sock --every 1 --count 20");
    });
    let board = &report.boards[2];
    assert_eq!((board.restarts, &board.ended, report.mismatches), (1, &None, 0));
    assert!(notices.iter().any(|notice| notice == "Restarted { agent: 3 }"), "{notices:?}");
}

/// Receives a node's messages.
struct Listener {
    socket: UnixStream,
    decoder: Box<Decoder<4096>>,
    bytes: VecDeque<u8>,
}

impl Listener {
    fn next<T>(&mut self, read: impl FnOnce(&Message<'_>) -> T) -> T {
        loop {
            while let Some(byte) = self.bytes.pop_front() {
                if let Some(Ok(message)) = self.decoder.push(byte) {
                    return read(&receive(message).unwrap());
                }
            }
            let mut buffer = [0; 4096];
            let length = self.socket.read(&mut buffer).unwrap();
            assert!(length > 0);
            self.bytes.extend(&buffer[..length]);
        }
    }
}

#[test]
fn a_client_that_asks_without_end_gets_one_answer_a_step() {
    let folder = Folder::new("serve-flood");
    // So fast that no time is ever left between two steps.
    let (report, _) = served(&folder, 1e6, |_| {
        let mut socket = UnixStream::connect(folder.path("nodes/agent-1.sock")).unwrap();
        let mut requests = Vec::new();
        for _ in 0..300 {
            send(&Request::Query, |piece| requests.extend_from_slice(piece));
        }
        socket.write_all(&requests).unwrap();
        let mut listener =
            Listener { socket, decoder: Box::new(Decoder::new()), bytes: VecDeque::new() };
        let mut ticks = Vec::new();
        while ticks.len() < 300 {
            listener.next(|message| match message {
                Message::Status(status) => ticks.push(status.tick),
                other => panic!("{other:?}"),
            });
        }
        assert!(ticks.is_sorted_by(|before, after| before < after), "{ticks:?}");
    });
    assert!(report.steps >= 300 && report.mismatches == 0, "{report:?}");
}

#[test]
fn what_is_not_a_socket_is_left_alone() {
    let folder = Folder::new("serve-occupied");
    std::fs::create_dir(folder.path("nodes")).unwrap();
    folder.write("nodes/agent-2.sock", "precious");
    let boards = "--boards unix:a,unix:b,unix:c";
    let error = folder.fail(&format!("cosim --serve nodes --without-learning {boards}"), 2);
    assert!(error.contains("agent-2.sock: not a socket"), "{error}");
    assert_eq!(std::fs::read(folder.path("nodes/agent-2.sock")).unwrap(), b"precious");
    // Nothing was created before the conflict was found.
    assert_eq!(std::fs::read_dir(folder.path("nodes")).unwrap().count(), 1);
}

#[test]
fn ctrl_c_ends_a_served_run_with_its_report() {
    let folder = Folder::new("serve-interrupted");
    for agent in 1..=3 {
        loop_node::serve(&folder.path(&format!("board-{agent}")));
    }
    let boards = "--boards unix:board-1,unix:board-2,unix:board-3";
    for (end, format) in [(Signal::SIGINT, "text"), (Signal::SIGTERM, "json")] {
        let arguments =
            format!("cosim --serve nodes --without-learning {boards} --format {format}");
        let run = folder.start(&arguments);
        wait_until("nodes can be reached", || {
            folder.run("monitor nodes/agent-2.sock --every 1 --count 5").status.success()
        });
        signal(&run, end);
        let output = ended(run);
        let (standard, error) = texts(&output);
        assert_eq!(output.status.code(), Some(0), "{error}");
        if format == "text" {
            assert!(standard.contains("bit for bit in every step: all equal"), "{standard}");
            assert!(error.contains("Nodes can be reached until Ctrl-C"), "{error}");
        } else {
            let report = object(&standard);
            assert_eq!((&report["mismatches"], &report["interrupted"]), (&0.into(), &false.into()));
            assert!(report["steps"].as_u64().unwrap() >= 5, "{report}");
        }
        // The sockets and their description are gone.
        assert_eq!(std::fs::read_dir(folder.path("nodes")).unwrap().count(), 0);
    }
}

#[test]
fn ctrl_c_ends_a_run_that_is_not_served_with_what_is_known() {
    let folder = Folder::new("cosim-interrupted");
    let reads: Vec<_> =
        (1..=3).map(|agent| loop_node::serve(&folder.path(&format!("board-{agent}")))).collect();
    let boards = "--boards unix:board-1,unix:board-2,unix:board-3";
    let run = folder.start(&format!("cosim --without-learning --steps 100000000 {boards}"));
    // A step takes a read or two; everything before it takes far fewer.
    wait_until("steps are taken", || reads[2].load(Ordering::Relaxed) > 1000);
    signal(&run, Signal::SIGINT);
    let output = ended(run);
    let (standard, error) = texts(&output);
    assert_eq!(output.status.code(), Some(1), "{error}");
    assert!(standard.contains("all equal"), "{standard}");
    assert!(error.contains("of 100000000 steps, all of them equal"), "{error}");
}

#[test]
fn a_host_that_is_killed_leaves_no_emulator_and_no_file() {
    let folder = Folder::new("serve-killed");
    // Writes its process id and the folder of its pipes.
    let script = "#!/bin/sh\nfor a; do case $a in *arg=fifo*) in=${a#*arg=fifo,arg=};; esac; done\n\
                  in=${in%%,*}\necho \"$$ ${in%/*}\" >> \"${0%/*}/trace\"\nexec sleep 1000\n";
    folder.write("qemu", script);
    let executable = std::fs::Permissions::from_mode(0o755);
    std::fs::set_permissions(folder.path("qemu"), executable).unwrap();
    folder.write("firmware", "");
    let memory = concat!(env!("CARGO_MANIFEST_DIR"), "/../memory.x");
    let mut run = folder.start(&format!(
        "cosim --serve nodes --qemu ./qemu --firmware firmware --memory {memory} --timeout 100"
    ));
    wait_until("an emulator runs", || {
        std::fs::read_to_string(folder.path("trace")).is_ok_and(|trace| trace.ends_with('\n'))
    });
    let trace = std::fs::read_to_string(folder.path("trace")).unwrap();
    let (id, pipes) = trace.trim().split_once(' ').unwrap();
    let state = || std::fs::read_to_string(format!("/proc/{id}/stat")).unwrap_or_default();
    wait_until("it is itself", || state().contains("(sleep)"));
    assert!(Path::new(pipes).exists(), "{trace}");
    run.kill().unwrap();
    run.wait().unwrap();
    // Reaping an orphan is up to its new parent: a zombie counts as ended.
    wait_until("the emulator has ended", || state().is_empty() || state().contains(") Z "));
    wait_until("its folder is gone", || !Path::new(pipes).exists());
    // The next run finds the sockets of the killed one and replaces them.
    let stderr = {
        let mut next = folder.start(&format!(
            "cosim --serve nodes --qemu ./none --firmware firmware --memory {memory}"
        ));
        let mut line = String::new();
        BufReader::new(next.stderr.take().unwrap()).read_line(&mut line).unwrap();
        next.wait().unwrap();
        line
    };
    assert!(stderr.contains("program not found"), "{stderr}");
}

#[test]
fn a_harmful_package_is_back_out_by_itself_and_a_good_one_stays() {
    let folder = Folder::new("serve-trial");
    let quirks = Quirks { trial_seconds: Some(10), ..Quirks::default() };
    let status = || object(&folder.succeed("node nodes/agent-1.sock status --format json"));
    served_with(&folder, "", 1e6, &quirks, |_, packages| {
        let package = packages.lock().unwrap()[&0].clone();
        wait_until("there is something to compare with", || {
            status()["tick"].as_u64().unwrap() > 8_000
        });
        let before = status();
        assert!(before["trial"].is_null() && before["last_revert"].is_null(), "{before}");
        assert!(before["innovation_rms"].as_f64().unwrap() > 0.0, "{before}");
        assert_eq!((&before["version"], &before["epoch"]), (&1.into(), &0.into()));
        assert_eq!((&before["reset_cause"], &before["boots"]), (&"unknown".into(), &1.into()));
        assert_eq!(before["health"]["restarts"], 0);

        let mut bad = Parts::new(&package, 2);
        bad.gain.iter_mut().for_each(|entry| *entry *= 30.0);
        std::fs::write(folder.path("bad.weights"), bad.seal().unwrap().as_bytes()).unwrap();
        folder.succeed("push nodes/agent-1.sock bad.weights");
        wait_until("it is back out", || !status()["last_revert"].is_null());
        let after = status();
        let last = &after["last_revert"];
        assert_eq!((&last["version"], &last["epoch"]), (&2.into(), &0.into()), "{after}");
        // Whichever limit it exceeds first.
        let reason = last["reason"].as_str().unwrap();
        assert!(["innovation", "restarts"].contains(&reason), "{after}");
        assert_eq!(after["version"], 1, "{after}");
        assert_eq!(after["trial"]["verdict"], "reverted");
        assert_eq!(after["trial"]["needed_seconds"].as_f64().unwrap().round(), 10.0);
        assert_eq!(after["trial"]["deadline_seconds"].as_f64().unwrap().round(), 30.0);
        let told = folder.succeed("node nodes/agent-1.sock");
        assert!(told.contains("version 2 of package epoch 0 was rolled back: "), "{told}");

        let tick = after["tick"].as_u64().unwrap();
        wait_until("there is something to compare with again", || {
            status()["tick"].as_u64().unwrap() > tick + 8_000
        });
        package.renumbered(3).save(&folder.path("good.weights")).unwrap();
        folder.succeed("push nodes/agent-1.sock good.weights --wait-confirmed");
        let end = status();
        assert_eq!((&end["version"], &end["trial"]["verdict"]), (&3.into(), &"confirmed".into()));
        let good = end["trial"]["good_seconds"].as_f64().unwrap();
        assert!(good >= end["trial"]["needed_seconds"].as_f64().unwrap(), "{end}");
    });
}
