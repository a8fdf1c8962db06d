//! The board layer around one agent.
//!
//! The agent itself performs no input or output: time, measurements and received frames are
//! arguments, frames to send are return values. The rest is the board's ([`board`]): reading a
//! [`Sensor`], moving bytes over a [`Link`], waiting for a [`Clock`]. A new board implements these
//! three and changes nothing else; [`registers`] is a sensor for every hardware abstraction layer
//! that implements `embedded-hal`. The boards themselves are separate crates, one folder each in
//! `boards`; the code they share below the traits is in [`on_chip`].
//!
//! The hardware is a type parameter, so everything here also builds and is tested on the host.
#![no_std]
#![deny(unsafe_code)]

pub mod board;
mod board_error;
mod boot_record;
pub mod held_bus;
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
pub use boot_record::BootRecord;
pub use in_the_loop::InTheLoop;
pub use key::key_from_hex;
pub use memory_map::{Symbols, WeightsRegion};
pub use node::{Epochs, Memory, Node, Progress, RECOMMENDED_TRIAL, Settings, Start};
pub use periods::Periods;
pub use queued_port::{Full, QueuedEnd, QueuedPort, queued_port};
pub use registers::RegisterSensor;
pub use serial_link::SerialLink;
pub use waiting_port::WaitingPort;
