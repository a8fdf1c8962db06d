//! The weight store: power cuts, damage, random histories.

mod damage;
mod histories;
pub(crate) mod packages;
mod power_cuts;
mod reading;

pub(crate) use damage::flipped_bits;
