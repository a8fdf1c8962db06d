//! The period timer, and the watchdog.

use firmware_template::{Clock, Periods};
use nrf52840_hal as hal;

use hal::pac::{self, RTC1, interrupt};
use hal::wdt::{Watchdog, WatchdogHandle, count, handles};

/// Frequency of the counter. \[Hz\]
const RTC_FREQUENCY: f32 = 32_768.0;
/// The counter has 24 bits. Periods are counted in fractions of its tick, so that theirs need not be a multiple of it.
const FRACTION_BITS: u32 = 8;
const COUNTER_MASK: u32 = (1 << 24) - 1;
/// The nearest tick from now at which a comparison is certain to be noticed (product specification,
/// RTC, compare).
const NEAREST: u32 = 2;
/// Wake-up interval of the processor when there is nothing to sample: 0.1 s. \[tick/256\]
const HEARTBEAT: u32 = (32_768 << FRACTION_BITS) / 10;
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

/// Lets the 32.768 kHz crystal drive the counter and the watchdog.
///
/// Until it oscillates, or if it never does, they run on the RC oscillator, which is less accurate.
pub(crate) fn select_crystal(clock: &pac::CLOCK) {
    clock.lfclksrc.write(|w| w.src().xtal());
    clock.tasks_lfclkstart.write(|w| w.tasks_lfclkstart().set_bit());
}

/// RTC1, which counts while the processor sleeps with all fast clocks off, and the watchdog that is
/// fed with it.
pub(crate) struct Timer {
    counter: RTC1,
    watchdog: Option<WatchdogHandle<handles::Hdl0>>,
    periods: Periods,
}

impl Timer {
    /// Starts the counter.
    pub(crate) fn new(counter: RTC1, watchdog: Option<WatchdogHandle<handles::Hdl0>>) -> Self {
        // SAFETY: every value is valid for this register; 0 is no prescaling.
        counter.prescaler.write(|w| unsafe { w.bits(0) });
        counter.intenset.write(|w| w.compare0().set());
        counter.tasks_start.write(|w| w.tasks_start().set_bit());
        Self { counter, watchdog, periods: Periods::new(HEARTBEAT) }
    }

    fn ticks(&self) -> u32 {
        self.counter.counter.read().bits() & COUNTER_MASK
    }

    /// Wraps to 0 after 512 s, as the counter does.
    fn now(&self) -> u32 {
        self.ticks() << FRACTION_BITS
    }
}

impl Clock for Timer {
    fn start(&mut self, period: f32) {
        let now = self.now();
        self.periods.start(period, RTC_FREQUENCY * (1 << FRACTION_BITS) as f32, now);
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
        let fraction = (1 << FRACTION_BITS) - 1;
        let next = (self.periods.next().wrapping_add(fraction) >> FRACTION_BITS) & COUNTER_MASK;
        // SAFETY: every value of 24 bits is valid for this register.
        self.counter.cc[0].write(|w| unsafe { w.bits(next) });
        // A time before the register is set does not wake the processor, nor does the very next tick.
        let now = self.ticks();
        let is_ahead = next.wrapping_sub(now) & COUNTER_MASK >= NEAREST;
        if is_ahead && !self.periods.is_due(now << FRACTION_BITS) {
            cortex_m::asm::wfe();
        }
    }
}

#[interrupt]
fn RTC1() {
    // SAFETY: only this handler accesses the event, and `Timer` does not depend on it.
    let counter = unsafe { &*RTC1::ptr() };
    counter.events_compare[0].reset();
    // The bus write is delayed, and the interrupt would fire again.
    let _ = counter.events_compare[0].read();
}
