//! Files: read up to a limit, written whole or left as they were, tables, and hashes.
//!
//! | module | purpose |
//! | --- | --- |
//! | [`input`] | reads a file, but not beyond a limit |
//! | [`output`] | writes a file whole, or leaves what was there |
//! | [`table`] | CSV tables |
//! | [`fnv`] | a hash for people to compare |

pub mod fnv;
pub mod input;
pub mod output;
pub mod table;
