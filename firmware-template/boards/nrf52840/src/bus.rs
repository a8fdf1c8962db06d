//! The I2C bus with timeouts. The HAL waits indefinitely for the end of a transfer: a device that holds
//! a line would stop the node until the watchdog resets the chip, and still hold the line afterwards.
//! Here every wait ends. After an error that a held line can cause, and once at the start, a device that
//! holds the data line is clocked until it lets go (nRF52840 product specification, 6.31 and 6.9).

use core::convert::Infallible;
use core::sync::atomic::{Ordering, compiler_fence};

use embedded_hal::delay::DelayNs;
use embedded_hal::digital::{self, InputPin, OutputPin};
use embedded_hal::i2c::{
    Error, ErrorKind, ErrorType, I2c, NoAcknowledgeSource, Operation, SevenBitAddress,
};
use firmware_template::held_bus::free_bus;
use hal::gpio::Disconnected;
use hal::gpio::p0::{P0_26, P0_27};
use hal::pac::{P0, TWIM0, p0};
use nrf52840_hal as hal;

/// Longest write, and longest read: a register's number and 16 bits. \[byte\]
const LENGTH: usize = 4;

/// TWIM0 on P0.26 and P0.27.
pub(crate) struct Bus {
    registers: TWIM0,
    /// What the peripheral reads and writes by itself: not on a stack that may be used otherwise by then.
    sent: [u8; LENGTH],
    received: [u8; LENGTH],
}

/// Why a transfer ended early.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum BusError {
    /// It did not end in time.
    Timeout,
    /// No device acknowledged.
    NoAcknowledge,
    /// More or fewer bytes than there should be.
    Length,
    /// A transfer other than a write, a read, or a write and then a read, of a few bytes.
    Unsupported,
}

impl Error for BusError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Timeout | Self::Unsupported => ErrorKind::Other,
            Self::NoAcknowledge => ErrorKind::NoAcknowledge(NoAcknowledgeSource::Unknown),
            Self::Length => ErrorKind::Overrun,
        }
    }
}

impl Bus {
    /// Number of times an event is polled: at 64 MHz and at least 8 cycles per poll more than 2 ms, ten
    /// times as long as the longest transfer takes.
    const LOOKS: u32 = 20_000;

    /// The bits of ERRORSRC for an address and for data without an acknowledgement, and all of them.
    const NOT_ACKNOWLEDGED: u32 = 0b110;
    const ERRORS: u32 = 0b111;

    /// Frees the lines and sets the peripheral up.
    pub(crate) fn new(
        registers: TWIM0,
        _data: P0_26<Disconnected>,
        _clock: P0_27<Disconnected>,
    ) -> Self {
        CLOCK.set_up();
        DATA.set_up();
        // SAFETY: the pins' numbers, on port 0; the highest bit, which disconnects, is clear.
        unsafe {
            registers.psel.scl.write(|w| w.bits(CLOCK.0));
            registers.psel.sda.write(|w| w.bits(DATA.0));
        }
        registers.frequency.write(|w| w.frequency().k400());
        let mut bus = Self { registers, sent: [0; LENGTH], received: [0; LENGTH] };
        bus.recover();
        bus
    }

    /// Takes the lines from the peripheral, which ends its transfer, frees them, and gives them back.
    fn recover(&mut self) {
        self.registers.enable.write(|w| w.enable().disabled());
        let (mut clock, mut data) = (CLOCK, DATA);
        let Ok(_is_free) = free_bus(&mut clock, &mut data, &mut Spin);
        self.registers.enable.write(|w| w.enable().enabled());
    }

    /// Sends the first `sent` bytes and receives `received` bytes, without a stop in between.
    fn transfer(&mut self, address: u8, sent: usize, received: usize) -> Result<(), BusError> {
        let registers = &self.registers;
        registers.events_stopped.reset();
        registers.events_error.reset();
        // SAFETY: an address of seven bits; ones clear the errors; both buffers are in RAM, as long as the
        // counts say or longer, and stay where they are until the transfer has ended or the peripheral is
        // disabled; 1 starts a task.
        unsafe {
            registers.errorsrc.write(|w| w.bits(Self::ERRORS));
            registers.address.write(|w| w.address().bits(address));
            registers.txd.ptr.write(|w| w.bits(self.sent.as_ptr() as u32));
            registers.txd.maxcnt.write(|w| w.bits(sent as u32));
            registers.rxd.ptr.write(|w| w.bits(self.received.as_mut_ptr() as u32));
            registers.rxd.maxcnt.write(|w| w.bits(received as u32));
            registers.shorts.write(|w| match (sent, received) {
                (_, 0) => w.lasttx_stop().enabled(),
                _ => w.lasttx_startrx().enabled().lastrx_stop().enabled(),
            });
            compiler_fence(Ordering::SeqCst);
            if sent > 0 {
                registers.tasks_starttx.write(|w| w.bits(1));
            } else {
                registers.tasks_startrx.write(|w| w.bits(1));
            }
        }
        let outcome = self.wait();
        compiler_fence(Ordering::SeqCst);
        outcome?;
        let errors = self.registers.errorsrc.read().bits();
        if errors & Self::NOT_ACKNOWLEDGED != 0 {
            return Err(BusError::NoAcknowledge);
        }
        let registers = &self.registers;
        let amounts = [registers.txd.amount.read().bits(), registers.rxd.amount.read().bits()];
        if errors != 0 || (sent > 0 && amounts[0] != sent as u32) {
            return Err(BusError::Length);
        }
        if received > 0 && amounts[1] != received as u32 {
            return Err(BusError::Length);
        }
        Ok(())
    }

