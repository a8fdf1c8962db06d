//! `[network]`.

use agent_core::math::activation::Activation;
use agent_core::observer::network::{Architecture, INNER_LAYERS_MAX, LAYER_WIDTH_MAX, Layer};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::gains;
use crate::scenario::Network;
use crate::scenario::error::ScenarioError;
use crate::scenario::reader::{STATE, Table, Value, has};
use crate::training::InitialParameters;

const LAYERS: &str = "[{ nodes = 8, activation = \"tanh\" }]";

/// `n` is the dimension of the state, and `known` the number of known inputs.
pub(in crate::scenario) fn network(
    root: &Table<'_>,
    n: usize,
    known: usize,
) -> Result<Option<Network>, ScenarioError> {
    let Some(table) = root.get_table("network")? else {
        return match root.get_table("outer_law")? {
            Some(law) => Err(law.error(
                "there is no network to adapt",
                "add a [network] table, or remove this one",
            )),
            None => Ok(None),
        };
    };
    table.only(&["layers", "inner", "outer"])?;
    let layers_value = table.require("layers", LAYERS)?;
    let list = layers_value.list("use { nodes = 8, activation = \"tanh\" }")?;
    if !(1..=INNER_LAYERS_MAX).contains(&list.len()) {
        let problem = has(list.len(), "layer", "layers");
        return Err(layers_value.error(problem, format!("use 1 to {INNER_LAYERS_MAX} layers")));
    }
    let layers = list.iter().map(layer).collect::<Result<Vec<_>, _>>()?;
    let architecture =
        Architecture::new(n + known, &layers).map_err(|error| layers_value.wrong(error))?;
    let inner = initial_parameters(&table.require("inner", "{ random = \"glorot\" }")?)?;
    let features = architecture.features();
    let outer_value = table.require("outer", "{ fill = 0.0 }")?;
    let outer = outer_weights(&outer_value, features, n)?;
    let outer_law = gains::outer_law(root, features)?;
    let norm = outer.iter().fold(0.0, |sum, weight| sum + weight * weight).sqrt();
    if norm > outer_law.bound {
        let problem = format!("has a Frobenius norm of {norm:.3}, above outer_law.bound");
        let hint = format!("use a bound above {norm:.3}, or smaller weights");
        return Err(outer_value.error(problem, hint));
    }
    Ok(Some(Network { architecture, inner, outer, outer_law }))
}

fn layer(value: &Value<'_>) -> Result<Layer, ScenarioError> {
    let table = value.table()?;
    table.only(&["nodes", "activation"])?;
    let width = table.require("nodes", "8")?.integer(1..=LAYER_WIDTH_MAX as u32)? as u8;
    let activation = table.require("activation", "\"tanh\"")?.choice(&Activation::NAMES)?;
    Ok(Layer { width, activation })
}

/// Reads `{ fill = number }` or `{ random = "glorot" }`.
pub(super) fn initial_parameters(value: &Value<'_>) -> Result<InitialParameters, ScenarioError> {
    let table = value.table()?;
    table.only(&["fill", "random"])?;
    match (table.get("fill", "0.5"), table.get("random", "\"glorot\"")) {
        (Some(fill), None) => fill.number().map(InitialParameters::Constant),
        (None, Some(random)) => {
            let nguyen_widrow = random.choice(&[("glorot", false), ("nguyen-widrow", true)])?;
            Ok(match nguyen_widrow {
                true => InitialParameters::NguyenWidrow,
                false => InitialParameters::Glorot,
            })
        }
        _ => Err(value.error(
            "needs exactly one of fill and random",
            "use { fill = 0.5 } or { random = \"glorot\" }",
        )),
    }
}

/// Draws `count` numbers between `-scale` and `scale`. They do not depend on the run's seed, as if
/// they were written in the file.
fn random_weights(scale: f64, count: usize) -> Vec<f64> {
    let mut random = ChaCha8Rng::seed_from_u64(0);
    (0..count).map(|_| scale * random.random_range(-1.0..1.0)).collect()
}

/// Reads `W_hat(0)`, row by row, shape `[features, n]`.
fn outer_weights(value: &Value<'_>, features: usize, n: usize) -> Result<Vec<f64>, ScenarioError> {
    if value.is_table() {
        let table = value.table()?;
        table.only(&["fill", "random"])?;
        return match (table.get("fill", "0.0"), table.get("random", "5.0")) {
            (Some(fill), None) => Ok(vec![fill.number()?; features * n]),
            (None, Some(random)) => Ok(random_weights(random.positive()?, features * n)),
            _ => Err(value.error(
                "needs exactly one of fill and random",
                "use { random = 5.0 } or { fill = 0.0 }",
            )),
        };
    }
    let rows = value.list("write each row as a list of numbers")?.len();
    if rows != features {
        let problem =
            format!("{}, but the last layer has {features} nodes", has(rows, "row", "rows"));
        return Err(value.error(problem, format!("write one row per node, {features} in all")));
    }
    Ok(value.matrix(n, STATE)?.transpose().as_slice().to_vec())
}
