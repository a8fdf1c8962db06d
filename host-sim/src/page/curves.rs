//! Errors of the trainings, epoch by epoch.

use std::path::Path;

use serde::Serialize;

use super::TableError;
use super::number::Short;

/// Trainings whose curves are kept at most.
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

/// Reads the first trainings of `training.csv`.
///
/// # Errors
/// If the table cannot be read or is not of its kind.
pub fn read(path: &Path) -> Result<Vec<Curve>, TableError> {
    let failed = |error| TableError::Read { path: path.to_owned(), error };
    let mut reader = csv::Reader::from_path(path).map_err(failed)?;
    let mut curves: Vec<Curve> = Vec::new();
    for record in reader.records() {
        let record = record.map_err(failed)?;
        let field = |index: usize| record.get(index).unwrap_or_default();
        let wrong = |index: usize| TableError::Field {
            path: path.to_owned(),
            line: record.position().map_or(0, csv::Position::line),
            field: field(index).to_owned(),
            expected: "a number",
        };
        let whole = |index: usize| field(index).parse::<u32>().map_err(|_| wrong(index));
        let error = |index: usize| match field(index) {
            "" => Ok(Short(f64::NAN)),
            text => text.parse().map(Short).map_err(|_| wrong(index)),
        };
        let (agent, cycle) = (whole(0)?, whole(1)?);
        if curves.last().is_none_or(|last| (last.agent, last.cycle) != (agent, cycle)) {
            if curves.len() == CURVES {
                break;
            }
            let none = Vec::new;
            curves.push(Curve { agent, cycle, train: none(), validation: none(), test: none() });
        }
        if let Some(last) = curves.last_mut() {
            last.train.push(error(3)?);
            last.validation.push(error(4)?);
            last.test.push(error(5)?);
        }
    }
    Ok(curves)
}
