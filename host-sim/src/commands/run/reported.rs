//! A run with all that is reported of it: baselines, other methods, checks, certificates, warnings.

use std::sync::atomic::AtomicU64;
use std::time::Instant;

use serde::Serialize;

use crate::commands::agent_table::AgentReport;
use crate::commands::baselines::{
    self, Baseline, Baselines, Choice, Comparison, Plan, States, has_packages,
};
use crate::commands::health::HealthReport;
use crate::commands::observer_certificate::ObserverCertificate;
use crate::commands::processor;
use crate::commands::radio::{self, Frames};
use crate::commands::trainings::{self, TrainingSummary};
use crate::commands::{CommandError, SharedProgress, methods, warnings};
use crate::engine::link::LayerCount;
use crate::engine::{Progress, RunOptions, RunResult, run};
use crate::report::checks::ChecksReport;
use crate::report::theorems::{Checks, DesignChecks};
use crate::scenario::{Method, Scenario};
use crate::warning::Warning;

/// A scenario that was checked and is ready to run.
#[derive(Debug)]
pub struct PreparedRun {
    scenario: Scenario,
    seed: u64,
    plan: Plan,
    others: Vec<Method>,
    design: DesignChecks,
    warnings: Vec<Warning>,
    start: Instant,
}

impl PreparedRun {
    /// Checks `scenario` and draws its initial state, if that is random. `choices` are the methods to compare
    /// with; without any, they are those without a network and with an untrained one if something is trained.
    ///
    /// # Errors
    /// If a method is not possible with this scenario.
    pub fn new(scenario: &Scenario, seed: u64, choices: &[Choice]) -> Result<Self, CommandError> {
        let start = Instant::now();
        let scenario = scenario.drawn(seed).into_owned();
        let plan = Plan::new(&scenario, choices);
        let others = baselines::methods(&scenario, choices)?;
        let design = DesignChecks::new(&scenario);
        let warnings = warnings::before(&scenario, &design);
        Ok(Self { scenario, seed, plan, others, design, warnings, start })
    }

    /// Returns the scenario, with the initial state that was drawn.
    #[must_use]
    pub fn scenario(&self) -> &Scenario {
        &self.scenario
    }

    /// Returns the warnings that do not need a run.
    #[must_use]
    pub fn warnings(&self) -> &[Warning] {
        &self.warnings
    }

    /// Runs the scenario, its baselines and the other methods in parallel, on the threads of the current
    /// pool. `progress` counts the steps of all runs.
    ///
    /// # Errors
    /// If the run itself fails. Baselines and other methods that fail become warnings.
    pub fn carry_out(self, progress: &dyn Progress) -> Result<ReportedRun, CommandError> {
        let Self { scenario, seed, plan, others, design, mut warnings, start } = self;
        let (result, baselines, others) = simulate(&scenario, seed, plan, &others, progress)?;
        let rows = method_rows(&scenario, &result, &baselines, others);
        let checks = Checks::of(design, &scenario, &result);
        let before = warnings.len();
        let found = warnings::after(&scenario, &result, &checks, &warnings);
        warnings.extend(found);
        warnings.extend(baselines.warnings());
        let own = [Method::NoNetwork, Method::Untrained];
        let others = rows.iter().filter(|row| !own.contains(&row.method));
        warnings.extend(others.filter_map(methods::Row::warning));
        let agents = agent_reports(&scenario, &result, &baselines);
        let (radio, processor) = costs(&scenario, &result);
        let certificate = ObserverCertificate::new(&scenario, &result.trainings);
        let trainings = trainings::summaries(&result.trainings);
        Ok(ReportedRun {
            scenario,
            seed,
            result,
            baselines,
            rows,
            agents,
            trainings,
            radio,
            processor,
            checks,
            certificate,
            warnings,
            before,
            start,
        })
    }
}

