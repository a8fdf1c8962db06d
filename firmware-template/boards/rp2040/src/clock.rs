//! The period timer, and the watchdog that is fed with it.

use firmware_template::{Clock, Periods};
use hal::Watchdog;
use hal::pac::{TIMER, interrupt};
use rp2040_hal as hal;

/// Frequency of the timer. \[Hz\]
const TIMER_FREQUENCY: f32 = 1e6;
/// Wake-up interval of the processor when there is nothing to sample: 0.1 s. \[tick\]
const HEARTBEAT: u32 = 100_000;

/// The lower half of the timer, a 32-bit counter, and its first alarm.
pub(crate) struct Timer {
    watchdog: Watchdog,
    periods: Periods,
}

impl Timer {
    /// Creates the timer, which the HAL has started.
    pub(crate) fn new(_: hal::Timer, watchdog: Watchdog) -> Self {
        registers().inte().write(|w| w.alarm_0().set_bit());
        Self { watchdog, periods: Periods::new(HEARTBEAT) }
    }

    fn now(&self) -> u32 {
        registers().timerawl().read().bits()
    }
}

/// The timer's registers, each with a single user: the HAL uses none, the interrupt one bit of its
/// own.
fn registers() -> &'static hal::pac::timer::RegisterBlock {
    // SAFETY: this is the timer's address.
    unsafe { &*TIMER::ptr() }
}

impl Clock for Timer {
    fn start(&mut self, period: f32) {
        let now = self.now();
        self.periods.start(period, TIMER_FREQUENCY, now);
    }

    fn elapsed(&mut self) -> u32 {
        let now = self.now();
        if self.periods.nothing_is_due(now) {
            self.done();
        }
        self.periods.elapsed(now)
    }

    fn done(&mut self) {
        self.watchdog.feed();
    }

    /// An interrupt that arrives before the wait instruction sets the event that it waits for, so
    /// none is missed.
    fn rest(&mut self) {
        // SAFETY: every value is valid for this register.
        registers().alarm0().write(|w| unsafe { w.bits(self.periods.next()) });
        // A time before the register is set does not wake the processor.
        if !self.periods.is_due(self.now()) {
            cortex_m::asm::wfe();
        }
    }
}

#[interrupt]
fn TIMER_IRQ_0() {
    registers().intr().write(|w| w.alarm_0().clear_bit_by_one());
}
