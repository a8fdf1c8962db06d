//! The paper's published results, for comparison only: nothing is tuned to these numbers.
//!
//! Source: F. M. Zegers, R. Sun, G. Chowdhary, W. E. Dixon, "Distributed State Estimation with
//! Deep Neural Networks for Uncertain Nonlinear Systems under Event-Triggered Communication",
//! Table 1 ("State Estimation RMSE With & Without DNN Learning", `t` in \[20, 40\]) and the
//! section "Simulation Results" around it (mean times between broadcasts, where the paper saw
//! no significant difference between its two simulations).

/// The paper's results for one agent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Published {
    /// Root mean square of `|e_1i|`, inner networks held constant. \[state unit\]
    pub rmse_without: f64,
    /// Root mean square of `|e_1i|`, inner networks trained once. \[state unit\]
    pub rmse_with: f64,
    /// The change between the two as printed; it does not always match the rounded numbers. \[%\]
    pub change_percent: f64,
    /// Mean time between broadcasts, the same in both simulations. \[s\]
    pub mean_interval: f64,
}

/// Agents 1 to 3 of the Van der Pol example.
pub const PUBLISHED: [Published; 3] = [
    Published {
        rmse_without: 0.1827,
        rmse_with: 0.0777,
        change_percent: -57.47,
        mean_interval: 0.0047,
    },
    Published {
        rmse_without: 0.1775,
        rmse_with: 0.0634,
        change_percent: -64.28,
        mean_interval: 0.0089,
    },
    Published {
        rmse_without: 0.2070,
        rmse_with: 0.0876,
        change_percent: -57.68,
        mean_interval: 0.0095,
    },
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn printed_changes_follow_from_printed_errors() {
        for row in PUBLISHED {
            let change = 100.0 * (row.rmse_with / row.rmse_without - 1.0);
            assert!((change - row.change_percent).abs() < 0.05, "{row:?}: {change}");
        }
    }
}
