//! `[design]` and `[outer_law]`: gains and the constants around them.

use nalgebra::{Cholesky, DMatrix, DVector};

use crate::scenario::error::ScenarioError;
use crate::scenario::reader::{Table, Value, has};
use crate::scenario::{Design, OuterGain, OuterLaw};

/// Highest smoothness of the projection that the agents offer.
const SMOOTHNESS_MAX: u32 = 7;

const DELTA: &str = "write a number above 0; it may be small, and the bound on the error gets tighter \
                     with it";
const EPSILON: &str = "write a number above 0; the smaller it is, the more often agents broadcast";

/// `n` is the dimension of the state.
pub(in crate::scenario) fn design(root: &Table<'_>, n: usize) -> Result<Design, ScenarioError> {
    let table = root.require_table("design")?;
    table.only(&["gain", "k2", "kappa", "rho", "delta", "epsilon"])?;
    let gain_value = table.require("gain", "80.0")?;
    let gain = symmetric(&gain_value, n, "the state has")?;
    if !is_positive_definite(&gain) {
        // With an eigenvector v to an eigenvalue that is not, all agents at v contradict `BMI`.
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
        let problem = format!("is {}, the analysis needs it above 1/kappa", k2_value.written());
        let hint = format!("write a number above {}, or a larger kappa", 1.0 / kappa);
        return Err(k2_value.error(problem, hint));
    }
    Ok(Design {
        gain,
        k2,
        kappa,
        rho: table.require("rho", "1.0")?.positive()?,
        delta: table.require("delta", "0.5")?.with_mend(DELTA).positive()?,
        epsilon: table.require("epsilon", "1000.0")?.with_mend(EPSILON).positive()?,
    })
}

/// `features` is `L`.
pub(super) fn outer_law(root: &Table<'_>, features: usize) -> Result<OuterLaw, ScenarioError> {
    let table = root.require_table("outer_law")?;
    table.only(&["gain", "bound", "boundary_layer", "smoothing", "smoothness"])?;
    let gain_value = table.require("gain", "2.0")?;
    let gain = symmetric(&gain_value, features, "the last layer has")?;
    if !is_positive_definite(&gain) {
        return Err(gain_value.error("is not positive definite", POSITIVE_DEFINITE));
    }
    let bound = table.require("bound", "10.0")?.positive()?;
    let layer_value = table.get("boundary_layer", "0.5");
    // A twentieth of the bound keeps the projection away from all but the largest weights.
    let boundary_layer = layer_value.as_ref().map_or(Ok(bound / 20.0), Value::positive)?;
    if let Some(value) = layer_value.filter(|_| boundary_layer >= bound) {
        let problem = format!("is {}, which leaves no room inside the bound", value.written());
        return Err(value.error(problem, format!("write a number below outer_law.bound, {bound}")));
    }
    let smoothing = table.get("smoothing", "0.1").map_or(Ok(0.1), |value| value.positive())?;
    let smoothness = table.get("smoothness", "1");
    let smoothness = smoothness.map_or(Ok(1), |value| value.integer(0..=SMOOTHNESS_MAX))?;
    Ok(OuterLaw { gain, bound, boundary_layer, smoothing, smoothness: smoothness as u8 })
}

const POSITIVE_DEFINITE: &str =
    "write a number above 0, a list of such, or a matrix with positive eigenvalues";

fn is_positive_definite(gain: &OuterGain) -> bool {
    match gain {
        OuterGain::Scalar(gain) => *gain > 0.0,
        OuterGain::Diagonal(diagonal) => diagonal.iter().all(|&gain| gain > 0.0),
        OuterGain::Full(matrix) => Cholesky::new(matrix.clone()).is_some(),
    }
}

/// A symmetric matrix of shape `[size, size]`, written as a number, a diagonal, or its rows.
fn symmetric(value: &Value<'_>, size: usize, owner: &str) -> Result<OuterGain, ScenarioError> {
    if !value.is_list() {
        return value.number().map(OuterGain::Scalar);
    }
    let rows = value.list("write every row as a list of numbers")?;
    if !rows.iter().any(Value::is_list) {
        return value.numbers_of(size, owner).map(OuterGain::Diagonal);
    }
    if rows.len() != size {
        let problem = format!("{}, {owner} {size}", has(rows.len(), "row", "rows"));
        return Err(value.error(problem, format!("give it {size} rows")));
    }
    let matrix = value.matrix(size, owner)?;
    for row in 0..size {
        for column in 0..row {
            let (below, above) = (matrix[(row, column)], matrix[(column, row)]);
            if below != above {
                let (row, column) = (row + 1, column + 1);
                let problem = format!(
                    "is not symmetric: row {row}, column {column} is {below}, \
                     row {column}, column {row} is {above}"
                );
                return Err(rows[row - 1].error_of(
                    value,
                    problem,
                    "write the same number in both",
                ));
            }
        }
    }
    Ok(OuterGain::Full(matrix))
}
