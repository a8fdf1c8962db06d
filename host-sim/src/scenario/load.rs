//! Reads a scenario file, table by table.

use std::path::Path;

use agent_core::observer::field::Coupling;
use toml::de::DeTable;

use super::changes::{self, Change};
use super::error::{ScenarioError, closest};
use super::reader::{Source, Table};
use super::sections::{
    agents, clock, disturbance, exchange, gains, health, learning, life, link, method, network,
    observer, plant, run, sensor, trigger,
};
use super::{BUILT_IN, Scenario, TriggerModel};
use crate::files::fnv::Fnv;
use crate::files::input::{is_too_large, read_limited};

/// Size limit of a scenario file, with room for thousands of agents with their own matrices.
/// \[bytes\]
const BYTES_MAX: u64 = 16 << 20;

impl Scenario {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// Returns the first problem found, with file, line, key and hint.
    pub fn load(path: &Path) -> Result<Self, ScenarioError> {
        Self::parse(&path.display().to_string(), &Self::read_text(path)?)
    }

    /// Reads the text of a file without checking it.
    ///
    /// # Errors
    /// If the file cannot be read, is too large, or is not UTF-8.
    pub fn read_text(path: &Path) -> Result<String, ScenarioError> {
        let file = path.display().to_string();
        let unread = Source { file: &file, text: "" };
        let bytes = read_limited(path, BYTES_MAX).map_err(|error| {
            if is_too_large(&error) {
                let problem = format!("file is larger than {} MiB", BYTES_MAX >> 20);
                return unread.error(None, None, problem, "pass the path of a scenario file");
            }
            let names = BUILT_IN.map(|(name, _)| name);
            let meant = closest(&file, names).map_or(String::new(), |name| format!("{name}, "));
            let hint = format!(
                "pass {meant}the path of a scenario file, or the name of a built-in scenario ({}); \
                 `host-sim scenario {} > mine.toml` writes a starting point",
                names.join(", "),
                closest(&file, names).unwrap_or(names[0]),
            );
            unread.error(None, None, format_args!("cannot be read: {error}"), hint)
        })?;
        String::from_utf8(bytes).map_err(|error| {
            let valid = &error.as_bytes()[..error.utf8_error().valid_up_to()];
            let line = valid.iter().filter(|&&byte| byte == b'\n').count() + 1;
            unread.error(Some(line), None, "is not UTF-8", "save the file as UTF-8 text")
        })
    }

    /// Changes keys in the text of a scenario, and reads and checks the result. Also returns the
    /// changed text. `file` is the name used in errors.
    ///
    /// ```
    /// use host_sim::scenario::{Change, PAPER, Scenario};
    ///
    /// let change = Change::parse("--set", "design.epsilon=500")?;
    /// let (scenario, text) = Scenario::parse_changed("paper.toml", PAPER, &[change])?;
    /// assert_eq!(scenario.design.epsilon, 500.0);
    /// assert!(text.contains("epsilon = 500\n"));
    /// # Ok::<(), Box<dyn core::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// Same as [`Scenario::parse`]; an error that a change caused names it.
    pub fn parse_changed(
        file: &str,
        text: &str,
        changes: &[Change],
    ) -> Result<(Self, String), ScenarioError> {
        let unchanged = || Self::parse(file, text).map(|scenario| (scenario, text.to_owned()));
        if changes.is_empty() {
            return unchanged();
        }
        let Some(changed) = changes::applied(file, text, changes) else { return unchanged() };
        let changed = changed?;
        match Self::parse(file, &changed) {
            Ok(scenario) => Ok((scenario, changed)),
            Err(error) => {
                let own = Self::parse(file, text).err();
                if let Some(own) =
                    own.filter(|own| (&own.key, &own.problem) == (&error.key, &error.problem))
                {
                    return Err(own);
                }
                let moved = changed.lines().count() != text.lines().count();
                Err(changes::blamed(error, changes, moved))
            }
        }
    }

