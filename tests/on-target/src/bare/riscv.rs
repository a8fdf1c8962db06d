//! RISC-V: the runtime's entry, and the cycle counter as the clock.

use riscv::register::mcycle;

use super::counter::Clock;

pub(super) struct CycleCounter;

#[riscv_rt::entry]
fn start() -> ! {
    super::run()
}

/// Returns the clock, which runs from reset on.
#[allow(clippy::unnecessary_wraps)] // another board's clock can be missing
pub(super) fn clock() -> Option<CycleCounter> {
    Some(CycleCounter)
}

impl Clock for CycleCounter {
    // Not inlined: an emulator counts wrongly where it first accesses a device.
    #[inline(never)]
    fn now(&self) -> u32 {
        mcycle::read() as u32
    }

    fn between(start: u32, end: u32) -> u32 {
        end.wrapping_sub(start)
    }

    #[inline(never)]
    #[allow(unsafe_code)]
    fn spin(iterations: u32) {
        // SAFETY: counts a register down to zero and accesses nothing else.
        unsafe {
            core::arch::asm!(
                "2: addi {left}, {left}, -1",
                "bnez {left}, 2b",
                left = inout(reg) iterations => _,
                options(nomem, nostack),
            );
        }
    }
}
