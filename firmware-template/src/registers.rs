//! A sensor behind an I2C bus whose channels are 16-bit registers.
//!
//! A register holds a signed number of counts, most significant byte first, as in many
//! accelerometers, gyroscopes and converters. A sample is, channel by channel,
//!
//! ```text
//! y = scale * counts + offset
//! ```
//!
//! in that order, rounded after the multiplication and after the addition, so the host and
//! every target compute the same bits.
//!
//! Cost for each channel: one bus transaction of 3 data bytes, one multiplication, one
//! addition. Memory: the bus and a reference to the channels.
//!
//! Invariant: every `scale` is finite and not 0, every `offset` finite.

use embedded_hal::i2c::{I2c, SevenBitAddress};

use crate::Sensor;

/// The highest address that the I2C bus does not reserve (UM10204, table 4).
const ADDRESS_MAX: SevenBitAddress = 0x77;
/// The lowest address that the I2C bus does not reserve (UM10204, table 4).
const ADDRESS_MIN: SevenBitAddress = 0x08;

/// Where one component of the measurement comes from, and its calibration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Channel {
    /// Address of the high byte in the sensor; the low byte follows it.
    pub register: u8,
    /// Slope of the calibration \[unit of the component / count\].
    pub scale: f32,
    /// The component at 0 counts \[unit of the component\].
    pub offset: f32,
}

impl Channel {
    /// Converts counts to the unit of the component.
    #[must_use]
    pub fn convert(&self, counts: i16) -> f32 {
        self.scale * f32::from(counts) + self.offset
    }
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
    /// The bus failed.
    Bus {
        /// Index of the channel that was being read, from 0.
        channel: usize,
        /// What the bus reported.
        source: E,
    },
    /// The slice for the measurement has the wrong length.
    Length {
        /// The number of channels.
        expected: usize,
        /// The length given.
        found: usize,
    },
}

/// A sensor with `OUTPUTS` channels on the bus `I2C`.
#[derive(Debug)]
pub struct RegisterSensor<'channels, I2C, const OUTPUTS: usize> {
    bus: I2C,
    address: SevenBitAddress,
    channels: &'channels [Channel; OUTPUTS],
}

impl<'channels, I2C: I2c, const OUTPUTS: usize> RegisterSensor<'channels, I2C, OUTPUTS> {
    /// The sensor at `address`; `channels` can be a `static` in flash.
    ///
    /// # Errors
    /// A [`ConfigError`] names the first value that cannot be right.
    pub fn new(
        bus: I2C,
        address: SevenBitAddress,
        channels: &'channels [Channel; OUTPUTS],
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
        Ok(Self { bus, address, channels })
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

        let mut sample = [0.0; OUTPUTS];
        for (channel, (value, parameters)) in sample.iter_mut().zip(self.channels).enumerate() {
            let mut counts = [0; 2];
            self.bus
                .write_read(self.address, &[parameters.register], &mut counts)
                .map_err(|source| ReadError::Bus { channel, source })?;
            *value = parameters.convert(i16::from_be_bytes(counts));
        }
        *measurement = sample;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    extern crate std;

    use embedded_hal::i2c::{ErrorKind, NoAcknowledgeSource};
    use embedded_hal_mock::eh1::i2c::{Mock, Transaction};
    use std::vec;

    use super::*;

    const ADDRESS: SevenBitAddress = 0x48;
    /// Powers of two, so that the expected values are exact.
    static CHANNELS: [Channel; 2] = [
        Channel { register: 0x3B, scale: 0.25, offset: 0.0 },
        Channel { register: 0x41, scale: 0.0078125, offset: 21.0 },
    ];

    fn reading(register: u8, counts: [u8; 2]) -> Transaction {
        Transaction::write_read(ADDRESS, vec![register], counts.to_vec())
    }

    #[test]
    fn counts_become_engineering_units() {
        let mut bus = Mock::new(&[reading(0x3B, [0x01, 0x02]), reading(0x41, [0xFF, 0x80])]);
        let mut sensor = RegisterSensor::new(bus.clone(), ADDRESS, &CHANNELS).unwrap();
        let mut measurement = [f32::NAN; 2];
        sensor.read(&mut measurement).unwrap();
        // 258 counts of 0.25, and -128 counts of 1/128 above 21.
        assert_eq!(measurement, [64.5, 20.0]);
        bus.done();
    }

    #[test]
    fn the_ends_of_the_range_keep_their_sign() {
        assert_eq!(CHANNELS[0].convert(i16::MIN), -8192.0);
        assert_eq!(CHANNELS[0].convert(i16::MAX), 8191.75);
    }

    #[test]
    fn a_failed_bus_leaves_the_measurement_alone() {
        let nack = ErrorKind::NoAcknowledge(NoAcknowledgeSource::Data);
        let mut bus =
            Mock::new(&[reading(0x3B, [0x01, 0x02]), reading(0x41, [0, 0]).with_error(nack)]);
        let mut sensor = RegisterSensor::new(bus.clone(), ADDRESS, &CHANNELS).unwrap();
        let mut measurement = [7.0, 8.0];
        let error = sensor.read(&mut measurement).unwrap_err();
        assert_eq!(error, ReadError::Bus { channel: 1, source: nack });
        assert_eq!(measurement, [7.0, 8.0]);
        bus.done();
    }

    #[test]
    fn a_wrong_length_is_refused_before_the_bus_is_used() {
        let mut bus = Mock::new(&[]);
        let mut sensor = RegisterSensor::new(bus.clone(), ADDRESS, &CHANNELS).unwrap();
        assert_eq!(
            sensor.read(&mut [0.0; 3]),
            Err(ReadError::Length { expected: sensor.outputs(), found: 3 })
        );
        bus.done();
    }

    #[test]
    fn settings_that_cannot_be_right_are_named() {
        let mut bus = Mock::new(&[]);
        let refusal = |address, channel| {
            RegisterSensor::new(bus.clone(), address, &[CHANNELS[0], channel]).unwrap_err()
        };
        assert_eq!(refusal(0x78, CHANNELS[1]), ConfigError::Address { found: 0x78 });
        assert_eq!(refusal(0x07, CHANNELS[1]), ConfigError::Address { found: 0x07 });
        let flat = Channel { scale: 0.0, ..CHANNELS[1] };
        assert_eq!(refusal(ADDRESS, flat), ConfigError::Scale { channel: 1, found: 0.0 });
        let far = Channel { offset: f32::INFINITY, ..CHANNELS[1] };
        assert_eq!(refusal(ADDRESS, far), ConfigError::Offset { channel: 1, found: f32::INFINITY });
        bus.done();
    }
}
