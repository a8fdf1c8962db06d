//! Restarts an agent during a run.

use super::AgentParams;
use super::AgentState;
use crate::agent::exchange::Exchange;
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
    /// Restarts with the estimate `x_hat(t_(k+1))` and the outer weights `W_hat(t_(k+1))`, row by
    /// row, shape `[L, N]`; `tick` is `k`, the tick of the last attempted step, whatever its
    /// result. Returns the frame to broadcast *in place of* the step's frame: receivers need the
    /// new sample, because this agent's trigger compares the estimate with it. The sequence
    /// continues, so that neighbours do not take the frame for an old one.
    ///
    /// The neighbours' samples are kept: a neighbour whose trigger does not fire would otherwise
    /// remain unheard. [`Self::forget_neighbours_outside`] drops implausible ones.
    ///
    /// # Errors
    /// A number that is not finite, or a wrong length; the state is then unchanged.
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
        self.exchange = Exchange::new();
        #[cfg(feature = "field")]
        self.field.restart();
        self.sample_estimate(tick + 1);
        Ok(self.announcement(params))
    }

    /// Drops the neighbours' held samples outside `region`: their senders count as unheard until
    /// their next frame.
    pub fn forget_neighbours_outside(&mut self, region: &Region<N>) {
        if region.discard_outside(self.neighbour_holds.as_mut()) > 0 {
            self.consensus_is_current = false;
        }
    }
}
