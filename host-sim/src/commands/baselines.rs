//! Baseline runs, which a run's errors are compared with: the same observers without a network, and
//! with the initial network.
//!
//! | run | network | outer law | learning |
//! | --- | --- | --- | --- |
//! | *no network* | none: feedback and consensus alone | no | no |
//! | *untrained* | the scenario's initial one | yes | no |
//! | the run itself | the scenario's own, or given packages | yes | as the scenario says |
//!
//! The field observer leaves a network out until it is trained, so both baselines are then the same run.
//!
//! Baselines record nothing and run in parallel with the run itself, without affecting its result.
//! If a baseline fails, the reason is reported and the run itself continues.

use clap::ValueEnum;
use clap::builder::PossibleValue;
use serde::Serialize;

use super::CommandError;
use crate::engine::statistics::AgentStatistics;
use crate::engine::{Progress, RunError, RunOptions, RunResult, check_support, run};
use crate::report::tables::change_percent;
use crate::scenario::{Method, Record, Scenario};
use crate::warning::{Warning, WarningCode};

/// What to run besides the run itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Choice {
    /// All methods.
    All,
    /// Only the run itself.
    None,
    /// This method.
    Only(Method),
}

impl Choice {
    /// All and none, and every method.
    const VARIANTS: [Self; Method::NAMES.len() + 2] = {
        let mut variants = [Self::All; Method::NAMES.len() + 2];
        variants[1] = Self::None;
        let mut place = 0;
        while place < Method::NAMES.len() {
            variants[place + 2] = Self::Only(Method::NAMES[place].1);
            place += 1;
        }
        variants
    };

    fn method(self) -> Option<Method> {
        match self {
            Self::All | Self::None => None,
            Self::Only(method) => Some(method),
        }
    }
}

impl ValueEnum for Choice {
    fn value_variants<'a>() -> &'a [Self] {
        &Self::VARIANTS
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        Some(match self {
            Self::All => PossibleValue::new("all").help("All of them"),
            Self::None => PossibleValue::new("none").help("Only the run itself"),
            Self::Only(method) => {
                PossibleValue::new(method.name()).help(format!("Knows {}", method.knows()))
            }
        })
    }
}

/// Returns the methods besides the baselines that are asked for and that the scenario allows, in the order
/// of the table.
///
/// # Errors
/// If `all` or `none` is not alone.
pub(super) fn methods(
    scenario: &Scenario,
    choices: &[Choice],
) -> Result<Vec<Method>, CommandError> {
    if let Some(alone) = choices.iter().find(|choice| choice.method().is_none())
        && choices.len() > 1
    {
        let name = if *alone == Choice::All { "all" } else { "none" };
        let problem =
            format!("--baselines: `{name}` cannot be combined with others; give it alone");
        return Err(CommandError::usage(problem));
    }
    let knows = scenario.plant.recording().is_none();
    let learns = !scenario.learning.is_empty() && scenario.network.is_some();
    // Those of an observer with a network have columns of their own.
    let has_columns = scenario.method == Method::Observer && scenario.network.is_some();
    let is_extra = |method: &Method| match method {
        Method::Observer => !has_columns,
        Method::NoNetwork => !has_columns && scenario.network.is_some(),
        // The same as without a network, if the field observer leaves it out.
        Method::Untrained => {
            let is_same = scenario.observer.is_some() && choices == [Choice::All];
            !has_columns && scenario.network.is_some() && !is_same
        }
        _ => true,
    };
    let mut methods: Vec<Method> = match choices {
        [Choice::All] => {
            let all = Method::NAMES.iter().map(|&(_, method)| method).filter(is_extra);
            all.filter(|&method| learns || method != Method::Regression)
                .filter(|&method| knows || !method.knows_f())
                .filter(|&method| check_support(scenario, method).is_ok())
                .collect()
        }
        choices => choices.iter().filter_map(|choice| choice.method()).filter(is_extra).collect(),
    };
    methods.retain(|&method| method != scenario.method);
    methods.sort();
    methods.dedup();
    if let Some(method) = methods.iter().find(|method| !knows && method.knows_f()) {
        return Err(CommandError::usage(format!(
            "--baselines {}: a recording does not define f; choose a method that does not know it",
            method.name()
        )));
    }
    for &method in &methods {
        check_support(scenario, method).map_err(|error| {
            CommandError::usage(format!("--baselines {}: {error}", method.name()))
        })?;
    }
    if methods.contains(&Method::Regression) && !learns {
        let name = &scenario.name;
        return Err(CommandError::usage(format!(
            "--baselines regression: scenario {name} has no learning cycle whose samples it could fit; \
             add [[learning]], or leave it out"
        )));
    }
    Ok(methods)
}

