//! `[plant]`.

use std::sync::Arc;

use super::recording::recording;
use super::state_names::{check_dimension, check_inputs, check_name, states};
use crate::plant::expression::{ExpressionError, SystemError, hint};
use crate::plant::{ExpressionSystem, Plant};
use crate::scenario::error::ScenarioError;
use crate::scenario::initial_state::InitialState;
use crate::scenario::reader::{STATE, Table, Value, has};

const EXPRESSION: &str = "\"0.5*x - sin(t)^2\"";

#[derive(Clone, Copy)]
enum Model {
    VanDerPol,
    Lorenz,
    Duffing,
    DampedPendulum,
    Linear,
    Expressions,
    Recording,
}

/// Reads the plant, its initial state, and the intensity of its noise, shape `[n]`, or empty without
/// noise.
pub(in crate::scenario) fn plant(
    root: &Table<'_>,
) -> Result<(Plant, InitialState, Vec<f64>), ScenarioError> {
    let table = root.require_table("plant")?;
    let model = table.require("model", "\"lorenz\"")?.choice(&[
        ("van-der-pol", Model::VanDerPol),
        ("lorenz", Model::Lorenz),
        ("duffing", Model::Duffing),
        ("damped-pendulum", Model::DampedPendulum),
        ("linear", Model::Linear),
        ("expressions", Model::Expressions),
        ("recording", Model::Recording),
    ])?;
    if let Model::Recording = model {
        let recorded = recording(&table)?;
        let mut initial_state = vec![0.0; recorded.states.len()];
        recorded.reference_at(0.0, &mut initial_state);
        let initial_state = InitialState { state: initial_state, spread: None };
        return Ok((Plant::Recording(Arc::new(recorded)), initial_state, Vec::new()));
    }
    let plant = if let Model::Expressions = model {
        table.only(&[
            "model",
            "parameters",
            "initial_state",
            "noise",
            "states",
            "inputs",
            "derivative",
        ])?;
        Plant::Expressions(expressions(&table)?)
    } else {
        table.only(&["model", "parameters", "initial_state", "noise"])?;
        built_in(model, &table)?
    };
    let initial_state = table.require("initial_state", "[1.0, 0.0]")?;
    let initial_state = InitialState::read(&initial_state, plant.dimension())?;
    let noise = match table.get("noise", "0.1") {
        Some(value) => noise(&value, plant.dimension())?,
        None => Vec::new(),
    };
    Ok((plant, initial_state, noise))
}

/// Reads one intensity for all components of the state, or one for each of the `n`.
fn noise(value: &Value<'_>, n: usize) -> Result<Vec<f64>, ScenarioError> {
    let noise = value.not_negative_for_each(n)?;
    Ok(if noise.iter().all(|&intensity| intensity == 0.0) { Vec::new() } else { noise })
}

fn built_in(model: Model, table: &Table<'_>) -> Result<Plant, ScenarioError> {
    let parameters = table.require_table("parameters")?;
    let only = |names: &[&str]| parameters.only(names);
    let number = |name: &str| parameters.require(name, "1.0")?.number();
    let not_zero = |name: &str| {
        parameters.require(name, "1.0")?.number_in("a number other than 0", |number| number != 0.0)
    };
    Ok(match model {
        Model::VanDerPol => {
            only(&["mu"])?;
            Plant::VanDerPol { mu: not_zero("mu")? }
        }
        Model::Lorenz => {
            only(&["sigma", "rho", "beta"])?;
            Plant::Lorenz { sigma: number("sigma")?, rho: number("rho")?, beta: number("beta")? }
        }
        Model::Duffing => {
            only(&["damping", "stiffness", "cubic_stiffness"])?;
            Plant::Duffing {
                damping: number("damping")?,
                stiffness: number("stiffness")?,
                cubic_stiffness: number("cubic_stiffness")?,
            }
        }
        Model::DampedPendulum => {
            only(&["gravity", "length", "damping"])?;
            Plant::DampedPendulum {
                gravity: number("gravity")?,
                length: not_zero("length")?,
                damping: number("damping")?,
            }
        }
        // The others are read elsewhere.
        Model::Linear | Model::Expressions | Model::Recording => {
            only(&["matrix"])?;
            let value = parameters.require("matrix", "[[0.0, 1.0], [-1.0, 0.0]]")?;
            let rows = value.list("write each row as a list of numbers")?.len();
            check_dimension(&value, rows, "row", "rows")?;
            Plant::Linear(value.matrix(rows, "the number of rows")?)
        }
    })
}

