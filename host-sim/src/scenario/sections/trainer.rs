//! The keys of `[recipes.*]` that name a trainer and its settings.

use crate::scenario::error::ScenarioError;
use crate::scenario::reader::Table;
use crate::training::{LevenbergMarquardtSettings, TrainerSettings};

/// The keys of one trainer, and what reads them.
type Reader = (&'static [&'static str], fn(&Table<'_>) -> Result<TrainerSettings, ScenarioError>);

/// The trainers by their names; the first is the default.
const TRAINERS: [(&str, Reader); 1] = [(
    "levenberg-marquardt",
    (
        &[
            "epochs",
            "goal",
            "mu",
            "mu_decrease",
            "mu_increase",
            "mu_min",
            "mu_max",
            "min_gradient",
            "validation_failures",
        ],
        levenberg_marquardt,
    ),
)];

/// Limit for epochs and failed validations in a recipe.
const EPOCHS_MAX: u32 = 1_000_000;

/// The trainer of a recipe, whose other keys are `others`.
pub(in crate::scenario) fn trainer(
    table: &Table<'_>,
    others: &[&str],
) -> Result<TrainerSettings, ScenarioError> {
    let (keys, read) = match table.get("trainer", "\"levenberg-marquardt\"") {
        Some(value) => value.choice(&TRAINERS)?,
        None => TRAINERS[0].1,
    };
    table.only(&[others, &["trainer"], keys].concat())?;
    read(table)
}

fn levenberg_marquardt(table: &Table<'_>) -> Result<TrainerSettings, ScenarioError> {
    let default = LevenbergMarquardtSettings::default();
    let positive =
        |key: &str, or: f64| table.get(key, "0.5").map_or(Ok(or), |value| value.positive());
    let not_negative =
        |key: &str, or: f64| table.get(key, "0.0").map_or(Ok(or), |value| value.not_negative());
    let count = |key: &str, or: usize| match table.get(key, "10") {
        Some(value) => value.integer(1..=EPOCHS_MAX).map(|count| count as usize),
        None => Ok(or),
    };
    let damping_decrease = match table.get("mu_decrease", "0.1") {
        Some(value) => value.number_in("a number between 0 and 1", |x| x > 0.0 && x < 1.0)?,
        None => default.damping_decrease,
    };
    let damping_increase = match table.get("mu_increase", "10.0") {
        Some(value) => value.number_in("a number above 1", |x| x > 1.0)?,
        None => default.damping_increase,
    };
    let damping_initial = positive("mu", default.damping_initial)?;
    let damping_min = not_negative("mu_min", default.damping_min)?;
    let damping_max = positive("mu_max", default.damping_max)?;
    if !(damping_min <= damping_initial && damping_initial <= damping_max) {
        let problem = format!(
            "mu_min = {damping_min:?}, mu = {damping_initial:?} and mu_max = {damping_max:?} \
             are out of order"
        );
        return Err(table.error(problem, "use mu_min <= mu <= mu_max"));
    }
    Ok(TrainerSettings::LevenbergMarquardt(LevenbergMarquardtSettings {
        damping_initial,
        damping_decrease,
        damping_increase,
        damping_min,
        damping_max,
        goal: not_negative("goal", default.goal)?,
        epochs_max: count("epochs", default.epochs_max)?,
        gradient_min: not_negative("min_gradient", default.gradient_min)?,
        validation_failures_max: count("validation_failures", default.validation_failures_max)?,
    }))
}
