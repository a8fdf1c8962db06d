//! The field observer's parameters in a package.

use agent_core::AgentId;
use agent_core::observer::field::{Coupling, Direction, FieldParams, FieldWords, HoldKind};
use agent_core::package::AgentConfig;
use serde::Serialize;

use super::decimal;
use crate::number::significant;
use crate::packages::with_node_dimension;

/// The field observer of an agent.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Observer {
    coupling: &'static str,
    hold: &'static str,
    uses_network: bool,
    adapts: bool,
    /// In hexadecimal.
    digest: String,
    half_precision: bool,
    /// Age of a parent's sample at which the spare parent is followed. \[s\]
    timeout_s: Option<f64>,
    relay_share: f64,
    /// One for each direction.
    directions: Vec<ObserverDirection>,
}

/// One direction of the field observer.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct ObserverDirection {
    /// The output that measures it, from 1.
    output: Option<u8>,
    /// The neighbour that the agent follows, and the one in its place if that is silent.
    parent: Option<AgentId>,
    spare: Option<AgentId>,
    announced: bool,
    /// The gain that this agent uses: of its own measurement, or towards samples. \[1/s\]
    gain: f32,
    /// \[1/s\]
    root_gain: f64,
    /// \[1/s\]
    tree_gain: f64,
    radius: f32,
    /// Largest estimate of the disturbance; `None` without a model of it.
    disturbance_limit: Option<f64>,
    /// \[1/s^2\]
    bias_gain: Option<f64>,
    /// Frequency of the disturbance. \[rad/s\]
    frequency: Option<f64>,
}

impl Observer {
    /// Reads the parameters in the package of an agent with `n` states; `None` for the paper's observer.
    pub(crate) fn new(node: &AgentConfig<'_>, n: usize) -> Option<Self> {
        with_node_dimension!(n, observer(node), else None)
    }

    /// Returns the settings of the whole observer, one line.
    pub(super) fn words(&self) -> String {
        let mut words = vec![
            format!("field: coupled by {}", self.coupling),
            format!("{} hold", self.hold),
            if self.uses_network { "with the network" } else { "without the network" }.to_owned(),
        ];
        if self.adapts {
            words.push("outer weights adapt".to_owned());
        }
        words.push(format!("numbers of {} bits", if self.half_precision { 16 } else { 32 }));
        if let Some(timeout) = self.timeout_s {
            words.push(format!("spare parents after {} s", significant(timeout, 4)));
        }
        words.push(format!("digest {}", self.digest));
        words.join(", ")
    }

    /// Returns the settings of each direction, a line for each.
    pub(super) fn directions(&self) -> impl Iterator<Item = String> + '_ {
        self.directions.iter().map(|direction| direction.words(self.follows_trees()))
    }

    fn follows_trees(&self) -> bool {
        self.coupling == TREES
    }

    /// Returns what all agents have in common, a line for each; the gains are those of agents that measure a direction,
    /// and of all others.
    pub(crate) fn shared_words(&self) -> [String; 4] {
        let list = |of: &dyn Fn(&ObserverDirection) -> Option<f64>| {
            let number =
                |number: Option<f64>| number.map_or("none".to_owned(), |x| significant(x, 3));
            self.directions
                .iter()
                .map(|direction| number(of(direction)))
                .collect::<Vec<_>>()
                .join(", ")
        };
        [
            format!("coupled by {}, {} hold", self.coupling, self.hold),
            format!(
                "gains in each direction, own measurement {} 1/s, towards neighbours {} 1/s",
                list(&|direction| Some(direction.root_gain)),
                list(&|direction| Some(direction.tree_gain)),
            ),
            format!("radius of the trigger {}", list(&|direction| Some(direction.radius.into()))),
            format!(
                "largest disturbance estimate {}",
                list(&|direction| direction.disturbance_limit)
            ),
        ]
    }
}

impl ObserverDirection {
    fn words(&self, follows_trees: bool) -> String {
        let gain = |gain: f64| significant(gain, 4);
        let mut words = Vec::new();
        match (self.output, self.parent) {
            (Some(output), _) => {
                words.push(format!(
                    "measured by output {output}, gain {} 1/s",
                    gain(self.root_gain)
                ));
            }
            (None, Some(parent)) => {
                let spare =
                    self.spare.map_or(String::new(), |spare| format!(" (or agent {spare})"));
                words.push(format!(
                    "follows agent {parent}{spare}, gain {} 1/s",
                    gain(self.tree_gain)
                ));
            }
            (None, None) => words.push("not measured".to_owned()),
        }
        if !follows_trees {
            words.push(format!("gain towards neighbours {} 1/s", gain(self.tree_gain)));
        }
        words.push(match self.announced {
            true => format!("announced at radius {}", significant(self.radius.into(), 3)),
            false => "not announced".to_owned(),
        });
        if let (Some(limit), Some(_)) = (self.disturbance_limit, self.output) {
            words.push(format!("disturbance estimated up to {}", significant(limit, 3)));
            words.extend(self.bias_gain.map(|bias| format!("bias gain {} 1/s2", gain(bias))));
            words.extend(
                self.frequency
                    .map(|frequency| format!("frequency {} rad/s", significant(frequency, 4))),
            );
        }
        words.join(", ")
    }
}

/// How [`Coupling::Trees`] is called.
const TREES: &str = "trees";

fn observer<const N: usize>(node: &AgentConfig<'_>) -> Option<Observer> {
    let params = FieldParams::<N>::from_words(FieldWords(node.field)).ok()?;
    let step_size = decimal(node.step_size);
    let neighbour = |place: Option<u8>| Some(node.neighbours().nth(place?.into())?.id);
    let direction = |direction: &Direction| {
        let model = &direction.model;
        let has_model = model.clip > 0.0;
        ObserverDirection {
            output: direction.output.map(|output| output.saturating_add(1)),
            parent: neighbour(direction.parent),
            spare: neighbour(direction.spare),
            announced: direction.is_announced,
            gain: match direction.output {
                Some(_) => direction.root_gain,
                None => direction.tree_gain,
            },
            root_gain: decimal(direction.root_gain),
            tree_gain: decimal(direction.tree_gain),
            radius: direction.radius,
            disturbance_limit: has_model.then(|| decimal(model.clip)),
            bias_gain: has_model.then(|| decimal(model.bias_gain)),
            frequency: (model.rotation_sine != 0.0).then(|| {
                let (sine, cosine) = (model.rotation_sine.into(), model.rotation_cosine.into());
                libm::atan2(sine, cosine) / step_size
            }),
        }
    };
    let options = &params.options;
    Some(Observer {
        coupling: match options.coupling {
            Coupling::Held => "held estimates",
            Coupling::Current => "current estimates",
            Coupling::Trees => TREES,
        },
        hold: match options.hold {
            HoldKind::ZeroOrder => "zero-order",
            HoldKind::Rate => "rate",
            HoldKind::Model => "model",
        },
        uses_network: options.uses_network,
        adapts: options.adapts,
        digest: format!("{:04x}", options.digest),
        half_precision: options.is_half,
        timeout_s: (options.timeout > 0).then(|| f64::from(options.timeout) * step_size),
        relay_share: decimal(options.relay_share),
        directions: params.directions.iter().map(direction).collect(),
    })
}
