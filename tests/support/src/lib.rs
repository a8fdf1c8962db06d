//! Support for tests, fuzzing and authors of boards: a NOR flash in memory that is as strict as the
//! strictest device, a model of the weight store, and a comparison of numbers.
//!
//! A board's flash driver can be compared with [`nor_flash::SimulatedFlash`]: the store must behave
//! the same on both.

mod close;
pub mod nor_flash;
pub mod store_model;

pub use close::close;
