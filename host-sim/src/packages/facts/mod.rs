//! The contents of a package, as text and as JSON, whose keys `docs/json.md` lists under `weights inspect`.

mod exchange;
mod observer;

use std::fmt::Write;
use std::path::Path;

use agent_core::AgentId;
use agent_core::agent::exchange::ExchangeParams;
use agent_core::math::symmetric::SymmetricMatrix;
use agent_core::package::{OnSwitch, SIGNATURE_BLOCK_LENGTH, TrialLimits};
use serde::Serialize;

use crate::packages::{PackageBytes, PackageSummary};
use crate::terminal;
use exchange::Exchange;
pub(crate) use observer::Observer;

/// The contents of a package.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Facts {
    pub(crate) format_version: u8,
    #[serde(flatten)]
    pub(crate) summary: PackageSummary,
    pub(crate) signed: bool,
    pub(crate) replaces: Option<u32>,
    /// Limits of the trial, if the package has any.
    pub(crate) trial: Option<TrialLimits>,
    /// What the agent does about links that fail, if anything.
    pub(crate) exchange: Option<Exchange>,
    pub(crate) observer: Option<Observer>,
    pub(crate) dimension: usize,
    pub(crate) known_inputs: usize,
    pub(crate) layers: Vec<Layer>,
    pub(crate) inner_parameters: usize,
    pub(crate) inner_parameters_largest: f32,
    pub(crate) outer_parameters: usize,
    pub(crate) outer_weights: Vec<f32>,
    pub(crate) outer_weights_norm: f64,
    pub(crate) outer_weights_on_switch: &'static str,
    pub(crate) output_matrix: Vec<f32>,
    pub(crate) gain: Matrix,
    pub(crate) neighbours: Vec<Neighbour>,
    pub(crate) outer_gain: Matrix,
    pub(crate) outer_weights_bound: f32,
    pub(crate) boundary_layer: f32,
    pub(crate) smoothing: f32,
    pub(crate) smoothness: u8,
    pub(crate) phi1: f32,
    pub(crate) phi2: f32,
    pub(crate) threshold: f32,
    pub(crate) step_s: f32,
    pub(crate) broadcast_interval_min_s: f32,
    pub(crate) trained_low: Vec<f32>,
    pub(crate) trained_high: Vec<f32>,
    pub(crate) scenario_hash: String,
    pub(crate) recipe: String,
    pub(crate) seed: u64,
    pub(crate) samples: u32,
    pub(crate) training_error: Option<f32>,
    pub(crate) held_out_error: Option<f32>,
    pub(crate) tool_version: String,
    pub(crate) test_vectors: usize,
    /// Bytes other than parameters, test vectors and signature.
    pub(crate) overhead_bytes: usize,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct Layer {
    nodes: u8,
    activation: &'static str,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Matrix {
    form: &'static str,
    entries: Vec<f32>,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Neighbour {
    agent: AgentId,
    weight: f32,
}

impl Matrix {
    fn new(matrix: &SymmetricMatrix<'_>) -> Self {
        Self { form: matrix.form().name(), entries: matrix.entries().to_vec() }
    }
}

impl Facts {
    /// Reads a package.
    #[must_use]
    pub fn new(bytes: &PackageBytes) -> Self {
        let package = bytes.package();
        let (node, provenance) = (&package.node, &package.provenance);
        let architecture = package.network.architecture();
        let parameters = package.network.parameters();
        let squares = package.outer_weights.iter().map(|&w| f64::from(w) * f64::from(w));
        let signed = bytes.is_signed();
        // In format 2 the block is always there, and counts as overhead if it is empty.
        let signature = if signed { SIGNATURE_BLOCK_LENGTH } else { 0 };
        let numbers = parameters.len() + package.outer_weights.len() + package.test_vectors.len();
        let [major, minor, patch] = provenance.tool_version;
        Self {
            format_version: bytes.format().number(),
            summary: PackageSummary::new(bytes),
            signed,
            replaces: package.replaces,
            trial: package.trial,
            exchange: (node.exchange != ExchangeParams::PAPER)
                .then(|| Exchange::new(&node.exchange, node.step_size)),
            observer: Observer::new(node, package.dimension()),
            dimension: package.dimension(),
            known_inputs: package.known_inputs,
            layers: architecture
                .layers()
                .iter()
                .map(|l| Layer { nodes: l.width, activation: l.activation.name() })
                .collect(),
            inner_parameters: parameters.len(),
            inner_parameters_largest: parameters.iter().fold(0.0, |most, p| most.max(p.abs())),
            outer_parameters: package.outer_weights.len(),
            outer_weights: package.outer_weights.to_vec(),
            outer_weights_norm: squares.fold(0.0, |sum, square| sum + square).sqrt(),
            outer_weights_on_switch: match package.outer_weights_on_switch {
                OnSwitch::Keep => "keep",
                OnSwitch::Replace => "replace",
            },
            output_matrix: node.output_matrix.to_vec(),
            gain: Matrix::new(&node.gain),
            neighbours: node
                .neighbours()
                .map(|n| Neighbour { agent: n.id, weight: n.weight })
                .collect(),
            outer_gain: Matrix::new(&node.outer_law.gain),
            outer_weights_bound: node.outer_law.projection.bound(),
            boundary_layer: node.outer_law.projection.boundary_layer,
            smoothing: node.outer_law.projection.smoothing,
            smoothness: node.outer_law.projection.smoothness,
            phi1: node.trigger.hold_error_weight,
            phi2: node.trigger.consensus_weight,
            threshold: node.trigger.threshold,
            step_s: node.step_size,
            broadcast_interval_min_s: package.broadcast_interval_min,
            trained_low: package.trained_box.low.to_vec(),
            trained_high: package.trained_box.high.to_vec(),
            scenario_hash: format!("{:016x}", u64::from_be_bytes(provenance.scenario_hash)),
            recipe: provenance.recipe.to_owned(),
            seed: provenance.seed,
            samples: provenance.samples,
            training_error: provenance.errors.map(|errors| errors.training),
            held_out_error: provenance.errors.map(|errors| errors.held_out),
            tool_version: format!("{major}.{minor}.{patch}"),
            test_vectors: package.test_vectors().count(),
            overhead_bytes: bytes.as_bytes().len() - signature - 4 * numbers,
        }
    }

    /// Returns a text with one line for each fact; `path` is the file of the package.
    #[must_use]
    pub fn text(&self, path: &Path) -> String {
        let mut text = String::new();
        // Writing into a string cannot fail.
        let mut line = |name: &str, value: String| {
            let _ = writeln!(text, "{name:22} {value}");
        };
        line("package", format!("{}, format {}", path.display(), self.format_version));
        line("bytes", format!("{}, of which {} overhead", self.summary.bytes, self.overhead_bytes));
        line("signed", if self.signed { "yes" } else { "no" }.to_owned());
        let replaces = self.replaces.map_or(String::new(), |newest| {
            format!(" (may replace versions up to {newest}, if signed)")
        });
        line("version", format!("{}{replaces}", self.summary.version));
        line("package epoch", self.summary.epoch.to_string());
        line("agent", self.summary.agent.to_string());
        let layers: Vec<_> =
            self.layers.iter().map(|l| format!("{} {}", l.nodes, l.activation)).collect();
        line(
            "network",
            format!(
                "{} inputs, {}, {} outputs",
                self.dimension + self.known_inputs,
                layers.join(", "),
                self.dimension
            ),
        );
        line(
            "inner parameters",
            format!("{}, largest {:.4}", self.inner_parameters, self.inner_parameters_largest),
        );
        line(
            "outer weights",
            format!(
                "{}, norm {:.4}, bound {}, when switched in: {}",
                self.outer_parameters,
                self.outer_weights_norm,
                self.outer_weights_bound,
                self.outer_weights_on_switch
            ),
        );
        for (row, entries) in self.output_matrix.chunks_exact(self.dimension).enumerate() {
            let name = if row == 0 { "output matrix" } else { "" };
            line(name, format!("{entries:?}"));
        }
        line("gain K1 [1/s]", format!("{} {:?}", self.gain.form, self.gain.entries));
        let neighbours: Vec<_> =
            self.neighbours.iter().map(|n| format!("{} (weight {})", n.agent, n.weight)).collect();
        line(
            "neighbours",
            if neighbours.is_empty() { "none".to_owned() } else { neighbours.join(", ") },
        );
        line(
            "adaptation gain [1/s2]",
            format!("{} {:?}", self.outer_gain.form, self.outer_gain.entries),
        );
        line(
            "trigger",
            format!("phi1 {} 1/s, phi2 {} 1/s, threshold {}", self.phi1, self.phi2, self.threshold),
        );
        line("step [s]", self.step_s.to_string());
        line(
            "shortest interval [s]",
            match self.broadcast_interval_min_s {
                0.0 => "not known".to_owned(),
                interval => format!("{interval} by Theorem 2, on the training trajectory"),
            },
        );
        let unlimited = self.trained_low.iter().all(|&low| low == f32::MIN);
        line(
            "trained inputs",
            match (self.samples, unlimited) {
                (0, true) => "none: not trained".to_owned(),
                _ => {
                    let limits = self.trained_low.iter().zip(&self.trained_high);
                    let limits: Vec<_> = limits.map(|(l, h)| format!("[{l:.4}, {h:.4}]")).collect();
                    limits.join(" x ")
                }
            },
        );
        let error =
            |error: Option<f32>| error.map_or("not known".to_owned(), |e| format!("{e:.3e}"));
        line(
            "training",
            format!(
                "recipe {}, seed {}, {} samples, mean squared error {} (held out: {})",
                terminal::one_line(&self.recipe),
                self.seed,
                self.samples,
                error(self.training_error),
                error(self.held_out_error)
            ),
        );
        line("scenario hash", self.scenario_hash.clone());
        line("made by", format!("version {}", self.tool_version));
        line("test vectors", self.test_vectors.to_string());
        line("exchange", self.exchange.as_ref().map_or("the paper's".to_owned(), Exchange::words));
        line("observer", self.observer.as_ref().map_or("the paper's".to_owned(), Observer::words));
        for (c, words) in self.observer.iter().flat_map(Observer::directions).enumerate() {
            line(&format!("  direction {}", c + 1), words);
        }
        line("limits of the trial", self.trial.as_ref().map_or("none".to_owned(), limits));
        text
    }
}

/// Returns a number of single precision as its shortest decimal form.
fn decimal(value: f32) -> f64 {
    value.to_string().parse().unwrap_or_else(|_| f64::from(value))
}

/// Returns the limits that are present, in words.
fn limits(limits: &TrialLimits) -> String {
    let number = |limit: Option<f32>, words: &str| limit.map(|limit| format!("{words} {limit}"));
    let count = |limit: Option<u32>, words: &str| limit.map(|limit| format!("{words} {limit}"));
    let found = [
        count(limits.seconds, "seconds at least"),
        number(limits.innovation_rms, "RMS of the innovation"),
        number(limits.broadcasts_per_second, "broadcasts per second"),
        count(limits.restarts, "restarts"),
        count(limits.overflows, "overflows"),
        count(limits.skipped_ticks, "skipped ticks"),
    ];
    match found.into_iter().flatten().collect::<Vec<_>>() {
        limits if limits.is_empty() => "none".to_owned(),
        limits => limits.join(", "),
    }
}
