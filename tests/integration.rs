//! The one binary of the integration tests.

mod scenario_errors;
