//! The weight store: power cuts, damage, random histories.

mod damage;
mod histories;
mod keys;
pub(crate) mod packages;
mod power_cuts;
mod reading;

pub(crate) use damage::flipped_bits;
pub(crate) use power_cuts::cut_every_way;