/// A baseline run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Baseline {
    /// The observer with feedback and consensus only.
    NoNetwork,
    /// The scenario's initial network; only the outer law adapts it.
    Untrained,
}

impl Baseline {
    /// Both baselines, in table order.
    pub(super) const ALL: [Self; 2] = [Self::NoNetwork, Self::Untrained];

    /// Returns its name in tables, figures and messages.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::NoNetwork => "no network",
            Self::Untrained => "untrained",
        }
    }

    /// Returns the scenario of this baseline.
    pub(super) fn scenario(self, scenario: &Scenario) -> Scenario {
        let mut scenario = scenario.clone();
        scenario.record = Record::NOTHING;
        scenario.method = match self {
            Self::NoNetwork => Method::NoNetwork,
            Self::Untrained => Method::Untrained,
        };
        scenario
    }

    /// Runs the baseline.
    pub(super) fn run(
        self,
        scenario: &Scenario,
        seed: u64,
        progress: &dyn Progress,
    ) -> Result<RunResult, RunError> {
        let options = RunOptions { seed, learning: false, bounds: false };
        run(&self.scenario(scenario), options, progress)
    }
}

/// The outcome of a baseline.
#[derive(Debug)]
pub(super) enum Outcome {
    /// Not requested, or there is nothing to compare.
    NotRun,
    /// The run itself is this baseline.
    Itself,
    /// The same as the baseline without a network.
    AsNoNetwork,
    Done(Vec<AgentStatistics>),
    Failed(RunError),
}

impl Outcome {
    fn of(result: Result<RunResult, RunError>) -> Self {
        match result {
            Ok(result) => Self::Done(result.agents),
            Err(error) => Self::Failed(error),
        }
    }
}

/// The baselines of a run, in the order of [`Baseline::ALL`].
#[derive(Debug)]
pub(super) struct Baselines {
    outcomes: [Outcome; 2],
}

/// Which baselines to run alongside a scenario (after `--without-learning` and `--weights`), and
/// whether the run is itself one of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Plan {
    pub(super) runs: [bool; 2],
    itself: bool,
    /// Whether an untrained network is not used, so that the baselines are the same.
    is_same: bool,
}

impl Plan {
    /// `choices` is empty for the default: both if something is trained.
    pub(super) fn new(scenario: &Scenario, choices: &[Choice]) -> Self {
        let trained = !scenario.learning.is_empty() || has_packages(scenario);
        let is_own = scenario.method == Method::Observer && scenario.network.is_some();
        let wanted = |choice: Choice| {
            let asked = choices.contains(&choice) || choices.contains(&Choice::All);
            is_own && if choices.is_empty() { trained } else { asked }
        };
        let [no_network, untrained] =
            [Method::NoNetwork, Method::Untrained].map(|method| wanted(Choice::Only(method)));
        let is_same = scenario.observer.is_some();
        let itself = !trained && (untrained || is_same && no_network);
        let runs = match is_same {
            true => [no_network && trained, untrained && trained && !no_network],
            false => [no_network, untrained && trained],
        };
        Self { runs, itself, is_same }
    }

    /// Returns the number of baselines to run.
    pub(super) fn count(self) -> u64 {
        self.runs.into_iter().map(u64::from).sum()
    }

