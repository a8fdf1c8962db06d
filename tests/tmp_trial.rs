#![allow(dead_code, unused_imports)]
mod sim {
    #[path = "/work/wt/trial/tests/sim/scenario_builder.rs"]
    pub(crate) mod scenario_builder;
}
mod store {
    #[path = "/work/wt/trial/tests/store/packages.rs"]
    pub(crate) mod packages;
}
mod trial;
