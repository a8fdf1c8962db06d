//! Results as tables, CSV files and MCAP recordings.

pub mod checks;
pub mod columns;
pub mod csv;
pub mod latex;
pub mod mcap;
pub mod paper;
pub mod tables;
pub mod theorems;
