//! What an agent does about links that fail, as a package has it.

use agent_core::agent::exchange::ExchangeParams;
use serde::Serialize;

use super::decimal;
use crate::number::significant;

/// How an agent copes with links that fail; `None` for what it does not do. \[s\]
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Exchange {
    heartbeat_s: Option<f64>,
    gap_s: Option<f64>,
    repeat_s: Option<f64>,
    fade_s: Option<[f64; 2]>,
    delay_s: Option<f64>,
    smoothing_s: Option<f64>,
}

impl Exchange {
    pub(super) fn new(exchange: &ExchangeParams, step_size: f32) -> Self {
        let seconds = |steps: u32| f64::from(steps) * decimal(step_size);
        let some = |steps: u32| (steps > 0).then(|| seconds(steps));
        Self {
            heartbeat_s: some(exchange.heartbeat),
            gap_s: some(exchange.gap),
            repeat_s: some(exchange.repeat),
            fade_s: (exchange.fade_to > 0)
                .then(|| [seconds(exchange.fade_from), seconds(exchange.fade_to)]),
            delay_s: some(exchange.delay),
            smoothing_s: some(exchange.smoothing),
        }
    }

    /// Returns what the agent does, in words.
    pub(super) fn words(&self) -> String {
        let time = |words: &str, time: Option<f64>, name: &str| {
            time.map(|time| format!("{words} {} s{name}", significant(time, 4)))
        };
        let fade = self.fade_s.map(|[from, to]| {
            format!(
                "neighbours fade out between {} and {} s of silence",
                significant(from, 4),
                significant(to, 4)
            )
        });
        let found = [
            time("a broadcast at least every", self.heartbeat_s, " (heartbeat)"),
            time("at most one every", self.gap_s, " (gap)"),
            time("events repeated after", self.repeat_s, ""),
            fade,
            time("smallest delay", self.delay_s, ""),
            time("late samples extrapolated by the velocity over", self.smoothing_s, ""),
        ];
        found.into_iter().flatten().collect::<Vec<_>>().join(", ")
    }
}
