//! Warnings before and after a run.

use agent_core::observer::field::HoldKind;

use super::{CommandError, ErrorCode};
use crate::analysis::{GainVerdict, spectral_norm};
use crate::engine::statistics::{AgentStatistics, Extrapolation};
use crate::engine::{RunResult, remedy};
use crate::learning::judgement::outer_weights;
use crate::number::significant;
use crate::plant::Plant;
use crate::report::theorems::{Checks, DesignChecks};
use crate::scenario::{Agent, Method, Scenario, Window};
use crate::terminal;
use crate::warning::{Warning, WarningCode};

/// Share of steps with a broadcast above which the event trigger saves little.
const FREQUENT: f64 = 0.25;

/// Prints warnings on standard error, one per line.
pub(super) fn print(warnings: &[Warning]) {
    for warning in warnings {
        terminal::warning(warning);
    }
}

/// Formats warnings as lines of a report.
pub(super) fn lines(warnings: &[Warning]) -> String {
    let lines: String = warnings.iter().map(|warning| format!("warning: {warning}\n")).collect();
    if lines.is_empty() { lines } else { lines + "\n" }
}

/// Says so if samples are to evolve by the networks of cycles that give each agent its own.
fn different_networks(scenario: &Scenario) -> Option<String> {
    let observer = scenario.observer.as_ref()?;
    let asked = observer.hold == Some(HoldKind::Model) && observer.network;
    let own = scenario.learning.iter().position(|cycle| !cycle.is_shared)?;
    (asked && scenario.agents.len() > 1).then(|| {
        format!(
            "observer.hold = \"model\" needs one network for all agents, and learning[{}] trains one for each: \
             samples will move at the rate sent with them; set shared = true there",
            own + 1
        )
    })
}

/// Names the known inputs that nothing uses: neither the plant's derivative nor a network.
fn unused_inputs(scenario: &Scenario) -> Option<String> {
    let (names, is_written) = match &scenario.plant {
        Plant::Expressions(system) => {
            let names = system.unused_inputs();
            (names.into_iter().map(str::to_owned).collect(), true)
        }
        plant => (plant.input_names(), false),
    };
    let has_network =
        scenario.network.is_some() || scenario.agents.iter().any(|agent| agent.package.is_some());
    let goes_without = scenario.method.knows_f() || scenario.method == Method::NoNetwork;
    let is_left_out = scenario.observer.as_ref().is_some_and(|observer| {
        // Until then agents run the paper's observer, with its network.
        !observer.network && observer.from == 0.0
    });
    let (first, others) = names.split_first()?;
    if has_network && !goes_without && !is_left_out {
        return None;
    }
    let names = others.iter().fold(format!("`{first}`"), |all, name| all + &format!(", `{name}`"));
    let place = if is_written { "plant.derivative does not, and " } else { "" };
    let reason = match has_network {
        true if is_left_out => "observer.network = false leaves the network out".to_owned(),
        true => format!("method = \"{}\" has no network that would", scenario.method.name()),
        false => "there is no network that would".to_owned(),
    };
    let them = if others.is_empty() { "it" } else { "them" };
    Some(format!("nothing uses {names} of plant.inputs: {place}{reason}; use or remove {them}"))
}