    /// Runs the baselines in parallel. `progress` is called once per run.
    pub(super) fn carry_out<P: Progress>(
        self,
        scenario: &Scenario,
        seed: u64,
        progress: impl Fn() -> P + Sync,
    ) -> Baselines {
        let outcome = |index: usize| {
            if self.runs[index] {
                Outcome::of(Baseline::ALL[index].run(scenario, seed, &progress()))
            } else if self.itself && (self.is_same || Baseline::ALL[index] == Baseline::Untrained) {
                Outcome::Itself
            } else {
                Outcome::NotRun
            }
        };
        let (no_network, untrained) = rayon::join(|| outcome(0), || outcome(1));
        let untrained = match untrained {
            Outcome::NotRun if self.is_same && self.runs[0] => Outcome::AsNoNetwork,
            untrained => untrained,
        };
        Baselines { outcomes: [no_network, untrained] }
    }
}

/// Returns whether any agent starts with a package given by the user.
pub(super) fn has_packages(scenario: &Scenario) -> bool {
    scenario.agents.iter().any(|agent| agent.package.is_some())
}

impl Baselines {
    /// Returns a baseline's statistics for each agent, or `None` if it was not run or failed.
    /// `itself` holds the statistics of the run itself.
    pub(super) fn agents<'s>(
        &'s self,
        baseline: Baseline,
        itself: &'s [AgentStatistics],
    ) -> Option<&'s [AgentStatistics]> {
        match &self.outcomes[baseline as usize] {
            Outcome::NotRun | Outcome::Failed(_) => None,
            Outcome::Itself => Some(itself),
            Outcome::AsNoNetwork => self.agents(Baseline::NoNetwork, itself),
            Outcome::Done(agents) => Some(agents),
        }
    }

    /// Returns whether the untrained network is the same as none, so that it needs no column or row of its own.
    pub(super) fn are_same(&self) -> bool {
        matches!(&self.outcomes, [_, Outcome::AsNoNetwork] | [Outcome::Itself, Outcome::Itself])
    }

    /// Says why there is one baseline only, if they are the same.
    pub(super) fn note(&self) -> &'static str {
        match self.are_same() {
            true => {
                "The field observer leaves a network out until it is trained, so `untrained` is the same as `no network`.\n\n"
            }
            false => "",
        }
    }

    /// Returns whether a baseline has its own column in tables: it was run, even if it failed.
    pub(super) fn is_shown(&self, baseline: Baseline) -> bool {
        matches!(self.outcomes[baseline as usize], Outcome::Done(_) | Outcome::Failed(_))
    }

    /// Returns why a baseline failed, if it did.
    pub(super) fn failure(&self, baseline: Baseline) -> Option<&RunError> {
        match &self.outcomes[baseline as usize] {
            Outcome::Failed(error) => Some(error),
            _ => None,
        }
    }

    /// Returns a warning for each baseline that failed.
    pub(super) fn warnings(&self) -> Vec<Warning> {
        let failed = |baseline: Baseline| match &self.outcomes[baseline as usize] {
            Outcome::Failed(error) => Some(Warning::new(
                WarningCode::BaselineFailed,
                format!(
                    "the baseline run ({}) failed, so its errors are missing: {error}",
                    baseline.name()
                ),
            )),
            _ => None,
        };
        Baseline::ALL.into_iter().filter_map(failed).collect()
    }

    /// Returns how each baseline ended, for JSON.
    pub(super) fn states(&self) -> States {
        let state = |outcome: &Outcome| match outcome {
            Outcome::NotRun | Outcome::AsNoNetwork => State { status: "not_run", reason: None },
            Outcome::Itself => State { status: "this_run", reason: None },
            Outcome::Done(_) => State { status: "done", reason: None },
            Outcome::Failed(error) => State { status: "failed", reason: Some(error.to_string()) },
        };
        let [no_network, untrained] = match &self.outcomes {
            [outcome, Outcome::AsNoNetwork] => [outcome, outcome],
            [no_network, untrained] => [no_network, untrained],
        };
        States { no_network: state(no_network), untrained: state(untrained) }
    }
}

/// How the baselines ended, in the JSON report.
#[derive(Debug, Serialize)]
pub(super) struct States {
    no_network: State,
    untrained: State,
}

#[derive(Debug, Serialize)]
struct State {
    status: &'static str,
    reason: Option<String>,
}

/// An agent's results compared with the baselines'.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Comparison {
    pub(super) rmse_no_network: Option<f64>,
    pub(super) rmse_untrained: Option<f64>,
    pub(super) broadcasts_no_network: Option<u64>,
    pub(super) broadcasts_untrained: Option<u64>,
    /// Relative to no network. \[%\]
    pub(super) change_no_network: Option<f64>,
    /// Relative to the untrained network. \[%\]
    pub(super) change_untrained: Option<f64>,
}