    /// Reads and checks the text of a scenario. `file` is the name used in errors.
    ///
    /// ```
    /// use host_sim::scenario::{PAPER, Scenario};
    ///
    /// let scenario = Scenario::parse("paper.toml", PAPER)?;
    /// assert_eq!((scenario.dimension(), scenario.agents.len()), (3, 3));
    ///
    /// let error = Scenario::parse("mine.toml", "name = 'x'\ntimes = {}").unwrap_err();
    /// assert_eq!(error.to_string(), "mine.toml:2: times: unknown key; did you mean time?");
    /// # Ok::<(), host_sim::scenario::ScenarioError>(())
    /// ```
    ///
    /// # Errors
    /// Returns the first problem found, with file, line, key and hint.
    pub fn parse(file: &str, text: &str) -> Result<Self, ScenarioError> {
        let source = Source { file, text };
        let document = DeTable::parse(text).map_err(|error| {
            let line = error.span().map(|span| source.line(span.start));
            let problem = format!("invalid TOML: {}", error.message().replace('\n', ", "));
            let hint =
                "write keys as `key = value` and tables as `[name]`, and use each name only once";
            source.error(line.or(Some(1)), None, problem, hint)
        })?;
        let scenario = read(&Table::root(&source, document.get_ref()))?;
        let hash = match scenario.plant.recording() {
            None => text_hash(text),
            Some(recorded) => text_hash(text) ^ recorded.hash(),
        };
        Ok(Scenario { hash, ..scenario })
    }
}

/// Line endings do not count: a file with CRLF has the same hash.
fn text_hash(text: &str) -> u64 {
    let mut hash = Fnv::default();
    for part in text.split('\r') {
        hash.add(part.as_bytes());
    }
    hash.finish()
}

fn read(root: &Table<'_>) -> Result<Scenario, ScenarioError> {
    root.only(&[
        "name",
        "method",
        "kalman",
        "plant",
        "disturbance",
        "time",
        "design",
        "outer_law",
        "network",
        "graph",
        "link",
        "trigger",
        "exchange",
        "observer",
        "sensor",
        "clock",
        "life",
        "agents",
        "learning",
        "relearning",
        "recipes",
        "health",
        "evaluation",
        "record",
    ])?;
    let name = run::name(root)?;
    let time = run::time(root)?;
    let (plant, initial, process_noise) = plant::plant(root)?;
    let n = plant.dimension();
    if let Some(recorded) = plant.recording() {
        run::check_recorded(root, &time, recorded.duration())?;
    }
    let disturbance = disturbance::disturbance(root, &plant, &time)?;
    let design = gains::design(root, n)?;
    let network = network::network(root, n, plant.input_names().len())?;
    let (sensor, clock) = (sensor::sensor(root)?, clock::clock(root, &time)?);
    let agents = agents::agents(root, n, sensor, clock, &time, &plant)?;
    let graph = agents::graph(root, agents.len())?;
    let link = link::link(root, &time, &graph)?;
    let life = life::life(root, &time, agents.len())?;
    let trigger = trigger::trigger(root)?;
    let kalman = method::kalman(root)?;
    let exchange = exchange::exchange(root, &time)?;
    let (mut observer, is_robust) = observer::observer(root, &time, n, network.is_some())?;
    if let (Some(table), Some(recorded)) = (root.get_table("observer")?, plant.recording())
        && observer.is_some()
        && !recorded.has_reference()
    {
        let hint = "add plant.reference, or remove this table";
        return Err(table.error(
            "derives its settings from the state, and the recording has no reference",
            hint,
        ));
    }
    if let Some(observer) = observer.as_mut().filter(|_| is_robust)
        && root.get_table("exchange")?.is_none()
    {
        observer.exchange = Some(exchange::robust(&time, link.edge.delay));
    }
    if let (Some(table), Some(observer)) = (root.get_table("trigger")?, &observer)
        && observer.coupling == Coupling::Trees
        && trigger != TriggerModel::Event
    {
        let hint = "remove [trigger], or set observer.coupling = \"held\"";
        return Err(table.error(
            "has no effect with coupling = \"trees\", where each direction has its own radius",
            hint,
        ));
    }
    let recipes = learning::recipes(root)?;
    let learning = learning::cycles(root, &time, agents.len(), &recipes, network.is_some())?;
    let relearning = learning::relearning(root, &time, learning.last())?;
    if let (Some(first), Some(network)) = (root.get_tables("learning")?.first(), &network) {
        learning::check_size(first, network.architecture.parameter_count())?;
    }
    let method = method::method(root, network.is_some(), !learning.is_empty(), &plant)?;
    let health = health::health(root, network.is_some())?;
    let evaluation = run::evaluation(root, &time)?;
    let record = run::record(root, &time, n, agents.len())?;
    let scenario = Scenario {
        name,
        hash: 0,
        plant,
        disturbance,
        initial_state: initial.state,
        initial_spread: initial.spread,
        process_noise,
        time,
        design,
        network,
        graph,
        link,
        life,
        trigger,
        method,
        kalman,
        exchange,
        observer,
        agents,
        learning,
        relearning,
        recipes,
        health,
        evaluation,
        record,
        run_steps: None,
    };
    learning::check_relearning(root, &scenario)?;
    Ok(scenario)
}
