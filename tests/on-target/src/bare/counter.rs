//! Counts instructions with a clock that an emulator derives from them.
//!
//! `qemu-system-* -icount shift=6` advances virtual time by 64 ns per instruction, and every clock
//! on the board follows. The number of ticks differs between clocks, so the counter times two loops
//! of known length: their difference gives the ticks per instruction, independently of the
//! overhead. A third loop must be predicted correctly, or the counter is not used. On a chip, where
//! an instruction takes one clock cycle or more, the third loop fails.

use core::hint::black_box;
use core::sync::atomic::{Ordering, compiler_fence};

use on_target::Meter;

/// A clock whose ticks are approximately a multiple of instructions.
pub(super) trait Clock {
    /// Returns the time, in ticks modulo the clock's range.
    fn now(&self) -> u32;
    /// Returns the ticks between two times.
    fn between(start: u32, end: u32) -> u32;
    /// Runs a loop of exactly two instructions `iterations` times, at least once.
    fn spin(iterations: u32);
}

/// Iterations of the timed loops, and of the predicted one.
const SHORT: u32 = 1_000;
const LONG: u32 = 501_000;
const PROOF: u32 = 3_333;

/// Instructions of one iteration.
const ITERATION: u32 = 2;

/// Tolerance of the prediction: the ends of an interval fall between ticks. \[instructions\]
const TOLERANCE: u32 = 2;

pub(super) struct Counter<C> {
    clock: C,
    /// Ticks of an empty measurement.
    overhead: u32,
    /// Ticks for [`Self::INSTRUCTIONS`].
    ticks: u32,
    /// Start of the measurement.
    started: u32,
}

impl<C: Clock> Counter<C> {
    const INSTRUCTIONS: u32 = (LONG - SHORT) * ITERATION;

    /// Creates a counter with `clock`; `None` if that does not count instructions.
    pub(super) fn calibrated(clock: C) -> Option<Self> {
        let mut counter = Self { clock, overhead: 0, ticks: Self::INSTRUCTIONS, started: 0 };
        counter.overhead = counter.time(|| ()).1;
        let ((), long) = counter.time(|| C::spin(LONG));
        let ((), short) = counter.time(|| C::spin(SHORT));
        counter.ticks = long.checked_sub(short).filter(|&ticks| ticks > 0)?;
        let ((), short) = counter.count(|| C::spin(SHORT));
        let ((), longer) = counter.count(|| C::spin(SHORT + PROOF));
        let found = longer.checked_sub(short)?;
        (found.abs_diff(PROOF * ITERATION) <= TOLERANCE).then_some(counter)
    }

    fn time<R>(&mut self, work: impl FnOnce() -> R) -> (R, u32) {
        let start = self.clock.now();
        compiler_fence(Ordering::SeqCst);
        let result = work();
        compiler_fence(Ordering::SeqCst);
        (result, C::between(start, self.clock.now()).saturating_sub(self.overhead))
    }

    fn instructions(&self, ticks: u32) -> u32 {
        let scaled = u64::from(ticks) * u64::from(Self::INSTRUCTIONS);
        let ticks = u64::from(self.ticks);
        let instructions = (scaled + ticks / 2).checked_div(ticks).unwrap_or(0);
        // The black box keeps the division out of the next interval.
        black_box(instructions as u32)
    }
}

impl<C: Clock> Meter for Counter<C> {
    fn count<R>(&mut self, work: impl FnOnce() -> R) -> (R, u32) {
        let (result, ticks) = self.time(work);
        (result, self.instructions(ticks))
    }

    fn start(&mut self) {
        self.started = self.clock.now();
        compiler_fence(Ordering::SeqCst);
    }

    fn stop(&mut self) -> u32 {
        compiler_fence(Ordering::SeqCst);
        let ticks = C::between(self.started, self.clock.now());
        self.instructions(ticks.saturating_sub(self.overhead))
    }
}
