//! `monitor`, `push` and `node` against peers that die, flood, talk nonsense or refuse.

use std::path::Path;
use std::process::{Child, Output};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use agent_core::health::BoardErrors;
use agent_core::service::{BoardFault, Event, Problem, Request, Response, Upload, receive};
use agent_core::store::StoreError;
use embedded_storage::nor_flash::NorFlashErrorKind;
use host_sim::packages::Recording;
use host_sim::scenario::{PAPER, Scenario};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use crate::cli::command_line::{Folder, texts};
use crate::cosim::fake_node::{Message, listen, state, status, tell_states};

/// Longer than anything here takes, so that a hang ends.
pub(crate) const LONG: Duration = Duration::from_secs(60);

/// Waits until it is so.
pub(crate) fn wait_until(what: &str, mut is_so: impl FnMut() -> bool) {
    let deadline = Instant::now() + LONG;
    while !is_so() {
        assert!(Instant::now() < deadline, "{what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

pub(crate) fn signal(child: &Child, signal: Signal) {
    kill(Pid::from_raw(i32::try_from(child.id()).unwrap()), signal).unwrap();
}

/// What it says, once it has ended by itself.
pub(crate) fn ended(mut child: Child) -> Output {
    wait_until("the command ends", || child.try_wait().unwrap().is_some());
    child.wait_with_output().unwrap()
}

fn recorded(path: &Path) -> usize {
    Recording::load(path, 3, 5).map_or(0, |recording| recording.samples.len())
}

#[test]
fn a_recording_survives_that_its_monitor_is_killed() {
    let folder = Folder::new("record-killed");
    let pause = Duration::from_millis(1);
    listen(&folder.path("node"), move |peer| tell_states(peer, status(), u64::MAX, pause));
    let mut monitor = folder.start("monitor node --record samples.csv");
    // What comes soon reaches the file soon.
    wait_until("samples are in the file", || recorded(&folder.path("samples.csv")) > 10);
    monitor.kill().unwrap();
    monitor.wait().unwrap();
    let recording = Recording::load(&folder.path("samples.csv"), 3, 5).unwrap();
    assert!(recording.gaps.is_empty());
    assert_eq!(recording.outer_weights, Some(vec![0.25; 15]));
}

#[test]
fn a_recording_goes_on_without_a_reader_of_its_output() {
    let folder = Folder::new("record-pipe");
    let pause = Duration::from_millis(1);
    listen(&folder.path("node"), move |peer| tell_states(peer, status(), u64::MAX, pause));
    let mut monitor = folder.start("monitor node --record samples.csv --count 1500");
    drop(monitor.stdout.take());
    let output = ended(monitor);
    assert_eq!((output.status.code(), texts(&output).1.as_str()), (Some(0), ""));
    assert_eq!(recorded(&folder.path("samples.csv")), 1499);
}

#[test]
fn monitor_ends_when_told_to_however_much_a_node_sends() {
    let folder = Folder::new("monitor-flood");
    listen(&folder.path("node"), |peer| tell_states(peer, status(), u64::MAX, Duration::ZERO));
    for end in [Signal::SIGINT, Signal::SIGTERM] {
        let name = format!("{end}.csv");
        let monitor = folder.start(&format!("monitor node --record {name}"));
        wait_until("samples are in the file", || recorded(&folder.path(&name)) > 0);
        signal(&monitor, end);
        let output = ended(monitor);
        let (standard, error) = texts(&output);
        assert_eq!((output.status.code(), error.as_str()), (Some(0), ""));
        assert!(standard.contains(&format!("Written to {name}: ")), "{standard}");
        assert!(recorded(&folder.path(&name)) > 0);
    }
}

#[test]
fn what_a_node_told_before_it_went_is_kept() {
    let folder = Folder::new("record-gone");
    listen(&folder.path("node"), |peer| tell_states(peer, status(), 50, Duration::ZERO));
    let output = folder.run("monitor node --record samples.csv");
    let (standard, error) = texts(&output);
    assert_eq!(output.status.code(), Some(1), "{error}");
    assert!(standard.contains("samples.csv: 49 samples"), "{standard}");
    assert!(error.contains("closed by the other end"), "{error}");
    assert_eq!(recorded(&folder.path("samples.csv")), 49);
}

#[test]
fn a_recording_on_a_full_disk_ends_and_says_so() {
    if !Path::new("/dev/full").exists() {
        return;
    }
    let folder = Folder::new("record-full");
    listen(&folder.path("node"), |peer| tell_states(peer, status(), u64::MAX, Duration::ZERO));
    let output = ended(folder.start("monitor node --record /dev/full"));
    assert_eq!(output.status.code(), Some(1));
    assert!(texts(&output).1.starts_with("error: /dev/full: "), "{output:?}");
}

#[test]
fn samples_are_skipped_counted_and_continued_after_a_reset() {
    let folder = Folder::new("record-bad");
    listen(&folder.path("node"), |peer| {
        while let Some(request) = peer.request() {
            match receive::<Request<'_>>(&request) {
                Some(Request::Query) => assert!(peer.say(&Response::Status(status()))),
                Some(Request::Subscribe(subscription)) => {
                    peer.say(&Response::Done);
                    if subscription.state_every.is_none() {
                        return;
                    }
                    break;
                }
                _ => {}
            }
        }
        for tick in 100..110 {
            let mut state = state(tick);
            if let (105, Response::State(state)) = (tick, &mut state) {
                state.derivative[1] = f32::NAN;
            }
            peer.say(&state);
        }
        // A damaged message, a message of the future, a lost one, and a reset.
        peer.write(&[9, 9, 9, 0]);
        peer.say(&state(111));
        peer.say(&Response::Hello(status()));
        (0..5).for_each(|tick| assert!(peer.say(&state(tick))));
        while peer.request().is_some() {
            peer.say(&Response::Done);
        }
    });
    let told = folder.succeed("monitor node --record samples.csv --count 16 --format json");
    let report: serde_json::Value = serde_json::from_str(told.lines().last().unwrap()).unwrap();
    let expected = [
        ("samples", 8 + 4),
        ("bad", 1),
        ("resets", 1),
        ("unreadable", 1),
        ("lost", 0),
        ("not_stepped", 0),
    ];
    for (name, count) in expected {
        assert_eq!(report[name], count, "{name} of {report}");
    }
    let recording = Recording::load(&folder.path("samples.csv"), 3, 5).unwrap();
    // Between 104 and 106, and at the reset.
    assert_eq!((recording.samples.len(), recording.gaps), (12, vec![4, 8]));
}

#[test]
fn a_node_of_another_version_and_garbage_are_told_apart() {
    let folder = Folder::new("node-other");
    listen(&folder.path("other"), |peer| {
        while peer.request().is_some() {
            let mut other = status();
            other.protocol = 2;
            peer.say(&Response::Status(other));
        }
    });
    let error = folder.fail("node other", 1);
    assert!(error.contains("protocol version 2, but this program uses version 1"), "{error}");
    listen(&folder.path("garbage"), |peer| {
        let bytes: Vec<u8> = (0..997u32).map(|i| (i * i % 251) as u8).collect();
        while peer.write(&bytes) {}
    });
    let error = folder.fail("node garbage", 1);
    assert!(error.contains("damaged and") && error.contains("baud rate"), "{error}");
    let error = folder.fail("node /dev/null", 1);
    assert!(error.contains("use serial:/dev/null"), "{error}");
}

/// A package file of the paper's agent 1, in this folder.
fn package(folder: &Folder) -> Vec<u8> {
    let mut scenario = Scenario::parse("paper", PAPER).unwrap();
    scenario.learning.clear();
    let mut packages = Vec::new();
    let start = &mut |_, package: &host_sim::packages::PackageBytes| {
        packages.push(package.clone());
        let fault = host_sim::cosim::fault::Fault::Interrupted;
        Err(host_sim::cosim::fault::NodeError { agent: 1, board: String::new(), fault })
    };
    let setup = host_sim::cosim::Setup::new(start, LONG, &std::sync::Arc::default());
    host_sim::cosim::cosimulate(&scenario, 0, setup, None, &host_sim::engine::Silent).unwrap_err();
    packages[0].save(&folder.path("node.weights")).unwrap();
    packages[0].as_bytes().to_vec()
}

#[test]
fn push_stops_at_a_damaged_file_before_it_looks_for_the_node() {
    let folder = Folder::new("push-damaged");
    let mut bytes = package(&folder);
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(folder.path("damaged.weights"), bytes).unwrap();
    let error = folder.fail("push absent.sock damaged.weights", 2);
    assert!(error.contains("damaged.weights: ") && !error.contains("absent.sock"), "{error}");
    let error = folder.fail("push absent.sock node.weights", 1);
    assert!(error.contains("absent.sock"), "{error}");
}

#[test]
fn push_says_what_to_do_about_each_refusal() {
    let folder = Folder::new("push-refused");
    package(&folder);
    let cases = [
        (
            "other",
            StoreError::Conflict { offset: 128 },
            1,
            "another push to this node is in progress",
        ),
        ("flash", StoreError::Flash(NorFlashErrorKind::Other), 1, "the node's flash failed"),
        ("trial", StoreError::OnTrial, 2, "end the trial of the current package"),
    ];
    for (name, problem, code, expected) in cases {
        listen(&folder.path(name), move |peer| {
            while let Some(request) = peer.request() {
                let answer = match receive::<Request<'_>>(&request) {
                    Some(Request::Query) => Response::Status(status()),
                    Some(Request::Begin { .. }) if problem != StoreError::OnTrial => {
                        Response::Upload(Upload { received: 0 })
                    }
                    _ => Response::Refused(Problem::Store(problem)),
                };
                peer.say(&answer);
            }
        });
        let error = folder.fail(&format!("push {name} node.weights"), code);
        assert!(error.contains(expected) && !error.contains("train"), "{error}");
    }
}

#[test]
fn a_push_that_is_interrupted_says_so_and_no_more() {
    let folder = Folder::new("push-interrupted");
    package(&folder);
    // It answers the first question, and then no more.
    let silent = Arc::new(AtomicBool::new(false));
    let is_silent = silent.clone();
    listen(&folder.path("node"), move |peer| {
        while let Some(request) = peer.request() {
            match receive(&request) {
                Some(Request::Query) => assert!(peer.say(&Response::Status(status()))),
                _ => silent.store(true, Ordering::Relaxed),
            }
        }
    });
    let push = folder.start("push node node.weights");
    wait_until("it pushes", || is_silent.load(Ordering::Relaxed));
    signal(&push, Signal::SIGINT);
    let output = ended(push);
    let (_, error) = texts(&output);
    assert_eq!(output.status.code(), Some(1), "{error}");
    assert!(error.contains("interrupted") && !error.contains("board is running"), "{error}");
}

#[test]
fn a_node_without_a_package_counts_in_ticks() {
    let folder = Folder::new("monitor-fallback");
    let mut without = status();
    (without.package, without.samples, without.tick) = (None, 4, 1000);
    listen(&folder.path("node"), move |peer| tell_states(peer, without, 9, Duration::ZERO));
    let told = folder.succeed("monitor node --count 4 --every 1");
    assert!(told.contains("running the agent built into the firmware"), "{told}");
    assert!(told.contains("tick         3  x_hat") && !told.contains("t = "), "{told}");
}

/// Messages of a newer node that this program cannot know: kinds of messages (200 as a varint of
/// two bytes), an event, and reports with more counters than now.
const NEWER: [&[u8]; 6] = [
    &[17, 1],
    &[100, 1, 2],
    &[0xc8, 1, 9],
    &[11, 100, 1],
    &[10, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24],
    &[13, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24],
];

#[test]
fn messages_of_a_newer_node_are_skipped_by_every_command() {
    let folder = Folder::new("node-newer");
    let bytes = package(&folder);
    let checksum = host_sim::service::push::checksum(&bytes);
    for message in NEWER {
        assert!(receive::<Message>(message).is_none(), "{message:?} is known now");
    }
    listen(&folder.path("node"), move |peer| {
        let mut now = status();
        while let Some(request) = peer.request() {
            NEWER.iter().for_each(|message| _ = peer.frame(message));
            let answer = match receive::<Request<'_>>(&request) {
                Some(Request::Query) => Response::Status(now),
                Some(Request::Begin { .. }) => Response::Upload(Upload { received: 0 }),
                Some(Request::Chunk { offset, bytes }) => {
                    Response::Upload(Upload { received: offset + bytes.len() as u32 })
                }
                Some(Request::Stage) => Response::Staged { version: 1 },
                Some(Request::Revert) => Response::InUse { version: Some(3) },
                Some(Request::Activate) => {
                    let package = now.package.as_mut().unwrap();
                    (package.version, package.checksum) = (1, checksum);
                    Response::InUse { version: Some(1) }
                }
                _ => Response::Done,
            };
            peer.say(&answer);
            if let Some(Request::Subscribe(_)) = receive::<Request<'_>>(&request) {
                for tick in 0..9 {
                    NEWER.iter().for_each(|message| _ = peer.frame(message));
                    peer.say(&state(tick));
                }
            }
        }
    });
    let told = folder.succeed("node node");
    assert!(told.contains("agent 1, package version 3"), "{told}");
    let told = folder.succeed("push node node.weights --confirm");
    assert!(told.contains("version 1 pushed") && told.contains("in use and confirmed"), "{told}");
    for action in ["confirm", "revert", "reset"] {
        folder.succeed(&format!("node node {action}"));
    }
    let told = folder.succeed("monitor node --count 4 --every 1 --record samples.csv");
    assert!(told.contains("samples.csv: 3 samples"), "{told}");
    assert_eq!(recorded(&folder.path("samples.csv")), 3);
}