/// Returns the warnings about `scenario` that do not need a run.
pub(super) fn before(scenario: &Scenario, design: &DesignChecks) -> Vec<Warning> {
    let mut warnings = Vec::new();
    let mut warn = |code, text: String| warnings.push(Warning::new(code, text));
    if design.gain.verdict == GainVerdict::StateNotCovered {
        let text = format!("design.gain in the matrix inequality: {}", design.gain_in_words());
        warn(WarningCode::StateNotCovered, text);
    } else if !design.gain.holds()
        && scenario.observer.is_none()
        && scenario.plant.recording().is_none()
    {
        let text = format!(
            "design.gain in the matrix inequality, which the theorems require: {}",
            design.gain_in_words()
        );
        warn(WarningCode::GainNotASolution, text);
    }
    if !design.step.is_stable() {
        warn(WarningCode::UnstableStep, design.step.describe());
    }
    if let Some(text) = short_smoothing(scenario) {
        warn(WarningCode::ShortSmoothing, text);
    }
    if let Some(text) = different_networks(scenario) {
        warn(WarningCode::DifferentNetworks, text);
    }
    if let Some(text) = unused_inputs(scenario) {
        warn(WarningCode::UnusedInput, text);
    }
    if let Some(last) = last_switch(scenario)
        && scenario.time.tick(scenario.evaluation.from) < scenario.time.tick(last)
    {
        let Window { from, to } = scenario.evaluation;
        let text = if scenario.time.tick(to) > scenario.time.tick(last) {
            format!(
                "the evaluation window starts at {from} s, before the last network is switched in \
                 at {last} s, so it mixes errors with and without that network; set evaluation.from = {last}"
            )
        } else {
            format!(
                "the evaluation window ends at {to} s, before the last network is switched in at \
                 {last} s, so it does not cover that network; set evaluation.from = {last} and \
                 evaluation.to = {}",
                scenario.time.duration
            )
        };
        warn(WarningCode::WindowBeforeSwitch, text);
    }
    let to_train = scenario.network.as_ref().filter(|_| !scenario.learning.is_empty());
    let outer = to_train.and_then(|n| outer_weights(&n.outer, scenario.dimension()));
    warnings.extend(outer);
    let trained = |agent: &Agent| agent.package.is_some();
    let trains = scenario.method == Method::Observer && !scenario.learning.is_empty();
    if let Err(error) = scenario.check_for_nodes()
        && trains
    {
        let text = format!("trained packages are not written: {error}");
        warnings.push(Warning::new(WarningCode::SimulationOnly, text));
    }
    if scenario.health.is_some()
        && scenario.learning.is_empty()
        && !scenario.agents.iter().any(trained)
    {
        let text = "no agent has a trained network, so [health] cannot count steps outside the trained \
                    box; add [[learning]], or give packages with --weights";
        warnings.push(Warning::new(WarningCode::HealthUntrained, text));
    }
    warnings
}

/// Returns what is wrong with `exchange.smoothing`, if it may be too short for the link.
///
/// With a longest delay `D` and a gain `K` of the consensus term, the linear consensus of paths, rings,
/// stars and complete graphs of up to five agents was stable from at most `2 D max(1, K D)` on, by the
/// eigenvalues of its discrete form.
fn short_smoothing(scenario: &Scenario) -> Option<String> {
    let smoothing = f64::from(scenario.exchange.smoothing) * scenario.time.step_size;
    let rules = scenario.link.rules.iter().map(|rule| &rule.edge);
    let edges = rules.chain([&scenario.link.edge]);
    let delay = edges.map(|edge| edge.delay + edge.jitter).fold(0.0, f64::max);
    let graph = &scenario.graph;
    let weight = graph.edges().iter().map(|edge| edge.weight).fold(0.0, f64::max);
    let degree = (0..graph.agents()).map(|agent| graph.degree(agent)).fold(0.0, f64::max);
    let gain = spectral_norm(&scenario.design.gain) * weight.max(0.5 * degree);
    let needed = 2.0 * delay * (gain * delay).max(1.0);
    (smoothing > 0.0 && smoothing < needed).then(|| {
        format!(
            "exchange.smoothing = {} s may be too short for a delay of up to {} s: late samples are extrapolated \
             with a velocity that they themselves change, and the error can grow without bound; use at \
             least {} s, or lower design.gain",
            significant(smoothing, 3),
            significant(delay, 3),
            significant(needed, 2),
        )
    })
}

/// Returns the time at which the last network is switched in, if any. \[s\]
fn last_switch(scenario: &Scenario) -> Option<f64> {
    let within = |time: &f64| scenario.time.tick(*time) < scenario.steps();
    scenario.learning.iter().map(|cycle| cycle.apply_at).filter(within).reduce(f64::max)
}

