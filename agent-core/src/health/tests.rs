//! Counters, rows of steps, and reports.
