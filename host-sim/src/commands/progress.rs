//! Progress bars on the terminal: one for the steps of the simulation, one for the epochs of the
//! training that reported last.
//!
//! The bars are drawn on standard error, at most ten times a second, and only if it is a terminal.
//! An update that is not drawn costs a few atomic operations. Any thread may send updates.

use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::engine::Progress;
use crate::training::EpochReport;

/// Maximum drawing rate. \[1/s\]
const DRAWS: u8 = 10;

const STEPS: &str =
    "{prefix:12} [{bar:32}] {percent:>3} %  {human_pos} of {human_len} steps  {eta} left";
const ENDLESS: &str = "{prefix:12} {human_pos} steps  {elapsed} elapsed";
const BYTES: &str = "{prefix:12} [{bar:32}] {percent:>3} %  {bytes} of {total_bytes}";
const EPOCHS: &str = "{prefix:12} {msg}  ({human_pos} training epochs in total)";

/// The two progress bars.
#[derive(Debug)]
pub(super) struct ProgressBars {
    bars: MultiProgress,
    steps: ProgressBar,
    epochs: ProgressBar,
    /// Whether the number of steps is unlimited.
    endless: bool,
}

impl ProgressBars {
    /// Creates the bars of a run called `name`, on standard error.
    #[must_use]
    pub(super) fn new(name: &str) -> Self {
        Self::drawn_on(name, ProgressDrawTarget::stderr_with_hz(DRAWS))
    }

    /// Creates the bars of a run that continues until a signal ends it.
    #[must_use]
    pub(super) fn endless(name: &str) -> Self {
        let mut bars = Self::new(name);
        bars.steps.set_style(style(ENDLESS));
        bars.endless = true;
        bars
    }

    /// Creates a bar that counts something other than steps.
    #[must_use]
    pub(super) fn counting(name: &str, what: &str) -> Self {
        let bars = Self::new(name);
        bars.steps.set_style(style(&STEPS.replace("steps", what)));
        bars
    }

    /// Hides the bars while `print` writes to the terminal.
    pub(super) fn suspended(&self, print: impl FnOnce()) {
        self.bars.suspend(print);
    }

    /// Creates bars that are never drawn.
    #[must_use]
    #[cfg(test)]
    fn hidden() -> Self {
        Self::drawn_on("", ProgressDrawTarget::hidden())
    }

    fn drawn_on(name: &str, target: ProgressDrawTarget) -> Self {
        let bars = MultiProgress::with_draw_target(target);
        let bar = |template: &str, prefix: &str| {
            let bar = bars.add(ProgressBar::new(0)).with_style(style(template));
            bar.with_prefix(prefix.to_owned())
        };
        let (steps, epochs) = (bar(STEPS, name), bar(EPOCHS, "training"));
        Self { bars, steps, epochs, endless: false }
    }

    /// Reports that `bytes` of `total` bytes have been sent.
    pub(super) fn transferred(&self, bytes: u64, total: u64) {
        if self.steps.length() != Some(total) {
            self.steps.set_style(style(BYTES));
            self.steps.set_length(total);
        }
        self.steps.set_position(bytes);
    }

    /// Reports that training of `agent` in `cycle` (both from 1) has finished epoch `number` with a
    /// mean squared error of `train_mse` \[squared state unit/s\].
    pub(super) fn trained(&self, agent: usize, cycle: usize, number: usize, train_mse: f64) {
        self.epochs.inc(1);
        if !self.epochs.is_hidden() {
            let message = format!(
                "agent {agent}, cycle {cycle}: training epoch {number}, MSE {train_mse:.3e}"
            );
            self.epochs.set_message(message);
        }
    }

    /// Removes the bars, so that the next output starts on a clean line.
    pub(super) fn finish(&self) {
        self.steps.finish_and_clear();
        self.epochs.finish_and_clear();
    }
}

impl Progress for ProgressBars {
    fn step(&self, tick: u64, steps: u64) {
        if !self.endless && self.steps.length() != Some(steps) {
            self.steps.set_length(steps);
        }
        self.steps.set_position(tick);
    }

    fn epoch(&self, agent: usize, cycle: usize, report: &EpochReport) {
        self.trained(agent, cycle, report.epoch, report.train);
    }
}

fn style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template)
        .unwrap_or_else(|_| ProgressStyle::default_bar())
        .progress_chars("=> ")
}

impl Drop for ProgressBars {
    fn drop(&mut self) {
        self.finish();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn templates_are_valid() {
        for template in [STEPS, ENDLESS, BYTES, EPOCHS] {
            assert!(ProgressStyle::with_template(template).is_ok(), "{template}");
        }
    }

    #[test]
    fn reports_from_several_threads_are_counted() {
        let bars = ProgressBars::hidden();
        std::thread::scope(|scope| {
            for agent in 1..=4 {
                let bars = &bars;
                scope
                    .spawn(move || (1..=25).for_each(|number| bars.trained(agent, 1, number, 0.5)));
            }
            bars.step(512, 40_000);
        });
        assert_eq!(bars.epochs.position(), 100);
        assert_eq!((bars.steps.position(), bars.steps.length()), (512, Some(40_000)));
    }

    #[test]
    fn endless_run_has_no_length() {
        let mut bars = ProgressBars::hidden();
        bars.endless = true;
        bars.step(512, 1 << 40);
        assert_eq!((bars.steps.position(), bars.steps.length()), (512, Some(0)));
    }
}
