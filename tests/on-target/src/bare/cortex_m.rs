//! Cortex-M: the runtime's entry, and SysTick as the clock.

use cortex_m::peripheral::SYST;
use cortex_m::peripheral::syst::SystClkSource;

use super::counter::Clock;

/// SysTick counts down 24 bits.
const RANGE: u32 = 1 << 24;

pub(super) struct SysTick;

#[cortex_m_rt::entry]
fn start() -> ! {
    super::run()
}

/// Returns the clock, once.
pub(super) fn clock() -> Option<SysTick> {
    let mut peripherals = cortex_m::Peripherals::take()?;
    peripherals.SYST.set_clock_source(SystClkSource::Core);
    peripherals.SYST.set_reload(RANGE - 1);
    peripherals.SYST.clear_current();
    peripherals.SYST.enable_counter();
    Some(SysTick)
}

impl Clock for SysTick {
    // Not inlined: an emulator counts wrongly where it first accesses a device.
    #[inline(never)]
    fn now(&self) -> u32 {
        SYST::get_current()
    }

    fn between(start: u32, end: u32) -> u32 {
        start.wrapping_sub(end) % RANGE
    }

    #[inline(never)]
    #[allow(unsafe_code)]
    fn spin(iterations: u32) {
        // SAFETY: counts a register down to zero and accesses nothing else.
        unsafe {
            core::arch::asm!(
                "2: subs {left}, {left}, #1",
                "bne 2b",
                left = inout(reg) iterations => _,
                options(nomem, nostack),
            );
        }
    }
}
