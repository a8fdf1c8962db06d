extern crate std;

use embedded_hal::i2c::{ErrorKind, NoAcknowledgeSource};
use embedded_hal_mock::eh1::i2c::{Mock, Transaction};
use std::vec;

use super::*;

const ADDRESS: SevenBitAddress = 0x48;
/// What is in the register, as it is.
const RAW: Channel =
    Channel { register: 0, format: Format::I16BigEndian, scale: 1.0, offset: 0.0, not_ready: None };
/// Powers of two, so that the expected values are exact.
static CHANNELS: [Channel; 2] = [
    Channel { register: 0x3B, offset: 0.0, scale: 0.25, ..RAW },
    Channel { register: 0x41, offset: 21.0, scale: 0.0078125, ..RAW },
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
    assert_eq!(CHANNELS[0].convert(i16::MIN.into()), -8192.0);
    assert_eq!(CHANNELS[0].convert(i16::MAX.into()), 8191.75);
}

#[test]
fn a_failed_bus_leaves_the_measurement_alone() {
    let nack = ErrorKind::NoAcknowledge(NoAcknowledgeSource::Data);
    let mut bus = Mock::new(&[reading(0x3B, [0x01, 0x02]), reading(0x41, [0, 0]).with_error(nack)]);
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

/// What a register with these bytes is read as; the mock checks that this many are asked for.
fn raw(format: Format, bytes: &[u8]) -> f32 {
    let mut bus = Mock::new(&[Transaction::write_read(ADDRESS, vec![7], bytes.to_vec())]);
    let channels = [Channel { register: 7, format, ..RAW }];
    let mut sensor = RegisterSensor::new(bus.clone(), ADDRESS, &channels).unwrap();
    let mut measurement = [f32::NAN];
    sensor.read(&mut measurement).unwrap();
    bus.done();
    measurement[0]
}

#[test]
fn width_sign_and_byte_order_are_those_of_the_format() {
    assert_eq!(raw(Format::I8, &[0x80]), -128.0);
    assert_eq!(raw(Format::U8, &[0x80]), 128.0);
    assert_eq!(raw(Format::I16BigEndian, &[0x80, 0x01]), -32767.0);
    assert_eq!(raw(Format::U16BigEndian, &[0x80, 0x01]), 32769.0);
    assert_eq!(raw(Format::I16LittleEndian, &[0x01, 0x80]), -32767.0);
    assert_eq!(raw(Format::U16LittleEndian, &[0x01, 0x80]), 32769.0);
    assert_eq!(raw(Format::U16LittleEndian, &[0xFF, 0xFF]), 65535.0);
}

const SET_UP: [SetUp; 3] = [
    SetUp { register: 0x20, value: RegisterValue::Byte(0x57) },
    SetUp { register: 0x01, value: RegisterValue::BigEndian(0x0220) },
    SetUp { register: 0x02, value: RegisterValue::LittleEndian(0x0220) },
];

/// The set-up as it goes over the bus.
fn writes() -> [Transaction; 3] {
    [vec![0x20, 0x57], vec![0x01, 0x02, 0x20], vec![0x02, 0x20, 0x02]]
        .map(|bytes| Transaction::write(ADDRESS, bytes))
}

#[test]
fn the_set_up_is_written_once_before_the_first_sample() {
    let mut expected = writes().to_vec();
    expected.extend([reading(0x3B, [0, 4]), reading(0x3B, [0, 8])]);
    let mut bus = Mock::new(&expected);
    let channels = [CHANNELS[0]];
    let sensor = RegisterSensor::new(bus.clone(), ADDRESS, &channels).unwrap();
    let mut sensor = sensor.with_set_up(&SET_UP);
    let mut measurement = [f32::NAN];
    for expected in [1.0, 2.0] {
        sensor.read(&mut measurement).unwrap();
        assert_eq!(measurement, [expected]);
    }
    bus.done();
}

#[test]
fn the_set_up_is_written_again_after_a_failed_read_and_after_a_failed_set_up() {
    let nack = ErrorKind::NoAcknowledge(NoAcknowledgeSource::Address);
    let [first, second, _] = writes();
    let mut expected = writes().to_vec();
    expected.push(reading(0x3B, [0, 0]).with_error(nack));
    expected.extend([first, second.with_error(ErrorKind::Bus)]);
    expected.extend(writes());
    expected.extend([reading(0x3B, [0, 4]), reading(0x3B, [0, 8])]);
    let mut bus = Mock::new(&expected);
    let channels = [CHANNELS[0]];
    let sensor = RegisterSensor::new(bus.clone(), ADDRESS, &channels).unwrap();
    let mut sensor = sensor.with_set_up(&SET_UP);
    let mut measurement = [7.0];
    let mut read = || {
        let result = sensor.read(&mut measurement);
        (result.map_err(|error| (error, error.kind())), measurement)
    };
    let error = ReadError::Bus { channel: 0, source: nack };
    assert_eq!(read(), (Err((error, SensorErrorKind::NoAnswer)), [7.0]));
    let error = ReadError::SetUp { index: 1, source: ErrorKind::Bus };
    assert_eq!(read(), (Err((error, SensorErrorKind::Bus)), [7.0]));
    assert_eq!(read(), (Ok(()), [1.0]));
    assert_eq!(read(), (Ok(()), [2.0]));
    bus.done();
}

#[test]
fn a_sensor_without_a_sample_is_not_ready_and_is_not_set_up_again() {
    let mut expected = writes().to_vec();
    expected.extend([reading(0x3B, [0x80, 0x00]), reading(0x3B, [0, 4])]);
    let mut bus = Mock::new(&expected);
    let channels = [Channel { not_ready: Some(i16::MIN.into()), ..CHANNELS[0] }];
    let sensor = RegisterSensor::new(bus.clone(), ADDRESS, &channels).unwrap();
    let mut sensor = sensor.with_set_up(&SET_UP);
    let mut measurement = [7.0];
    let error = sensor.read(&mut measurement).unwrap_err();
    assert_eq!((error, measurement), (ReadError::NotReady { channel: 0 }, [7.0]));
    assert_eq!(error.kind(), SensorErrorKind::NotReady);
    assert_eq!(sensor.read(&mut measurement), Ok(()));
    assert_eq!(measurement, [1.0]);
    bus.done();
}
