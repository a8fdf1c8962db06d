//! Switches to another package between two steps: the paper's `T_p`, at which the piecewise
//! continuous `Phi_hat` jumps while the estimate stays continuous.

use super::{OnSwitch, Package};
use crate::agent::hold::HoldSlots;
use crate::agent::inbox::Inbox;
use crate::agent::{AgentParams, AgentState};
use crate::math::parameter::ParameterError;
use crate::observer::feedback::Neighbour;

impl<const N: usize, const FEATURES: usize, S> AgentState<N, FEATURES, S>
where
    S: HoldSlots<N>,
{
    /// Prepares the next step for `package`, whose parameters are `new`, after steps with the
    /// neighbours `old`. The estimate is kept. The adapted outer weights are kept too, unless the
    /// package replaces them or has a different number of features. Samples and pending frames are
    /// dropped from slots whose neighbour changes.
    ///
    /// # Errors
    /// Invalid outer weights, or a number of neighbours that differs from the number of slots
    /// (create a new state in that case); nothing is changed in either case.
    pub fn switch<I>(
        &mut self,
        old: &[Neighbour],
        new: &AgentParams<'_, N>,
        package: &Package<'_>,
        inbox: &mut Inbox<N, I>,
    ) -> Result<(), ParameterError>
    where
        I: HoldSlots<N>,
    {
        let (expected, found) = (self.neighbour_holds().len(), new.neighbours().len());
        if expected != found {
            let parameter = "observer.neighbours";
            return Err(ParameterError::Length { parameter, expected, found });
        }
        let same_features = self.outer_weights().rows().len() == package.features();
        if !same_features || package.outer_weights_on_switch == OnSwitch::Replace {
            self.replace_outer_weights(new, package.outer_weights)?;
        }
        let stays = |place: usize| {
            let (old, new) = (old.get(place), new.neighbours().get(place));
            old.zip(new).is_some_and(|(old, new)| old.id == new.id)
        };
        self.keep_neighbours(stays);
        inbox.keep_places(stays);
        #[cfg(feature = "field")]
        self.set_field(new, package.node.field)?;
        Ok(())
    }
}