/// A run with all that is reported of it.
#[derive(Debug)]
pub struct ReportedRun {
    pub(super) scenario: Scenario,
    pub(super) seed: u64,
    pub(super) result: RunResult,
    pub(super) baselines: Baselines,
    pub(super) rows: Vec<methods::Row>,
    pub(super) agents: Vec<AgentReport>,
    pub(super) trainings: Vec<TrainingSummary>,
    pub(super) radio: Vec<radio::Cost>,
    pub(super) processor: Vec<processor::Cost>,
    pub(super) checks: Checks,
    pub(super) certificate: Option<ObserverCertificate>,
    warnings: Vec<Warning>,
    /// The number of warnings that did not need the run.
    before: usize,
    start: Instant,
}

/// The report as JSON, with the keys of `run --format json`.
#[derive(Serialize)]
struct Report<'a> {
    scenario: &'a str,
    seed: u64,
    /// The plant's state at `t = 0`. \[state unit\]
    initial_state: &'a [f64],
    #[serde(skip_serializing_if = "Option::is_none")]
    elapsed_s: Option<f64>,
    baselines: States,
    /// The run compared with other methods, if there are any.
    methods: &'a [methods::Row],
    agents: &'a [AgentReport],
    trainings: &'a [TrainingSummary],
    /// What each layer of the link did; empty for the paper's link.
    link: &'a [LayerCount],
    /// What broadcasts in the evaluation window cost on real radios.
    radio: &'a [radio::Cost],
    /// What computing costs on real microcontrollers.
    processor: &'a [processor::Cost],
    checks: ChecksReport,
    #[serde(skip_serializing_if = "Option::is_none")]
    observer: Option<&'a ObserverCertificate>,
    warnings: &'a [Warning],
}

impl ReportedRun {
    /// Returns the scenario that was run.
    #[must_use]
    pub fn scenario(&self) -> &Scenario {
        &self.scenario
    }

    /// Returns statistics, traces, training runs and digest.
    #[must_use]
    pub fn result(&self) -> &RunResult {
        &self.result
    }

    /// Returns all warnings, those that do not need a run first.
    #[must_use]
    pub fn warnings(&self) -> &[Warning] {
        &self.warnings
    }

    /// Returns the warnings that the run itself gave.
    pub(super) fn warnings_found(&self) -> &[Warning] {
        &self.warnings[self.before..]
    }

    /// Returns the time since the check. \[s\]
    #[must_use]
    pub fn elapsed_s(&self) -> f64 {
        self.start.elapsed().as_secs_f64()
    }

    /// Returns the report with the keys of `run --format json`, without the error of [`Self::outcome`].
    pub fn report(&self) -> impl Serialize {
        self.report_after(Some(self.elapsed_s()))
    }

    /// Returns the report without `elapsed_s`: the same for every run of this scenario and seed.
    pub(super) fn report_without_time(&self) -> impl Serialize {
        self.report_after(None)
    }

    fn report_after(&self, elapsed_s: Option<f64>) -> Report<'_> {
        Report {
            scenario: &self.scenario.name,
            seed: self.seed,
            initial_state: &self.scenario.initial_state,
            elapsed_s,
            baselines: self.baselines.states(),
            methods: &self.rows,
            agents: &self.agents,
            trainings: &self.trainings,
            link: &self.result.layers,
            radio: &self.radio,
            processor: &self.processor,
            checks: ChecksReport::new(&self.checks),
            observer: self.certificate.as_ref(),
            warnings: &self.warnings,
        }
    }

    /// Returns whether the run means anything.
    ///
    /// # Errors
    /// If the errors grew without bound.
    pub fn outcome(&self) -> Result<(), CommandError> {
        warnings::outcome(&self.scenario, &self.checks)
    }

    /// Returns the name of the run in comparison with its baselines.
    pub(super) fn name(&self) -> &'static str {
        let scenario = &self.scenario;
        if scenario.method != Method::Observer {
            scenario.method.name()
        } else if !scenario.learning.is_empty() {
            "learned"
        } else if has_packages(scenario) {
            "packages"
        } else if scenario.network.is_some() && scenario.observer.is_none() {
            Baseline::Untrained.name()
        } else {
            Baseline::NoNetwork.name()
        }
    }
}

