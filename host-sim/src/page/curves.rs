//! Errors of the training runs, epoch by epoch.

use std::path::Path;

use serde::Serialize;

use super::TableError;
use super::number::{DIGITS, Short};
use super::table::each_row;

/// Training runs whose curves are kept at most.
const CURVES: usize = 24;

/// The errors of one training. \[(state unit/s)²\]
#[derive(Debug, PartialEq, Serialize)]
pub struct Curve {
    /// From 1.
    agent: u32,
    /// From 1.
    cycle: u32,
    /// On the training samples, by epoch from 0, shape `[epochs + 1]`.
    train: Vec<Short>,
    /// On the validation samples; NaN without any.
    validation: Vec<Short>,
    /// On the test samples; NaN without any.
    test: Vec<Short>,
}

/// Reads the first training runs of `training.csv`.
///
/// # Errors
/// If the table cannot be read or is not of its kind.
pub fn read(path: &Path) -> Result<Vec<Curve>, TableError> {
    let mut curves: Vec<Curve> = Vec::new();
    each_row(path, |row| {
        let (agent, cycle) = (row.number(0)?, row.number(1)?);
        if curves.last().is_none_or(|last| (last.agent, last.cycle) != (agent, cycle)) {
            if curves.len() == CURVES {
                return Ok(false);
            }
            let none = Vec::new;
            curves.push(Curve { agent, cycle, train: none(), validation: none(), test: none() });
        }
        if let Some(last) = curves.last_mut() {
            let error = |column| row.optional(column).map(|value| Short(value, DIGITS));
            last.train.push(error(3)?);
            last.validation.push(error(4)?);
            last.test.push(error(5)?);
        }
        Ok(true)
    })?;
    Ok(curves)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn epochs_are_gathered_by_training_and_there_is_a_limit() {
        let mut text = String::from("agent,cycle,epoch,train,validation,test,damping,gradient\n");
        for agent in 1..=CURVES + 1 {
            text += &format!("{agent},1,0,1.0,,3.0,0,0\n{agent},1,1,0.5,0.75,,0,0\n");
        }
        let path = std::env::temp_dir().join(format!("{}-curves.csv", std::process::id()));
        fs::write(&path, text).unwrap();
        let curves = read(&path);
        fs::remove_file(&path).unwrap();
        let curves = curves.unwrap();
        assert_eq!(curves.len(), CURVES);
        let json = serde_json::to_value(&curves[2]).unwrap();
        let expected = serde_json::json!({
            "agent": 3, "cycle": 1, "train": [1, 0.5], "validation": [null, 0.75], "test": [3, null]
        });
        assert_eq!(json, expected);
    }
}
