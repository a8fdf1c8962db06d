//! The I2C bus with timeouts. The HAL waits indefinitely for the controller's flags: a device that holds
//! a line would stop the node until the watchdog resets the chip, and still hold the line afterwards.
//! Here every wait ends. After an error that a held line can cause, and once at the start, a device that
//! holds the data line is clocked until it lets go (RP2040 datasheet, 4.3, and 2.14 for the reset).

use embedded_hal::delay::DelayNs;
use embedded_hal::i2c::{
    Error, ErrorKind, ErrorType, I2c, NoAcknowledgeSource, Operation, SevenBitAddress,
};
use firmware_template::held_bus::free_bus;
use hal::gpio::bank0::{Gpio4, Gpio5};
use hal::gpio::{FunctionI2C, InOutPin, Pin, PullUp};
use hal::pac::{I2C0, RESETS};
use rp2040_hal as hal;

/// The data line.
pub(crate) type DataPin = Pin<Gpio4, FunctionI2C, PullUp>;
/// The clock line.
pub(crate) type ClockPin = Pin<Gpio5, FunctionI2C, PullUp>;

/// Frequency of the system clock in MHz, which the controller counts.
const MEGAHERTZ: u32 = 125;

/// Counts of a low and a high time of the clock line, 1.5 us and 1 us: 400 kHz at most (4.3.14.1). The
/// fast mode asks for 1.3 us and 0.6 us (UM10204, table 10).
const LOW: u16 = (MEGAHERTZ * 3 / 2 - 1) as u16;
const HIGH: u16 = (MEGAHERTZ - 7 - SPIKE as u32) as u16;
/// Counts of the longest spike that is filtered, and for which the data line is held after the clock
/// line has fallen: 50 ns and 300 ns.
const SPIKE: u8 = 7;
const HOLD: u16 = (MEGAHERTZ * 3 / 10 + 1) as u16;

/// I2C0 on GP4 and GP5.
pub(crate) struct Bus {
    registers: I2C0,
    resets: RESETS,
    /// Both, except while the lines are freed.
    pins: Option<(DataPin, ClockPin)>,
}

/// Why a transfer ended early.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum BusError {
    /// A flag was not set in time.
    Timeout,
    /// No device acknowledged.
    NoAcknowledge,
    /// Another master, or what the controller takes for one.
    Arbitration,
}

impl Error for BusError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Timeout => ErrorKind::Other,
            Self::NoAcknowledge => ErrorKind::NoAcknowledge(NoAcknowledgeSource::Unknown),
            Self::Arbitration => ErrorKind::ArbitrationLoss,
        }
    }
}

impl Bus {
    /// Number of times a flag is polled: at 125 MHz and at least 8 cycles per poll more than 1 ms, 50 times
    /// as long as a byte takes.
    const LOOKS: u32 = 20_000;

    /// Bits of IC_TX_ABRT_SOURCE: no acknowledgement of an address or of data, and what the other
    /// reasons are.
    const NOT_ACKNOWLEDGED: u32 = 0b1001;
    const REASONS: u32 = (1 << 17) - 1;

    /// Frees the lines and sets the controller up.
    pub(crate) fn new(registers: I2C0, pins: (DataPin, ClockPin), resets: RESETS) -> Self {
        let mut bus = Self { registers, resets, pins: Some(pins) };
        bus.recover();
        bus
    }

    /// Takes the lines from the controller, which aborts its transfer by a reset, frees them, and gives
    /// them back.
    fn recover(&mut self) {
        let Some((data, clock)) = self.pins.take() else { return };
        // Their outputs are low, and enabled while a line is pulled.
        let (mut data, mut clock) = (InOutPin::new(data), InOutPin::new(clock));
        self.resets.reset().modify(|_, w| w.i2c0().set_bit());
        let Ok(_is_free) = free_bus(&mut clock, &mut data, &mut Spin);
        self.resets.reset().modify(|_, w| w.i2c0().clear_bit());
        self.set_up();
        self.pins = Some((data.release(), clock.release()));
    }

