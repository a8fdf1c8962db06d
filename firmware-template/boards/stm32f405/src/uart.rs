//! The serial ports: their interrupts fill and empty the queues.

use firmware_template::QueuedEnd;
use firmware_template::on_chip::Shared;
use hal::gpio::{AnyPin, Output};
use hal::pac::{USART3, USART6, interrupt};
use hal::prelude::*;
use hal::serial::{self, Event, Flag, Instance, Serial};
use hal::{Listen, ReadFlags};
use stm32f4xx_hal as hal;

pub(crate) static SERVICE: Shared<Uart<USART3>> = Shared::new();
pub(crate) static LINK: Shared<Uart<USART6>> = Shared::new();

/// The interrupt's part of a serial port.
pub(crate) struct Uart<U: Instance> {
    serial: Serial<U>,
    end: QueuedEnd<'static>,
    /// Switches an RS-485 transceiver to sending.
    driver: Option<AnyPin<Output>>,
    /// Whether bytes are on their way, the last one included.
    is_sending: bool,
}

/// Number of looks at the link while it sends: at 168 MHz and at least 15 cycles each 25 ms, longer than
/// a full queue takes.
const LOOKS: u32 = 300_000;

/// Waits until the link has sent everything and let go of the line: interrupts do not run while flash is
/// erased.
pub(crate) fn wait_until_sent() {
    for _ in 0..LOOKS {
        if LINK.with(|uart| uart.is_sending || !uart.end.is_empty()) != Some(true) {
            break;
        }
    }
}

impl<U: Instance> Uart<U> {
    /// Hands the port to its interrupt, through `place`.
    pub(crate) fn begin(
        place: &Shared<Self>,
        serial: Result<Serial<U>, serial::config::InvalidConfig>,
        end: QueuedEnd<'static>,
        driver: Option<AnyPin<Output>>,
    ) {
        // The hardware supports the baud rates above.
        if let Ok(mut serial) = serial {
            serial.listen(Event::RxNotEmpty);
            place.set(Self { serial, end, driver, is_sending: false });
        }
    }

    fn serve(place: &Shared<Self>) {
        place.with(|uart| {
            uart.receive();
            uart.send();
        });
    }

    fn receive(&mut self) {
        loop {
            match self.serial.read() {
                Ok(byte) => self.end.put(byte),
                Err(hal::nb::Error::WouldBlock) => break,
                // The HAL has consumed the damaged byte and its error.
                Err(hal::nb::Error::Other(_)) => (),
            }
        }
    }

    /// Sends as many bytes as there is space for. QEMU always has space, and never interrupts.
    fn send(&mut self) {
        loop {
            let flags = self.serial.flags();
            if !flags.contains(Flag::TxEmpty) {
                return;
            }
            if let Some(byte) = self.end.take() {
                self.is_sending = true;
                if let Some(driver) = &mut self.driver {
                    driver.set_high();
                }
                // There is space, as the flag showed.
                let _ = self.serial.write(byte);
                self.serial.listen(Event::TxEmpty);
                continue;
            }
            if flags.contains(Flag::TransmissionComplete) {
                self.is_sending = false;
                self.serial.unlisten(Event::TxEmpty | Event::TransmissionComplete);
                if let Some(driver) = &mut self.driver {
                    driver.set_low();
                }
            } else {
                self.serial.unlisten(Event::TxEmpty);
                self.serial.listen(Event::TransmissionComplete);
            }
            return;
        }
    }
}

#[interrupt]
fn USART3() {
    Uart::serve(&SERVICE);
    #[cfg(feature = "embassy")]
    crate::tasks::SERVICE_INPUT.signal(());
}

#[interrupt]
fn USART6() {
    Uart::serve(&LINK);
}
