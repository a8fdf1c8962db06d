//! The board layer around one agent.
//!
//! The agent itself does no input and output: time, measurements and received frames are
//! arguments, frames to send are return values. What remains for a board is [`board`]: read
//! a [`Sensor`], move bytes over a [`Link`], wait for a [`Clock`]. A new board implements
//! these three and changes nothing else; [`registers`] is one sensor that runs on every
//! hardware abstraction layer that implements `embedded-hal`. The boards themselves are crates of their
//! own, one folder each in `boards`; what they share below the traits is [`on_chip`].
//!
//! Everything here builds and is tested on the host too, since the hardware is a type
//! parameter.
#![no_std]
#![deny(unsafe_code)]

pub mod board;
mod board_error;
mod in_the_loop;
mod key;
mod memory_map;
pub mod node;
pub mod on_chip;
mod periods;
mod queued_port;
pub mod registers;
mod serial_link;
mod waiting_port;

pub use board::{
    Board, Clock, Hardware, Link, LinkError, LinkErrorKind, Sensor, SensorError, SensorErrorKind,
};
pub use in_the_loop::InTheLoop;
pub use key::key_from_hex;
pub use memory_map::{Symbols, WeightsRegion};
pub use node::{Memory, Node, Progress, Settings};
pub use periods::Periods;
pub use queued_port::{Full, QueuedEnd, QueuedPort, queued_port};
pub use registers::RegisterSensor;
pub use serial_link::SerialLink;
pub use waiting_port::WaitingPort;
