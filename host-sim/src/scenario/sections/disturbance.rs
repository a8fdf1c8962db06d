//! `[disturbance]`.

use super::plant::system;
use crate::plant::{Disturbance, Harmonic, Plant, RandomDisturbance, Wave};
use crate::scenario::Time;
use crate::scenario::error::ScenarioError;
use crate::scenario::reader::{STATE, Table, Value, has};

/// Reads the keys of one model from the table.
type Read = fn(&Table<'_>, &Plant, &Time) -> Result<Disturbance, ScenarioError>;

/// The models by their names.
const MODELS: [(&str, Read); 4] = [
    ("none", none),
    ("harmonic", harmonic_sum),
    ("expressions", expressions),
    ("ornstein-uhlenbeck", ornstein_uhlenbeck),
];

pub(in crate::scenario) fn disturbance(
    root: &Table<'_>,
    plant: &Plant,
    time: &Time,
) -> Result<Disturbance, ScenarioError> {
    let Some(table) = root.get_table("disturbance")? else { return Ok(Disturbance::None) };
    if plant.recording().is_some() {
        let hint = "remove [disturbance]: what disturbed the experiment is in its recording";
        return Err(table.error("has no effect on a recording", hint));
    }
    let read: Read = table.require("model", "\"none\"")?.choice(&MODELS)?;
    read(&table, plant, time)
}

fn none(table: &Table<'_>, _: &Plant, _: &Time) -> Result<Disturbance, ScenarioError> {
    table.only(&["model"])?;
    Ok(Disturbance::None)
}

fn expressions(table: &Table<'_>, plant: &Plant, _: &Time) -> Result<Disturbance, ScenarioError> {
    table.only(&["model", "components"])?;
    let value = table.require("components", "[\"0.5*sin(2*t)\", \"0\"]")?;
    system(&value, &plant.state_names(), &[]).map(Disturbance::Expressions)
}

fn harmonic_sum(table: &Table<'_>, plant: &Plant, _: &Time) -> Result<Disturbance, ScenarioError> {
    table.only(&["model", "components"])?;
    let value = table.require("components", HARMONICS)?;
    harmonics(&value, plant.dimension()).map(Disturbance::Harmonic)
}

/// Reads a random disturbance; every run draws its own path.
fn ornstein_uhlenbeck(
    table: &Table<'_>,
    plant: &Plant,
    time: &Time,
) -> Result<Disturbance, ScenarioError> {
    table.only(&["model", "deviation", "correlation_time"])?;
    let n = plant.dimension();
    let deviation = table.require("deviation", "0.5")?.not_negative_for_each(n)?;
    let correlation_time = table.require("correlation_time", "0.5")?.positive()?;
    let (steps, most) = (time.tick(time.duration), RandomDisturbance::NUMBERS_MAX / n as u64);
    if steps > most {
        let problem = format!("is drawn before the run, for each of its {steps} steps");
        let hint =
            format!("use a shorter time.duration or a longer time.step, for at most {most} steps");
        return Err(table.error(problem, hint));
    }
    Ok(Disturbance::Random(RandomDisturbance::new(deviation, correlation_time)))
}

const HARMONICS: &str = "[{ amplitude = 0.5, angular_frequency = 2.0, function = \"sin\" }, []]";
const HARMONIC: &str = "use { amplitude = 0.5, angular_frequency = 2.0, function = \"sin\" }";

fn harmonics(value: &Value<'_>, n: usize) -> Result<Vec<Harmonic>, ScenarioError> {
    let list = value.list(HARMONIC)?;
    if list.len() != n {
        let problem = format!("{}, expected {n} ({STATE})", has(list.len(), "entry", "entries"));
        return Err(value.error(problem, format!("write {n} entries, [] for no disturbance")));
    }
    let mut harmonics = Vec::new();
    for (component, value) in list.iter().enumerate() {
        if value.is_table() {
            harmonics.push(harmonic(component, &value.table()?)?);
            continue;
        }
        if !value.is_list() {
            return Err(value.wrong("is not a table or a list of tables"));
        }
        for value in value.list(HARMONIC)? {
            harmonics.push(harmonic(component, &value.table()?)?);
        }
    }
    Ok(harmonics)
}

fn harmonic(component: usize, table: &Table<'_>) -> Result<Harmonic, ScenarioError> {
    table.only(&["amplitude", "angular_frequency", "function", "phase", "offset"])?;
    let or_zero = |key: &str| table.get(key, "0.0").map_or(Ok(0.0), |value| value.number());
    let function = table.require("function", "\"sin\"")?;
    Ok(Harmonic {
        component,
        function: function.choice(&[("sin", Wave::Sin), ("cos", Wave::Cos)])?,
        amplitude: table.require("amplitude", "0.5")?.number()?,
        angular_frequency: table.require("angular_frequency", "2.0")?.number()?,
        phase: or_zero("phase")?,
        offset: or_zero("offset")?,
    })
}