/// Returns the warnings about a run of `scenario` that are not already in `before`.
pub(super) fn after(
    scenario: &Scenario,
    run: &RunResult,
    checks: &Checks,
    before: &[Warning],
) -> Vec<Warning> {
    let of_trainings = run.trainings.iter().flat_map(|training| &training.warnings);
    let mut warnings = without_repetition(of_trainings.cloned(), before);
    let mut warn = |code, text: String| warnings.push(Warning::new(code, text));
    for text in &run.missed {
        warn(WarningCode::NotSwitchedIn, text.clone());
    }
    if let Some(text) = unstable_run(scenario, checks) {
        warn(WarningCode::UnstableRun, text);
    } else if let Some(text) = useless_estimate(scenario, run) {
        warn(WarningCode::UselessEstimate, text);
    }
    if let Some(text) = extrapolation(scenario, &run.agents) {
        warn(WarningCode::Extrapolation, text);
    }
    let steps = scenario.steps().max(1) as f64;
    // The first broadcast, at t = 0, is not caused by the trigger.
    let shares = run.agents.iter().map(|agent| (agent.broadcasts().max(1) - 1) as f64 / steps);
    let event = scenario.trigger.departure().is_none();
    let frequent: Vec<(usize, f64)> =
        (1..).zip(shares).filter(|(_, share)| event && *share > FREQUENT).collect();
    if let Some(worst) = frequent.iter().copied().reduce(|a, b| if b.1 > a.1 { b } else { a }) {
        let others = match frequent.len() {
            1 => String::new(),
            count => format!(" ({count} agents broadcast in more than a quarter of the steps)"),
        };
        let advice = match &scenario.observer {
            None => "raise design.epsilon, lower design.gain",
            Some(_) => "raise observer.error or observer.radius",
        };
        let text = format!(
            "agent {} broadcast in {:.0} % of the steps{others}, so the event trigger saves little; \
             {advice}, or shorten time.step",
            worst.0,
            100.0 * worst.1,
        );
        warn(WarningCode::FrequentBroadcasts, text);
    }
    let applies = event && checks.design.departures.is_empty();
    let needed = checks.theorem1.lumped.filter(|l| applies && checks.theorem1.rho < l.estimate);
    if let Some(lumped) = needed {
        let rho = checks.theorem1.rho;
        let alone = if lumped.disturbance > rho {
            format!(
                " (the disturbance alone, all agents stacked, reaches {})",
                significant(lumped.disturbance, 4)
            )
        } else {
            String::new()
        };
        let text = format!(
            "design.rho = {rho} is below chi_bar_max, which this run estimates at about {}{alone}, so \
             Theorem 1 does not apply; raise design.rho, and design.gain as `host-sim check` then \
             suggests, or ignore the bound",
            significant(lumped.estimate, 3),
        );
        warn(WarningCode::RhoTooSmall, text);
    }
    warnings
}

/// Share of the width of the samples' range by which inputs may leave it without a warning.
const OUTSIDE: f32 = 0.05;

/// Describes how far polynomials were used outside the range of their samples, or returns `None` if they practically were not.
pub(super) fn extrapolation(scenario: &Scenario, agents: &[AgentStatistics]) -> Option<String> {
    let found = agents.iter().map(|agent| &agent.extrapolation);
    let names = [scenario.plant.state_names(), scenario.plant.input_names()].concat();
    let farthest = names.iter().enumerate().filter_map(|(place, name)| {
        let farthest = found.clone().filter_map(|agent| agent.farthest.get(place));
        let farthest = farthest.copied().fold(0.0, f32::max);
        let percent = significant(100.0 * f64::from(farthest), 2);
        (farthest > OUTSIDE).then(|| format!("{name} by up to {percent} %"))
    });
    let farthest: Vec<String> = farthest.collect();
    let sum = |of: fn(&Extrapolation) -> u64| found.clone().map(of).sum::<u64>() as f64;
    let share = sum(|agent| agent.outside) / sum(|agent| agent.steps).max(1.0);
    (!farthest.is_empty()).then(|| {
        format!(
            "regression: the polynomials are used outside the range of their samples in {} % of the evaluated steps, {} of \
             the range's width; beyond it they are constant, so these errors say little about polynomials in \
             general; collect samples over a longer window (collect_from and collect_to of [[learning]])",
            significant(100.0 * share, 2),
            farthest.join(", "),
        )
    })
}

