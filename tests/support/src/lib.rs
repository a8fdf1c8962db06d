//! For tests, fuzzing, and authors of boards: NOR flash in memory that is as strict as the
//! strictest part, a model of what the weight store must do, and a comparison of numbers.
//!
//! A board's own flash driver can be held against [`nor_flash::SimulatedFlash`]: what the store
//! does on one, it must do on the other.

mod close;
pub mod nor_flash;
pub mod store_model;

pub use close::close;
