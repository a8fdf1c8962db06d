//! What a person should know before a run takes its time.

use crate::analysis::{GainCertificate, outputs_determine_state};
use crate::scenario::{Agent, Scenario};
use crate::terminal;

/// Prints what speaks against `scenario`, a line each, on standard error.
pub(super) fn print(scenario: &Scenario) {
    for warning in warnings(scenario) {
        terminal::warning(warning);
    }
}

fn warnings(scenario: &Scenario) -> Vec<String> {
    let mut warnings = Vec::new();
    let gain = GainCertificate::new(scenario);
    if !outputs_determine_state(scenario) {
        warnings.push(
            "together the agents do not measure the whole state, and no design.gain makes up for \
             it; let some agent measure what is missing"
                .to_owned(),
        );
    } else if !gain.holds() {
        warnings.push(format!(
            "design.gain is no solution of the paper's matrix inequality, so its theorems do not \
             hold: lambda_min = {:.4} 1/s, k1 = k2 + rho^2/delta = {:.4} 1/s; raise design.gain, \
             add edges to the graph, or lower k2 and rho",
            gain.eigenvalue_min, gain.k1,
        ));
    }
    if let Some(network) = scenario.network.as_ref().filter(|_| !scenario.learning.is_empty()) {
        let mut rows = network.outer.chunks_exact(scenario.dimension());
        let first = rows.next();
        if network.architecture.features() > 1 && rows.all(|row| Some(row) == first) {
            warnings.push(
                "all rows of network.outer are equal, so training can hardly tell the \
                 components of the state apart; write network.outer = { random = 5.0 }, about \
                 the size of the state's rate"
                    .to_owned(),
            );
        }
    }
    let trained = |agent: &Agent| agent.package.is_some();
    if scenario.health.is_some()
        && scenario.learning.is_empty()
        && !scenario.agents.iter().any(trained)
    {
        warnings.push(
            "no agent's network is trained, so [health] knows no box of trained inputs and counts \
             no step outside; add [[learning]], or give packages with --weights"
                .to_owned(),
        );
    }
    warnings
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::{BUILT_IN, PAPER};

    fn changed(from: &str, to: &str) -> Vec<String> {
        assert!(PAPER.contains(from), "{from}");
        warnings(&Scenario::parse("paper.toml", &PAPER.replacen(from, to, 1)).unwrap())
    }

    #[test]
    fn the_built_in_scenarios_need_no_warning() {
        for (name, text) in BUILT_IN {
            assert_eq!(warnings(&Scenario::parse(name, text).unwrap()), [""; 0], "{name}");
        }
    }

    #[test]
    fn each_weakness_has_its_warning() {
        let blind =
            changed("output_matrix = [[0.0, 1.0, 0.0]]", "output_matrix = [[1.0, 0.0, 0.0]]");
        assert!(blind[0].contains("do not measure the whole state"), "{blind:?}");
        let weak = changed("k2 = 10.0", "k2 = 100.0");
        assert!(weak[0].contains("no solution"), "{weak:?}");
    }

    #[test]
    fn a_watch_without_anything_trained_sees_little() {
        let text = format!("{PAPER}\n[health]\n");
        let mut scenario = Scenario::parse("paper.toml", &text).unwrap();
        assert_eq!(warnings(&scenario), [""; 0]);
        scenario.learning.clear();
        assert!(warnings(&scenario)[0].contains("no agent's network is trained"));
    }

    #[test]
    fn equal_outer_rows_are_no_good_to_learn_with() {
        let mut scenario = Scenario::parse("paper.toml", PAPER).unwrap();
        scenario.network.as_mut().unwrap().outer.fill(0.0);
        assert!(warnings(&scenario)[0].contains("all rows of network.outer are equal"));
        scenario.learning.clear();
        assert!(warnings(&scenario).is_empty());
    }
}
