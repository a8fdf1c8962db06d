//! What a run measured for each agent, next to its baselines: a table for the terminal, and a CSV
//! file.

use std::path::Path;

use serde::Serialize;

use super::baselines::{Baseline, Baselines};
use super::health::HealthReport;
use super::seeds::Spread;
use crate::engine::RunResult;
use crate::engine::link::Effect;
use crate::files::output::OutputError;
use crate::files::table::{Row, write_table};
use crate::report::columns::{Table, aligned};
use crate::report::tables::{number, percent};
use crate::scenario::Scenario;

/// An agent's results in the JSON report.
#[derive(Debug, Default, Serialize)]
pub(super) struct AgentReport {
    pub(super) agent: usize,
    pub(super) rmse: Option<f64>,
    pub(super) rmse_no_network: Option<f64>,
    pub(super) rmse_untrained: Option<f64>,
    pub(super) change_percent_no_network: Option<f64>,
    /// Against the untrained network.
    pub(super) change_percent: Option<f64>,
    /// Share of the smoothed targets' variance that the agent's last training explains.
    pub(super) explained_variance: Option<f64>,
    pub(super) max_error: Option<f64>,
    /// Of a recording, in the evaluation window. \[output unit\]
    pub(super) innovation_rms: Option<f64>,
    pub(super) broadcasts: u64,
    /// Broadcasts, as handed to the radio; each has one copy for every neighbour.
    pub(super) frames_sent: u64,
    pub(super) broadcasts_evaluated: u64,
    pub(super) bytes_evaluated: u64,
    /// Copies that reached a neighbour.
    pub(super) frames_delivered: Option<u64>,
    /// Copies that did not; those in transit at the end are neither.
    pub(super) frames_lost: Option<u64>,
    pub(super) bytes_sent: u64,
    pub(super) airtime_s: Option<f64>,
    pub(super) broadcasts_no_network: Option<u64>,
    pub(super) broadcasts_untrained: Option<u64>,
    pub(super) mean_interval: Option<f64>,
    pub(super) min_interval: Option<f64>,
    /// Present only if the agent's health was monitored.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) health: Option<HealthReport>,
}

/// Number of agents listed individually on the terminal.
const LINES: usize = 20;

/// A column of errors: its heading and how to get an agent's error.
type Errors<'a> = (&'a str, fn(&AgentReport) -> Option<f64>);

/// The columns of errors: those of the baselines that are shown, and of the run itself, called `name`.
fn errors<'n>(baselines: &Baselines, name: &'n str) -> Vec<Errors<'n>> {
    let columns: [(Baseline, Errors<'_>); 2] = [
        (Baseline::NoNetwork, ("no network", |agent| agent.rmse_no_network)),
        (Baseline::Untrained, ("untrained", |agent| agent.rmse_untrained)),
    ];
    let compared = columns.iter().filter(|(baseline, _)| baselines.is_shown(*baseline));
    compared.map(|(_, errors)| *errors).chain([(name, rmse as fn(&AgentReport) -> _)]).collect()
}

/// Returns the table of at most this many agents; `name` is the column heading of the run itself.
pub(super) fn table(
    agents: &[AgentReport],
    baselines: &Baselines,
    name: &str,
    most: usize,
) -> Table {
    let errors = errors(baselines, name);
    let against_none = baselines.is_shown(Baseline::NoNetwork);

    let mut headings = vec![["", "agent"]];
    headings.extend(errors.iter().map(|(name, _)| ["RMSE", *name]));
    if against_none {
        headings.push(["change against", "no network [%]"]);
    }
    headings.push(["", "maximum"]);
    let has_innovation = agents.iter().any(|agent| agent.innovation_rms.is_some());
    if has_innovation {
        headings.push(["innovation", "RMS"]);
    }
    headings.push(["", "broadcasts"]);
    headings.extend([["interval [s]", "mean"], ["interval [s]", "shortest"]]);
    let row = |agent: &AgentReport| {
        let mut row = vec![agent.agent.to_string()];
        row.extend(errors.iter().map(|(_, error)| number(error(agent))));
        if against_none {
            row.push(percent(agent.change_percent_no_network));
        }
        row.push(number(agent.max_error));
        if has_innovation {
            row.push(number(agent.innovation_rms));
        }
        row.push(agent.broadcasts.to_string());
        row.extend([number(agent.mean_interval), number(agent.min_interval)]);
        row
    };
    Table::new(&headings, agents.iter().take(most).map(row).collect())
}

/// Returns the table as text; `name` is the column heading of the run itself.
pub(super) fn text(
    scenario: &Scenario,
    agents: &[AgentReport],
    baselines: &Baselines,
    name: &str,
) -> String {
    let window = &scenario.evaluation;
    let mut text = format!(
        "\n|e_1i(t)| for t in [{}, {}] s [state unit], and broadcasts over the whole run\n\n{}",
        window.from,
        window.to,
        table(agents, baselines, name, LINES).text(),
    );
    if agents.len() > LINES {
        text += &format!("and {} more agents, in agents.csv\n\n", agents.len() - LINES);
        text += &spread(agents, &errors(baselines, name));
    }
    text.push('\n');
    text
}

