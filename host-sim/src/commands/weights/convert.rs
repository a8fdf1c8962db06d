//! `weights import` and `weights export`: exchanging networks with other tools.

use std::path::{Path, PathBuf};

use agent_core::math::activation::Activation;
use agent_core::observer::network::Architecture;
use agent_core::package::{OnSwitch, Serial};
use clap::Args;
use serde::Serialize;

use crate::analysis::TriggerConstants;
use crate::commands::key::Passphrase;
use crate::commands::package_format::PackageFormat;
use crate::commands::{
    Changes, CommandError, Format, load_scenario, print_json, print_text, versions,
};
use crate::files::output::OutputFile;
use crate::learning::agent_config;
use crate::learning::trained::INITIAL_VERSION;
use crate::offline::{agent_index, network_of, version_after};
use crate::packages::{Draft, PackageBytes, PackageSummary};
use crate::scenario::SimulationOnly;
use crate::shell::shell_word;
use crate::tensors::{self, Activations, ActivationsSource, NetworkArrays};

/// Arguments of `weights export`.
#[derive(Debug, Args)]
pub(in crate::commands) struct Export {
    /// Weight package
    package: PathBuf,
    /// File to write: .npz for NumPy and MATLAB's Python bridge, .safetensors for PyTorch and JAX
    #[arg(long)]
    out: PathBuf,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// Arguments of `weights import`.
#[derive(Debug, Args)]
pub(in crate::commands) struct Import {
    /// A .npz or .safetensors file with arrays layer1.weight, layer1.bias .. and outer.weight
    arrays: PathBuf,
    /// Package file to write
    #[arg(long)]
    out: PathBuf,
    /// Package of the same node: provides everything but the network, and the version to increment
    #[arg(long, required_unless_present = "scenario", conflicts_with_all = ["scenario", "agent"])]
    base: Option<PathBuf>,
    /// Scenario that describes the node, instead of --base
    #[arg(long, requires = "agent")]
    scenario: Option<PathBuf>,
    #[command(flatten)]
    changes: Changes,
    /// Number of the agent in the scenario, from 1
    #[arg(long)]
    agent: Option<usize>,
    /// Activations: one for all layers, or one per layer, separated by commas [default: those in
    /// the file, else tanh]
    #[arg(long, value_parser = activation, value_delimiter = ',')]
    activations: Vec<Activation>,
    /// Version of the package [default: one more than that of --base, else 2]
    #[arg(long)]
    package_version: Option<u32>,
    /// Keep the node's adapted outer weights when the package is switched in, instead of replacing
    /// them with the imported ones
    #[arg(long)]
    keep_outer_weights: bool,
    /// Private key to sign the package with
    #[arg(long)]
    sign: Option<PathBuf>,
    #[command(flatten)]
    passphrase: Passphrase,
    #[command(flatten)]
    package_format: PackageFormat,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

fn activation(name: &str) -> Result<Activation, String> {
    let found = Activation::NAMES.iter().find(|(known, _)| *known == name);
    found.map(|&(_, activation)| activation).ok_or_else(|| {
        let names = Activation::NAMES.map(|(known, _)| known).join(", ");
        format!("unknown activation {name:?}; choose one of {names}")
    })
}

pub(super) fn export(arguments: &Export) -> Result<(), CommandError> {
    #[derive(Serialize)]
    struct Report {
        package: String,
        out: String,
        inner_parameters: usize,
        outer_parameters: usize,
    }
    let bytes = PackageBytes::load(&arguments.package)?;
    let package = bytes.package();
    let arrays = NetworkArrays {
        architecture: package.network.architecture().clone(),
        inner: package.network.parameters().to_vec(),
        outer: package.outer_weights.to_vec(),
    };
    tensors::write(&arguments.out, &arrays)?;
    let report = Report {
        package: arguments.package.display().to_string(),
        out: arguments.out.display().to_string(),
        inner_parameters: arrays.inner.len(),
        outer_parameters: arrays.outer.len(),
    };
    match arguments.format {
        Format::Json => print_json(&report),
        Format::Text => print_text(&format!(
            "Written to {}: {} inner and {} outer parameters\n\
             To convert back: host-sim weights import {} --base {} --out NEW.weights\n",
            report.out,
            report.inner_parameters,
            report.outer_parameters,
            shell_word(&arguments.out),
            shell_word(&arguments.package)
        )),
    }
}

pub(super) fn import(arguments: &Import) -> Result<(), CommandError> {
    #[derive(Serialize)]
    struct Report {
        package: String,
        #[serde(flatten)]
        summary: PackageSummary,
        signed: bool,
        activations_from: &'static str,
        largest_rounding: Option<f64>,
    }
    let key = arguments.sign.as_deref().map(|path| arguments.passphrase.key(path)).transpose()?;
    let mut draft = draft(arguments)?;
    let activations = match arguments.activations[..] {
        [] => Activations::FromFile,
        [all] => Activations::All(all),
        _ => Activations::PerLayer(arguments.activations.clone()),
    };
    let (mut arrays, import) = tensors::read(&arguments.arrays, activations)?;
    if import.activations == ActivationsSource::Assumed {
        take_activations(&mut arrays, &draft.architecture);
    }
    check_fit(arguments, &draft, &arrays)?;
    draft.architecture = arrays.architecture;
    draft.inner = arrays.inner;
    draft.outer_weights = arrays.outer;
    let package =
        draft.seal().map_err(|error| unsuitable(&arguments.arrays, &error.to_string()))?;
    let output = OutputFile::prepare(&arguments.out, PackageBytes::KIND)?;
    let chosen = arguments.package_version;
    let format = arguments.package_format;
    let package = versions::save(package, chosen, format, key.as_ref(), &arguments.out, output)?;
    let report = Report {
        package: arguments.out.display().to_string(),
        summary: PackageSummary::new(&package),
        signed: package.is_signed(),
        activations_from: match import.activations {
            ActivationsSource::File => "file",
            ActivationsSource::Caller => "caller",
            ActivationsSource::Assumed => "assumed",
        },
        largest_rounding: import.rounding.as_ref().map(|rounding| rounding.error),
    };
    match arguments.format {
        Format::Json => print_json(&report),
        Format::Text => print_text(&format!(
            "Written to {}: {}, {}\n\
             Activations: {}; {}\n\
             Outer weights adapted by the node: {}\n",
            report.package,
            report.summary,
            if report.signed { "signed" } else { "not signed" },
            match import.activations {
                ActivationsSource::File => "from the file",
                ActivationsSource::Caller => "from --activations",
                ActivationsSource::Assumed =>
                    "assumed to be those of the node's network, else tanh; if wrong, give --activations",
            },
            report.largest_rounding.map_or("every value unchanged".to_owned(), |e| {
                format!("rounding to single precision changed values by up to {e:.1e}")
            }),
            match draft.on_switch {
                OnSwitch::Keep => "kept when the package is switched in",
                OnSwitch::Replace =>
                    "replaced by the imported ones (--keep-outer-weights keeps them)",
            },
        )),
    }
}

/// Uses the activations of the replaced network, if it has the same number of layers.
fn take_activations(arrays: &mut NetworkArrays, replaced: &Architecture) {
    let mut layers = arrays.architecture.layers().to_vec();
    if layers.len() != replaced.layers().len() {
        return;
    }
    for (layer, replaced) in layers.iter_mut().zip(replaced.layers()) {
        layer.activation = replaced.activation;
    }
    if let Ok(architecture) = Architecture::new(arrays.architecture.inputs(), &layers) {
        arrays.architecture = architecture;
    }
}

fn unsuitable(arrays: &Path, problem: &str) -> CommandError {
    let file = arrays.display();
    CommandError::usage(format!("{file}: {problem}; change the arrays, or import for another node"))
        .about(arrays)
}

/// Checks that the network fits the node's state and gains.
fn check_fit(
    arguments: &Import,
    draft: &Draft,
    arrays: &NetworkArrays,
) -> Result<(), CommandError> {
    let (n, found) = (draft.low.len(), arrays.architecture.inputs());
    if found != n {
        let problem =
            format!("the network has {found} inputs, but the node's state has {n} components");
        return Err(unsuitable(&arguments.arrays, &problem));
    }
    let (gain, features) = (draft.node.node().outer_law.gain, arrays.architecture.features());
    if gain.validate("the node's outer gain", features).is_err() {
        let problem = format!(
            "the last inner layer has {features} nodes, which the node's outer gain does not fit"
        );
        return Err(unsuitable(&arguments.arrays, &problem));
    }
    Ok(())
}

/// Returns the package without its network.
fn draft(arguments: &Import) -> Result<Draft, CommandError> {
    if arguments.scenario.is_none() {
        arguments.changes.refuse_without_scenario()?;
    }
    let base = arguments.base.as_deref().map(PackageBytes::load).transpose()?;
    let mut draft = match (&base, &arguments.scenario, arguments.agent) {
        (Some(base), ..) => Draft::copy(&base.package()),
        (None, Some(scenario), Some(agent)) => of_scenario(scenario, &arguments.changes, agent)?,
        _ => {
            let problem = "no node to import for".to_owned();
            return Err(CommandError::usage(problem + "; give --base, or --scenario and --agent"));
        }
    };
    draft.version = match (arguments.package_version, &arguments.base) {
        (Some(version), _) => version,
        (None, Some(base)) => {
            let (epoch, version) = (draft.epoch, draft.version);
            version_after(Serial { epoch, version }, base)?
        }
        (None, None) => draft.version + 1,
    };
    // They were for another network.
    draft.trial = None;
    draft.on_switch = if arguments.keep_outer_weights { OnSwitch::Keep } else { OnSwitch::Replace };
    draft.recipe = "import".to_owned();
    draft.samples = 0;
    draft.seed = 0;
    draft.errors = None;
    // Known only for networks trained by this program.
    draft.broadcast_interval_min = 0.0;
    Ok(draft)
}

fn of_scenario(path: &Path, changes: &Changes, agent: usize) -> Result<Draft, CommandError> {
    let scenario = load_scenario(path, changes)?;
    let about = |error: SimulationOnly| CommandError::from(error).about(path);
    scenario.check_for_nodes().map_err(about)?;
    let index = agent_index(&scenario, agent)?;
    let network = network_of(&scenario)?;
    let n = scenario.dimension();
    let trigger = TriggerConstants::new(&scenario);
    Ok(Draft {
        epoch: 0,
        version: INITIAL_VERSION,
        on_switch: OnSwitch::Replace,
        architecture: network.architecture.clone(),
        known_inputs: 0,
        inner: Vec::new(),
        outer_weights: Vec::new(),
        node: agent_config(&scenario, &trigger, index),
        broadcast_interval_min: 0.0,
        low: vec![f32::MIN; n],
        high: vec![f32::MAX; n],
        trial: None,
        scenario_hash: scenario.hash,
        recipe: String::new(),
        seed: 0,
        samples: 0,
        errors: None,
    })
}
