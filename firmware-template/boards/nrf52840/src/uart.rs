//! The service port: its interrupt fills and empties the queues.

use firmware_template::QueuedEnd;
use firmware_template::on_chip::Shared;
use nrf52840_hal::pac::{UART0, interrupt};

pub(crate) static SERVICE: Shared<Uart> = Shared::new();

/// The interrupt's part of the service port. Uses the plain UART rather than the one with DMA: its
/// receiver buffers six bytes and signals every byte, instead of only a full buffer.
pub(crate) struct Uart {
    uart: UART0,
    end: QueuedEnd<'static>,
    sending: bool,
}

impl Uart {
    pub(crate) fn new(uart: UART0, transmit: u32, receive: u32, end: QueuedEnd<'static>) -> Self {
        // SAFETY: the pins exist on this chip, and the peripheral is not enabled yet.
        unsafe {
            uart.psel.txd.write(|w| w.bits(transmit));
            uart.psel.rxd.write(|w| w.bits(receive));
        }
        uart.baudrate.write(|w| w.baudrate().baud115200());
        uart.enable.write(|w| w.enable().enabled());
        uart.intenset.write(|w| w.rxdrdy().set().txdrdy().set());
        uart.tasks_startrx.write(|w| w.tasks_startrx().set_bit());
        uart.tasks_starttx.write(|w| w.tasks_starttx().set_bit());
        Self { uart, end, sending: false }
    }

    fn serve(&mut self) {
        while self.uart.events_rxdrdy.read().events_rxdrdy().bit_is_set() {
            self.uart.events_rxdrdy.reset();
            self.end.put(self.uart.rxd.read().rxd().bits());
        }
        if self.uart.events_txdrdy.read().events_txdrdy().bit_is_set() {
            self.uart.events_txdrdy.reset();
            self.sending = false;
        }
        if !self.sending
            && let Some(byte) = self.end.take()
        {
            self.sending = true;
            // SAFETY: every value is valid for this register.
            self.uart.txd.write(|w| unsafe { w.txd().bits(byte) });
        }
    }
}

#[interrupt]
fn UARTE0_UART0() {
    SERVICE.with(Uart::serve);
}
