//! `[design]` and `[outer_law]`: gains and related constants.

use nalgebra::{Cholesky, DMatrix, DVector};

use crate::scenario::error::ScenarioError;
use crate::scenario::reader::{STATE, Table, Value, has};
use crate::scenario::{Design, OuterGain, OuterLaw};

/// Highest smoothness of the projection that the agents support.
const SMOOTHNESS_MAX: u32 = 7;

const DELTA: &str = "use a number above 0; a smaller delta tightens the bound on the error";
const EPSILON: &str = "use a number above 0; a smaller epsilon makes agents broadcast more often";

/// `n` is the dimension of the state.
pub(in crate::scenario) fn design(root: &Table<'_>, n: usize) -> Result<Design, ScenarioError> {
    let table = root.require_table("design")?;
    table.only(&["gain", "k2", "kappa", "rho", "delta", "epsilon"])?;
    let gain_value = table.require("gain", "80.0")?;
    let gain = scaled(&gain_value, n, STATE)?;
    if !is_positive_definite(&gain) {
        // An eigenvector `v` with an eigenvalue <= 0 violates `BMI` when all agents are at `v`.
        return Err(gain_value.error("is not positive definite", POSITIVE_DEFINITE));
    }
    let gain = match gain {
        OuterGain::Scalar(gain) => DMatrix::from_diagonal_element(n, n, gain),
        OuterGain::Diagonal(diagonal) => DMatrix::from_diagonal(&DVector::from_vec(diagonal)),
        OuterGain::Full(matrix) => matrix,
    };
    let k2_value = table.require("k2", "5.0")?;
    let (k2, kappa) = (k2_value.positive()?, table.require("kappa", "0.5")?.positive()?);
    if k2 * kappa <= 1.0 {
        let problem = format!("is {}, expected a number above 1/kappa", k2_value.written());
        let hint = format!("use a number above {}, or a larger kappa", 1.0 / kappa);
        return Err(k2_value.error(problem, hint));
    }
    Ok(Design {
        gain,
        k2,
        kappa,
        rho: table.require("rho", "1.0")?.positive()?,
        delta: table.require("delta", "0.5")?.with_hint(DELTA).positive()?,
        epsilon: table.require("epsilon", "1000.0")?.with_hint(EPSILON).positive()?,
    })
}

/// `features` is `L`.
pub(super) fn outer_law(root: &Table<'_>, features: usize) -> Result<OuterLaw, ScenarioError> {
    let table = root.require_table("outer_law")?;
    table.only(&["gain", "bound", "boundary_layer", "smoothing", "smoothness"])?;
    let gain_value = table.require("gain", "2.0")?;
    let gain = scaled(&gain_value, features, "the width of the last layer")?;
    if !is_positive_definite(&gain) {
        return Err(gain_value.error("is not positive definite", POSITIVE_DEFINITE));
    }
    let bound = table.require("bound", "10.0")?.positive()?;
    let layer_value = table.get("boundary_layer", "0.5");
    // With a twentieth of the bound, the projection affects only the largest weights.
    let boundary_layer = layer_value.as_ref().map_or(Ok(bound / 20.0), Value::positive)?;
    if let Some(value) = layer_value.filter(|_| boundary_layer >= bound) {
        let problem = format!("is {}, which is not below the bound", value.written());
        return Err(value.error(problem, format!("use a number below outer_law.bound, {bound}")));
    }
    let smoothing = table.get("smoothing", "0.1").map_or(Ok(0.1), |value| value.positive())?;
    let smoothness = table.get("smoothness", "1");
    let smoothness = smoothness.map_or(Ok(1), |value| value.integer(0..=SMOOTHNESS_MAX))?;
    Ok(OuterLaw { gain, bound, boundary_layer, smoothing, smoothness: smoothness as u8 })
}

const POSITIVE_DEFINITE: &str =
    "use a number above 0, a list of numbers above 0, or a matrix with positive eigenvalues";

fn is_positive_definite(gain: &OuterGain) -> bool {
    match gain {
        OuterGain::Scalar(gain) => *gain > 0.0,
        OuterGain::Diagonal(diagonal) => diagonal.iter().all(|&gain| gain > 0.0),
        OuterGain::Full(matrix) => Cholesky::new(matrix.clone()).is_some(),
    }
}

/// Reads a gain of shape `[size, size]`: a symmetric matrix, or such a matrix and a factor on it.
fn scaled(value: &Value<'_>, size: usize, owner: &str) -> Result<OuterGain, ScenarioError> {
    if !value.is_table() {
        return symmetric(value, size, owner);
    }
    let table = value.table()?;
    table.only(&["values", "scale"])?;
    let scale = table.get("scale", "1.5").map_or(Ok(1.0), |value| value.positive())?;
    Ok(match symmetric(&table.require("values", "80.0")?, size, owner)? {
        OuterGain::Scalar(gain) => OuterGain::Scalar(scale * gain),
        OuterGain::Diagonal(gains) => {
            OuterGain::Diagonal(gains.into_iter().map(|gain| scale * gain).collect())
        }
        OuterGain::Full(matrix) => OuterGain::Full(matrix * scale),
    })
}

/// Reads a symmetric matrix of shape `[size, size]`, given as a number, a diagonal, or its rows.
fn symmetric(value: &Value<'_>, size: usize, owner: &str) -> Result<OuterGain, ScenarioError> {
    if !value.is_list() {
        return value.number().map(OuterGain::Scalar);
    }
    let rows = value.list("write each row as a list of numbers")?;
    if !rows.iter().any(Value::is_list) {
        return value.numbers_of(size, owner).map(OuterGain::Diagonal);
    }
    if rows.len() != size {
        let problem = format!("{}, expected {size} ({owner})", has(rows.len(), "row", "rows"));
        return Err(value.error(problem, format!("write {size} rows")));
    }
    let matrix = value.matrix(size, owner)?;
    for row in 0..size {
        for column in 0..row {
            let (below, above) = (matrix[(row, column)], matrix[(column, row)]);
            if below != above {
                let (row, column) = (row + 1, column + 1);
                let problem = format!(
                    "is not symmetric: entry ({row}, {column}) is {below}, \
                     entry ({column}, {row}) is {above}"
                );
                return Err(rows[row - 1].error_of(value, problem, "use the same number in both"));
            }
        }
    }
    Ok(OuterGain::Full(matrix))
}
