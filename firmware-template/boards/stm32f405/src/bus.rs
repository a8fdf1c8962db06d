//! The I2C bus with timeouts. The HAL, which sets up the bus, waits indefinitely for its flags; a
//! stuck bus would then stop the node, although it can run without a measurement. After an error, and
//! once at the start, a device that holds the data line is clocked until it lets go.

use core::convert::Infallible;

use embedded_hal::delay::DelayNs;
use embedded_hal::digital::{self, InputPin, OutputPin};
use embedded_hal::i2c::{
    Error, ErrorKind, ErrorType, I2c, NoAcknowledgeSource, Operation, SevenBitAddress,
};
use firmware_template::held_bus::free_bus;
use hal::i2c;
use hal::pac::i2c1::sr1;
use hal::pac::{GPIOB, I2C1, gpiob};
use stm32f4xx_hal as hal;

/// I2C1.
pub(crate) struct Bus {
    registers: I2C1,
}

/// Why a transfer ended early.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum BusError {
    /// A flag was not set in time.
    Timeout,
    /// No device acknowledged.
    NoAcknowledge,
    /// A misplaced start or stop condition, or another master.
    Bus,
}

impl Error for BusError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Timeout => ErrorKind::Other,
            Self::NoAcknowledge => ErrorKind::NoAcknowledge(NoAcknowledgeSource::Unknown),
            Self::Bus => ErrorKind::Bus,
        }
    }
}

impl Bus {
    /// Number of times a flag is polled: at 168 MHz and at least 8 cycles per poll almost 1 ms, 40
    /// times as long as a byte takes.
    const LOOKS: u32 = 20_000;

    /// Creates the bus from the one that the HAL has set up, and frees its lines: a reset in the middle of
    /// a transfer leaves them held.
    pub(crate) fn new(bus: i2c::I2c<I2C1>) -> Self {
        let (registers, _) = bus.release();
        let mut bus = Self { registers };
        bus.recover();
        bus
    }

    /// Waits for a flag.
    fn wait(&mut self, flag: impl Fn(&sr1::R) -> bool) -> Result<(), BusError> {
        for _ in 0..Self::LOOKS {
            let status = self.registers.sr1().read();
            if status.af().bit_is_set() {
                return Err(BusError::NoAcknowledge);
            }
            if status.berr().bit_is_set() || status.arlo().bit_is_set() {
                return Err(BusError::Bus);
            }
            if flag(&status) {
                return Ok(());
            }
        }
        Err(BusError::Timeout)
    }

    /// Addresses the device; if only a single byte is read, it must not be acknowledged, which is
    /// configured here.
    fn start(&mut self, address: u8, reads: bool, acknowledge: bool) -> Result<(), BusError> {
        self.registers.cr1().modify(|_, w| w.start().set_bit().ack().bit(acknowledge));
        self.wait(|status| status.sb().bit_is_set())?;
        self.send(address << 1 | u8::from(reads));
        self.wait(|status| status.addr().bit_is_set())?;
        // Reading both status registers clears the flag.
        let _ = self.registers.sr2().read();
        Ok(())
    }

    fn send(&mut self, byte: u8) {
        // SAFETY: every value is valid for this register.
        self.registers.dr().write(|w| unsafe { w.bits(byte.into()) });
    }

    fn write_bytes(&mut self, bytes: &[u8]) -> Result<(), BusError> {
        for &byte in bytes {
            self.wait(|status| status.tx_e().bit_is_set())?;
            self.send(byte);
        }
        self.wait(|status| status.btf().bit_is_set())
    }

    fn read_bytes(&mut self, buffer: &mut [u8]) -> Result<(), BusError> {
        let length = buffer.len();
        for (index, place) in buffer.iter_mut().enumerate() {
            if index + 1 == length {
                self.registers.cr1().modify(|_, w| w.ack().clear_bit().stop().set_bit());
            }
            self.wait(|status| status.rx_ne().bit_is_set())?;
            *place = self.registers.dr().read().bits() as u8;
        }
        Ok(())
    }

    fn stop(&mut self) {
        self.registers.cr1().modify(|_, w| w.stop().set_bit());
    }

