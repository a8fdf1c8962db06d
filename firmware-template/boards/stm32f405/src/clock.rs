//! The clocks: the oscillator that everything runs from, and the timer that counts periods.

use firmware_template::{Clock, Periods};
use hal::pac::{RCC, TIM2, interrupt};
use hal::prelude::*;
use hal::rcc::{Config, Enable, Rcc, Reset};
use hal::watchdog::IndependentWatchdog;
use stm32f4xx_hal as hal;

/// Frequency of the board's crystal. \[MHz\]
const CRYSTAL: u32 = 12;
/// How often the processor wakes if there is nothing to sample. \[1/s\]
const HEARTBEATS: u32 = 10;
/// How often a ready bit is looked at before it is given up: at 16 MHz and at least 6 cycles a look,
/// over 37 ms. A crystal starts within 2 ms, the PLL locks within 0.3 ms (DS8626, HSE oscillator and
/// main PLL characteristics).
const LOOKS: u32 = 100_000;

/// Starts the crystal and runs everything from it: 168 MHz, buses at 42 and 84 MHz. The HAL waits for
/// the crystal and for the PLL without an end, so both are tried out here first.
///
/// If one of them does not start, the chip goes on at the 16 MHz of its internal oscillator, which is
/// off by 1 % at 25 degrees C and by up to 8 % over its range (DS8626, HSI oscillator): the node works,
/// its periods are that much wrong, and the second value is false.
pub(crate) fn start(rcc: RCC) -> (Rcc, bool) {
    let is_ready = crystal_and_pll_start(&rcc);
    let clocks = if is_ready {
        Config::hse(CRYSTAL.MHz()).sysclk(168.MHz()).pclk1(42.MHz()).pclk2(84.MHz())
    } else {
        Config::hsi()
    };
    (rcc.freeze(clocks), is_ready)
}

/// Whether the crystal starts and the PLL locks on to it. The PLL is off again afterwards, as the HAL
/// expects it; the crystal stays on.
fn crystal_and_pll_start(rcc: &RCC) -> bool {
    rcc.cr().modify(|_, w| w.hseon().set_bit());
    if !(0..LOOKS).any(|_| rcc.cr().read().hserdy().bit_is_set()) {
        rcc.cr().modify(|_, w| w.hseon().clear_bit());
        return false;
    }
    // 1 MHz into the PLL, 168 times that halved twice over: the least that it may be asked for.
    // SAFETY: the values are within what RM0090, 6.3.2, allows.
    rcc.pllcfgr().modify(|_, w| unsafe {
        w.pllsrc().hse().pllm().bits(CRYSTAL as u8).plln().bits(168).pllp().div4()
    });
    rcc.cr().modify(|_, w| w.pllon().set_bit());
    let locked = (0..LOOKS).any(|_| rcc.cr().read().pllrdy().bit_is_set());
    rcc.cr().modify(|_, w| w.pllon().clear_bit());
    // It takes some cycles to be off; its settings cannot be changed before.
    locked && (0..LOOKS).any(|_| rcc.cr().read().pllrdy().bit_is_clear())
}

/// TIM2, a counter of 32 bits, and the watchdog that is fed with it.
pub(crate) struct Timer {
    timer: TIM2,
    /// \[Hz\]
    frequency: f32,
    watchdog: IndependentWatchdog,
    periods: Periods,
}

impl Timer {
    /// Lets the counter run.
    pub(crate) fn new(timer: TIM2, rcc: &mut Rcc, watchdog: IndependentWatchdog) -> Self {
        TIM2::enable(rcc);
        TIM2::reset(rcc);
        let ticks = rcc.clocks.timclk1().raw();
        // SAFETY: every value is one that this register takes.
        timer.arr().write(|w| unsafe { w.bits(u32::MAX) });
        timer.dier().write(|w| w.cc1ie().set_bit());
        timer.cr1().write(|w| w.cen().set_bit());
        let periods = Periods::new(ticks / HEARTBEATS);
        Self { timer, frequency: ticks as f32, watchdog, periods }
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
        self.watchdog.feed();
        let now = self.now();
        self.periods.elapsed(now)
    }

    /// An interrupt that comes before the instruction sets the event that it waits for, so none
    /// is slept through.
    fn rest(&mut self) {
        // SAFETY: every value is one that this register takes.
        self.timer.ccr1().write(|w| unsafe { w.bits(self.periods.next()) });
        // What comes before the register is set does not wake.
        if !self.periods.is_due(self.now()) {
            cortex_m::asm::wfe();
        }
    }
}

#[interrupt]
fn TIM2() {
    /// `CC1IF` of the status register.
    const COMPARE_1: u32 = 1 << 1;
    // SAFETY: only this touches the status register, whose bits are cleared by 0 and ignore 1.
    unsafe { TIM2::steal().sr().write(|w| w.bits(!COMPARE_1)) };
}