fn expressions(table: &Table<'_>) -> Result<ExpressionSystem, ScenarioError> {
    let states = states(table)?;
    let mut parameters = Vec::new();
    if let Some(table) = table.get_table("parameters")? {
        for (name, value) in table.entries("1.0") {
            check_name(&value, name, &states)?;
            parameters.push((name.to_owned(), value.number()?));
        }
    }
    let inputs = inputs(table, &states, &parameters)?;
    let derivative = table.require("derivative", "[\"v\", \"-x\"]")?;
    let texts = expression_texts(&derivative, states.len())?;
    ExpressionSystem::with_inputs(&texts, &states, inputs, &parameters)
        .map_err(|refused| refused_expression(&derivative, &texts, &refused))
}

/// Reads `{ u = "sin(t)" }`: known inputs, in file order.
fn inputs(
    table: &Table<'_>,
    states: &[String],
    parameters: &[(String, f64)],
) -> Result<ExpressionSystem, ScenarioError> {
    let (mut names, mut texts, mut values) = (Vec::new(), Vec::new(), Vec::new());
    if let Some(inputs) = table.get_table("inputs")? {
        for (name, value) in inputs.entries("\"sin(t)\"") {
            check_name(&value, name, states)?;
            if parameters.iter().any(|(parameter, _)| parameter == name) {
                let problem = format!("`{name}` is a parameter");
                return Err(value.error(problem, "use another name"));
            }
            check_inputs(&value, names.len() + 1, states.len())?;
            names.push(name.to_owned());
            // A number is a constant, as `--vary` writes it.
            texts.push(match value.number() {
                Ok(number) => format!("{number:?}"),
                Err(_) => value.text()?.to_owned(),
            });
            values.push(value);
        }
    }
    ExpressionSystem::of_time(&texts, &names, parameters).map_err(|refused| {
        let text = &texts[refused.index];
        let problem = format!("in `{text}`: {}", refused.error);
        let hint = match &refused.error {
            ExpressionError::UnknownName { name, .. } if states.contains(name) => {
                "write a function of time: an input does not depend on the state".to_owned()
            }
            error => expression_hint(error, text),
        };
        values[refused.index].error(problem, hint)
    })
}

/// Parses one expression per state.
pub(super) fn system(
    value: &Value<'_>,
    states: &[String],
    parameters: &[(String, f64)],
) -> Result<ExpressionSystem, ScenarioError> {
    let texts = expression_texts(value, states.len())?;
    ExpressionSystem::parse(&texts, states, parameters)
        .map_err(|refused| refused_expression(value, &texts, &refused))
}

/// Reads `n` texts.
fn expression_texts<'v>(value: &Value<'v>, n: usize) -> Result<Vec<&'v str>, ScenarioError> {
    let list = value.list(&format!("write an expression such as {EXPRESSION}"))?;
    if list.len() != n {
        let found = has(list.len(), "expression", "expressions");
        return Err(value
            .error(format!("{found}, expected {n} ({STATE})"), format!("write {n} expressions")));
    }
    list.iter().map(Value::text).collect()
}

/// Returns the error about one of the expressions in `value`.
fn refused_expression(value: &Value<'_>, texts: &[&str], refused: &SystemError) -> ScenarioError {
    let text = texts[refused.index];
    let problem = format!("in `{text}`: {}", refused.error);
    let hint = expression_hint(&refused.error, text);
    match value.list(EXPRESSION) {
        Ok(list) => list[refused.index].error(problem, hint),
        Err(_) => value.error(problem, hint),
    }
}

fn expression_hint(error: &ExpressionError, text: &str) -> String {
    if let Some(hint) = hint(error, text) {
        return hint;
    }
    match error {
        ExpressionError::UnknownName { known, .. } => {
            format!("known names: {}", known.join(", "))
        }
        ExpressionError::ArgumentCount { expected, .. } => {
            format!("pass {expected}, separated by commas")
        }
        ExpressionError::TooDeep => "use fewer nested parentheses".to_owned(),
        _ => format!("write an expression such as {EXPRESSION}"),
    }
}
