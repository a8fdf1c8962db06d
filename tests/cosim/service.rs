//! Commands that talk to the nodes of a running co-simulation.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use agent_core::service::{CHUNK_LENGTH_MAX, Request};
use host_sim::cosim::board::Board;
use host_sim::cosim::{CosimReport, Service, Setup, cosimulate};
use host_sim::engine::Silent;
use host_sim::packages::PackageBytes;
use host_sim::scenario::{PAPER, Scenario};
use host_sim::service::{Address, Client, Line, Message};

use crate::cli::command_line::{Folder, texts};
use crate::cosim::loop_node::{self, Quirks};

/// Runs the paper's scenario without learning while `visit`, which finds the nodes at the sockets
/// in the folder, is running.
fn served(folder: &Folder, visit: impl FnOnce()) -> CosimReport {
    let mut scenario = Scenario::parse("paper", PAPER).unwrap();
    scenario.learning.clear();
    // Ends when `visit` returns.
    scenario.time.duration = 1e6;
    let stop = Arc::new(AtomicBool::new(false));
    let service = Service { folder: folder.path("nodes"), speed: 1.0, stop: stop.clone() };
    std::thread::scope(|scope| {
        let run = scope.spawn(|| {
            let start = &mut |_, package: &PackageBytes| {
                let quirks = Quirks { trial_seconds: Some(10), ..Quirks::default() };
                let socket = loop_node::spawn(Some(package), &quirks);
                Ok(Board::new(Line::over_socket(socket, &Arc::default()).unwrap(), "thread", false))
            };
            let setup = Setup::new(start, Duration::from_secs(10), &Arc::default());
            cosimulate(&scenario, 0, setup, Some(&service), &Silent).unwrap()
        });
        while !folder.path("nodes/agent-3.sock").exists() {
            std::thread::sleep(Duration::from_millis(1));
        }
        // Ends the run even if the visit panics.
        let end = End(stop);
        visit();
        drop(end);
        run.join().unwrap()
    })
}

struct End(Arc<AtomicBool>);

