//! Results as tables and CSV files.

pub mod checks;
pub mod columns;
pub mod csv;
pub mod latex;
pub mod paper;
pub mod tables;
pub mod theorems;
