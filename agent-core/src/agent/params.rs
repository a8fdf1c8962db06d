//! What does not change about an agent.

use nalgebra::SMatrix;

use crate::agent::hold::RESTART_SILENCE;
use crate::math::parameter::{ParameterError, positive};
use crate::math::symmetric::SymmetricMatrix;
use crate::observer::feedback::{Neighbour, ObserverParams};
use crate::observer::outer_law::OuterLawParams;
use crate::observer::projection::ProjectionParams;
use crate::observer::trigger::{Trigger, TriggerParams};
use crate::{AgentId, Tick};

/// Everything about an agent that does not change, checked as a whole.
#[derive(Clone, Debug, PartialEq)]
pub struct AgentParams<'a, const N: usize> {
    pub(super) id: AgentId,
    pub(super) step_size: f32,
    pub(super) observer: ObserverParams<'a, N>,
    pub(super) outer_law: OuterLawParams<'a>,
    pub(super) trigger: Trigger,
    pub(super) restart_silence: Tick,
}

impl<'a, const N: usize> AgentParams<'a, N> {
    /// Joins the parameters of agent `id`, which is stepped every `step_size` \[s\].
    ///
    /// # Errors
    /// The first parameter that is out of its range.
    pub fn new(
        id: AgentId,
        step_size: f32,
        observer: ObserverParams<'a, N>,
        outer_law: OuterLawParams<'a>,
        trigger: TriggerParams,
    ) -> Result<Self, ParameterError> {
        positive("step_size", step_size)?;
        observer.validate(id)?;
        outer_law.projection.validate()?;
        trigger.validate()?;
        let (trigger, restart_silence) = (Trigger::Event(trigger), RESTART_SILENCE);
        Ok(Self { id, step_size, observer, outer_law, trigger, restart_silence })
    }

    /// The same with another number of steps than [`RESTART_SILENCE`] until a neighbour that began
    /// anew is heard again. Above the longest delay of the link, or a frame that was overtaken
    /// can take the place of a newer one.
    #[must_use]
    pub fn with_restart_silence(self, restart_silence: Tick) -> Self {
        Self { restart_silence, ..self }
    }

    /// Returns the same parameters with another trigger than the event trigger. Packages carry no other, so
    /// this is for simulations.
    ///
    /// # Errors
    /// A constant of the trigger that is out of its range.
    pub fn with_trigger(self, trigger: Trigger) -> Result<Self, ParameterError> {
        trigger.validate()?;
        Ok(Self { trigger, ..self })
    }

    /// The same with neighbours and `Gamma` that lie elsewhere: copies of what was checked.
    #[inline(always)] // A node does it in every step, and a call copies everything once more.
    pub(crate) fn relocated<'b>(
        &self,
        neighbours: &'b [Neighbour],
        outer_gain: SymmetricMatrix<'b>,
    ) -> AgentParams<'b, N> {
        AgentParams {
            id: self.id,
            step_size: self.step_size,
            observer: ObserverParams {
                output_matrix: self.observer.output_matrix.clone(),
                gain: self.observer.gain,
                neighbours,
            },
            outer_law: OuterLawParams { gain: outer_gain, projection: self.outer_law.projection },
            trigger: self.trigger,
            restart_silence: self.restart_silence,
        }
    }

    /// The agent's number.
    #[must_use]
    pub fn id(&self) -> AgentId {
        self.id
    }

    /// `dt`. \[s\]
    #[must_use]
    pub fn step_size(&self) -> f32 {
        self.step_size
    }

    /// `m`, how many outputs the agent measures.
    #[must_use]
    pub fn outputs(&self) -> usize {
        self.observer.output_matrix.outputs()
    }

    /// Returns when the agent broadcasts.
    #[must_use]
    pub fn trigger(&self) -> &Trigger {
        &self.trigger
    }

    /// `K_1`, shape `[N, N]`. \[1/s\]
    #[must_use]
    pub fn gain(&self) -> &SMatrix<f32, N, N> {
        &self.observer.gain
    }

    /// The operator that keeps the outer weights bounded.
    #[must_use]
    pub fn projection(&self) -> &ProjectionParams {
        &self.outer_law.projection
    }

    /// The neighbours, in the order of an inbox's places.
    #[must_use]
    pub fn neighbours(&self) -> &'a [Neighbour] {
        self.observer.neighbours
    }
}
