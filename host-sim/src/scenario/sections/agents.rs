//! `[[agents]]` and `[graph]`. Agents are numbered from 1 in the file and from 0 here.

use std::collections::BTreeSet;

use super::clock::{self, ClockSettings};
use super::recording::columns;
use super::sensor::{self, SensorSettings};
use crate::graph::{Edge, Graph, GraphError};
use crate::number::counted;
use crate::plant::Plant;
use crate::scenario::error::ScenarioError;
use crate::scenario::reader::{STATE, Table, Value, has};
use crate::scenario::{Agent, Time};

const EDGE: &str = "use [agent, agent] or [agent, agent, weight]";

/// Maximum number of agents.
const AGENTS_MAX: u32 = 100_000;

/// Maximum number of agents that all hear each other: two million edges.
const COMPLETE_MAX: usize = 2_000;

/// `n` is the dimension of the state; `sensor` and `clock` are those of agents without their own.
pub(in crate::scenario) fn agents(
    root: &Table<'_>,
    n: usize,
    sensor: SensorSettings,
    clock: ClockSettings,
    time: &Time,
    plant: &Plant,
) -> Result<Vec<Agent>, ScenarioError> {
    let tables = root.get_tables("agents")?;
    if tables.is_empty() {
        return Err(root.missing("agents", "add an [[agents]] table for each agent"));
    }
    let mut agents = Vec::new();
    for table in &tables {
        table.only(&[
            "output_matrix",
            "initial_estimate",
            "count",
            "sensor",
            "clock",
            "measured",
        ])?;
        let output_value = table.require("output_matrix", "[[1.0, 0.0]]")?;
        let output_matrix = output_value.matrix(n, STATE)?;
        if output_matrix.nrows() > n {
            let rows = output_matrix.nrows();
            let problem = format!("has {rows} rows, more than the {n} components of the state");
            return Err(output_value.error(problem, format!("write 1 to {n} rows")));
        }
        let initial_estimate = match table.get("initial_estimate", "[0.0, 0.0]") {
            Some(value) => value.numbers_of(n, STATE)?,
            None => vec![0.0; n],
        };
        let count = table.get("count", "2").map_or(Ok(1), |v| v.integer(1..=AGENTS_MAX))?;
        let total = agents.len() + count as usize;
        if total > AGENTS_MAX as usize {
            let problem = format!("brings the number of agents to {total}");
            return Err(table.error(problem, format!("use at most {AGENTS_MAX}")));
        }
        let sensor = match table.get_table("sensor")? {
            Some(own) => sensor::settings(&own, sensor)?,
            None => sensor,
        };
        let clock = match table.get_table("clock")? {
            Some(own) => clock::settings(&own, clock, time)?,
            None => clock,
        };
        let measured = measured(table, plant, output_matrix.nrows())?;
        let agent =
            Agent { output_matrix, measured, initial_estimate, package: None, sensor, clock };
        agents.resize(total, agent);
    }
    Ok(agents)
}

/// Reads the columns of a recording that an agent with this many outputs measures; none for the plant's own
/// outputs.
fn measured(table: &Table<'_>, plant: &Plant, outputs: usize) -> Result<Vec<usize>, ScenarioError> {
    match (table.get("measured", "[\"y1\"]"), plant.recording()) {
        (Some(value), Some(recorded)) => {
            let columns = columns(recorded, &value, outputs, "row of output_matrix")?;
            if let Some(&known) = columns.iter().find(|column| recorded.inputs.contains(column)) {
                let name = &recorded.names[known];
                let problem = format!("the column `{name}` is a known input of all agents");
                let hint = "remove it here, or from plant.inputs";
                return Err(value.error(problem, hint));
            }
            let is_empty = |column: &usize| recorded.columns[*column].iter().all(|x| x.is_nan());
            if let Some(empty) = columns.iter().copied().find(is_empty) {
                let problem = format!("the column `{}` has no numbers", recorded.names[empty]);
                return Err(value.error(problem, "name a column with measurements"));
            }
            Ok(columns)
        }
        (Some(value), None) => Err(value.error(
            "only a recording has columns",
            "remove it, or set plant.model = \"recording\"",
        )),
        (None, Some(recorded)) if !recorded.has_reference() => Err(table.error(
            "there is nothing to measure: the recording has no reference for the state",
            "name the columns with what this agent measured, such as measured = [\"y1\"]",
        )),
        (None, _) => Ok(Vec::new()),
    }
}

/// `agents` is the number of agents.
pub(in crate::scenario) fn graph(root: &Table<'_>, agents: usize) -> Result<Graph, ScenarioError> {
    if let (1, None) = (agents, root.get_table("graph")?) {
        return Graph::new(1, &[]).map_err(|error| root.error(error, "add a [graph] table"));
    }
    let table = root.require_table("graph")?;
    table.only(&["adjacency", "edges", "topology", "weight"])?;
    let adjacency = table.get("adjacency", "[[0.0, 1.0], [1.0, 0.0]]");
    let edges = table.get("edges", "[[1, 2]]");
    let topology = table.get("topology", "\"ring\"");
    if let Some(weight) = table.get("weight", "1.0").filter(|_| topology.is_none()) {
        let hint = "put the weights into adjacency or edges, or add topology = \"ring\"";
        return Err(weight.error("needs a topology", hint));
    }
    match (adjacency, edges, topology) {
        (Some(adjacency), None, None) => from_adjacency(&adjacency, agents),
        (None, Some(edges), None) => from_edges(&edges, agents),
        (None, None, Some(topology)) => from_topology(&topology, &table, agents),
        _ => Err(table.error(
            "needs exactly one of adjacency, edges and topology",
            "keep or add one of them",
        )),
    }
}

