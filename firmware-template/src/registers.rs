//! A sensor behind an I2C bus whose channels are registers of 8 or 16 bits.
//!
//! A register holds a number of counts, in the [`Format`] of its channel. A sample is, channel by
//! channel,
//!
//! ```text
//! y = scale * counts + offset
//! ```
//!
//! in that order, rounded after the multiplication and after the addition, so the host and
//! every target compute the same bits.
//!
//! A sensor that has to be configured gets its [`SetUp`] before the first sample, and again before the
//! next one whenever the bus has failed: it may have lost its supply meanwhile, and with it all it was
//! told.
//!
//! Cost for each channel: one bus transaction of 2 or 3 data bytes, one multiplication, one
//! addition. Memory: the bus and references to the channels and the set-up.
//!
//! Invariant: every `scale` is finite and not 0, every `offset` finite.

use embedded_hal::i2c::{Error, I2c, SevenBitAddress};

use crate::{Sensor, SensorError, SensorErrorKind};

/// The highest address that the I2C bus does not reserve (UM10204, table 4).
const ADDRESS_MAX: SevenBitAddress = 0x77;
/// The lowest address that the I2C bus does not reserve (UM10204, table 4).
const ADDRESS_MIN: SevenBitAddress = 0x08;

/// How a register holds counts: its width, its byte order, and whether there is a sign (in two's
/// complement).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// 8 bits, signed.
    I8,
    /// 8 bits, unsigned.
    U8,
    /// 16 bits, signed, most significant byte first, as in many accelerometers and converters.
    I16BigEndian,
    /// 16 bits, unsigned, most significant byte first.
    U16BigEndian,
    /// 16 bits, signed, least significant byte first.
    I16LittleEndian,
    /// 16 bits, unsigned, least significant byte first.
    U16LittleEndian,
}

impl Format {
    /// Bytes of a register.
    #[must_use]
    pub const fn length(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            _ => 2,
        }
    }

    /// Converts a register, as it comes over the bus, to counts. The second byte is not used where
    /// there is one only.
    #[must_use]
    pub const fn counts(self, bytes: [u8; 2]) -> i32 {
        let [first, _] = bytes;
        match self {
            Self::I8 => first as i8 as i32,
            Self::U8 => first as i32,
            Self::I16BigEndian => i16::from_be_bytes(bytes) as i32,
            Self::U16BigEndian => u16::from_be_bytes(bytes) as i32,
            Self::I16LittleEndian => i16::from_le_bytes(bytes) as i32,
            Self::U16LittleEndian => u16::from_le_bytes(bytes) as i32,
        }
    }
}

/// Where one component of the measurement comes from, and its calibration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Channel {
    /// Address of the register in the sensor, of its first byte if there are two; the other one
    /// follows.
    pub register: u8,
    /// What is in the register.
    pub format: Format,
    /// Slope of the calibration \[unit of the component / count\].
    pub scale: f32,
    /// The component at 0 counts \[unit of the component\].
    pub offset: f32,
    /// The counts that the register has while there is no sample, if the sensor tells it that way.
    pub not_ready: Option<i32>,
}

impl Channel {
    /// Converts counts to the unit of the component.
    #[must_use]
    pub fn convert(&self, counts: i32) -> f32 {
        // 17 bits fit into a float exactly.
        self.scale * counts as f32 + self.offset
    }
}

/// A register that is written to configure a sensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SetUp {
    /// Its address in the sensor.
    pub register: u8,
    /// What is written.
    pub value: RegisterValue,
}

/// What a register is set to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RegisterValue {
    /// 8 bits.
    Byte(u8),
    /// 16 bits, most significant byte first.
    BigEndian(u16),
    /// 16 bits, least significant byte first.
    LittleEndian(u16),
}

/// Why a sensor cannot be built.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum ConfigError {
    /// The address is not in 0x08..=0x77.
    Address {
        /// The address given.
        found: SevenBitAddress,
    },
    /// A scale is 0, infinite or not a number.
    Scale {
        /// Index of the channel, from 0.
        channel: usize,
        /// The scale given.
        found: f32,
    },
    /// An offset is infinite or not a number.
    Offset {
        /// Index of the channel, from 0.
        channel: usize,
        /// The offset given.
        found: f32,
    },
}

/// Why there is no sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ReadError<E> {
    /// The bus failed while the sensor was being configured.
    SetUp {
        /// Index of the write, from 0.
        index: usize,
        /// What the bus reported.
        source: E,
    },
    /// The bus failed.
    Bus {
        /// Index of the channel that was being read, from 0.
        channel: usize,
        /// What the bus reported.
        source: E,
    },
    /// The sensor has no sample yet.
    NotReady {
        /// Index of the channel, from 0.
        channel: usize,
    },
    /// The slice for the measurement has the wrong length.
    Length {
        /// The number of channels.
        expected: usize,
        /// The length given.
        found: usize,
    },
}