    /// Configures the controller after its reset, which leaves it disabled.
    fn set_up(&mut self) {
        for _ in 0..Self::LOOKS {
            if self.resets.reset_done().read().i2c0().bit_is_set() {
                break;
            }
        }
        let registers = &self.registers;
        registers.ic_con().write(|w| {
            w.master_mode().enabled().ic_slave_disable().slave_disabled();
            w.speed().fast().ic_restart_en().enabled()
        });
        // SAFETY: the counts are within the limits of the datasheet, 4.3.14.
        unsafe {
            registers.ic_fs_scl_lcnt().write(|w| w.ic_fs_scl_lcnt().bits(LOW));
            registers.ic_fs_scl_hcnt().write(|w| w.ic_fs_scl_hcnt().bits(HIGH));
            registers.ic_fs_spklen().write(|w| w.ic_fs_spklen().bits(SPIKE));
            registers.ic_sda_hold().write(|w| w.ic_sda_tx_hold().bits(HOLD));
        }
    }

    /// Waits until `done`, or until the controller has aborted the transfer.
    fn wait(&mut self, done: impl Fn(&I2C0) -> bool) -> Result<(), BusError> {
        for _ in 0..Self::LOOKS {
            let reasons = self.registers.ic_tx_abrt_source().read().bits() & Self::REASONS;
            if reasons != 0 {
                // Reading clears flag and reasons. The controller has sent a stop by itself.
                let _ = self.registers.ic_clr_tx_abrt().read();
                return Err(if reasons & Self::NOT_ACKNOWLEDGED != 0 {
                    BusError::NoAcknowledge
                } else {
                    BusError::Arbitration
                });
            }
            if done(&self.registers) {
                return Ok(());
            }
        }
        Err(BusError::Timeout)
    }

    /// Selects the device; the controller must be disabled for that.
    fn select(&mut self, address: u8) -> Result<(), BusError> {
        self.registers.ic_enable().write(|w| w.enable().disabled());
        self.wait(|registers| registers.ic_enable_status().read().ic_en().is_disabled())?;
        // SAFETY: every address of seven bits is valid for this register.
        self.registers.ic_tar().write(|w| unsafe { w.ic_tar().bits(address.into()) });
        let _ = self.registers.ic_clr_intr().read();
        self.registers.ic_enable().write(|w| w.enable().enabled());
        Ok(())
    }

    /// Sends a byte, or the command to receive one if there is none.
    fn command(&mut self, byte: Option<u8>, stop: bool) -> Result<(), BusError> {
        self.wait(|registers| registers.ic_status().read().tfnf().is_not_full())?;
        self.registers.ic_data_cmd().write(|w| {
            w.stop().bit(stop).cmd().bit(byte.is_none());
            // SAFETY: every value is valid for this field.
            unsafe { w.dat().bits(byte.unwrap_or(0)) }
        });
        Ok(())
    }

    fn operate(&mut self, address: u8, operations: &mut [Operation<'_>]) -> Result<(), BusError> {
        self.select(address)?;
        // Between operations in different directions the controller starts again by itself.
        let operation_count = operations.len();
        for (operation, index) in operations.iter_mut().zip(1..) {
            let is_last = index == operation_count;
            match operation {
                Operation::Write(bytes) => {
                    for (byte, index) in bytes.iter().zip(1..) {
                        self.command(Some(*byte), is_last && index == bytes.len())?;
                    }
                }
                Operation::Read(buffer) => {
                    let length = buffer.len();
                    for (place, index) in buffer.iter_mut().zip(1..) {
                        self.command(None, is_last && index == length)?;
                        self.wait(|registers| registers.ic_status().read().rfne().is_not_empty())?;
                        *place = self.registers.ic_data_cmd().read().dat().bits();
                    }
                }
            }
        }
        self.wait(|registers| registers.ic_raw_intr_stat().read().stop_det().is_active())
    }
}

/// Waits by counting cycles at 125 MHz.
struct Spin;

impl DelayNs for Spin {
    fn delay_ns(&mut self, time: u32) {
        cortex_m::asm::delay(time.saturating_mul(MEGAHERTZ) / 1_000 + 1);
    }
}

impl ErrorType for Bus {
    type Error = BusError;
}

impl I2c<SevenBitAddress> for Bus {
    /// The last operation must not be empty, as a stop is sent with its last byte.
    fn transaction(
        &mut self,
        address: SevenBitAddress,
        operations: &mut [Operation<'_>],
    ) -> Result<(), BusError> {
        let outcome = self.operate(address, operations);
        // Without an acknowledgement the device is not there or not ready, and nothing holds the bus.
        if let Err(BusError::Timeout | BusError::Arbitration) = outcome {
            self.recover();
        }
        outcome
    }
}
