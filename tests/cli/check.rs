//! `check`: what can be said of a scenario before a run.

use crate::cli::command_line::{Folder, object, short, texts};
use crate::cli::json_documented::assert_documented;

fn folder(name: &str, observer: &str) -> Folder {
    let folder = Folder::new(name);
    folder.write("mine.toml", &(short().text() + observer));
    folder
}

#[test]
fn the_field_observer_is_checked_as_far_as_it_is_known() {
    let folder = folder("check-field", "\n[observer]\nfrom = 0.5\nerror = 0.05\n");
    let text = folder.succeed("check mine.toml");
    let expected = [
        "Field observer from t = 0.5 s",
        "own measurement",
        "radius of the trigger",
        "certified; after a long time",
        "derives it again from the network",
    ];
    assert!(expected.iter().all(|part| text.contains(part)), "{text}");
    let report = object(&folder.succeed("check mine.toml --format json"));
    assert_documented(&report, &["from", "trained_later", "settings", "certified", "bound"]);
    let observer = &report["observer"];
    assert_eq!((&observer["certified"], &observer["trained_later"]), (&true.into(), &true.into()));
    // Without training it is what `run` certifies.
    let without = "--without-learning --baselines none --format json --out out";
    let run = object(&folder.succeed(&format!("run mine.toml {without}")));
    assert_eq!(observer["bound"], run["observer"]["bound"]);
    let text = folder.succeed("check mine.toml --set learning=[]");
    assert!(!text.contains("derives it again"), "{text}");
    // The paper's observer has no such lines.
    folder.write("paper.toml", &short().text());
    let text = folder.succeed("check paper.toml");
    assert!(!text.contains("Field observer"), "{text}");
}

#[test]
fn an_observer_that_a_run_refuses_is_refused_before_it() {
    let folder = folder("check-gate", "\n[observer]\ntree_gain = 5000.0\n");
    for command in ["check mine.toml", "run mine.toml --out out"] {
        let output = folder.run(command);
        let (_, error) = texts(&output);
        assert_eq!(output.status.code(), Some(1), "{command}: {error}");
        assert!(error.contains("the tree gain 5000 1/s of direction 1"), "{command}: {error}");
    }
}

#[test]
fn what_is_not_certified_is_said_with_its_reason() {
    let folder = folder("check-reasons", "\n[observer]\npreset = \"robust\"\n");
    let text = folder.succeed("check mine.toml");
    assert!(text.contains("nothing is certified: the preset \"robust\" sets gaps"), "{text}");
}

#[test]
fn a_gain_that_agents_do_not_use_limits_no_step() {
    // Far above the limit of the paper's observer with this gain, and below that of the field observer's own.
    let gain = "--set design.gain=[2e6,2e6]";
    let folder = folder("check-step", "\n[observer]\nfrom = 0.0\nerror = 0.05\n");
    let text = folder.succeed(&format!("check mine.toml {gain}"));
    let expected = ["K1 and the event trigger: not in use", "agents do not use design.gain"];
    assert!(expected.iter().all(|part| text.contains(part)), "{text}");
    folder.succeed(&format!("run mine.toml {gain} --out out"));
    // Until the switch agents run the paper's observer, with a step that is too long.
    let output = folder.run(&format!("check mine.toml {gain} --set observer.from=0.3"));
    let (text, _) = texts(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("is too long"), "{text}");
}
