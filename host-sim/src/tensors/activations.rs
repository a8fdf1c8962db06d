//! Activations of the layers: their names, and the precedence of file and caller.

use agent_core::math::activation::Activation;
use agent_core::observer::network::Architecture;

use super::TensorProblem;

/// The activations that the caller of an import requests.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Activations {
    /// Those of the file, or tanh throughout if it states none.
    #[default]
    FromFile,
    /// The same activation for all layers.
    All(Activation),
    /// One activation per layer, first to last.
    PerLayer(Vec<Activation>),
}

/// Where the activations of an imported network come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ActivationsSource {
    /// The file.
    File,
    /// The caller; the file stated the same or none.
    Caller,
    /// Assumed to be tanh.
    Assumed,
}

impl Activations {
    /// Returns one activation for each of the `layers`, with their source; `stated` are the names
    /// in the file.
    pub(super) fn resolve(
        self,
        stated: Option<&[String]>,
        layers: usize,
    ) -> Result<(Vec<Activation>, ActivationsSource), TensorProblem> {
        let stated = match stated {
            Some(names) => {
                let named = names.iter().map(|name| from_name(name)).collect::<Result<_, _>>()?;
                Some(one_each(named, layers)?)
            }
            None => None,
        };
        let asked = match self {
            Self::FromFile => None,
            Self::All(activation) => Some(vec![activation; layers]),
            Self::PerLayer(each) => Some(one_each(each, layers)?),
        };
        match (stated, asked) {
            (None, None) => Ok((vec![Activation::Tanh; layers], ActivationsSource::Assumed)),
            (Some(stated), None) => Ok((stated, ActivationsSource::File)),
            (Some(stated), Some(asked)) if stated != asked => {
                Err(TensorProblem::ActivationsDiffer {
                    stated: joined(&stated),
                    asked: joined(&asked),
                })
            }
            (_, Some(asked)) => Ok((asked, ActivationsSource::Caller)),
        }
    }
}

/// Returns the names of an architecture's activations, one per layer.
pub(super) fn names_of(architecture: &Architecture) -> Vec<&'static str> {
    architecture.layers().iter().map(|layer| layer.activation.name()).collect()
}

fn one_each(given: Vec<Activation>, layers: usize) -> Result<Vec<Activation>, TensorProblem> {
    match given.as_slice() {
        &[for_all] => Ok(vec![for_all; layers]),
        each if each.len() == layers => Ok(given),
        _ => Err(TensorProblem::ActivationCount { found: given.len(), layers }),
    }
}

fn from_name(sought: &str) -> Result<Activation, TensorProblem> {
    Activation::NAMES
        .iter()
        .find(|(name, _)| *name == sought)
        .map(|&(_, activation)| activation)
        .ok_or_else(|| TensorProblem::UnknownActivation { name: sought.to_owned() })
}

fn joined(activations: &[Activation]) -> String {
    activations.iter().map(|activation| activation.name()).collect::<Vec<_>>().join(",")
}