    /// Waits for the end of the transfer, which an error does not end by itself.
    fn wait(&mut self) -> Result<(), BusError> {
        for _ in 0..Self::LOOKS {
            if self.registers.events_stopped.read().bits() != 0 {
                return Ok(());
            }
            if self.registers.events_error.read().bits() != 0 {
                self.registers.events_error.reset();
                // SAFETY: 1 starts the task.
                self.registers.tasks_stop.write(|w| unsafe { w.bits(1) });
            }
        }
        Err(BusError::Timeout)
    }

    fn operate(&mut self, address: u8, operations: &mut [Operation<'_>]) -> Result<(), BusError> {
        let (written, read): (&[u8], &mut [u8]) = match operations {
            [Operation::Write(written)] => (written, &mut []),
            [Operation::Read(read)] => (&[], read),
            [Operation::Write(written), Operation::Read(read)] => (written, read),
            _ => return Err(BusError::Unsupported),
        };
        let (sent, received) = (written.len(), read.len());
        if sent.max(received) > LENGTH || sent.max(received) == 0 {
            return Err(BusError::Unsupported);
        }
        self.sent.iter_mut().zip(written).for_each(|(place, byte)| *place = *byte);
        self.transfer(address, sent, received)?;
        // SAFETY: a place of this program's own, which the peripheral has written to.
        let bytes = unsafe { (&raw const self.received).read_volatile() };
        read.iter_mut().zip(bytes).for_each(|(place, byte)| *place = byte);
        Ok(())
    }
}

/// A pin of port 0. Its output is low and enabled while the line is pulled, so it is open-drain.
struct Line(u32);

const DATA: Line = Line(26);
const CLOCK: Line = Line(27);

impl Line {
    fn port() -> &'static p0::RegisterBlock {
        // SAFETY: the port's address. Only this bus uses the two pins, and the registers that other pins
        // share ignore zeros.
        unsafe { &*P0::ptr() }
    }

    /// Configures the pin as the peripheral needs it: an input that only pulls low, with a pull-up.
    fn set_up(&self) {
        let port = Self::port();
        // SAFETY: zeros change nothing.
        port.outclr.write(|w| unsafe { w.bits(1 << self.0) });
        if let Some(pin) = port.pin_cnf.get(self.0 as usize) {
            pin.write(|w| {
                w.dir().input().input().connect().pull().pullup().drive().s0d1().sense().disabled()
            });
        }
    }
}

impl digital::ErrorType for Line {
    type Error = Infallible;
}

impl OutputPin for Line {
    fn set_low(&mut self) -> Result<(), Infallible> {
        // SAFETY: zeros change nothing.
        Self::port().dirset.write(|w| unsafe { w.bits(1 << self.0) });
        Ok(())
    }

    fn set_high(&mut self) -> Result<(), Infallible> {
        // SAFETY: as above.
        Self::port().dirclr.write(|w| unsafe { w.bits(1 << self.0) });
        Ok(())
    }
}

impl InputPin for Line {
    fn is_high(&mut self) -> Result<bool, Infallible> {
        Ok(Self::port().in_.read().bits() & 1 << self.0 != 0)
    }

    fn is_low(&mut self) -> Result<bool, Infallible> {
        self.is_high().map(|is_high| !is_high)
    }
}

/// Waits by counting cycles at 64 MHz.
struct Spin;

impl DelayNs for Spin {
    fn delay_ns(&mut self, time: u32) {
        cortex_m::asm::delay(time.saturating_mul(64) / 1_000 + 1);
    }
}

impl ErrorType for Bus {
    type Error = BusError;
}

impl I2c<SevenBitAddress> for Bus {
    /// A write, a read, or a write and then a read, of at most four bytes.
    fn transaction(
        &mut self,
        address: SevenBitAddress,
        operations: &mut [Operation<'_>],
    ) -> Result<(), BusError> {
        let outcome = self.operate(address, operations);
        if outcome == Err(BusError::Timeout) {
            self.recover();
        }
        outcome
    }
}
