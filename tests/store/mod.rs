//! The weight store: power cuts, damage, random histories.

mod damage;
mod histories;
mod packages;
mod power_cuts;
mod reading;
