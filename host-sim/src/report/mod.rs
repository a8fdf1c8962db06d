//! Results as tables and CSV files.

pub mod csv;
pub mod paper;
pub mod tables;