impl Drop for End {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Sends a request to a node and waits for any answer.
fn ask(client: &mut Client, request: &Request<'_>) {
    let any = |message: &Message<'_>| message.is_answer().then_some(());
    client.ask(request, Duration::from_secs(10), &mut |_| {}, "an answer", any).unwrap();
}

fn client(folder: &Folder, agent: usize) -> Client {
    let address = Address::Socket(folder.path(&format!("nodes/agent-{agent}.sock")));
    Client::new(address.connect(&Arc::default()).unwrap())
}

#[test]
fn cosim_nodes_are_recorded_trained_for_and_pushed_to_while_every_bit_agrees() {
    let folder = Folder::new("cosim-cycle");
    let report = served(&folder, || {
        let told = folder.succeed("monitor nodes/agent-1.sock --record samples.csv --count 500");
        let head = std::fs::read_to_string(folder.path("samples.csv")).unwrap();
        let hash = Scenario::parse("paper", PAPER).unwrap().hash;
        assert!(head.contains("# agent: 1\n# package: version 1, checksum 0x"), "{head}");
        assert!(head.contains(&format!("# scenario: paper, hash {hash:#018x}\n")), "{head}");
        let refused =
            folder.fail("train samples.csv --scenario paper --agent 2 --out 2.weights", 2);
        assert!(refused.contains("samples of agent 1, not of agent 2"), "{refused}");
        let refused = folder.fail("monitor nodes/agent-1.sock --record samples.csv", 2);
        assert!(refused.contains("exists and is not empty"), "{refused}");
        assert!(told.contains("agent 1, package version 1"), "{told}");
        assert!(told.contains("x_hat") && told.contains("samples.csv: 499 samples"), "{told}");
        // Half a second of samples explains nothing, but is enough here.
        let always = "[recipes.better]\nswitch_in = \"always\"";
        folder.write("always.toml", &PAPER.replace("[recipes.better]", always));
        let train = "train samples.csv --scenario always.toml --agent 1 --recipe better";
        let train = folder.run(&format!("{train} --out node.weights"));
        let warning = texts(&train).1;
        assert!(train.status.success(), "{warning}");
        let hash = format!("samples.csv: recorded with scenario paper (hash {hash:#018x})");
        assert!(warning.contains(&hash), "{warning}");
        let bytes = std::fs::read(folder.path("node.weights")).unwrap();

        // Files known to be damaged are not sent at all.
        let mut tampered = bytes.clone();
        tampered[bytes.len() / 2] ^= 4;
        std::fs::write(folder.path("tampered.weights"), &tampered).unwrap();
        let refused = folder.run("push unix:nodes/agent-1.sock tampered.weights");
        let (standard, error) = texts(&refused);
        assert_eq!((refused.status.code(), standard.as_str()), (Some(2), ""));
        assert!(error.contains("tampered.weights: ") && error.contains("checksum"), "{error}");

        // One transfer breaks off; another continues it.
        let mut broken = client(&folder, 1);
        ask(&mut broken, &Request::Begin { length: bytes.len() as u32 });
        for (index, chunk) in bytes.chunks(CHUNK_LENGTH_MAX).take(5).enumerate() {
            let offset = (index * CHUNK_LENGTH_MAX) as u32;
            ask(&mut broken, &Request::Chunk { offset, bytes: chunk });
        }
        drop(broken);
        let pushed = folder.succeed("push nodes/agent-1.sock node.weights --confirm");
        assert!(
            pushed.contains("version 2 pushed") && pushed.contains("resumed at byte 640"),
            "{pushed}"
        );
        assert!(pushed.contains("in use and confirmed"), "{pushed}");
        let status = folder.succeed("node nodes/agent-1.sock");
        assert!(status.contains("package version 2") && status.contains("confirmed"), "{status}");
        let again = folder.succeed("push nodes/agent-1.sock node.weights --format json");
        let again: serde_json::Value = serde_json::from_str(&again).unwrap();
        assert_eq!((&again["version"], again["resumed_from"].is_null()), (&2.into(), true));
        // Pushing it again does not put it on trial again.
        assert_eq!(again["confirmed"], true);
        let again = folder.succeed("push nodes/agent-1.sock node.weights");
        assert!(again.contains("already on the node; in use and confirmed"), "{again}");
        // Some steps with the new package.
        folder.succeed("monitor nodes/agent-1.sock --every 1 --count 50");
    });
    assert_eq!((&report.first_mismatch, report.mismatches), (&None, 0));
    let switches: Vec<_> = report.boards.iter().map(|board| board.switches).collect();
    assert_eq!(switches, [1, 0, 0]);
    for board in &report.boards {
        assert_eq!((board.compared, &board.parted), (report.steps, &None));
    }
    assert!(!folder.path("nodes/agent-1.sock").exists());
}

#[test]
fn diverted_cosim_nodes_are_no_longer_compared() {
    let folder = Folder::new("cosim-reset");
    let report = served(&folder, || {
        let told = folder.succeed("monitor nodes/agent-3.sock --every 10 --count 3 --format json");
        let lines: Vec<serde_json::Value> =
            told.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        assert_eq!(lines.len(), 4, "{told}");
        assert_eq!(lines[1]["State"]["tick"].as_u64().unwrap() % 10, 0);
        assert_eq!(lines[1]["State"]["outer_weights"].as_array().unwrap().len(), 0);
        // Nodes in the loop refuse to control time, and refuse bytes that are not a package.
        let mut client = client(&folder, 2);
        ask(&mut client, &Request::Tick { periods: 1, measurement: None });
        let refused = folder.fail("node nodes/agent-3.sock revert", 2);
        assert!(refused.contains("no package is on trial; only a package on trial"), "{refused}");
        folder.succeed("node nodes/agent-3.sock reset");
        folder.succeed("monitor nodes/agent-3.sock --every 1 --count 50");
    });
    assert_eq!((&report.first_mismatch, report.mismatches), (&None, 0));
    let parted = |agent: usize| report.boards[agent - 1].parted.clone().unwrap_or_default();
    assert!(parted(3).contains("it was reset"), "{report:?}");
    // Agent 1 hears agent 3, agent 2 hears agent 1.
    assert!(parted(1).contains("its neighbour 3 deviates"), "{report:?}");
    assert!(parted(2).contains("its neighbour 1 deviates"), "{report:?}");
    assert!(report.boards[1].compared < report.steps);
}