impl Comparison {
    /// Compares the agent with this index.
    pub(super) fn new(baselines: &Baselines, itself: &[AgentStatistics], index: usize) -> Self {
        let [no_network, untrained] = Baseline::ALL.map(|baseline| {
            baselines.agents(baseline, itself).and_then(|agents| agents.get(index))
        });
        let rmse = itself[index].rmse();
        let rmse_no_network = no_network.and_then(AgentStatistics::rmse);
        let rmse_untrained = untrained.and_then(AgentStatistics::rmse);
        Self {
            rmse_no_network,
            rmse_untrained,
            broadcasts_no_network: no_network.map(AgentStatistics::broadcasts),
            broadcasts_untrained: untrained.map(AgentStatistics::broadcasts),
            change_no_network: change_percent(rmse_no_network, rmse),
            change_untrained: change_percent(rmse_untrained, rmse),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::Silent;
    use crate::scenario::PAPER;

    fn paper(duration: f64) -> Scenario {
        let mut scenario = Scenario::parse("paper.toml", PAPER).unwrap();
        scenario.time.duration = duration;
        scenario.evaluation.from = 0.5 * duration;
        scenario.evaluation.to = duration;
        scenario
    }

    fn plan(change: impl Fn(&mut Scenario), choices: &[Choice]) -> ([bool; 2], bool) {
        let mut scenario = paper(1.0);
        change(&mut scenario);
        let plan = Plan::new(&scenario, choices);
        (plan.runs, plan.itself)
    }

    #[test]
    fn only_meaningful_baselines_are_planned() {
        let (all, none): (&[Choice], &[Choice]) = (&[Choice::All], &[Choice::None]);
        let unchanged = |_: &mut Scenario| ();
        let no_learning = |scenario: &mut Scenario| scenario.learning.clear();
        let no_network = |scenario: &mut Scenario| {
            scenario.learning.clear();
            scenario.network = None;
        };
        assert_eq!(plan(unchanged, &[]), ([true, true], false));
        assert_eq!(plan(unchanged, none), ([false, false], false));
        assert_eq!(plan(no_learning, &[]), ([false, false], false));
        assert_eq!(plan(no_learning, all), ([true, false], true));
        assert_eq!(plan(no_network, &[]), ([false, false], false));
        assert_eq!(plan(no_network, all), ([false, false], false));
    }

    #[test]
    fn without_learning_the_paper_scenario_does_not_depend_on_the_seed() {
        let scenario = paper(0.5);
        for baseline in Baseline::ALL {
            let digest = |seed| baseline.run(&scenario, seed, &Silent).unwrap().digest;
            assert_eq!(digest(0), digest(1), "{baseline:?}");
        }
        let [no_network, untrained] =
            Baseline::ALL.map(|baseline| baseline.run(&scenario, 0, &Silent).unwrap().digest);
        assert_ne!(no_network, untrained);
    }

    #[test]
    fn a_baseline_that_fails_is_reported_with_its_reason() {
        let mut scenario = paper(0.1);
        // The outer law refuses this bound; without a network there is no outer law.
        scenario.network.as_mut().unwrap().outer_law.bound = -1.0;
        let plan = Plan::new(&scenario, &[]);
        let baselines = plan.carry_out(&scenario, 0, || Silent);
        let warnings = baselines.warnings();
        assert_eq!(warnings.len(), 1, "{warnings:?}");
        assert_eq!(warnings[0].code, WarningCode::BaselineFailed);
        assert!(warnings[0].text.contains("untrained") && warnings[0].text.contains("agent 1"));
        let states = serde_json::to_value(baselines.states()).unwrap();
        assert_eq!(states["no_network"]["status"], "done");
        assert_eq!(states["untrained"]["status"], "failed");
        assert!(states["untrained"]["reason"].as_str().unwrap().contains("agent 1"));
        assert!(baselines.is_shown(Baseline::Untrained));
        assert!(baselines.agents(Baseline::Untrained, &[]).is_none());
    }
}
