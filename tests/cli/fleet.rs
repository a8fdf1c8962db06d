//! One network for a fleet, trained on the recordings of several agents.

use std::fs;

use host_sim::packages::PackageBytes;

use crate::cli::command_line::{Folder, object, short};
use crate::cli::json_documented::assert_documented;

fn folder(name: &str, more: &str) -> Folder {
    let folder = Folder::new(name);
    let text = short().text().replace("\nevents = ", "\nsamples = true\nevents = ");
    folder.write("mine.toml", &(text + more));
    folder.succeed("run mine.toml --out out --baselines none");
    folder
}

const TRAIN: &str =
    "train out/agent1_cycle1_samples.csv out/agent2_cycle1_samples.csv --scenario mine.toml";

#[test]
fn a_fleet_gets_one_network_from_the_samples_of_all() {
    let folder = folder("fleet", "");
    let report = object(&folder.succeed(&format!("{TRAIN} --agent 1,2 --out fleet --format json")));
    let paths = ["fleet/agent1.weights", "fleet/agent2.weights"];
    assert_eq!(report["packages"], serde_json::json!(paths));
    assert_eq!(report["package"], paths[0]);
    let single = folder.succeed(
        "train out/agent1_cycle1_samples.csv --scenario mine.toml --agent 1 --out one.weights \
         --format json",
    );
    let (all, one) = (&report["recorded_samples"], &object(&single)["recorded_samples"]);
    assert_eq!(all.as_u64(), one.as_u64().map(|one| 2 * one));
    let [first, second] = paths.map(|path| PackageBytes::load(&folder.path(path)).unwrap());
    let (first, second) = (first.package(), second.package());
    assert_eq!((first.node.agent, second.node.agent), (1, 2));
    assert_eq!(first.network, second.network);
    assert_eq!(first.outer_weights, second.outer_weights);
    assert_ne!(first.node.output_matrix, second.node.output_matrix);
    folder.succeed(
        "run mine.toml --without-learning --weights fleet/agent1.weights --weights \
         fleet/agent2.weights --out again",
    );
    // Each next one is newer.
    folder.succeed(&format!("{TRAIN} --agent 1,2 --out fleet"));
    let again = PackageBytes::load(&folder.path(paths[1])).unwrap();
    assert_eq!(again.package().version, second.version + 1);
}

#[test]
fn the_field_observers_parameters_are_in_the_packages() {
    let observer = "\n[observer]\npreset = \"field\"\nerror = 0.02\n";
    let folder = folder("fleet-field", observer);
    folder.succeed(&format!("{TRAIN} --agent 1,2 --out fleet"));
    for path in ["fleet/agent1.weights", "fleet/agent2.weights"] {
        let package = PackageBytes::load(&folder.path(path)).unwrap();
        assert!(!package.package().node.field.is_empty());
        let text = folder.succeed(&format!("weights inspect {path}"));
        assert!(text.contains("field: coupled by trees"), "{text}");
        let [measured, followed] = match path.contains("agent1") {
            true => [
                "direction 1          measured by output 1, gain",
                "direction 2          follows agent 2, gain",
            ],
            false => [
                "direction 2          measured by output 1, gain",
                "direction 1          follows agent 1, gain",
            ],
        };
        assert!(text.contains(measured) && text.contains(followed), "{text}");
        let facts = object(&folder.succeed(&format!("weights inspect {path} --format json")));
        assert_documented(&facts, &["parent", "root_gain", "disturbance_limit", "relay_share"]);
    }
    // Differences are told in words, too.
    let text = folder.succeed("weights diff fleet/agent1.weights fleet/agent2.weights");
    let expected =
        ["observer, direction 1, output: 1 -> none", "observer, direction 2, parent: 2 -> none"];
    assert!(expected.iter().all(|line| text.contains(line)), "{text}");
    assert!(!text.contains(['{', '"']) && !text.contains("null"), "{text}");
}

#[test]
fn recordings_and_agents_that_do_not_fit_are_refused() {
    let folder = folder("fleet-refused", "");
    // A recording of an agent that gets no network, if the file says whose it is.
    let path = folder.path("out/agent2_cycle1_samples.csv");
    let text = fs::read_to_string(&path).unwrap();
    let head = "# agent: 2\n";
    if !text.starts_with('#') {
        fs::write(&path, head.to_owned() + &text).unwrap();
    }
    let error = folder.fail(&format!("{TRAIN} --agent 1 --out one.weights"), 2);
    assert!(error.contains("samples of agent 2"), "{error}");
    let error = folder.fail(&format!("{TRAIN} --agent 1,1 --out fleet"), 2);
    assert!(error.contains("given twice"), "{error}");
    let error = folder.fail(&format!("{TRAIN} --agent 1,3 --out fleet"), 2);
    assert!(error.contains("agents 1 to 2"), "{error}");
    folder.write("file", "not a folder");
    let error = folder.fail(&format!("{TRAIN} --agent 1,2 --out file"), 1);
    assert!(error.contains("file is not a folder; choose another one"), "{error}");
}
