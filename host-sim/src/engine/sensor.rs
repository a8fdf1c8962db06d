//! Sensor models: what an agent measures of `C x_0`.
//!
//! A sample is the exact output plus bias, drift, noise and outliers, clipped to the range and rounded
//! to the resolution, in this order. Between samples the last one is used again, or there is none.

use agent_core::Tick;

use crate::random::{Purpose, Random};
use crate::scenario::{SensorSettings, Time};

/// The sensor of one agent.
#[derive(Clone, Debug)]
pub(super) struct Sensor {
    settings: SensorSettings,
    time: Time,
    agent: u64,
    noise: Random,
    outliers: Random,
    drop_outs: Random,
    /// Number of samples that were due so far.
    samples: u64,
    /// Whether the last sample has a value.
    has_value: bool,
}

impl Sensor {
    /// Creates the sensor of `agent`, from 0; `None` if it measures exactly.
    pub(super) fn new(
        settings: &SensorSettings,
        time: &Time,
        agent: usize,
        seed: u64,
    ) -> Option<Self> {
        (!settings.is_ideal()).then(|| Self {
            settings: *settings,
            time: *time,
            agent: agent as u64,
            noise: Random::new(seed, Purpose::SensorNoise),
            outliers: Random::new(seed, Purpose::Outlier),
            drop_outs: Random::new(seed, Purpose::DropOut),
            samples: 0,
            has_value: false,
        })
    }

    /// Measures at `tick`: replaces the exact outputs in `exact` with values of the sensor in `measured`,
    /// which holds those of the step before. Returns whether there are any.
    pub(super) fn measure(&mut self, tick: Tick, exact: &[f64], measured: &mut [f32]) -> bool {
        let time = self.time.at(tick);
        if !self.is_due(time) {
            return self.has_value && self.settings.is_held;
        }
        self.has_value = !self.drop_outs.happens(self.settings.drop_out, [self.agent, 0, tick]);
        if self.has_value {
            for (output, (exact, measured)) in exact.iter().zip(measured).enumerate() {
                let value = self.value(*exact, time, [self.agent, output as u64, tick]);
                // A converter has a largest value.
                *measured = value.clamp(f32::MIN.into(), f32::MAX.into()) as f32;
            }
        }
        self.has_value
    }

    /// Forgets the last sample.
    pub(super) fn restart(&mut self) {
        self.has_value = false;
    }

    /// Returns whether a sample is due at `time` \[s\].
    fn is_due(&mut self, time: f64) -> bool {
        let SensorSettings { period, phase, .. } = self.settings;
        // Times are multiples of the step up to rounding.
        let tolerance = 1e-6 * self.time.step_size;
        // A sensor that is quicker than the steps has a sample for each.
        if period <= self.time.step_size {
            return time + tolerance >= phase;
        }
        let due = ((time - phase + tolerance) / period).floor() + 1.0;
        let due = if due > 0.0 { due as u64 } else { 0 };
        std::mem::replace(&mut self.samples, due) < due
    }

    fn value(&self, exact: f64, time: f64, at: [u64; 3]) -> f64 {
        let SensorSettings { noise, bias, drift, range, bits, outliers, .. } = self.settings;
        let mut value = exact + bias + drift * time;
        if noise > 0.0 {
            value += noise * self.noise.normal(at);
        }
        if let Some(outliers) = outliers
            && self.outliers.happens(outliers.probability, at)
        {
            let [agent, output, tick] = at;
            value += outliers.size * self.outliers.normal([agent, output, tick | 1 << 62]);
        }
        let Some([low, high]) = range else { return value };
        value = value.clamp(low, high);
        if let Some(bits) = bits {
            let resolution = (high - low) / (1_u64 << bits) as f64;
            // The highest of 2^bits codes is one below the end of the range.
            let code = ((value - low) / resolution).round().min((1_u64 << bits) as f64 - 1.0);
            value = low + code * resolution;
        }
        value
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plant::Integrator;
    use crate::scenario::Outliers;

    const TIME: Time = Time { duration: 100.0, step_size: 0.01, integrator: Integrator::Euler };

    fn samples(settings: SensorSettings, exact: f64, ticks: u64) -> Vec<Option<f32>> {
        let mut sensor = Sensor::new(&settings, &TIME, 1, 7).unwrap();
        let mut measured = [f32::NAN];
        let sample = |tick| sensor.measure(tick, &[exact], &mut measured).then_some(measured[0]);
        (0..ticks).map(sample).collect()
    }

    #[test]
    fn an_exact_sensor_needs_no_model() {
        assert!(Sensor::new(&SensorSettings::default(), &TIME, 0, 0).is_none());
        let sampled = SensorSettings { is_held: false, ..SensorSettings::default() };
        assert!(Sensor::new(&sampled, &TIME, 0, 0).is_none());
    }

    #[test]
    fn noise_bias_and_drift_add_up() {
        let settings =
            SensorSettings { noise: 0.5, bias: 1.0, drift: 0.02, ..SensorSettings::default() };
        let values: Vec<f64> =
            samples(settings, 3.0, 10_000).into_iter().map(|v| f64::from(v.unwrap())).collect();
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        // The drift adds 0.02 * 50 on average.
        assert!((mean(&values) - 5.0).abs() < 0.02, "{}", mean(&values));
        let drift = mean(&values[9_000..]) - mean(&values[..1_000]);
        assert!((drift - 1.8).abs() < 0.06, "{drift}");
        let noise: Vec<f64> = (0..10_000)
            .map(|tick| values[tick] - 4.0 - 0.02 * TIME.at(tick as u64))
            .map(|noise| noise * noise)
            .collect();
        assert!((mean(&noise).sqrt() - 0.5).abs() < 0.01, "{}", mean(&noise).sqrt());
    }

    #[test]
    fn a_converter_saturates_and_rounds() {
        let settings =
            SensorSettings { range: Some([-4.0, 4.0]), bits: Some(3), ..SensorSettings::default() };
        for (exact, expected) in
            [(0.4, 0.0), (0.6, 1.0), (-3.9, -4.0), (9.0, 3.0), (-9.0, -4.0), (2.51, 3.0)]
        {
            assert_eq!(samples(settings, exact, 1), [Some(expected)], "{exact}");
        }
    }

    #[test]
    fn slow_samples_are_held_or_missing_in_between() {
        let slow = SensorSettings { period: 0.025, phase: 0.01, ..SensorSettings::default() };
        let held = samples(slow, 1.0, 8);
        assert_eq!(held.iter().map(Option::is_some).collect::<Vec<_>>()[..2], [false, true]);
        let gaps = samples(SensorSettings { is_held: false, ..slow }, 1.0, 12);
        // Samples at 0.01, 0.035, 0.06, 0.085 and 0.11 s, seen by the next step.
        let seen: Vec<usize> = (0..12).filter(|&tick| gaps[tick].is_some()).collect();
        assert_eq!(seen, [1, 4, 6, 9, 11]);
    }

    #[test]
    fn drop_outs_and_outliers_have_their_frequency() {
        let settings = SensorSettings {
            drop_out: 0.1,
            outliers: Some(Outliers { probability: 0.05, size: 100.0 }),
            ..SensorSettings::default()
        };
        let values = samples(settings, 0.0, 20_000);
        let missing = values.iter().filter(|value| value.is_none()).count();
        let wild = values.iter().flatten().filter(|value| value.abs() > 1.0).count();
        assert!((1_850..2_150).contains(&missing), "{missing}");
        assert!((800..1_000).contains(&wild), "{wild}");
    }
}
