use super::*;
use crate::scenario::{PAPER, Scenario};

fn change(text: &str) -> Change {
    Change::parse("--set", text).unwrap()
}

fn changed(text: &str, changes: &[&str]) -> String {
    let changes: Vec<_> = changes.iter().map(|text| change(text)).collect();
    applied("mine.toml", text, &changes).unwrap().unwrap()
}

fn paper(changes: &[&str]) -> Result<Scenario, ScenarioError> {
    let changes: Vec<_> = changes.iter().map(|text| change(text)).collect();
    Scenario::parse_changed("paper", PAPER, &changes).map(|(scenario, _)| scenario)
}

fn refusal(changes: &[&str]) -> String {
    paper(changes).unwrap_err().to_string()
}

#[test]
fn only_the_value_changes_and_comments_stay() {
    let text = "# first\n[a]\nb = 1.0 # why\nc = [1, 2] # list\n\n[[d]]\ne = 1\n\n[[d]]\ne = 2\n";
    assert_eq!(
        changed(text, &["a.b=2e3", "a.c.2=5", "d.2.e = 7", "a.c.1=4"]),
        "# first\n[a]\nb = 2e3 # why\nc = [4, 5] # list\n\n[[d]]\ne = 1\n\n[[d]]\ne = 7\n"
    );
    assert_eq!(
        changed("a = 1\n", &["b.c.d=x", "b.c.e=[1, 2]"]).parse::<DocumentMut>().unwrap()["b"]["c"]
            ["e"][1]
            .as_integer(),
        Some(2)
    );
}

#[test]
fn what_is_not_toml_is_a_string_or_a_number() {
    for (text, shown) in [
        ("k=field", "field"),
        ("k=\"field\"", "field"),
        ("k=1e3", "1e3"),
        ("k=.5", "0.5"),
        ("k=[1, 2]", "[1, 2]"),
        ("k=true", "true"),
        ("k={ a = 1 }", "{ a = 1 }"),
        ("k=[1", "[1"),
    ] {
        assert_eq!(change(text).shown(), shown, "{text}");
    }
    assert_eq!(Change::parse("--set", "k").unwrap_err(), ChangeError::NoValue);
    assert_eq!(Change::parse("--set", "k= ").unwrap_err(), ChangeError::Empty);
    assert_eq!(Change::parse("--set", "=1").unwrap_err(), ChangeError::Key);
    assert_eq!(Change::parse("--set", "a..b=1").unwrap_err(), ChangeError::Key);
}

#[test]
fn every_kind_of_key_of_a_scenario_can_be_changed() {
    let scenario = paper(&[
        "design.epsilon=500",
        "plant.initial_state.2=-1.5",
        "plant.parameters.mu=0.4",
        "agents.2.sensor.noise=0.25",
        "link.loss=0.1",
        "recipes.better.epochs=7",
        "observer.preset=field",
    ])
    .unwrap();
    assert_eq!(scenario.design.epsilon, 500.0);
    assert_eq!(scenario.initial_state, [5.0, -1.5, 8.0]);
    assert_eq!(scenario.agents[1].sensor.noise, 0.25);
    assert_eq!(scenario.agents[0].sensor.noise, 0.0);
    assert_eq!(scenario.link.edge.loss, 0.1);
    assert!(scenario.observer.is_some());
    assert_ne!(scenario.hash, paper(&[]).unwrap().hash);
}

#[test]
fn a_plain_gain_becomes_a_scaled_one() {
    let scenario = paper(&["design.gain.scale=0.5"]).unwrap();
    assert_eq!(scenario.design.gain.diagonal().as_slice(), [67.43, 131.615, 131.615]);
    let twice = paper(&["design.gain.scale=3", "design.gain.scale=0.5"]).unwrap();
    assert_eq!(twice.design, scenario.design);
    let random = paper(&["plant.initial_state.random=[1, 2, 3]"]).unwrap();
    assert_eq!(random.initial_spread, Some(vec![1.0, 2.0, 3.0]));
}

#[test]
fn the_papers_observer_replaces_any_other() {
    let with_observer =
        format!("{PAPER}\n[observer]\nradius = 0.1\nfrom = 20.0 # as in the study\n");
    let other = Scenario::parse("paper", &with_observer).unwrap();
    assert!(other.observer.is_some());
    let changes = [change("observer.preset=paper")];
    let (scenario, text) = Scenario::parse_changed("paper", &with_observer, &changes).unwrap();
    assert_eq!(scenario.observer, None);
    assert!(text.ends_with("[observer]\npreset = \"paper\"\n"), "{text}");
    for changes in [
        ["observer.preset=paper", "observer.error=0.02"],
        ["observer.error=0.02", "observer.preset=paper"],
    ] {
        assert_eq!(
            refusal(&changes),
            "paper: --set observer.error=0.02: has no effect with observer.preset=paper; leave one of them out"
        );
    }
    let twice = ["observer.preset=paper", "observer.preset=field"].map(change);
    let (scenario, _) = Scenario::parse_changed("paper", &with_observer, &twice).unwrap();
    assert_eq!(scenario.observer, other.observer);
}

#[test]
fn refusals_name_the_change() {
    assert_eq!(
        refusal(&["design.rho=2.0", "design.epsilom=3"]),
        "paper: --set design.epsilom=3: design.epsilom: unknown key; did you mean epsilon?"
    );
    assert_eq!(
        refusal(&["desing.epsilon=3"]),
        "paper: --set desing.epsilon=3: desing: unknown key; did you mean design?"
    );
    assert!(refusal(&["design.epsilon=-3"]).starts_with(
        "paper: --set design.epsilon=-3: design.epsilon: is -3, expected a number above 0"
    ));
    assert_eq!(
        refusal(&["agents.4.sensor.noise=1"]),
        "paper: --set agents.4.sensor.noise=1: agents is a list with 3 entries, and \"4\" is not one of them; \
         write the number of an entry, agents.1 to agents.3"
    );
    assert_eq!(
        refusal(&["design.epsilon.x=1"]),
        "paper: --set design.epsilon.x=1: design.epsilon is a number, not a table; set \
         design.epsilon itself"
    );
    // The key of the error is another one, which the change made wrong.
    let error = refusal(&["design.kappa=0.01"]);
    assert!(
        error.starts_with("paper:")
            && error.contains(": --set design.kappa=0.01: design.k2: is 10"),
        "{error}"
    );
    let error = refusal(&["agents.2.sensor.nois=1"]);
    assert!(error.ends_with("agents[2].sensor.nois: unknown key; did you mean noise?"), "{error}");
}

#[test]
fn a_mistake_in_the_file_itself_keeps_its_line() {
    let text = PAPER.replacen("rho = 2.0", "rho = -2.0", 1);
    let plain = Scenario::parse("paper", &text).unwrap_err();
    let changes = [change("link.loss=0.1")];
    let changed = Scenario::parse_changed("paper", &text, &changes).unwrap_err();
    assert_eq!(changed, plain);
    let broken = Scenario::parse_changed("paper", "a =", &changes).unwrap_err();
    assert_eq!(broken, Scenario::parse("paper", "a =").unwrap_err());
}
