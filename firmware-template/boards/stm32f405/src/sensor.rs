//! The accelerometer.

use embedded_hal::delay::DelayNs;
use embedded_hal::i2c::Error as _;
use firmware_template::{Sensor, SensorErrorKind};
use lsm303agr::interface::I2cInterface;
use lsm303agr::mode::MagOneShot;
use lsm303agr::{AccelMode, AccelOutputDataRate, Lsm303agr};

use crate::bus::{Bus, BusError};

/// The accelerometer of an LSM303AGR: 1,344 samples per second, +-2 g, 4 mg per count.
pub(crate) struct Accelerometer<D> {
    device: Lsm303agr<I2cInterface<Bus>, MagOneShot>,
    delay: D,
    /// Whether the device has been set up without an error since.
    ready: bool,
}

impl<D: DelayNs> Accelerometer<D> {
    /// Standard gravity (CGPM 1901) per thousandth of a g. \[m/s^2\]
    const MILLIGRAVITY: f32 = 9.806_65e-3;

    /// Creates the sensor; the device is set up with the first sample.
    pub(crate) fn new(bus: Bus, delay: D) -> Self {
        Self { device: Lsm303agr::new_with_i2c(bus), delay, ready: false }
    }

    fn sample(&mut self) -> Result<f32, lsm303agr::Error<BusError>> {
        if !self.ready {
            let rate = AccelOutputDataRate::Khz1_344;
            self.device.init()?;
            self.device.set_accel_mode_and_odr(&mut self.delay, AccelMode::Normal, rate)?;
        }
        let thousandths = self.device.acceleration()?.x_mg();
        Ok(thousandths as f32 * Self::MILLIGRAVITY)
    }
}

/// The kind of an error of the driver.
fn kind(error: &lsm303agr::Error<BusError>) -> SensorErrorKind {
    match error {
        lsm303agr::Error::Comm(error) => error.kind().into(),
        _ => SensorErrorKind::Other,
    }
}

impl<D: DelayNs> Sensor for Accelerometer<D> {
    type Error = SensorErrorKind;

    fn outputs(&self) -> usize {
        1
    }

    fn read(&mut self, measurement: &mut [f32]) -> Result<(), Self::Error> {
        let [place] = measurement else { return Err(SensorErrorKind::Other) };
        let sample = self.sample();
        self.ready = sample.is_ok();
        *place = sample.map_err(|error| kind(&error))?;
        Ok(())
    }
}
