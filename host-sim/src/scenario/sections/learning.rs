//! `[[learning]]`, `[relearning]` and `[recipes.*]`.

use std::num::NonZeroU32;

use super::agents::agent;
use super::network::initial_parameters;
use super::run::{after_the_end, check_before_end};
use super::trainer;
use crate::number::significant;
use crate::scenario::error::{ScenarioError, closest};
use crate::scenario::reader::{Table, Value};
use crate::scenario::{LearningCycle, Recipe, Relearning, Scenario, SwitchIn, Time, Window};
use crate::training::InitialParameters;
use crate::training::network_problem::PARAMETERS_MAX;

/// Default weight decay of a recipe: `docs/decisions/0004-training-recipe.md`.
const WEIGHT_DECAY: f64 = 1e-3;

/// Reads the learning cycles of `agents` agents.
pub(in crate::scenario) fn cycles(
    root: &Table<'_>,
    time: &Time,
    agents: usize,
    recipes: &[Recipe],
    has_network: bool,
) -> Result<Vec<LearningCycle>, ScenarioError> {
    let tables = root.get_tables("learning")?;
    let mut cycles: Vec<LearningCycle> = Vec::with_capacity(tables.len());
    for table in &tables {
        if !has_network {
            let hint = "add a [network] table, or remove this one";
            return Err(table.error("there is no network to train", hint));
        }
        let cycle = cycle(table, time, agents, recipes)?;
        check_order(table, &cycle, &cycles)?;
        cycles.push(cycle);
    }
    Ok(cycles)
}

fn cycle(
    table: &Table<'_>,
    time: &Time,
    agents: usize,
    recipes: &[Recipe],
) -> Result<LearningCycle, ScenarioError> {
    table.only(&[
        "agents",
        "collect_from",
        "collect_to",
        "stride",
        "apply_at",
        "recipe",
        "shared",
    ])?;
    let learners = match table.get("agents", "[1, 2]") {
        Some(value) => learners(&value, agents)?,
        None => (0..agents).collect(),
    };
    let from = table.require("collect_from", "5.0")?.not_negative()?;
    let to_value = table.require("collect_to", "8.0")?;
    let to = to_value.positive()?;
    let collect = Window { from, to };
    if to > time.duration {
        return Err(after_the_end(&to_value, time));
    }
    if collect.ticks(time).is_empty() {
        let problem = format!("is {}, but must be after collect_from", to_value.written());
        return Err(to_value.error(problem, format!("use a time after {from}")));
    }
    let stride = stride(table, "stride")?.unwrap_or(NonZeroU32::MIN);
    let apply_value = table.require("apply_at", "10.0")?;
    let apply_at = apply_value.positive()?;
    check_before_end(&apply_value, apply_at, time)?;
    if apply_at < to {
        let problem = format!("is {}, before collecting ends", apply_value.written());
        return Err(
            apply_value.error(problem, format!("use a time no earlier than collect_to, {to}"))
        );
    }
    let recipe_value = table.require("recipe", "\"plain\"")?;
    let recipe = recipe_value.text()?;
    if !recipes.iter().any(|known| known.name == recipe) {
        let hint = match closest(recipe, recipes.iter().map(|known| known.name.as_str())) {
            Some(closest) => format!("did you mean \"{closest}\"?"),
            None => {
                let known = recipes.iter().map(|known| format!("\"{}\", ", known.name));
                format!("use {}or add a [recipes.{recipe}] table", known.collect::<String>())
            }
        };
        return Err(recipe_value.error(format_args!("unknown recipe `{recipe}`"), hint));
    }
    let is_shared = table.get("shared", "true").map_or(Ok(false), |value| value.boolean())?;
    let recipe = recipe.to_owned();
    Ok(LearningCycle { agents: learners, collect, stride, apply_at, recipe, is_shared })
}

/// Checks that a cycle can start by itself, and end, within the run.
pub(in crate::scenario) fn check_relearning(
    root: &Table<'_>,
    scenario: &Scenario,
) -> Result<(), ScenarioError> {
    let (Some(table), Some(least)) = (root.get_table("relearning")?, scenario.relearning_end())
    else {
        return Ok(());
    };
    let window = scenario.relearning.as_ref().map_or(0.0, |relearning| relearning.window);
    let steps = scenario.time.tick(window).max(1);
    if let Some(relearning) = &scenario.relearning
        && relearning.rate >= steps as f64
    {
        let rate = table.get("rate", "2.0");
        let rate = rate.map_or_else(|| relearning.rate.to_string(), |rate| rate.written());
        let problem = format!(
            "has no effect: an agent broadcasts at most once in each of the {steps} steps of a window, never {rate} \
             times as often as once in a window"
        );
        return Err(
            table.error(problem, "use a lower rate or a longer window, or remove this table")
        );
    }
    let duration = scenario.time.duration;
    if scenario.time.tick(least) < scenario.steps() {
        return Ok(());
    }
    let problem = format!(
        "has no effect: a cycle that starts by itself is applied at {} s at the earliest, and the run ends at \
         {duration} s",
        significant(least, 3)
    );
    let hint =
        "use a shorter window, a longer time.duration or earlier cycles, or remove this table";
    Err(table.error(problem, hint))
}