fn from_adjacency(value: &Value<'_>, agents: usize) -> Result<Graph, ScenarioError> {
    let rows = value.list("write each row as a list of numbers")?;
    if rows.len() != agents {
        let found = has(rows.len(), "row", "rows");
        let problem =
            format!("{found}, but there are {}", counted(agents as u64, "agent", "agents"));
        return Err(value.error(problem, format!("write one row per agent, {agents} in all")));
    }
    let matrix = value.matrix(agents, "the number of agents")?;
    Graph::from_adjacency(&matrix).map_err(|error| {
        let row = match error {
            GraphError::NotSymmetric { column, .. } => Some(column),
            GraphError::SelfLoop { agent } => Some(agent),
            GraphError::Weight { second, .. } => Some(second),
            _ => None,
        };
        let hint = graph_hint(&error);
        match row {
            Some(row) => rows[row].error_of(value, error, hint),
            None => value.error(error, hint),
        }
    })
}

fn from_edges(value: &Value<'_>, agents: usize) -> Result<Graph, ScenarioError> {
    let mut edges = Vec::new();
    let mut joined = BTreeSet::new();
    for entry in value.list(EDGE)? {
        let parts = entry.list("use the number of an agent")?;
        let ([first, second], weight) = match parts.as_slice() {
            [first, second] => ([first, second], None),
            [first, second, weight] => {
                ([first, second], Some(weight.with_hint("use a weight above 0")))
            }
            _ => {
                let problem = has(parts.len(), "entry", "entries");
                return Err(entry.error(problem, EDGE));
            }
        };
        let ends = [agent(first, agents)?, agent(second, agents)?];
        let (first, second) = (ends[0].min(ends[1]), ends[0].max(ends[1]));
        let weight = weight.map_or(Ok(1.0), |value| value.positive())?;
        let error = if first == second {
            Some(GraphError::SelfLoop { agent: first })
        } else if !joined.insert((first, second)) {
            Some(GraphError::Repeated { first, second })
        } else {
            None
        };
        if let Some(error) = error {
            return Err(entry.error(error, graph_hint(&error)));
        }
        edges.push(Edge { first, second, weight });
    }
    Graph::new(agents, &edges).map_err(|error| value.error(error, graph_hint(&error)))
}

/// Returns the index, from 0, of the agent that the file names by number.
pub(super) fn agent(value: &Value<'_>, agents: usize) -> Result<usize, ScenarioError> {
    Ok(value.integer(1..=agents as u32)? as usize - 1)
}

#[derive(Clone, Copy)]
enum Topology {
    Path,
    Ring,
    Star,
    Complete,
}

fn from_topology(
    value: &Value<'_>,
    table: &Table<'_>,
    agents: usize,
) -> Result<Graph, ScenarioError> {
    let topology = value.choice(&[
        ("path", Topology::Path),
        ("ring", Topology::Ring),
        ("star", Topology::Star),
        ("complete", Topology::Complete),
    ])?;
    let weight = table.get("weight", "1.0").map_or(Ok(1.0), |value| value.positive())?;
    let edge = |(first, second)| Edge { first, second, weight };
    let path = (1..agents).map(|agent| (agent - 1, agent));
    let edges: Vec<Edge> = match topology {
        Topology::Path => path.map(edge).collect(),
        // Two agents share a single edge, not a ring of two.
        Topology::Ring => {
            let closing = (agents > 2).then(|| (0, agents - 1));
            path.chain(closing).map(edge).collect()
        }
        Topology::Star => (1..agents).map(|agent| edge((0, agent))).collect(),
        Topology::Complete if agents > COMPLETE_MAX => {
            let problem = format!("would have {} edges", agents * (agents - 1) / 2);
            let hint = format!("use at most {COMPLETE_MAX} agents, or another topology");
            return Err(value.error(problem, hint));
        }
        Topology::Complete => (0..agents)
            .flat_map(|first| (first + 1..agents).map(move |second| (first, second)))
            .map(edge)
            .collect(),
    };
    Graph::new(agents, &edges).map_err(|error| value.error(error, graph_hint(&error)))
}

fn graph_hint(error: &GraphError) -> String {
    match error {
        GraphError::NotSymmetric { .. } => "write the same weight in both".to_owned(),
        GraphError::SelfLoop { .. } => {
            "remove this edge; an agent always uses its own values".to_owned()
        }
        GraphError::Weight { .. } => "use a number above 0, or 0 for no edge".to_owned(),
        GraphError::Repeated { .. } => "list each edge once".to_owned(),
        GraphError::Disconnected { agent } => {
            format!("connect agent {} to the rest", agent + 1)
        }
        _ => "add a [graph] table".to_owned(),
    }
}
