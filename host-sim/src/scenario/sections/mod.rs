//! One module per group of tables in the file.

pub(super) mod agents;
pub(super) mod clock;
pub(super) mod disturbance;
pub(super) mod exchange;
pub(super) mod gains;
pub(super) mod health;
pub(super) mod learning;
pub(super) mod life;
pub(super) mod link;
pub(super) mod method;
pub(super) mod network;
pub(super) mod observer;
pub(super) mod plant;
pub(super) mod recording;
pub(super) mod run;
pub(super) mod sensor;
pub(super) mod state_names;
pub(super) mod trainer;
pub(super) mod trigger;