/// Describes an error that makes an agent's estimate useless, or returns `None` if there is none.
fn useless_estimate(scenario: &Scenario, run: &RunResult) -> Option<String> {
    let (agent, error) = run.useless_estimate()?;
    let advice = if scenario.method.is_kalman() {
        "lower kalman.radius"
    } else if scenario.trigger.departure().is_some() {
        "lower trigger.every"
    } else if scenario.observer.is_some() {
        "lower observer.error or observer.radius"
    } else {
        "lower the trigger's radius (design.epsilon), or use [observer] where broadcasts are few"
    };
    Some(format!(
        "agent {agent} has an RMSE of {}, but the state itself is only {} (RMS) from its mean, so an estimate \
         that never moves would hardly be worse; {advice}",
        significant(error, 3),
        significant(run.state_deviation, 3),
    ))
}

/// Removes repeated warnings about outer weights, which are the same for all agents.
fn without_repetition(warnings: impl Iterator<Item = Warning>, before: &[Warning]) -> Vec<Warning> {
    let is_outer = |warning: &Warning| warning.code == WarningCode::OuterWeights;
    let mut seen = before.iter().any(is_outer);
    warnings.filter(|warning| !is_outer(warning) || !std::mem::replace(&mut seen, true)).collect()
}

/// Describes how a run was unstable, or returns `None` if it was stable.
pub(super) fn unstable_run(scenario: &Scenario, checks: &Checks) -> Option<String> {
    let growth = checks.growth.filter(|_| checks.unbounded())?;
    let hint = if checks.design.step.is_stable() {
        match scenario.method {
            Method::Periodic => remedy(scenario).to_owned(),
            _ => format!("{}; or check the plant", remedy(scenario)),
        }
    } else {
        checks.design.step.describe()
    };
    Some(format!(
        "the error grew without bound: |e_1| of all agents was {} at t = 0 and {} over the last \
         tenth of the run, while the state stayed within {}; {hint}",
        significant(growth.initial, 3),
        significant(growth.last, 3),
        significant(growth.plant, 3),
    ))
}

