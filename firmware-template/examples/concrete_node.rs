//! One node with every type parameter filled in.
//!
//! Generic code becomes machine code only where it is used with concrete types. This is that
//! place for `cargo xtask cross`, which reads the instructions.
#![no_std]
#![forbid(unsafe_code)]

use agent_core::network::{InnerNetwork, Scratch};
use core::{convert::Infallible, hint::black_box};
use embedded_hal::i2c::{ErrorType, I2c, Operation};
use firmware_template::{RegisterSensor, Sensor, registers::ReadError};

/// A bus on which every sensor reads 0 counts, which the compiler does not know.
#[derive(Debug)]
pub struct SilentBus;

impl ErrorType for SilentBus {
    type Error = Infallible;
}

impl I2c for SilentBus {
    fn transaction(&mut self, _: u8, operations: &mut [Operation<'_>]) -> Result<(), Infallible> {
        for operation in operations {
            if let Operation::Read(bytes) = operation {
                bytes.fill(black_box(0));
            }
        }
        Ok(())
    }
}

/// Reads a sensor with three channels.
///
/// # Errors
/// [`ReadError::Length`] if `measurement` does not have three elements.
#[inline(never)]
pub fn read(
    sensor: &mut RegisterSensor<'static, SilentBus, 3>,
    measurement: &mut [f32],
) -> Result<(), ReadError<Infallible>> {
    sensor.read(measurement)
}

/// Evaluates the inner network with its parameters in flash.
///
/// `None` if `x` does not have the length that the network asks for.
#[inline(never)]
pub fn features<'scratch>(
    network: &InnerNetwork<&'static [f32]>,
    x: &[f32],
    scratch: &'scratch mut Scratch,
) -> Option<&'scratch [f32]> {
    network.features(x, scratch)
}
