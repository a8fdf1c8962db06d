//! The serial ports: their interrupts fill and empty the queues. The HAL sets them up; afterwards
//! only their registers are needed.

use core::ops::Deref;

use firmware_template::QueuedEnd;
use firmware_template::on_chip::Shared;
use hal::pac::{UART0, UART1, interrupt, uart0};
use rp2040_hal as hal;

pub(crate) static SERVICE: Shared<Uart<UART0>> = Shared::new();
pub(crate) static LINK: Shared<Uart<UART1>> = Shared::new();

/// The interrupt's part of a serial port.
pub(crate) struct Uart<U> {
    registers: U,
    end: QueuedEnd<'static>,
}

impl<U: Deref<Target = uart0::RegisterBlock>> Uart<U> {
    /// The error flags of a received byte: framing, parity, break, overrun.
    const ERRORS: u16 = 0b1111 << 8;

    /// Enables the interrupts of a configured port: when bytes have arrived, even fewer than the
    /// FIFO threshold, and when there is space to send.
    pub(crate) fn new(registers: U, end: QueuedEnd<'static>) -> Self {
        registers.uartimsc().write(|w| w.rxim().set_bit().rtim().set_bit().txim().set_bit());
        Self { registers, end }
    }

    fn serve(&mut self) {
        let registers = &self.registers;
        // Cleared before the FIFO is filled, so that its next emptying is not missed.
        registers.uarticr().write(|w| w.txic().clear_bit_by_one());
        while registers.uartfr().read().rxfe().bit_is_clear() {
            let received = registers.uartdr().read().bits() as u16;
            if received & Self::ERRORS == 0 {
                self.end.put(received as u8);
            }
        }
        while registers.uartfr().read().txff().bit_is_clear() {
            let Some(byte) = self.end.take() else { break };
            // SAFETY: every value is valid for this register.
            registers.uartdr().write(|w| unsafe { w.data().bits(byte) });
        }
    }
}

/// Number of looks at the link while it sends: at 125 MHz and at least 15 cycles each 36 ms, longer than
/// a full queue takes.
const LOOKS: u32 = 300_000;

/// Waits until the link has sent everything: interrupts do not run while flash is erased.
pub(crate) fn wait_until_sent() {
    for _ in 0..LOOKS {
        let is_sending = |uart: &mut Uart<UART1>| {
            !uart.end.is_empty() || uart.registers.uartfr().read().busy().bit_is_set()
        };
        if LINK.with(is_sending) != Some(true) {
            break;
        }
    }
}

#[interrupt]
fn UART0_IRQ() {
    SERVICE.with(Uart::serve);
}

#[interrupt]
fn UART1_IRQ() {
    LINK.with(Uart::serve);
}
