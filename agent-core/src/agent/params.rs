//! The immutable parameters of an agent.

use nalgebra::SMatrix;

use crate::agent::exchange::ExchangeParams;
use crate::agent::hold::RESTART_SILENCE;
use crate::math::numeric::{components, square_root};
use crate::math::parameter::{ParameterError, positive};
use crate::math::symmetric::SymmetricMatrix;
use crate::observer::feedback::{Neighbour, ObserverParams};
use crate::observer::outer_law::OuterLawParams;
use crate::observer::projection::ProjectionParams;
use crate::observer::trigger::{Trigger, TriggerParams};
use crate::{AgentId, Tick};

/// All parameters of an agent, validated as a whole.
///
/// ```
/// use agent_core::{AgentParams, StateVector};
/// # use agent_core::{Neighbour, ObserverParams, OutputMatrix, OuterLawParams, ProjectionParams};
/// # use agent_core::{SymmetricMatrix, TriggerParams};
/// # let neighbours = [Neighbour { id: 2, weight: 1.0 }];
/// # let observer = ObserverParams {
/// #     output_matrix: OutputMatrix::new(&[StateVector::<2>::new(1.0, 0.0)])?,
/// #     gain: SymmetricMatrix::Scalar(50.0).unfold(),
/// #     neighbours: &neighbours,
/// # };
/// # let projection =
/// #     ProjectionParams { radius: 9.0, boundary_layer: 1.0, smoothing: 0.1, smoothness: 1 };
/// # let outer_law = OuterLawParams { gain: SymmetricMatrix::Scalar(1.0), projection };
/// # let trigger =
/// #     TriggerParams { hold_error_weight: 1e4, consensus_weight: 0.5, threshold: 10.0 };
/// # let params = AgentParams::new(1, 1e-3, observer, outer_law, trigger)?;
///
/// // `params` describes agent 1, which measures one output and hears agent 2.
/// assert_eq!((params.id(), params.outputs()), (1, 1));
/// assert_eq!(params.neighbours()[0].id, 2);
/// # Ok::<(), agent_core::math::parameter::ParameterError>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct AgentParams<'a, const N: usize> {
    pub(super) id: AgentId,
    pub(super) step_size: f32,
    pub(super) observer: ObserverParams<'a, N>,
    pub(super) outer_law: OuterLawParams<'a>,
    pub(super) trigger: Trigger,
    pub(super) restart_silence: Tick,
    pub(super) exchange: ExchangeParams,
}

impl<'a, const N: usize> AgentParams<'a, N> {
    /// Creates the parameters of agent `id`, which is stepped every `step_size` \[s\].
    ///
    /// # Errors
    /// The first parameter outside its range.
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
        let exchange = ExchangeParams::PAPER;
        Ok(Self { id, step_size, observer, outer_law, trigger, restart_silence, exchange })
    }

    /// Sets the exchange with the neighbours, in place of the paper's.
    ///
    /// # Errors
    /// Two parameters that contradict each other.
    pub fn with_exchange(self, exchange: ExchangeParams) -> Result<Self, ParameterError> {
        exchange.validate()?;
        Ok(Self { exchange, ..self })
    }

    /// Returns the exchange with the neighbours.
    #[must_use]
    pub fn exchange(&self) -> &ExchangeParams {
        &self.exchange
    }

    /// Sets the number of steps after which a restarted neighbour is heard again, in place of
    /// [`RESTART_SILENCE`]. It must exceed the longest delay of the link; otherwise a delayed
    /// frame can replace a newer one.
    #[must_use]
    pub fn with_restart_silence(self, restart_silence: Tick) -> Self {
        Self { restart_silence, ..self }
    }

    /// Returns the same parameters with a trigger other than the event trigger. Packages carry no other, so
    /// this is for simulations.
    ///
    /// # Errors
    /// A constant of the trigger that is out of its range.
    pub fn with_trigger(self, trigger: Trigger) -> Result<Self, ParameterError> {
        trigger.validate()?;
        Ok(Self { trigger, ..self })
    }

    /// The same with neighbours and `Gamma` that are stored elsewhere: copies of what was checked.
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
            exchange: self.exchange,
        }
    }

    /// Returns the agent's number.
    #[must_use]
    pub fn id(&self) -> AgentId {
        self.id
    }

    /// Returns `dt`. \[s\]
    #[must_use]
    pub fn step_size(&self) -> f32 {
        self.step_size
    }

    /// Returns `m`, the number of outputs the agent measures.
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

    /// Returns a magnitude up to which neither the agent's estimate nor its neighbours' samples can make
    /// a step overflow, whatever their signs: at least 1. \[state unit\]
    ///
    /// Let `c` bound the components. Then `|z| <= 2 c sum a_ij`, `|C^T C x_hat| <= c m N |C|^2`, and
    /// the derivative's feedback is at most `|K_1| N` times their sum, with the largest entry of each
    /// matrix as its norm; adaptation multiplies `C^T e_3` by `Gamma sigma`, with
    /// `|sigma| <= 1`. Trigger and outer law square such terms, weighted by `phi_1` and `phi_2`, and
    /// add up at most `N` or `L N` squares. The product of all these factors, each at least 1, times `c`
    /// is at most `2^60`, so no square exceeds `2^120` and no sum of them the largest number. A
    /// measurement of the same magnitude fits, too.
    #[must_use]
    pub fn ceiling(&self) -> f32 {
        /// `2^60`.
        const LARGEST: f32 = 1_152_921_504_606_846_976.0;
        let dimension = N as f32;
        let output = self.observer.output_matrix.rows().iter();
        let output = output
            .fold(1.0, |largest_so_far: f32, row| largest_so_far.max(largest(components(row))));
        let edges = self.observer.neighbours.iter().fold(1.0, |sum, edge| sum + edge.weight);
        let gain = largest(self.observer.gain.data.0.as_flattened());
        let feedback = 2.0 * edges + dimension * dimension * output * output;
        let law = largest(self.outer_law.gain.entries());
        let trigger = match &self.trigger {
            Trigger::Event(params) => largest(&[params.hold_error_weight, params.consensus_weight]),
            _ => 1.0,
        };
        let growth = dimension * feedback * gain.max(law) * self.step_size.max(1.0);
        let ceiling = LARGEST / (growth * square_root(trigger).max(1.0));
        if ceiling > 1.0 { ceiling } else { 1.0 }
    }

    /// Returns the parameters of the operator that bounds the outer weights.
    #[must_use]
    pub fn projection(&self) -> &ProjectionParams {
        &self.outer_law.projection
    }

    /// Returns the neighbours, in the order of an inbox's slots.
    #[must_use]
    pub fn neighbours(&self) -> &'a [Neighbour] {
        self.observer.neighbours
    }
}

/// Returns the largest magnitude, at least 1.
#[inline(never)]
fn largest(entries: &[f32]) -> f32 {
    entries.iter().fold(1.0, |largest: f32, entry| largest.max(entry.abs()))
}
