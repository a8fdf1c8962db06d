//! One network for several agents, from the recordings of several: in learning cycles and in `train`.

use agent_core::package::Serial;

use super::{Plan, PlanError};
use crate::analysis::TriggerConstants;
use crate::learning::agent_config;
use crate::learning::harmonic::Harmonic;
use crate::packages::{Draft, PackageBytes, Recording};
use crate::scenario::Scenario;

/// What a network for several agents is trained on.
#[derive(Clone, Debug)]
pub struct FleetSamples {
    /// The samples of all, one after the other, without what the observer's disturbance model takes care
    /// of.
    pub recording: Recording,
    /// The harmonic found in each direction; empty unless the observer looks for them.
    pub harmonics: Vec<Option<Harmonic>>,
}

impl FleetSamples {
    /// Joins recordings; `agents` are those that recorded them, from 0. `plan` is that of the field
    /// observer. `None` without recordings.
    #[must_use]
    pub fn new(
        plan: Option<&Plan<'_>>,
        agents: &[usize],
        recordings: &[Recording],
    ) -> Option<Self> {
        let harmonics = plan.map_or_else(Vec::new, |plan| plan.harmonics(agents, recordings));
        // The network learns what the disturbance model of the observer does not.
        let without = plan.and_then(|plan| plan.without(&harmonics, recordings));
        let recording = match without.as_deref().unwrap_or(recordings) {
            [recording] => recording.clone(),
            recordings => Recording::joined(recordings)?,
        };
        Some(Self { recording, harmonics })
    }
}

/// Returns the package of each agent with the network of `trained`, which is for the first of them, and
/// with the parameters of the field observer, if `plan` is given.
///
/// # Errors
/// If a package cannot be packed.
pub fn fleet_packages(
    scenario: &Scenario,
    plan: Option<&Plan<'_>>,
    harmonics: &[Option<Harmonic>],
    trained: &PackageBytes,
    agents: &[(usize, Serial)],
) -> Result<Vec<PackageBytes>, PlanError> {
    let trigger = TriggerConstants::new(scenario);
    let package = |place: usize, (agent, serial): (usize, Serial)| {
        let mut package = trained.clone();
        if place > 0 {
            let mut draft = Draft::copy(&package.package());
            draft.node = agent_config(scenario, &trigger, agent);
            Serial { epoch: draft.epoch, version: draft.version } = serial;
            package = draft.seal()?;
        }
        match plan {
            Some(plan) => plan.equip(&package, agent, harmonics),
            None => Ok(package),
        }
    };
    agents.iter().enumerate().map(|(place, &agent)| package(place, agent)).collect()
}
