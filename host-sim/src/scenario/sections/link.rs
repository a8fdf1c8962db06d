//! `[link]`, `[[link.edges]]` and `[[link.partitions]]`.

use super::agents::agent;
use super::run::window;
use crate::graph::Graph;
use crate::scenario::error::ScenarioError;
use crate::scenario::reader::{Table, Value};
use crate::scenario::{Time, Window};

/// What happens to frames between agents. The default is the paper's: every broadcast reaches all
/// neighbours at once and unharmed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LinkSettings {
    /// What every edge does to frames.
    pub edge: EdgeSettings,
    /// What individual edges do differently; of several rules for the same time, the last one applies.
    pub rules: Vec<EdgeRule>,
    /// Times at which groups of agents do not reach each other.
    pub partitions: Vec<Partition>,
    /// The medium that the agents share; `None` if each frame has one of its own.
    pub medium: Option<MediumSettings>,
}

impl LinkSettings {
    /// Returns whether frames arrive as the paper assumes.
    #[must_use]
    pub fn is_ideal(&self) -> bool {
        *self == Self::default()
    }

    /// Returns the longest delay of a frame that does not wait for the medium. \[s\]
    #[must_use]
    pub fn longest_delay(&self) -> f64 {
        let edges = self.rules.iter().map(|rule| &rule.edge).chain([&self.edge]);
        edges.fold(0.0, |longest: f64, edge| longest.max(edge.delay + edge.jitter))
    }
}

/// What an edge does to the frames that it carries.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EdgeSettings {
    /// Whether the edge exists.
    pub connected: bool,
    /// Probability that a frame does not arrive.
    pub loss: f64,
    /// Loss in bursts.
    pub burst: Option<Burst>,
    /// Time from sending to arrival. \[s\]
    pub delay: f64,
    /// Half-width of the uniform distribution of the delay. \[s\]
    pub jitter: f64,
    /// Probability that a frame arrives twice.
    pub duplicate: f64,
    /// Probability that bytes of a frame are changed.
    pub corrupt: f64,
}

impl Default for EdgeSettings {
    fn default() -> Self {
        Self {
            connected: true,
            loss: 0.0,
            burst: None,
            delay: 0.0,
            jitter: 0.0,
            duplicate: 0.0,
            corrupt: 0.0,
        }
    }
}

/// The channel of Gilbert and Elliott: a chain with two states that takes a step for each frame and
/// loses every frame in its bad state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Burst {
    /// Probability of a step from the good state to the bad one.
    pub to_bad: f64,
    /// Probability of a step back.
    pub to_good: f64,
}

/// What one edge does differently for some time.
#[derive(Clone, Debug, PartialEq)]
pub struct EdgeRule {
    /// The two agents, from 0; the rule applies to frames in both directions.
    pub ends: [usize; 2],
    /// When. \[s\]
    pub window: Window,
    /// What the edge does then.
    pub edge: EdgeSettings,
}

/// A time in which frames pass only inside groups of agents.
#[derive(Clone, Debug, PartialEq)]
pub struct Partition {
    /// The group of each agent.
    pub group: Vec<usize>,
    /// When. \[s\]
    pub window: Window,
}

/// A medium that carries one frame at a time within reach of each other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MediumSettings {
    /// \[bit/s\]
    pub rate: f64,
    /// Frames start at multiples of this time; `None` for at any time. \[s\]
    pub slot: Option<f64>,
    /// Agent `i`, from 0, uses only the slots whose number is `i` modulo this.
    pub slots: u32,
    /// Largest share of time for which an agent may send, above 0 and at most 1.
    pub duty_cycle: f64,
}

/// The keys of [`EdgeSettings`].
const EDGE_KEYS: [&str; 6] = ["loss", "burst", "delay", "jitter", "duplicate", "corrupt"];

/// Longest delay: frames in transit are kept in memory. \[s\]
const DELAY_MAX: f64 = 3_600.0;

/// Shortest slot; a byte takes longer on any radio. \[s\]
const SLOT_MIN: f64 = 1e-6;

/// Reads `[link]`.
pub(in crate::scenario) fn link(
    root: &Table<'_>,
    time: &Time,
    graph: &Graph,
) -> Result<LinkSettings, ScenarioError> {
    let Some(table) = root.get_table("link")? else { return Ok(LinkSettings::default()) };
    let own = ["kind", "rate", "slot", "slots", "duty_cycle", "edges", "partitions"];
    table.only(&[own.as_slice(), &EDGE_KEYS].concat())?;
    if let Some(kind) = table.get("kind", "\"lossless\"") {
        kind.choice(&[("lossless", ())])?;
    }
    let edge = edge_settings(&table, EdgeSettings::default())?;
    let rules = table.get_tables("edges")?;
    let rules =
        rules.iter().map(|rule| edge_rule(rule, &edge, time, graph)).collect::<Result<_, _>>()?;
    let partitions = table.get_tables("partitions")?;
    let partitions =
        partitions.iter().map(|table| partition(table, time, graph)).collect::<Result<_, _>>()?;
    Ok(LinkSettings { edge, rules, partitions, medium: medium(&table)? })
}