/// Returns what happened to the frames, and what each layer of the link did; nothing for the paper's link.
pub(super) fn traffic(result: &RunResult, agents: &[AgentReport]) -> String {
    if result.layers.is_empty() {
        return String::new();
    }
    let sum = |count: fn(&AgentReport) -> Option<u64>| agents.iter().filter_map(count).sum::<u64>();
    let (delivered, lost) = (sum(|agent| agent.frames_delivered), sum(|agent| agent.frames_lost));
    let airtime: f64 = agents.iter().filter_map(|agent| agent.airtime_s).sum();
    let mut text = format!(
        "Link: {} frames sent, {} bytes, {} s on air; one copy for each neighbour: {delivered} delivered, \
         {lost} lost\n",
        sum(|agent| Some(agent.frames_sent)),
        sum(|agent| Some(agent.bytes_sent)),
        number(Some(airtime)),
    );
    let (mut losses, mut others) = (Vec::new(), Vec::new());
    for did in result.layers.iter().filter(|did| did.count > 0) {
        match did.effect {
            Effect::Loses(how) => losses.push(format!("{} {how}", did.count)),
            Effect::Alters(how) => others.push(format!("{} {how}", did.count)),
        }
    }
    for (heading, entries) in [("lost", losses), ("delayed or changed", others)] {
        if !entries.is_empty() {
            text += &format!("  {heading}: {}\n", entries.join(", "));
        }
    }
    text.push('\n');
    text
}

fn rmse(agent: &AgentReport) -> Option<f64> {
    agent.rmse
}

/// Returns the best, median and worst error over all agents, for each run.
fn spread(agents: &[AgentReport], errors: &[Errors<'_>]) -> String {
    let headings = [["", "RMSE of all"], ["", "best"], ["", "median"], ["", "worst"]];
    let row = |(name, error): &Errors<'_>| {
        let spread = Spread::of(agents.iter().filter_map(error));
        let levels = spread.map(|spread| [spread.min, spread.median, spread.max]);
        let levels = (0..3).map(|index| number(levels.map(|levels| levels[index])));
        [(*name).to_owned()].into_iter().chain(levels).collect()
    };
    let rows: Vec<_> = errors.iter().map(row).collect();
    aligned(&headings, &rows)
}

/// Writes the fields of the JSON report for each agent, except its health.
pub(super) fn write_csv(path: &Path, agents: &[AgentReport]) -> Result<(), OutputError> {
    let header = [
        "agent",
        "rmse [state unit]",
        "rmse_no_network [state unit]",
        "rmse_untrained [state unit]",
        "change_no_network [%]",
        "change [%]",
        "explained_variance [-]",
        "max_error [state unit]",
        "innovation_rms [output unit]",
        "broadcasts",
        "frames_delivered",
        "frames_lost",
        "bytes_sent [byte]",
        "airtime_s [s]",
        "broadcasts_no_network",
        "broadcasts_untrained",
        "mean_interval [s]",
        "min_interval [s]",
    ];
    let columns = |row: &mut Row<'_>, agent: &AgentReport| {
        let count = |row: &mut Row<'_>, count: Option<u64>| match count {
            Some(count) => row.integer(count),
            None => row.text(""),
        };
        row.integer(agent.agent as u64)?;
        row.optional(agent.rmse)?;
        row.optional(agent.rmse_no_network)?;
        row.optional(agent.rmse_untrained)?;
        row.optional(agent.change_percent_no_network)?;
        row.optional(agent.change_percent)?;
        row.optional(agent.explained_variance)?;
        row.optional(agent.max_error)?;
        row.optional(agent.innovation_rms)?;
        row.integer(agent.broadcasts)?;
        count(row, agent.frames_delivered)?;
        count(row, agent.frames_lost)?;
        row.integer(agent.bytes_sent)?;
        row.optional(agent.airtime_s)?;
        count(row, agent.broadcasts_no_network)?;
        count(row, agent.broadcasts_untrained)?;
        row.optional(agent.mean_interval)?;
        row.optional(agent.min_interval)
    };
    write_table(path, &header, agents.iter(), columns)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::link::LayerCount;
    use crate::engine::{RunOptions, Silent, run};
    use crate::scenario::{PAPER, Window};

    /// Keys of a link whose medium and layers all have something to do.
    const BUSY: &str = "loss = 0.3\ndelay = 0.003\nduplicate = 0.2\ncorrupt = 0.2\nrate = 20e3\n\
                        burst = { to_bad = 0.1, to_good = 0.3 }";
    const OUTAGES: &str = "[[link.partitions]]\ngroups = [[1], [2, 3]]\nfrom = 0.5\nto = 0.7\n\
                           [[life]]\nagent = 2\nfrom = 0.2\nto = 0.4";

    #[test]
    fn the_text_tells_what_every_layer_did() {
        let text = PAPER.replacen("[link]", &format!("[link]\n{BUSY}"), 1);
        let text = text.replacen("[evaluation]", &format!("{OUTAGES}\n[evaluation]"), 1);
        let mut scenario = Scenario::parse("busy.toml", &text).unwrap();
        scenario.learning.clear();
        scenario.time.duration = 1.0;
        scenario.evaluation = Window { from: 0.5, to: 1.0 };
        let options = RunOptions { seed: 0, learning: false, bounds: false };
        let result = run(&scenario, options, &Silent).unwrap();
        let text = traffic(&result, &[]);
        for LayerCount { layer, effect, count } in result.layers {
            let (Effect::Loses(what) | Effect::Alters(what)) = effect;
            // Whether a frame is waiting when its sender goes down is left to chance.
            assert!(count > 0 || layer == "sender-down", "{layer} did nothing");
            assert_eq!(text.contains(&format!(" {count} {what}")), count > 0, "{layer}: {text}");
        }
    }

    #[test]
    fn the_median_of_an_even_number_is_between_the_middle_two() {
        let agent = |rmse| AgentReport { rmse: Some(rmse), ..AgentReport::default() };
        let text = spread(&[9.0, 1.0, 4.0, 2.0].map(agent), &[("learned", rmse)]);
        let expected = [
            "RMSE of all   best  median  worst",
            "---------------------------------",
            "    learned  1.000   3.000  9.000",
            "",
        ];
        assert_eq!(text, expected.join("\n"));
    }
}