impl<E: Error> SensorError for ReadError<E> {
    fn kind(&self) -> SensorErrorKind {
        match self {
            Self::SetUp { source, .. } | Self::Bus { source, .. } => source.kind().into(),
            Self::NotReady { .. } => SensorErrorKind::NotReady,
            Self::Length { .. } => SensorErrorKind::Other,
        }
    }
}

/// A sensor with `OUTPUTS` channels on the bus `I2C`.
#[derive(Debug)]
pub struct RegisterSensor<'a, I2C, const OUTPUTS: usize> {
    bus: I2C,
    address: SevenBitAddress,
    channels: &'a [Channel; OUTPUTS],
    set_up: &'a [SetUp],
    /// Whether the set-up has been written, and no error has occurred since.
    is_set_up: bool,
}

impl<'a, I2C: I2c, const OUTPUTS: usize> RegisterSensor<'a, I2C, OUTPUTS> {
    /// Creates the sensor at `address`; `channels` can be a `static` in flash. The bus is not used yet.
    ///
    /// # Errors
    /// A [`ConfigError`] names the first value that cannot be right.
    pub fn new(
        bus: I2C,
        address: SevenBitAddress,
        channels: &'a [Channel; OUTPUTS],
    ) -> Result<Self, ConfigError> {
        if !(ADDRESS_MIN..=ADDRESS_MAX).contains(&address) {
            return Err(ConfigError::Address { found: address });
        }
        for (channel, &Channel { scale, offset, .. }) in channels.iter().enumerate() {
            if !scale.is_finite() || scale == 0.0 {
                return Err(ConfigError::Scale { channel, found: scale });
            }
            if !offset.is_finite() {
                return Err(ConfigError::Offset { channel, found: offset });
            }
        }
        Ok(Self { bus, address, channels, set_up: &[], is_set_up: false })
    }

    /// Has these registers written, in this order, before the first sample and before the next one
    /// after each failure of the bus.
    #[must_use]
    pub fn with_set_up(self, set_up: &'a [SetUp]) -> Self {
        Self { set_up, ..self }
    }

    fn write_set_up(&mut self) -> Result<(), ReadError<I2C::Error>> {
        for (index, &SetUp { register, value }) in self.set_up.iter().enumerate() {
            let written = match value {
                RegisterValue::Byte(value) => self.bus.write(self.address, &[register, value]),
                RegisterValue::BigEndian(value) => {
                    let [high, low] = value.to_be_bytes();
                    self.bus.write(self.address, &[register, high, low])
                }
                RegisterValue::LittleEndian(value) => {
                    let [low, high] = value.to_le_bytes();
                    self.bus.write(self.address, &[register, low, high])
                }
            };
            written.map_err(|source| ReadError::SetUp { index, source })?;
        }
        Ok(())
    }

    fn read_channels(&mut self) -> Result<[i32; OUTPUTS], ReadError<I2C::Error>> {
        let mut counts = [0; OUTPUTS];
        for (channel, (counts, parameters)) in counts.iter_mut().zip(self.channels).enumerate() {
            let mut bytes = [0; 2];
            let place = bytes.get_mut(..parameters.format.length()).unwrap_or_default();
            self.bus
                .write_read(self.address, &[parameters.register], place)
                .map_err(|source| ReadError::Bus { channel, source })?;
            *counts = parameters.format.counts(bytes);
        }
        Ok(counts)
    }
}

impl<I2C: I2c, const OUTPUTS: usize> Sensor for RegisterSensor<'_, I2C, OUTPUTS> {
    type Error = ReadError<I2C::Error>;

    fn outputs(&self) -> usize {
        OUTPUTS
    }

    fn read(&mut self, measurement: &mut [f32]) -> Result<(), Self::Error> {
        let found = measurement.len();
        let measurement: &mut [f32; OUTPUTS] =
            measurement.try_into().map_err(|_| ReadError::Length { expected: OUTPUTS, found })?;

        if !self.is_set_up {
            self.write_set_up()?;
        }
        let counts = self.read_channels();
        self.is_set_up = counts.is_ok();
        let counts = counts?;
        for (channel, (counts, parameters)) in counts.iter().zip(self.channels).enumerate() {
            if parameters.not_ready == Some(*counts) {
                return Err(ReadError::NotReady { channel });
            }
        }
        let samples = counts.iter().zip(self.channels);
        for (place, (&counts, parameters)) in measurement.iter_mut().zip(samples) {
            *place = parameters.convert(counts);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
