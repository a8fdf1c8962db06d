//! The period timer, and the watchdog.

use firmware_template::{Clock, Periods};
use nrf52840_hal as hal;

use hal::pac::{self, TIMER1, interrupt};
use hal::wdt::{Watchdog, WatchdogHandle, count, handles};

/// Frequency of TIMER1. \[Hz\]
const TIMER_FREQUENCY: f32 = 16e6;
/// Wake-up interval of the processor when there is nothing to sample: 0.1 s. \[tick\]
const HEARTBEAT: u32 = 1_600_000;
/// 8 s, far above the 0.6 s needed to erase the pages of a slot. \[1/32768 s\]
const WATCHDOG_PERIOD: u32 = 8 * 32_768;

/// Starts the watchdog, or recovers one that survived a reset.
pub(crate) fn watchdog(wdt: pac::WDT) -> Option<WatchdogHandle<handles::Hdl0>> {
    let parts = match Watchdog::try_new(wdt) {
        Ok(mut watchdog) => {
            watchdog.set_lfosc_ticks(WATCHDOG_PERIOD);
            watchdog.run_during_sleep(true);
            Some(watchdog.activate::<count::One>())
        }
        Err(wdt) => Watchdog::try_recover::<count::One>(wdt).ok(),
    };
    let (mut handle,) = parts?.handles;
    handle.pet();
    Some(handle)
}

/// TIMER1, a 32-bit counter, and the watchdog that is fed with it.
pub(crate) struct Timer {
    timer: TIMER1,
    watchdog: Option<WatchdogHandle<handles::Hdl0>>,
    periods: Periods,
}

impl Timer {
    /// Starts the counter.
    pub(crate) fn new(timer: TIMER1, watchdog: Option<WatchdogHandle<handles::Hdl0>>) -> Self {
        timer.bitmode.write(|w| w.bitmode()._32bit());
        // SAFETY: 16 MHz, without prescaling.
        timer.prescaler.write(|w| unsafe { w.prescaler().bits(0) });
        timer.intenset.write(|w| w.compare0().set());
        timer.tasks_start.write(|w| w.tasks_start().set_bit());
        Self { timer, watchdog, periods: Periods::new(HEARTBEAT) }
    }

    fn now(&self) -> u32 {
        self.timer.tasks_capture[1].write(|w| w.tasks_capture().set_bit());
        self.timer.cc[1].read().bits()
    }
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
        if let Some(watchdog) = &mut self.watchdog {
            watchdog.pet();
        }
    }

    /// An interrupt that arrives before the wait instruction sets the event that it waits for, so
    /// none is missed.
    fn rest(&mut self) {
        // SAFETY: every value is valid for this register.
        self.timer.cc[0].write(|w| unsafe { w.bits(self.periods.next()) });
        // A time before the register is set does not wake the processor.
        if !self.periods.is_due(self.now()) {
            cortex_m::asm::wfe();
        }
    }
}

#[interrupt]
fn TIMER1() {
    // SAFETY: only this handler accesses the event, and `Timer` does not depend on it.
    let timer = unsafe { &*TIMER1::ptr() };
    timer.events_compare[0].reset();
    // The bus write is delayed, and the interrupt would fire again.
    let _ = timer.events_compare[0].read();
}