/// Reads the keys of an edge; those that are missing are as in `default`.
fn edge_settings(table: &Table<'_>, default: EdgeSettings) -> Result<EdgeSettings, ScenarioError> {
    let probability = |key: &str, default: f64| {
        table.get(key, "0.1").map_or(Ok(default), |value| value.probability())
    };
    let burst = match table.get("burst", "{ to_bad = 0.02, to_good = 0.2 }") {
        // Without a way into the bad state there are no bursts.
        Some(value) => Some(burst(&value)?).filter(|burst| burst.to_bad > 0.0),
        None => default.burst,
    };
    let delay = match table.get("delay", "0.01") {
        Some(value) => {
            value.number_in("0 to 3600 seconds", |delay| (0.0..=DELAY_MAX).contains(&delay))?
        }
        None => default.delay,
    };
    let jitter = match table.get("jitter", "0.002") {
        Some(value) => {
            let jitter = value.not_negative()?;
            if jitter > delay {
                let problem = format!("is {}, above the delay, {delay}", value.written());
                return Err(value.error(
                    problem,
                    "use a jitter of at most the delay: frames cannot arrive before they are sent",
                ));
            }
            jitter
        }
        None => default.jitter.min(delay),
    };
    Ok(EdgeSettings {
        connected: default.connected,
        loss: probability("loss", default.loss)?,
        burst,
        delay,
        jitter,
        duplicate: probability("duplicate", default.duplicate)?,
        corrupt: probability("corrupt", default.corrupt)?,
    })
}

fn burst(value: &Value<'_>) -> Result<Burst, ScenarioError> {
    let table = value.table()?;
    table.only(&["to_bad", "to_good"])?;
    let to_good = table.require("to_good", "0.2")?;
    Ok(Burst {
        to_bad: table.require("to_bad", "0.02")?.probability()?,
        to_good: to_good
            .number_in("a probability above 0, so that the burst ends", |p| p > 0.0 && p <= 1.0)?,
    })
}

fn edge_rule(
    table: &Table<'_>,
    all: &EdgeSettings,
    time: &Time,
    graph: &Graph,
) -> Result<EdgeRule, ScenarioError> {
    table.only(&[["agents", "from", "to", "connected"].as_slice(), &EDGE_KEYS].concat())?;
    let ends = table.require("agents", "[1, 2]")?;
    let numbers = ends.list("use the number of an agent")?;
    let [first, second] = numbers.as_slice() else {
        return Err(ends.wrong("does not name two agents"));
    };
    let (first, second) = (agent(first, graph.agents())?, agent(second, graph.agents())?);
    if !graph.neighbours(first).iter().any(|neighbour| neighbour.agent == second) {
        let problem = format!("names agents {} and {}, which have no edge", first + 1, second + 1);
        return Err(ends.error(problem, "name the ends of an edge in [graph]"));
    }
    let connected = table.get("connected", "false").map_or(Ok(true), |value| value.boolean())?;
    let edge = EdgeSettings { connected, ..edge_settings(table, *all)? };
    Ok(EdgeRule { ends: [first, second], window: window(table, time)?, edge })
}

fn partition(table: &Table<'_>, time: &Time, graph: &Graph) -> Result<Partition, ScenarioError> {
    table.only(&["groups", "from", "to"])?;
    let groups = table.require("groups", "[[1], [2, 3]]")?;
    // Agents that are not named form a group of their own.
    let mut group = vec![0; graph.agents()];
    let lists = groups.list("write each group as a list of agents")?;
    if lists.is_empty() {
        return Err(groups.wrong("has no groups"));
    }
    for (number, list) in (1..).zip(&lists) {
        for value in list.list("use the number of an agent")? {
            let index = agent(&value, graph.agents())?;
            if group[index] != 0 {
                let problem = format!("agent {} is in two groups", index + 1);
                return Err(value.error(problem, "name each agent once"));
            }
            group[index] = number;
        }
    }
    if group.iter().all(|&number| number == group[0]) {
        let hint = "use at least two groups, or omit some agents: the omitted ones form a group of their own";
        return Err(groups.error("contains all agents in one group", hint));
    }
    Ok(Partition { group, window: window(table, time)? })
}

fn medium(table: &Table<'_>) -> Result<Option<MediumSettings>, ScenarioError> {
    let rate = table.get("rate", "250000.0");
    let [slot, slots, duty_cycle] = [("slot", "0.01"), ("slots", "3"), ("duty_cycle", "0.01")]
        .map(|(key, example)| table.get(key, example));
    let Some(rate) = rate else {
        return match slot.or(slots).or(duty_cycle) {
            Some(value) => {
                Err(value.error("needs a shared medium", "add rate = 250000.0 to [link]"))
            }
            None => Ok(None),
        };
    };
    let rate = rate.positive()?;
    let slot = slot
        .map(|value| value.number_in("a time of at least 1e-6 seconds", |slot| slot >= SLOT_MIN));
    let slot = slot.transpose()?;
    let slots = match (slots, slot) {
        (None, _) => 1,
        (Some(value), Some(_)) => value.integer(1..=u32::MAX)?,
        (Some(value), None) => {
            return Err(value.error("needs the length of a slot", "add slot = 0.01 to [link]"));
        }
    };
    let duty_cycle = duty_cycle.map_or(Ok(1.0), |value| {
        value.number_in("a number above 0 and at most 1", |share| share > 0.0 && share <= 1.0)
    })?;
    Ok(Some(MediumSettings { rate, slot, slots, duty_cycle }))
}