/// Returns a row for each method, the run itself first; none unless the run is compared with methods other
/// than its baselines.
fn method_rows(
    scenario: &Scenario,
    result: &RunResult,
    baselines: &Baselines,
    others: Vec<methods::Row>,
) -> Vec<methods::Row> {
    if others.is_empty() {
        return Vec::new();
    }
    let mut rows = vec![methods::Row::new(scenario.method, &result.agents)];
    for (baseline, method) in
        [(Baseline::NoNetwork, Method::NoNetwork), (Baseline::Untrained, Method::Untrained)]
    {
        if baseline == Baseline::Untrained && baselines.are_same() {
            continue;
        }
        let agents = baselines.agents(baseline, &result.agents);
        rows.extend(agents.map(|agents| methods::Row::new(method, agents)));
        rows.extend(baselines.failure(baseline).map(|error| methods::Row::failed(method, error)));
    }
    rows.extend(others);
    rows
}

/// Runs the scenario, its baselines and other methods in parallel.
fn simulate(
    scenario: &Scenario,
    seed: u64,
    plan: Plan,
    others: &[Method],
    progress: &dyn Progress,
) -> Result<(RunResult, Baselines, Vec<methods::Row>), CommandError> {
    let done = AtomicU64::new(0);
    let others_runs: u64 = others.iter().map(|method| method.runs()).sum();
    let total = scenario.steps() * (scenario.method.runs() + plan.count() + others_runs);
    let progress = || SharedProgress::new(progress, &done, total);
    let options = RunOptions { seed, learning: true, bounds: true };
    let (result, (baselines, others)) = rayon::join(
        || run(scenario, options, &progress()),
        || {
            rayon::join(
                || plan.carry_out(scenario, seed, progress),
                || methods::carry_out(scenario, others, seed, progress),
            )
        },
    );
    Ok((result?, baselines, others))
}

/// Returns what the window's broadcasts and steps cost on real radios and microcontrollers.
fn costs(scenario: &Scenario, result: &RunResult) -> (Vec<radio::Cost>, Vec<processor::Cost>) {
    let sent: Vec<_> = result
        .agents
        .iter()
        .map(|agent| Frames { count: agent.broadcasts_evaluated, bytes: agent.bytes_evaluated })
        .collect();
    let nodes = radio::nodes(&scenario.graph, &sent);
    let window = scenario.evaluation.to - scenario.evaluation.from;
    (radio::costs(&nodes, window), processor::costs(scenario, &nodes, window))
}

fn agent_reports(
    scenario: &Scenario,
    result: &RunResult,
    baselines: &Baselines,
) -> Vec<AgentReport> {
    let agents = result.agents.iter().enumerate();
    agents
        .map(|(index, agent)| {
            let comparison = Comparison::new(baselines, &result.agents, index);
            AgentReport {
                agent: index + 1,
                rmse: agent.rmse(),
                rmse_no_network: comparison.rmse_no_network,
                rmse_untrained: comparison.rmse_untrained,
                change_percent_no_network: comparison.change_no_network,
                change_percent: comparison.change_untrained,
                explained_variance: trainings::explained(&result.trainings, index + 1),
                max_error: agent.max_error(),
                innovation_rms: agent.innovation_rms(),
                broadcasts: agent.broadcasts(),
                frames_sent: agent.broadcasts(),
                broadcasts_evaluated: agent.broadcasts_evaluated,
                bytes_evaluated: agent.bytes_evaluated,
                frames_delivered: agent.traffic.map(|traffic| traffic.delivered),
                frames_lost: agent.traffic.map(|traffic| traffic.lost),
                bytes_sent: agent.bytes_sent,
                airtime_s: agent.traffic.map(|traffic| traffic.airtime),
                broadcasts_no_network: comparison.broadcasts_no_network,
                broadcasts_untrained: comparison.broadcasts_untrained,
                mean_interval: agent.mean_interval(&scenario.time),
                min_interval: agent.min_interval(&scenario.time),
                health: agent.health.map(HealthReport),
            }
        })
        .collect()
}