/// Reads when cycles like `last` start by themselves.
pub(in crate::scenario) fn relearning(
    root: &Table<'_>,
    time: &Time,
    last: Option<&LearningCycle>,
) -> Result<Option<Relearning>, ScenarioError> {
    let Some(table) = root.get_table("relearning")? else { return Ok(None) };
    table.only(&["rate", "window", "pause"])?;
    let Some(last) = last else {
        let hint = "add a [[learning]] table for later cycles to repeat, or remove [relearning]";
        return Err(table.error("there is no learning cycle to repeat", hint));
    };
    let rate = table
        .get("rate", "2.0")
        .map_or(Ok(2.0), |value| value.number_in("a number above 1", |rate| rate > 1.0))?;
    let window_value = table.get("window", "2.0");
    let window = window_value.as_ref().map_or(Ok(2.0), Value::positive)?;
    if let Some(value) = window_value.filter(|_| window < time.step_size) {
        let hint = format!("use at least time.step, {}", time.step_size);
        return Err(value.error("is shorter than a step", hint));
    }
    let pause = table
        .get("pause", "10.0")
        .map_or(Ok(last.collect.to - last.collect.from), |value| value.positive())?;
    Ok(Some(Relearning { rate, window, pause }))
}

fn learners(value: &Value<'_>, agents: usize) -> Result<Vec<usize>, ScenarioError> {
    let list = value.list("use the number of an agent")?;
    if list.is_empty() {
        return Err(
            value.error("is empty", "name at least one agent, or remove the key to train all")
        );
    }
    let mut learners = Vec::with_capacity(list.len());
    for entry in &list {
        let learner = agent(entry, agents)?;
        if learners.contains(&learner) {
            let problem = format!("agent {} is listed twice", learner + 1);
            return Err(entry.error(problem, "list each agent once"));
        }
        learners.push(learner);
    }
    Ok(learners)
}

/// Checks that the network is small enough for the trainer's normal equations.
pub(in crate::scenario) fn check_size(
    table: &Table<'_>,
    parameters: usize,
) -> Result<(), ScenarioError> {
    if parameters <= PARAMETERS_MAX {
        return Ok(());
    }
    let problem = format!(
        "the network has {parameters} inner parameters; training supports at most {PARAMETERS_MAX}"
    );
    Err(table.error(problem, "use fewer or narrower network.layers, or remove [[learning]]"))
}

/// Checks that a cycle begins only after every earlier cycle of the same agent has been applied.
fn check_order(
    table: &Table<'_>,
    cycle: &LearningCycle,
    earlier: &[LearningCycle],
) -> Result<(), ScenarioError> {
    for (index, before) in earlier.iter().enumerate() {
        let shared = cycle.agents.iter().find(|learner| before.agents.contains(learner));
        if let Some(learner) = shared.filter(|_| cycle.collect.from < before.apply_at) {
            let value = table.require("collect_from", "5.0")?;
            let problem = format!(
                "is {}, before learning[{}] is applied to agent {} at {}",
                value.written(),
                index + 1,
                learner + 1,
                before.apply_at
            );
            let hint = "list the cycles of an agent in order of time, without overlap";
            return Err(value.error(problem, hint));
        }
    }
    Ok(())
}

fn stride(table: &Table<'_>, key: &str) -> Result<Option<NonZeroU32>, ScenarioError> {
    let stride = table.get(key, "1").map(|value| value.integer(1..=u32::MAX)).transpose()?;
    Ok(stride.and_then(NonZeroU32::new))
}

/// Reads the recipes, in file order.
pub(in crate::scenario) fn recipes(root: &Table<'_>) -> Result<Vec<Recipe>, ScenarioError> {
    let Some(table) = root.get_table("recipes")? else { return Ok(Vec::new()) };
    let recipe = |(name, value): (&str, Value<'_>)| recipe(name, &value.table()?);
    table.entries("{ epochs = 100 }").into_iter().map(recipe).collect()
}

fn recipe(name: &str, table: &Table<'_>) -> Result<Recipe, ScenarioError> {
    let own = [
        "smoothing_window",
        "decimation",
        "normalise",
        "initial",
        "split",
        "weight_decay",
        "switch_in",
    ];
    let trainer = trainer::trainer(table, &own)?;
    let smoothing_window =
        table.get("smoothing_window", "0.1").map(|value| value.not_negative()).transpose()?;
    let normalise = table.get("normalise", "true").map_or(Ok(true), |value| value.boolean())?;
    let switch_in = match table.get("switch_in", "\"always\"") {
        Some(value) => {
            value.choice(&[("checked", SwitchIn::Checked), ("always", SwitchIn::Always)])?
        }
        None => SwitchIn::default(),
    };
    let initial = match table.get("initial", "{ random = \"glorot\" }") {
        Some(value) => initial_parameters(&value)?,
        None => InitialParameters::Glorot,
    };
    let weight_decay = match table.get("weight_decay", "1e-3") {
        Some(value) => value.not_negative()?,
        None if normalise => WEIGHT_DECAY,
        None => 0.0,
    };
    Ok(Recipe {
        name: name.to_owned(),
        smoothing_window,
        decimation: stride(table, "decimation")?,
        normalise,
        initial,
        split: split(table)?,
        weight_decay,
        trainer,
        switch_in,
    })
}

/// Reads the fractions for training, validation and test.
fn split(table: &Table<'_>) -> Result<[f64; 3], ScenarioError> {
    // The default of the toolbox that the paper used.
    let Some(value) = table.get("split", "[0.7, 0.15, 0.15]") else {
        return Ok([0.7, 0.15, 0.15]);
    };
    let parts = value.numbers_of(3, "training, validation and test")?;
    let sum = parts.iter().fold(0.0, |sum, part| sum + part);
    if parts[0] <= 0.0 || parts.iter().any(|&part| part < 0.0) || (sum - 1.0).abs() > 1e-9 {
        let problem =
            format!("is {}, but the fractions must be >= 0 and add up to 1", value.written());
        let hint = "use three numbers >= 0 that add up to 1, the first above 0";
        return Err(value.error(problem, hint));
    }
    Ok([parts[0], parts[1], parts[2]])
}
