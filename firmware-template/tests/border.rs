//! A whole node against doubles of its board, through nothing but the three traits.

use std::{cell::RefCell, collections::VecDeque, rc::Rc};

use embedded_hal::delay::DelayNs;
use embedded_hal_mock::eh1::{
    delay::{CheckedDelay, Transaction as Delay},
    i2c::{Mock, Transaction},
};
use firmware_template::{Clock, Link, RegisterSensor, Sensor, registers::Channel};

/// One end of a cable between two nodes.
#[derive(Default)]
struct Cable {
    incoming: Rc<RefCell<VecDeque<Vec<u8>>>>,
    outgoing: Rc<RefCell<VecDeque<Vec<u8>>>>,
}

impl Cable {
    fn pair() -> (Self, Self) {
        let here = Self::default();
        let there = Self { incoming: here.outgoing.clone(), outgoing: here.incoming.clone() };
        (here, there)
    }
}

#[derive(Debug, PartialEq)]
struct TooLong(usize);

impl Link for Cable {
    type Error = TooLong;

    fn send(&mut self, frame: &[u8]) -> Result<(), TooLong> {
        self.outgoing.borrow_mut().push_back(frame.to_vec());
        Ok(())
    }

    fn poll<'buffer>(
        &mut self,
        buffer: &'buffer mut [u8],
    ) -> Result<Option<&'buffer [u8]>, TooLong> {
        let Some(frame) = self.incoming.borrow_mut().pop_front() else { return Ok(None) };
        let part = buffer.get_mut(..frame.len()).ok_or(TooLong(frame.len()))?;
        part.copy_from_slice(&frame);
        Ok(Some(part))
    }
}

/// Sleeps a whole period; good enough where the work between two steps takes no time.
struct Sleeper<D>(D);

impl<D: DelayNs> Clock for Sleeper<D> {
    fn period(&self) -> f32 {
        0.005
    }

    fn wait(&mut self) -> u32 {
        self.0.delay_us(5_000);
        1
    }
}

/// One sampling instant: wait, sample, send; returns the neighbour's sample, if it came.
fn step(clock: &mut impl Clock, sensor: &mut impl Sensor, link: &mut impl Link) -> Option<f32> {
    assert_eq!(clock.wait(), 1);
    let mut measurement = [0.0];
    sensor.read(&mut measurement).expect("a sample");
    link.send(&measurement[0].to_le_bytes()).expect("a sent frame");
    let mut buffer = [0; 8];
    let frame = link.poll(&mut buffer).expect("a working receiver")?;
    Some(f32::from_le_bytes(frame.try_into().expect("four bytes")))
}

#[test]
fn a_sample_crosses_from_bus_to_neighbour() {
    let channels = [Channel { register: 0, scale: 0.5, offset: 1.0 }];
    let reading = |low| Transaction::write_read(0x48, vec![0], vec![0, low]);
    let mut bus = Mock::new(&[reading(4), reading(6)]);
    let mut timer = CheckedDelay::new(&[Delay::delay_us(5_000), Delay::delay_us(5_000)]);
    let mut sensor = RegisterSensor::new(bus.clone(), 0x48, &channels).expect("a sensor");
    let mut clock = Sleeper(timer.clone());
    let (mut here, mut there) = Cable::pair();

    assert_eq!(step(&mut clock, &mut sensor, &mut here), None);
    assert_eq!(step(&mut clock, &mut sensor, &mut there), Some(3.0));
    assert_eq!(here.poll(&mut [0; 8]), Ok(Some(&4.0f32.to_le_bytes()[..])));
    bus.done();
    timer.done();
}

#[test]
fn a_frame_longer_than_the_buffer_does_not_block_the_next() {
    let (mut here, mut there) = Cable::pair();
    here.send(&[1, 2, 3]).expect("a sent frame");
    here.send(&[4]).expect("a sent frame");
    let mut buffer = [0; 2];
    assert_eq!(there.poll(&mut buffer), Err(TooLong(3)));
    assert_eq!(there.poll(&mut buffer), Ok(Some(&[4][..])));
    assert_eq!(there.poll(&mut buffer), Ok(None));
}
