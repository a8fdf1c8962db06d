//! Two inner networks in RAM, one in use and one in waiting.
//!
//! A newly trained network arrives while the old one goes on working; once it is complete and
//! checked, the two change places between two steps (the paper's `T_p`, an instant at which the
//! piecewise continuous `Phi_hat` jumps). A node that reads its weights in place from flash
//! needs no bank.
//!
//! Memory: twice `4 PARAMETERS + 24` bytes. Invariant: what is in use is always a whole, checked
//! network, or nothing.

use crate::network::{Architecture, InnerNetwork, NetworkError};

/// A network with its parameters in a static buffer.
pub type StaticNetwork<const PARAMETERS: usize> = InnerNetwork<heapless::Vec<f32, PARAMETERS>>;

/// A pair of networks of up to `PARAMETERS` inner parameters each.
#[derive(Clone, Debug, Default)]
pub struct NetworkBank<const PARAMETERS: usize> {
    active: Option<StaticNetwork<PARAMETERS>>,
    standby: Option<StaticNetwork<PARAMETERS>>,
}

impl<const PARAMETERS: usize> NetworkBank<PARAMETERS> {
    /// No network in either place.
    #[must_use]
    pub const fn new() -> Self {
        Self { active: None, standby: None }
    }

    /// The network in use.
    #[must_use]
    pub fn active(&self) -> Option<&StaticNetwork<PARAMETERS>> {
        self.active.as_ref()
    }

    /// The network in waiting.
    #[must_use]
    pub fn standby(&self) -> Option<&StaticNetwork<PARAMETERS>> {
        self.standby.as_ref()
    }

    /// Checks a network and puts it in waiting; the one in use is not touched.
    ///
    /// # Errors
    /// More parameters than there is room for, or what [`InnerNetwork::new`] refuses. What was
    /// in waiting then still is.
    pub fn stage(
        &mut self,
        architecture: Architecture,
        parameters: &[f32],
    ) -> Result<(), NetworkError> {
        let parameters = heapless::Vec::from_slice(parameters).map_err(|_| {
            NetworkError::ParameterCount { expected: PARAMETERS, found: parameters.len() }
        })?;
        self.standby = Some(InnerNetwork::new(architecture, parameters)?);
        Ok(())
    }

    /// Lets the two networks change places, so that a second call goes back; returns whether
    /// there was one in waiting. Without one nothing changes.
    pub fn switch(&mut self) -> bool {
        if self.standby.is_some() {
            core::mem::swap(&mut self.active, &mut self.standby);
            true
        } else {
            false
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::activation::Activation;
    use crate::network::Layer;

    #[test]
    fn a_refused_network_leaves_both_places_as_they_were() {
        let layer = Layer { width: 1, activation: Activation::Tanh };
        let architecture = Architecture::new(1, &[layer]).unwrap();
        let mut bank = NetworkBank::<2>::new();
        assert!(!bank.switch());
        bank.stage(architecture.clone(), &[1.0, 2.0]).unwrap();
        assert!(bank.active().is_none());
        assert!(bank.switch());
        bank.stage(architecture.clone(), &[3.0, 4.0]).unwrap();
        for bad in [&[1.0][..], &[1.0, f32::NAN], &[1.0, 2.0, 3.0]] {
            assert!(bank.stage(architecture.clone(), bad).is_err());
            assert_eq!(bank.active().unwrap().parameters(), [1.0, 2.0]);
            assert_eq!(bank.standby().unwrap().parameters(), [3.0, 4.0]);
        }
        assert!(bank.switch());
        assert_eq!(bank.active().unwrap().parameters(), [3.0, 4.0]);
    }
}
