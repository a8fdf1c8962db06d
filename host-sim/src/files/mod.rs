//! Files: size-limited input, atomic output, tables, and hashes.
//!
//! | module | purpose |
//! | --- | --- |
//! | [`input`] | reads files up to a size limit |
//! | [`output`] | writes files atomically |
//! | [`table`] | CSV tables |
//! | [`text`] | tables that a user gives |
//! | [`fnv`] | a hash that identifies content |

pub mod fnv;
pub mod input;
pub mod output;
pub mod table;
pub mod text;
