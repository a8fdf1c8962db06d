//! What a run's errors are compared with: the same observers without any network, and with the
//! network as it starts.
//!
//! | run | network | outer law | learning |
//! | --- | --- | --- | --- |
//! | *no network* | none: feedback and consensus alone | no | no |
//! | *untrained* | the scenario's own, as it starts | yes | no |
//! | the run itself | the scenario's own, or given packages | yes | as the scenario says |
//!
//! Baselines record nothing and run in parallel with the run itself, whose bits they cannot change.
//! One that fails is reported with the reason, and the run itself goes on.

use clap::ValueEnum;
use serde::Serialize;

use crate::engine::statistics::AgentStatistics;
use crate::engine::{Progress, RunError, RunOptions, RunResult, run};
use crate::report::tables::change_percent;
use crate::scenario::{Record, Scenario};
use crate::warning::{Warning, WarningCode};

/// Which baselines are run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum Choice {
    /// Without a network, and with the untrained one
    All,
    /// Only the run itself
    None,
}

/// A run to compare with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Baseline {
    /// The observer on its feedback alone.
    NoNetwork,
    /// The scenario's own network as it starts, adapted by the outer law only.
    Untrained,
}

impl Baseline {
    /// Both, in the order of tables.
    pub(super) const ALL: [Self; 2] = [Self::NoNetwork, Self::Untrained];

    /// What it is called in tables, figures and messages.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::NoNetwork => "no network",
            Self::Untrained => "untrained",
        }
    }

    /// The scenario of this baseline.
    pub(super) fn scenario(self, scenario: &Scenario) -> Scenario {
        let mut scenario = scenario.clone();
        scenario.record = NOTHING;
        scenario.learning.clear();
        for agent in &mut scenario.agents {
            agent.package = None;
        }
        if self == Self::NoNetwork {
            scenario.network = None;
        }
        scenario
    }

    /// Runs it.
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

/// Of a run that is for comparison only.
pub(super) const NOTHING: Record = Record { trace_stride: None, events: false, samples: false };

/// How a baseline ended.
#[derive(Debug)]
pub(super) enum Outcome {
    /// It was not asked for, or there is nothing to compare.
    NotRun,
    /// The run itself is this baseline.
    Itself,
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

/// Which baselines are worth comparing with a run of `scenario` (after `--without-learning` and
/// `--weights`), and which of them it is itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Plan {
    pub(super) runs: [bool; 2],
    itself: bool,
}

impl Plan {
    pub(super) fn new(scenario: &Scenario, choice: Option<Choice>) -> Self {
        let trained = !scenario.learning.is_empty() || has_packages(scenario);
        let wanted = choice.map_or(trained, |choice| choice == Choice::All);
        let compared = wanted && scenario.network.is_some();
        Self { runs: [compared, compared && trained], itself: compared && !trained }
    }

    /// How many baselines are run.
    pub(super) fn count(self) -> u64 {
        self.runs.into_iter().map(u64::from).sum()
    }

    /// Runs the baselines, in parallel. `progress` makes one for each run.
    pub(super) fn carry_out<P: Progress>(
        self,
        scenario: &Scenario,
        seed: u64,
        progress: impl Fn() -> P + Sync,
    ) -> Baselines {
        let outcome = |index: usize| {
            if self.runs[index] {
                Outcome::of(Baseline::ALL[index].run(scenario, seed, &progress()))
            } else if self.itself && Baseline::ALL[index] == Baseline::Untrained {
                Outcome::Itself
            } else {
                Outcome::NotRun
            }
        };
        let (no_network, untrained) = rayon::join(|| outcome(0), || outcome(1));
        Baselines { outcomes: [no_network, untrained] }
    }
}

/// Whether an agent starts with a package from outside.
pub(super) fn has_packages(scenario: &Scenario) -> bool {
    scenario.agents.iter().any(|agent| agent.package.is_some())
}

impl Baselines {
    /// What a baseline measured of each agent; `itself` is what the run measured. `None` if it was
    /// not run or failed.
    pub(super) fn agents<'s>(
        &'s self,
        baseline: Baseline,
        itself: &'s [AgentStatistics],
    ) -> Option<&'s [AgentStatistics]> {
        match &self.outcomes[baseline as usize] {
            Outcome::NotRun | Outcome::Failed(_) => None,
            Outcome::Itself => Some(itself),
            Outcome::Done(agents) => Some(agents),
        }
    }

    /// Whether a baseline has a column of its own in tables: it was run, even if it failed.
    pub(super) fn is_shown(&self, baseline: Baseline) -> bool {
        matches!(self.outcomes[baseline as usize], Outcome::Done(_) | Outcome::Failed(_))
    }

    /// A warning for each baseline that failed.
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

    /// How each ended, for JSON.
    pub(super) fn states(&self) -> States {
        let [no_network, untrained] = self.outcomes.each_ref().map(|outcome| match outcome {
            Outcome::NotRun => State { status: "not_run", reason: None },
            Outcome::Itself => State { status: "this_run", reason: None },
            Outcome::Done(_) => State { status: "done", reason: None },
            Outcome::Failed(error) => State { status: "failed", reason: Some(error.to_string()) },
        });
        States { no_network, untrained }
    }
}

/// How the baselines ended, as JSON has it.
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

/// An agent's errors against those of the baselines.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Comparison {
    pub(super) rmse_no_network: Option<f64>,
    pub(super) rmse_untrained: Option<f64>,
    pub(super) broadcasts_no_network: Option<u64>,
    pub(super) broadcasts_untrained: Option<u64>,
    /// Against no network. \[%\]
    pub(super) change_no_network: Option<f64>,
    /// Against the untrained network. \[%\]
    pub(super) change_untrained: Option<f64>,
}

impl Comparison {
    /// Of the agent with this index.
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

    fn plan(change: impl Fn(&mut Scenario), choice: Option<Choice>) -> ([bool; 2], bool) {
        let mut scenario = paper(1.0);
        change(&mut scenario);
        let plan = Plan::new(&scenario, choice);
        (plan.runs, plan.itself)
    }

    #[test]
    fn baselines_are_those_that_say_something() {
        let (all, none) = (Some(Choice::All), Some(Choice::None));
        let unchanged = |_: &mut Scenario| ();
        let no_learning = |scenario: &mut Scenario| scenario.learning.clear();
        let no_network = |scenario: &mut Scenario| {
            scenario.learning.clear();
            scenario.network = None;
        };
        assert_eq!(plan(unchanged, None), ([true, true], false));
        assert_eq!(plan(unchanged, none), ([false, false], false));
        assert_eq!(plan(no_learning, None), ([false, false], false));
        assert_eq!(plan(no_learning, all), ([true, false], true));
        assert_eq!(plan(no_network, None), ([false, false], false));
        assert_eq!(plan(no_network, all), ([false, false], false));
    }

    #[test]
    fn without_learning_the_seed_of_the_papers_runs_does_not_matter() {
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
        let plan = Plan::new(&scenario, None);
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
