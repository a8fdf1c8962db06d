//! Which functions the layers apply: their names, and whose word counts.

use agent_core::math::activation::Activation;
use agent_core::observer::network::Architecture;

use super::TensorProblem;

/// What the caller of an import says about the activations.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Activations {
    /// Nothing: the file's are taken, tanh throughout if it states none.
    #[default]
    FromFile,
    /// The same for all layers.
    All(Activation),
    /// One a layer, first to last.
    PerLayer(Vec<Activation>),
}

/// Who said which activations the layers of an imported network have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ActivationsSource {
    /// The file.
    File,
    /// The caller; the file said the same or nothing.
    Caller,
    /// Nobody: tanh was assumed.
    Assumed,
}

impl Activations {
    /// One activation for each of the `layers`, with their source; `stated` is what the file
    /// says.
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

/// The names of an architecture's activations, one a layer.
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