/// Returns an error if the run was unstable.
pub(super) fn outcome(scenario: &Scenario, checks: &Checks) -> Result<(), CommandError> {
    unstable_run(scenario, checks)
        .map_or(Ok(()), |text| Err(CommandError::new(ErrorCode::Unstable, text)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::{RunOptions, Silent, run};
    use crate::scenario::{BUILT_IN, PAPER};

    fn codes(warnings: &[Warning]) -> Vec<WarningCode> {
        warnings.iter().map(|warning| warning.code).collect()
    }

    fn before_run(scenario: &Scenario) -> Vec<Warning> {
        before(scenario, &DesignChecks::new(scenario))
    }

    fn changed(from: &str, to: &str) -> Vec<Warning> {
        assert!(PAPER.contains(from), "{from}");
        before_run(&Scenario::parse("paper.toml", &PAPER.replacen(from, to, 1)).unwrap())
    }

    fn after_run(scenario: &Scenario) -> Vec<Warning> {
        let options = RunOptions { seed: 0, learning: true, bounds: true };
        let result = run(scenario, options, &Silent).unwrap();
        after(scenario, &result, &Checks::new(scenario, &result), &[])
    }

    #[test]
    fn the_built_in_scenarios_warn_only_about_rho() {
        for (name, text) in BUILT_IN {
            let scenario = Scenario::parse(name, text).unwrap();
            assert_eq!(before_run(&scenario), [], "{name}");
            let found = after_run(&scenario);
            assert!(codes(&found).iter().all(|&c| c == WarningCode::RhoTooSmall), "{found:?}");
        }
    }

    #[test]
    fn each_design_problem_has_its_own_warning() {
        let blind =
            changed("output_matrix = [[0.0, 1.0, 0.0]]", "output_matrix = [[1.0, 0.0, 0.0]]");
        assert_eq!(codes(&blind), [WarningCode::StateNotCovered]);
        assert!(blind[0].text.contains("no gain helps"), "{blind:?}");
        let weak = changed("k2 = 10.0", "k2 = 100.0");
        assert_eq!(codes(&weak), [WarningCode::GainNotASolution]);
        // 113.333 / 36.1356, and then the step is too long.
        assert!(weak[0].text.contains("NOT a solution; multiply design.gain by 3.14"), "{weak:?}");
        assert!(weak[0].text.ends_with("set time.step below 0.00074 s"), "{weak:?}");
        let long = changed("step = 0.001", "step = 0.004");
        assert_eq!(codes(&long), [WarningCode::UnstableStep]);
        assert!(long[0].text.contains("set time.step below 0.00233 s"), "{long:?}");
        let early = changed("from = 20.0", "from = 19.0");
        assert_eq!(codes(&early), [WarningCode::WindowBeforeSwitch]);
        assert!(early[0].text.ends_with("set evaluation.from = 20"), "{early:?}");
        let over = changed("from = 20.0\n# [s]\nto = 40.0", "from = 5.0\nto = 20.0");
        assert_eq!(codes(&over), [WarningCode::WindowBeforeSwitch]);
        let hint = "set evaluation.from = 20 and evaluation.to = 40";
        assert!(over[0].text.ends_with(hint), "{over:?}");
    }

    #[test]
    fn a_smoothing_that_is_too_short_for_the_delay_is_reported() {
        let with = |smoothing: f64| {
            let text = PAPER.replacen("kind = \"lossless\"", "delay = 0.01", 1)
                + &format!("\n[exchange]\nsmoothing = {smoothing}\n");
            before_run(&Scenario::parse("paper.toml", &text).unwrap())
        };
        let short = with(0.05);
        assert_eq!(codes(&short), [WarningCode::ShortSmoothing]);
        // 2 * 0.01 * 263.23 * 0.01.
        assert!(short[0].text.contains("use at least 0.053 s"), "{short:?}");
        assert_eq!(with(0.053), []);
        assert_eq!(with(0.0), []);
    }

    #[test]
    fn a_model_hold_without_a_shared_network_is_reported() {
        let with = |shared: &str, hold: &str| {
            let text = PAPER.replacen("[[learning]]", &format!("[[learning]]\n{shared}"), 1)
                + &format!("\n[observer]\nfrom = 1.0\nhold = \"{hold}\"\n");
            codes(&before_run(&Scenario::parse("paper.toml", &text).unwrap()))
        };
        assert_eq!(with("", "model"), [WarningCode::DifferentNetworks]);
        assert_eq!(with("", "rate"), []);
        assert_eq!(with("shared = true", "model"), []);
    }

    #[test]
    fn a_step_that_is_too_long_is_reported_as_unstable() {
        let text = PAPER.replacen("step = 0.001", "step = 0.004", 1);
        let mut scenario = Scenario::parse("paper.toml", &text).unwrap();
        scenario.learning.clear();
        scenario.network = None;
        scenario.time.duration = 0.2;
        let found = after_run(&scenario);
        let expected =
            [WarningCode::UnstableRun, WarningCode::FrequentBroadcasts, WarningCode::RhoTooSmall];
        assert_eq!(codes(&found), expected, "{found:?}");
        assert!(found[0].text.contains("grew without bound"), "{found:?}");
        assert!(found[2].text.contains("the disturbance alone"), "{found:?}");
    }

    #[test]
    fn monitoring_without_a_trained_network_is_warned_about() {
        let text = format!("{PAPER}\n[health]\n");
        let mut scenario = Scenario::parse("paper.toml", &text).unwrap();
        assert_eq!(before_run(&scenario), []);
        scenario.learning.clear();
        assert_eq!(codes(&before_run(&scenario)), [WarningCode::HealthUntrained]);
    }

    #[test]
    fn useless_outer_weights_are_reported_before_the_run() {
        let mut scenario = Scenario::parse("paper.toml", PAPER).unwrap();
        scenario.network.as_mut().unwrap().outer.fill(0.0);
        assert_eq!(codes(&before_run(&scenario)), [WarningCode::OuterWeights]);
        scenario.learning.clear();
        assert_eq!(before_run(&scenario), []);
    }

    #[test]
    fn outer_weights_that_cannot_learn_are_reported_once() {
        let outer = |text: &str| Warning::new(WarningCode::OuterWeights, text);
        let few = || Warning::new(WarningCode::FewSamples, "agent 1, cycle 1: few");
        let of_trainings =
            [outer("agent 1, cycle 1: zero"), few(), outer("agent 2, cycle 1: zero")];
        let kept = |before: &[Warning]| without_repetition(of_trainings.iter().cloned(), before);
        assert_eq!(kept(&[]), [outer("agent 1, cycle 1: zero"), few()]);
        assert_eq!(kept(&[few()]), [outer("agent 1, cycle 1: zero"), few()]);
        assert_eq!(kept(&[outer("zero")]), [few()]);
    }
}