#[test]
fn node_and_monitor_show_what_a_board_reports() {
    let folder = Folder::new("node-board");
    let errors = |sensor_bus| BoardErrors { sensor_bus, link_damaged: 3, ..BoardErrors::default() };
    listen(&folder.path("node"), move |peer| {
        while let Some(request) = peer.request() {
            match receive::<Request<'_>>(&request) {
                Some(Request::Query) => {
                    // A message of the future comes in between.
                    peer.frame(&[100, 1]);
                    peer.say(&Response::Event(Event::BoardFault(BoardFault::Clock)));
                    peer.say(&Response::BoardErrors { tick: 0, counters: errors(2) });
                    peer.say(&Response::Status(status()));
                }
                Some(Request::Subscribe(subscription)) => {
                    peer.say(&Response::Done);
                    if subscription.state_every.is_none() {
                        return;
                    }
                    peer.say(&Response::BoardErrors { tick: 1_500, counters: errors(4) });
                    peer.say(&state(1_500));
                }
                _ => {}
            }
        }
    });
    let told = folder.succeed("node node");
    let expected =
        "  board errors: samples lost on the sensor's bus: 2, frames that arrived damaged: 3\n";
    assert!(told.contains("  board fault: the crystal or the PLL did not start"), "{told}");
    assert!(told.ends_with(expected), "{told}");
    let told: serde_json::Value =
        serde_json::from_str(&folder.succeed("node node --format json")).unwrap();
    assert_eq!((&told["tick"], &told["protocol"]), (&0.into(), &1.into()));
    assert_eq!(told["board_faults"], serde_json::json!(["Clock"]));
    let counts = &told["board_errors"];
    assert_eq!((&counts["sensor_bus"], &counts["link_damaged"]), (&2.into(), &3.into()));
    assert_eq!((counts.as_object().unwrap().len(), &counts["sensor_other"]), (9, &0.into()));

    let told = folder.succeed("monitor node --count 1");
    assert!(told.contains(expected), "{told}");
    assert!(
        told.contains("t =     1.500 s  board errors: samples lost on the sensor's bus: 4, "),
        "{told}"
    );
    let told = folder.succeed("monitor node --count 1 --format json");
    let lines: Vec<serde_json::Value> =
        told.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert!(lines[0].get("Status").is_some(), "{told}");
    assert_eq!(lines[1], serde_json::json!({"Event": {"BoardFault": "Clock"}}));
    assert_eq!(lines[2]["BoardErrors"]["counters"]["sensor_bus"], 2);
    assert_eq!(lines[3]["BoardErrors"]["tick"], 1_500);
    assert_eq!(lines[3]["BoardErrors"]["counters"]["sensor_bus"], 4);
}
