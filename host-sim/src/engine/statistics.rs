//! Statistics of each agent, updated during a run.

use agent_core::Tick;
use agent_core::health::HealthCounters;

use super::link::Traffic;
use crate::scenario::Time;

/// Root mean square and maximum of `|e_1i|` over the evaluation window, and the times between
/// broadcasts over the whole run.
#[derive(Clone, Debug, Default)]
pub struct AgentStatistics {
    sum_squared: f64,
    samples: u64,
    max_squared: f64,
    innovation_squared: f64,
    innovations: u64,
    first_broadcast: Tick,
    last_broadcast: Tick,
    broadcasts: u64,
    min_interval: Option<Tick>,
    /// Length of all frames that the agent broadcast. \[byte\]
    pub bytes_sent: u64,
    /// Number of broadcasts in the evaluation window.
    pub broadcasts_evaluated: u64,
    /// Length of their frames. \[byte\]
    pub bytes_evaluated: u64,
    /// What happened to the agent's frames; `None` if the link does not count.
    pub traffic: Option<Traffic>,
    /// Number of received frames that the agent refused.
    pub frames_refused: u64,
    /// Health counters; `None` if the agent was not monitored.
    pub health: Option<HealthCounters>,
    /// Largest `e_2i_max` of Theorem 2; 0 if not requested. \[state unit/s\]
    pub hold_error_rate_max: f64,
    /// Largest `|W_hat_i|` (Frobenius); 0 if not requested.
    pub outer_weights_norm_max: f64,
    /// Where fitted polynomials were used beyond their samples.
    pub extrapolation: Extrapolation,
    /// Ticks of all broadcasts, if the scenario records events.
    pub events: Vec<Tick>,
}

/// How far the inputs of a polynomial were outside the range of the samples that it was fitted to, in the evaluation
/// window.
#[derive(Clone, Debug, Default)]
pub struct Extrapolation {
    /// Steps with a polynomial.
    pub steps: u64,
    /// Of these, those with an input outside.
    pub outside: u64,
    /// The farthest of each input, as a share of the range's width; empty without a polynomial.
    pub farthest: Vec<f32>,
}

impl Extrapolation {
    /// Records how far each input is outside at one step, as a share of the range's width.
    pub fn note(&mut self, outside: impl Iterator<Item = f32>) {
        let mut is_outside = false;
        for (place, share) in outside.enumerate() {
            is_outside |= share > 0.0;
            match self.farthest.get_mut(place) {
                Some(farthest) => *farthest = farthest.max(share),
                None => self.farthest.push(share),
            }
        }
        self.steps += 1;
        self.outside += u64::from(is_outside);
    }
}

impl AgentStatistics {
    /// Records the squared norm of `e_1i` at one step of the evaluation window.
    #[inline]
    pub fn error(&mut self, squared: f64) {
        self.sum_squared += squared;
        self.samples += 1;
        self.max_squared = self.max_squared.max(squared);
    }

    /// Records the sum of the squares of this many innovations in the evaluation window.
    pub fn innovation(&mut self, squared: f64, count: u64) {
        self.innovation_squared += squared;
        self.innovations += count;
    }

    /// Returns the root mean square of the innovation over the evaluation window; `None` if it was not
    /// recorded, as in runs of a simulated plant. \[output unit\]
    #[must_use]
    pub fn innovation_rms(&self) -> Option<f64> {
        (self.innovations > 0).then(|| (self.innovation_squared / self.innovations as f64).sqrt())
    }

    /// Records a broadcast of this many bytes at `tick`, in the evaluation window or not.
    #[inline]
    pub fn broadcast(&mut self, tick: Tick, bytes: usize, keep_event: bool, is_evaluated: bool) {
        self.bytes_sent += bytes as u64;
        if is_evaluated {
            self.broadcasts_evaluated += 1;
            self.bytes_evaluated += bytes as u64;
        }
        if self.broadcasts == 0 {
            self.first_broadcast = tick;
        } else {
            let interval = tick - self.last_broadcast;
            self.min_interval = Some(self.min_interval.map_or(interval, |min| min.min(interval)));
        }
        self.last_broadcast = tick;
        self.broadcasts += 1;
        if keep_event {
            self.events.push(tick);
        }
    }

    /// Returns the number of broadcasts, including the one at `t = 0`.
    #[must_use]
    pub fn broadcasts(&self) -> u64 {
        self.broadcasts
    }

    /// Returns the root mean square of `|e_1i|` over the evaluation window; `None` if it has no
    /// steps.
    #[must_use]
    pub fn rmse(&self) -> Option<f64> {
        (self.samples > 0).then(|| (self.sum_squared / self.samples as f64).sqrt())
    }

    /// Returns the maximum of `|e_1i|` over the evaluation window; `None` if it has no steps.
    #[must_use]
    pub fn max_error(&self) -> Option<f64> {
        (self.samples > 0).then(|| self.max_squared.sqrt())
    }

    /// Returns the mean time between broadcasts; `None` with fewer than two. \[s\]
    #[must_use]
    pub fn mean_interval(&self, time: &Time) -> Option<f64> {
        let intervals = self.broadcasts.checked_sub(1).filter(|&intervals| intervals > 0)?;
        Some(time.at(self.last_broadcast - self.first_broadcast) / intervals as f64)
    }

    /// Returns the shortest time between broadcasts; `None` with fewer than two. \[s\]
    #[must_use]
    pub fn min_interval(&self, time: &Time) -> Option<f64> {
        self.min_interval.map(|ticks| time.at(ticks))
    }
}