    /// Frees the lines, and resets the peripheral, keeping its settings but aborting the transfer.
    fn recover(&mut self) {
        self.stop();
        // Outputs while they are clocked, and alternate functions again; they stay open-drain.
        CLOCK.set_mode(Line::OUTPUT);
        DATA.set_mode(Line::OUTPUT);
        let (mut clock, mut data) = (CLOCK, DATA);
        let Ok(_is_free) = free_bus(&mut clock, &mut data, &mut Spin);
        CLOCK.set_mode(Line::ALTERNATE);
        DATA.set_mode(Line::ALTERNATE);
        let registers = &self.registers;
        let (cr2, ccr, trise) = (
            registers.cr2().read().bits(),
            registers.ccr().read().bits(),
            registers.trise().read().bits(),
        );
        registers.cr1().modify(|_, w| w.swrst().set_bit());
        registers.cr1().reset();
        // SAFETY: the values were read from these registers.
        unsafe {
            registers.cr2().write(|w| w.bits(cr2));
            registers.ccr().write(|w| w.bits(ccr));
            registers.trise().write(|w| w.bits(trise));
        }
        registers.cr1().modify(|_, w| w.pe().set_bit());
    }

    fn operate(&mut self, address: u8, operations: &mut [Operation<'_>]) -> Result<(), BusError> {
        let mut stopped = true;
        for operation in operations {
            match operation {
                Operation::Write(bytes) => {
                    self.start(address, false, true)?;
                    self.write_bytes(bytes)?;
                    stopped = false;
                }
                Operation::Read([]) => {}
                Operation::Read(buffer) => {
                    self.start(address, true, buffer.len() > 1)?;
                    self.read_bytes(buffer)?;
                    // A read ends with a stop; only a write can be followed by another start.
                    stopped = true;
                }
            }
        }
        if !stopped {
            self.stop();
        }
        Ok(())
    }
}

/// A pin of port B.
struct Line(u32);

const CLOCK: Line = Line(6);
const DATA: Line = Line(7);

impl Line {
    /// Values of a pin's field in MODER.
    const OUTPUT: u32 = 1;
    const ALTERNATE: u32 = 2;

    fn port() -> &'static gpiob::RegisterBlock {
        // SAFETY: the port's address. Only this bus uses the two pins; of the registers that other pins
        // share, MODER is changed here only, after the set-up and outside interrupts.
        unsafe { &*GPIOB::ptr() }
    }

    fn set_mode(&self, mode: u32) {
        let shift = 2 * self.0;
        // SAFETY: both values are valid for the field, and the others keep theirs.
        Self::port()
            .moder()
            .modify(|r, w| unsafe { w.bits(r.bits() & !(3 << shift) | mode << shift) });
    }
}

impl digital::ErrorType for Line {
    type Error = Infallible;
}

impl OutputPin for Line {
    fn set_low(&mut self) -> Result<(), Infallible> {
        // SAFETY: every value is valid for this register, and zeros change nothing.
        Self::port().bsrr().write(|w| unsafe { w.bits(1 << (16 + self.0)) });
        Ok(())
    }

    fn set_high(&mut self) -> Result<(), Infallible> {
        // SAFETY: as above.
        Self::port().bsrr().write(|w| unsafe { w.bits(1 << self.0) });
        Ok(())
    }
}

impl InputPin for Line {
    fn is_high(&mut self) -> Result<bool, Infallible> {
        Ok(Self::port().idr().read().bits() & 1 << self.0 != 0)
    }

    fn is_low(&mut self) -> Result<bool, Infallible> {
        self.is_high().map(|is_high| !is_high)
    }
}

/// Waits by counting cycles at 168 MHz, or longer at a lower frequency.
struct Spin;

impl DelayNs for Spin {
    fn delay_ns(&mut self, time: u32) {
        cortex_m::asm::delay(time.saturating_mul(168) / 1_000 + 1);
    }
}

impl ErrorType for Bus {
    type Error = BusError;
}

impl I2c<SevenBitAddress> for Bus {
    /// A read ends with a stop, even before another operation.
    fn transaction(
        &mut self,
        address: SevenBitAddress,
        operations: &mut [Operation<'_>],
    ) -> Result<(), BusError> {
        let outcome = self.operate(address, operations);
        if outcome.is_err() {
            self.recover();
        }
        outcome
    }
}
