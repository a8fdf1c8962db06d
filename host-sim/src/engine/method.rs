//! Turns a scenario with a baseline's method into what the engine runs.

use std::borrow::Cow;
use std::num::NonZeroU32;

use super::{RunError, RunResult};
use crate::basis::placeholder;
use crate::scenario::{Method, Record, Scenario, TriggerModel};

/// A radius that no deviation reaches. \[state unit\]
const OUT_OF_REACH: f64 = 1e6;

/// Returns the scenario that the engine runs for the scenario's method. `observe` runs a scenario: for
/// `periodic`, the observer at events, to know how often it broadcasts.
///
/// # Errors
/// Those of that run.
pub(super) fn prepared<'s>(
    scenario: &'s Scenario,
    observe: impl FnOnce(&Scenario) -> Result<RunResult, RunError>,
) -> Result<Cow<'s, Scenario>, RunError> {
    let mut changed = match scenario.method {
        Method::Observer | Method::Kalman | Method::ExtendedKalman => {
            return Ok(Cow::Borrowed(scenario));
        }
        Method::Periodic => return periodic(scenario, observe).map(Cow::Owned),
        _ => scenario.clone(),
    };
    for agent in &mut changed.agents {
        agent.package = None;
    }
    match changed.method {
        Method::NoNetwork => {
            changed.learning.clear();
            match &mut changed.observer {
                Some(observer) => observer.network = false,
                None => changed.network = None,
            }
        }
        Method::Untrained => changed.learning.clear(),
        Method::KnownModel => {
            changed.learning.clear();
            use_placeholder(&mut changed);
        }
        _ => use_placeholder(&mut changed),
    }
    Ok(Cow::Owned(changed))
}

/// Lets the agents use other features in place of a network's.
fn use_placeholder(scenario: &mut Scenario) {
    scenario.network = placeholder(scenario);
    if let Some(observer) = &mut scenario.observer {
        observer.network = true;
    }
}

/// Returns the scenario with broadcasts at fixed times, as often as at events.
fn periodic(
    scenario: &Scenario,
    observe: impl FnOnce(&Scenario) -> Result<RunResult, RunError>,
) -> Result<Scenario, RunError> {
    let mut changed =
        Scenario { method: Method::Observer, record: Record::NOTHING, ..scenario.clone() };
    let result = observe(&changed)?;
    let broadcasts: u64 = result.agents.iter().map(|agent| agent.broadcasts_evaluated).sum();
    let window = scenario.evaluation.ticks(&scenario.time);
    let steps = (window.end - window.start) * scenario.agents.len() as u64;
    let every = (steps as f64 / broadcasts.max(1) as f64).round().clamp(1.0, f64::from(u32::MAX));
    let every = NonZeroU32::new(every as u32).unwrap_or(NonZeroU32::MIN);
    (changed.method, changed.record) = (scenario.method, scenario.record);
    match &mut changed.observer {
        Some(observer) => {
            observer.radius = Some(vec![OUT_OF_REACH; scenario.dimension()]);
            let exchange = observer.exchange.as_mut().unwrap_or(&mut changed.exchange);
            exchange.heartbeat = every.get();
            exchange.gap = exchange.gap.min(every.get());
            // Nothing else may broadcast.
            exchange.repeat = 0;
        }
        None => {
            changed.trigger = TriggerModel::Periodic { every };
            // Nothing else may broadcast.
            (changed.exchange.heartbeat, changed.exchange.repeat) = (0, 0);
        }
    }
    Ok(changed)
}
