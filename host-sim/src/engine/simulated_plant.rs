//! The plant as a run simulates it: its equations, its disturbance, and the noise that drives it.

use agent_core::Tick;

use crate::plant::Stepper;
use crate::random::{Purpose, Random};
use crate::scenario::Scenario;

/// Moves the plant's state on.
pub(super) struct SimulatedPlant<'s> {
    scenario: &'s Scenario,
    stepper: Stepper,
    noise: Random,
}

impl<'s> SimulatedPlant<'s> {
    /// Creates the plant of a run with this seed.
    pub(super) fn new(scenario: &'s Scenario, seed: u64) -> Self {
        let stepper = Stepper::new(scenario.time.integrator);
        Self { scenario, stepper, noise: Random::new(seed, Purpose::ProcessNoise) }
    }

    /// Returns what integrates the plant.
    pub(super) fn stepper(&mut self) -> &mut Stepper {
        &mut self.stepper
    }

    /// Moves `x`, shape `[n]`, from `tick` to the tick after it.
    #[inline]
    pub(super) fn advance(&mut self, tick: Tick, x: &mut [f64]) {
        let Scenario { plant, disturbance, time, process_noise, .. } = self.scenario;
        self.stepper.step(plant, disturbance, time.at(tick), time.step_size, x);
        if process_noise.is_empty() {
            return;
        }
        let root = time.step_size.sqrt();
        let intensities = x.iter_mut().zip(process_noise).enumerate();
        for (component, (x, intensity)) in intensities.filter(|(_, (_, noise))| **noise > 0.0) {
            *x += intensity * root * self.noise.normal([0, component as u64, tick]);
        }
    }
}
