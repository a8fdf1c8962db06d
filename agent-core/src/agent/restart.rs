//! Beginning anew in the middle of a run.

use super::AgentParams;
use super::AgentState;
use crate::agent::hold::HoldSlots;
use crate::agent::region::Region;
use crate::math::numeric::{components, zeros};
use crate::math::parameter::{ParameterError, finite};
use crate::wire::frame::Frame;
use crate::{StateVector, Tick};

impl<const N: usize, const FEATURES: usize, S> AgentState<N, FEATURES, S>
where
    S: HoldSlots<N>,
{
    /// Begins anew with the estimate `x_hat(t_(k+1))` and the outer weights `W_hat(t_(k+1))`, row
    /// by row, shape `[L, N]`; `tick` is `k`, that of the last attempt at a step, whatever came of
    /// it. Returns the frame to broadcast *in place of* the step's: receivers have to know the new
    /// sample, since it is what this agent compares itself with. Its sequence goes on, so that
    /// nobody takes it for an old one.
    ///
    /// What the neighbours broadcast stays: of one that has nothing new to say nothing would be
    /// heard again. [`Self::forget_neighbours_outside`] drops what cannot be true.
    ///
    /// # Errors
    /// A number that is not finite, or a length that does not fit; nothing is changed then.
    pub fn restart(
        &mut self,
        params: &AgentParams<'_, N>,
        tick: Tick,
        estimate: StateVector<N>,
        outer_weights: &[f32],
    ) -> Result<Frame<N>, ParameterError> {
        finite("restart_estimate", components(&estimate))?;
        self.outer_weights.replace(outer_weights, &params.outer_law)?;
        // A last tick of `Tick::MAX` would have no successor.
        let tick = tick.max(self.last_tick.unwrap_or(0)).min(Tick::MAX - 1);
        self.last_tick = Some(tick);
        self.estimate = estimate;
        self.consensus_term = zeros();
        self.output_error = zeros();
        self.sample_estimate(tick + 1);
        Ok(self.announcement(params))
    }

    /// Drops the neighbours' held samples that lie outside `region`: their senders count as not
    /// heard until their next frame.
    pub fn forget_neighbours_outside(&mut self, region: &Region<N>) {
        if region.discard_outside(self.neighbour_holds.as_mut()) > 0 {
            self.consensus_is_current = false;
        }
    }
}
