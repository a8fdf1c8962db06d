//! The clocks: the system oscillator, and the period timer.

use firmware_template::{Clock, Periods};
use hal::pac::{RCC, TIM2, interrupt};
use hal::prelude::*;
use hal::rcc::{Config, Enable, Rcc, Reset};
use hal::watchdog::IndependentWatchdog;
use stm32f4xx_hal as hal;

/// Frequency of the board's crystal. \[MHz\]
const CRYSTAL: u32 = 12;
/// Wake-up rate of the processor when there is nothing to sample. \[1/s\]
const HEARTBEATS: u32 = 10;
/// Number of times a ready bit is polled before giving up: at 16 MHz and at least 6 cycles per
/// poll, over 37 ms. A crystal starts within 2 ms, the PLL locks within 0.3 ms (DS8626, HSE
/// oscillator and main PLL characteristics).
const LOOKS: u32 = 100_000;

/// Starts the crystal and runs everything from it: 168 MHz, buses at 42 and 84 MHz. The HAL waits
/// indefinitely for the crystal and the PLL, so both are tested here first.
///
/// If one of them does not start, the chip continues at the 16 MHz of its internal oscillator,
/// which is off by 1 % at 25 degrees C and by up to 8 % over its range (DS8626, HSI oscillator):
/// the node works, its periods are off by the same amount, and the second value is false.
pub(crate) fn start(rcc: RCC) -> (Rcc, bool) {
    let is_ready = crystal_and_pll_start(&rcc);
    let clocks = if is_ready {
        Config::hse(CRYSTAL.MHz()).sysclk(168.MHz()).pclk1(42.MHz()).pclk2(84.MHz())
    } else {
        Config::hsi()
    };
    (rcc.freeze(clocks), is_ready)
}

/// Returns whether the crystal starts and the PLL locks. The PLL is off again afterwards, as the
/// HAL expects; the crystal stays on.
fn crystal_and_pll_start(rcc: &RCC) -> bool {
    rcc.cr().modify(|_, w| w.hseon().set_bit());
    if !(0..LOOKS).any(|_| rcc.cr().read().hserdy().bit_is_set()) {
        rcc.cr().modify(|_, w| w.hseon().clear_bit());
        return false;
    }
    // 1 MHz into the PLL, multiplied by 168 and divided by 4: the lowest permitted setting.
    // SAFETY: the values are in the ranges of RM0090, 6.3.2.
    rcc.pllcfgr().modify(|_, w| unsafe {
        w.pllsrc().hse().pllm().bits(CRYSTAL as u8).plln().bits(168).pllp().div4()
    });
    rcc.cr().modify(|_, w| w.pllon().set_bit());
    let locked = (0..LOOKS).any(|_| rcc.cr().read().pllrdy().bit_is_set());
    rcc.cr().modify(|_, w| w.pllon().clear_bit());
    // The PLL takes some cycles to stop; until then its settings cannot be changed.
    locked && (0..LOOKS).any(|_| rcc.cr().read().pllrdy().bit_is_clear())
}

/// TIM2, a 32-bit counter, and the watchdog that is fed with it.
pub(crate) struct Timer {
    timer: TIM2,
    /// \[Hz\]
    frequency: f32,
    watchdog: IndependentWatchdog,
    periods: Periods,
}

impl Timer {
    /// Starts the counter.
    pub(crate) fn new(timer: TIM2, rcc: &mut Rcc, watchdog: IndependentWatchdog) -> Self {
        TIM2::enable(rcc);
        TIM2::reset(rcc);
        let ticks = rcc.clocks.timclk1().raw();
        // SAFETY: every value is valid for this register.
        timer.arr().write(|w| unsafe { w.bits(u32::MAX) });
        timer.dier().write(|w| w.cc1ie().set_bit());
        timer.cr1().write(|w| w.cen().set_bit());
        let periods = Periods::new(ticks / HEARTBEATS);
        Self { timer, frequency: ticks as f32, watchdog, periods }
    }

    /// Returns the time until the next period begins. \[us\]
    #[cfg(feature = "embassy")]
    pub(crate) fn until_next(&self) -> u64 {
        let now = self.now();
        if self.periods.is_due(now) {
            return 0;
        }
        let ticks = self.periods.next().wrapping_sub(now);
        u64::from(ticks) * 1_000_000 / (self.frequency as u64)
    }

    fn now(&self) -> u32 {
        self.timer.cnt().read().bits()
    }
}

impl Clock for Timer {
    fn start(&mut self, period: f32) {
        let now = self.now();
        self.periods.start(period, self.frequency, now);
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
        self.timer.ccr1().write(|w| unsafe { w.bits(self.periods.next()) });
        // A time before the register is set does not wake the processor.
        if !self.periods.is_due(self.now()) {
            cortex_m::asm::wfe();
        }
    }
}

#[interrupt]
fn TIM2() {
    /// `CC1IF` of the status register.
    const COMPARE_1: u32 = 1 << 1;
    // SAFETY: only this handler accesses the status register, whose bits are cleared by 0 and
    // ignore 1.
    unsafe { TIM2::steal().sr().write(|w| w.bits(!COMPARE_1)) };
}
