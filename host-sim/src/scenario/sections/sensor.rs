//! `[sensor]`, and `sensor` of an agent.

use crate::scenario::error::ScenarioError;
use crate::scenario::reader::Table;

/// How an agent measures its outputs. The default is the paper's: exactly, in every step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SensorSettings {
    /// Standard deviation of the noise, normally distributed and independent. \[output unit\]
    pub noise: f64,
    /// Constant error. \[output unit\]
    pub bias: f64,
    /// Growth of the error. \[output unit/s\]
    pub drift: f64,
    /// Smallest and largest value; beyond, the sensor saturates. \[output unit\]
    pub range: Option<[f64; 2]>,
    /// Resolution over the range: values are multiples of its `2^-bits`.
    pub bits: Option<u32>,
    /// Probability that there is no value in a sample.
    pub drop_out: f64,
    /// Values that have nothing to do with the state.
    pub outliers: Option<Outliers>,
    /// Time between samples, which need not be a number of steps; 0 for one in every step. \[s\]
    pub period: f64,
    /// Time of the first sample. \[s\]
    pub phase: f64,
    /// Whether the last sample is used again until the next one; otherwise there is no value.
    pub is_held: bool,
}

/// Outliers of a sensor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outliers {
    /// Probability in each sample.
    pub probability: f64,
    /// Standard deviation of what is added. \[output unit\]
    pub size: f64,
}

const KEYS: [&str; 10] =
    ["noise", "bias", "drift", "range", "bits", "drop_out", "outliers", "period", "phase", "hold"];

impl Default for SensorSettings {
    fn default() -> Self {
        Self {
            noise: 0.0,
            bias: 0.0,
            drift: 0.0,
            range: None,
            bits: None,
            drop_out: 0.0,
            outliers: None,
            period: 0.0,
            phase: 0.0,
            is_held: true,
        }
    }
}

impl SensorSettings {
    /// Returns whether the agent measures as the paper assumes.
    #[must_use]
    pub fn is_ideal(&self) -> bool {
        Self { is_held: true, ..*self } == Self::default()
    }

    /// Returns the standard deviation of noise and rounding together. \[output unit\]
    #[must_use]
    pub fn deviation(&self) -> f64 {
        let rounding = match (self.range, self.bits) {
            (Some([low, high]), Some(bits)) => {
                (high - low) / libm::exp2(f64::from(bits)) / 12f64.sqrt()
            }
            _ => 0.0,
        };
        libm::hypot(self.noise, rounding)
    }
}

/// Reads `[sensor]`.
pub(in crate::scenario) fn sensor(root: &Table<'_>) -> Result<SensorSettings, ScenarioError> {
    match root.get_table("sensor")? {
        Some(table) => settings(&table, SensorSettings::default()),
        None => Ok(SensorSettings::default()),
    }
}

/// Reads a table of sensor keys; those that are missing are as in `default`.
pub(super) fn settings(
    table: &Table<'_>,
    default: SensorSettings,
) -> Result<SensorSettings, ScenarioError> {
    table.only(&KEYS)?;
    let number =
        |key: &str, default: f64| table.get(key, "0.1").map_or(Ok(default), |v| v.number());
    let noise = table.get("noise", "0.01").map_or(Ok(default.noise), |v| v.not_negative())?;
    let range = match table.get("range", "[-10.0, 10.0]") {
        Some(value) => {
            let limits = value.numbers_of(2, "the smallest and the largest value")?;
            if limits[0] >= limits[1] {
                return Err(value.wrong("its second value is not above the first"));
            }
            Some([limits[0], limits[1]])
        }
        None => default.range,
    };
    let bits = match table.get("bits", "12") {
        Some(value) if range.is_none() => {
            return Err(value.error("needs a range", "add range = [-10.0, 10.0] next to it"));
        }
        Some(value) => Some(value.integer(1..=32)?),
        None => default.bits,
    };
    let outliers = match table.get("outliers", "{ probability = 0.001, size = 5.0 }") {
        Some(value) => {
            let table = value.table()?;
            table.only(&["probability", "size"])?;
            Some(Outliers {
                probability: table.require("probability", "0.001")?.probability()?,
                size: table.require("size", "5.0")?.not_negative()?,
            })
        }
        None => default.outliers,
    };
    Ok(SensorSettings {
        noise,
        bias: number("bias", default.bias)?,
        drift: number("drift", default.drift)?,
        range,
        bits,
        drop_out: table
            .get("drop_out", "0.01")
            .map_or(Ok(default.drop_out), |v| v.probability())?,
        outliers,
        period: table.get("period", "0.01").map_or(Ok(default.period), |v| v.not_negative())?,
        phase: table.get("phase", "0.003").map_or(Ok(default.phase), |v| v.not_negative())?,
        is_held: table.get("hold", "true").map_or(Ok(default.is_held), |v| v.boolean())?,
    })
}
