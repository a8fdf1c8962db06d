//! `weights evaluate`: evaluates a package on a recording, before it is pushed.
//!
//! For every sample, the network's output `f_hat = W_hat^T sigma(Phi_hat(x_hat))`, computed by the
//! node's own code in single precision, is compared with the recorded derivative of the estimate.
//! The errors without a network (zero) and with a constant (the mean) are given for comparison.

use std::fmt::Write;
use std::path::PathBuf;

use agent_core::AgentId;
use agent_core::observer::network::Scratch;
use agent_core::package::{OnSwitch, Package};
use clap::Args;
use serde::Serialize;

use crate::commands::{CommandError, Format, print_json, print_text};
use crate::packages::{PackageBytes, Recording, with_dimension};
use crate::training::{Dataset, Smoothing};

/// Arguments of `weights evaluate`.
#[derive(Debug, Args)]
pub(in crate::commands) struct Arguments {
    /// Weight package
    package: PathBuf,
    /// Recorded samples of its agent, in the format of `train`
    samples: PathBuf,
    /// Window over which to average inputs and derivatives first, as a recipe's smoothing_window: a
    /// network cannot explain the consensus chatter in a raw derivative [s]
    #[arg(long, default_value_t = 0.0, value_parser = window)]
    smoothing_window: f64,
    /// Use the package's outer weights, even if the node would keep those of the recording
    #[arg(long)]
    own_outer_weights: bool,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

fn window(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number| (0.0..1e9).contains(number));
    number.ok_or_else(|| "expected a number of seconds, at least 0 and below 1e9".to_owned())
}

#[derive(Serialize)]
struct Report {
    package: String,
    recording: String,
    agent: AgentId,
    version: u32,
    /// `package` or `recording`.
    outer_weights: &'static str,
    samples: usize,
    gaps: usize,
    smoothing_window_s: f64,
    outside_box: usize,
    outside_box_share: f64,
    /// Number of samples with a non-finite network output, which are excluded from all errors.
    not_finite: usize,
    components: Vec<Component>,
    total: Component,
}

/// Mean squared errors of the recorded derivative.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
struct Component {
    /// With the package's network. [(state unit/s)²]
    mse: f64,
    /// Square root of `mse`. [state unit/s]
    rms: f64,
    /// Without a network.
    mse_without: f64,
    /// With the best constant.
    mse_constant: f64,
    /// `1 - mse / mse_constant`; `null` if the derivative is constant.
    explained: Option<f64>,
}

impl Component {
    fn new(mse: f64, mse_without: f64, mse_constant: f64) -> Self {
        let explained = (mse_constant > 0.0).then(|| 1.0 - mse / mse_constant);
        Self { mse, rms: mse.sqrt(), mse_without, mse_constant, explained }
    }
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    let bytes = PackageBytes::load(&arguments.package)?;
    let mut package = bytes.package();
    if package.known_inputs > 0 {
        let file = arguments.package.display();
        let problem = format!(
            "{file}: the network takes known inputs, which are not read from sample files, so it cannot be \
             evaluated on them; try it in a run with `host-sim run SCENARIO --weights PACKAGE`"
        );
        return Err(CommandError::usage(problem).about(&arguments.package));
    }
    let recording = Recording::load(&arguments.samples, package.dimension(), package.features())?;
    let kept = recording.outer_weights.as_deref().filter(|_| {
        package.outer_weights_on_switch == OnSwitch::Keep && !arguments.own_outer_weights
    });
    if let Some(kept) = kept {
        package.outer_weights = kept;
    }
    let smoothing = Smoothing { window: arguments.smoothing_window, stride: 1 };
    let smoothed = smoothing
        .apply_with_gaps(&recording.samples, &recording.ticks(), recording.interval)
        .map_err(|error| {
            let file = arguments.samples.display();
            CommandError::usage(format!("{file}: {error}; give a shorter --smoothing-window"))
                .about(&arguments.samples)
        })?;
    let outputs = outputs(&package, &smoothed.data);
    let n = package.dimension();
    let finite = |row: &[f32]| row.iter().all(|value| value.is_finite());
    let not_finite = outputs.chunks_exact(n).filter(|row| !finite(row)).count();
    let components = components(&smoothed.data, &outputs);
    let raw = recording.samples.inputs().chunks_exact(recording.samples.width());
    let outside_box = raw
        .filter(|row| {
            let row: Vec<f32> = row.iter().map(|&value| value as f32).collect();
            !package.trained_box.contains(&row)
        })
        .count();
    let sum = |part: fn(&Component) -> f64| components.iter().map(part).fold(0.0, |a, b| a + b);
    let report = Report {
        package: arguments.package.display().to_string(),
        recording: arguments.samples.display().to_string(),
        agent: package.node.agent,
        version: package.version,
        outer_weights: if kept.is_some() { "recording" } else { "package" },
        samples: smoothed.data.len(),
        gaps: recording.gaps.len(),
        smoothing_window_s: arguments.smoothing_window,
        outside_box,
        outside_box_share: outside_box as f64 / recording.samples.len() as f64,
        not_finite,
        total: Component::new(sum(|c| c.mse), sum(|c| c.mse_without), sum(|c| c.mse_constant)),
        components,
    };
    match arguments.format {
        Format::Json => print_json(&report),
        Format::Text => print_text(&text(&report)),
    }
}

/// Returns the network's output for every sample, row-major, shape `[samples, n]`.
fn outputs(package: &Package<'_>, data: &Dataset) -> Vec<f32> {
    let mut scratch = Scratch::NEW;
    let mut outputs = Vec::with_capacity(data.targets().len());
    for input in data.inputs().chunks_exact(data.width()) {
        let input: Vec<f32> = input.iter().map(|&value| value as f32).collect();
        let output =
            with_dimension!(package.dimension(), output(package, &input, &mut scratch), else None);
        outputs.extend(output.unwrap_or_else(|| vec![f32::NAN; data.dimension()]));
    }
    outputs
}

fn output<const N: usize>(
    package: &Package<'_>,
    input: &[f32],
    scratch: &mut Scratch,
) -> Option<Vec<f32>> {
    package.evaluate::<N>(input, scratch).map(|(_, output)| output.as_slice().to_vec())
}

/// Returns the errors of each component over the samples with finite outputs.
fn components(data: &Dataset, outputs: &[f32]) -> Vec<Component> {
    let n = data.dimension();
    let rows = || {
        data.targets()
            .chunks_exact(n)
            .zip(outputs.chunks_exact(n))
            .filter(|(_, output)| output.iter().all(|value| value.is_finite()))
    };
    let count = rows().count() as f64;
    let mean = |of: &dyn Fn(f64, f64) -> f64, i: usize| {
        rows().fold(0.0, |sum, (target, output)| sum + of(target[i], output[i].into())) / count
    };
    (0..n)
        .map(|i| {
            let average = mean(&|target, _| target, i);
            Component::new(
                mean(&|target, output| (target - output) * (target - output), i),
                mean(&|target, _| target * target, i),
                mean(&|target, _| (target - average) * (target - average), i),
            )
        })
        .collect()
}

fn text(report: &Report) -> String {
    let mut text = format!(
        "{}: agent {}, version {}, on {} samples of {}\n\
         {} samples ({:.1} %) are outside the trained box\n\
         Outer weights: from the {}\n\n\
         Mean squared error of the derivative [(state unit/s)^2]\n\
         component   this package   no network   a constant   explained\n",
        report.package,
        report.agent,
        report.version,
        report.samples,
        report.recording,
        report.outside_box,
        100.0 * report.outside_box_share,
        report.outer_weights,
    );
    // Writing into a string cannot fail.
    let mut line = |name: &str, c: &Component| {
        let explained = c.explained.map_or("-".to_owned(), |e| format!("{:.1} %", 100.0 * e));
        let _ = writeln!(
            text,
            "{name:9}   {:12.4e}   {:10.3e}   {:10.3e}   {explained:>9}",
            c.mse, c.mse_without, c.mse_constant
        );
    };
    for (index, component) in report.components.iter().enumerate() {
        line(&(index + 1).to_string(), component);
    }
    line("all", &report.total);
    if report.not_finite > 0 {
        let _ = writeln!(
            text,
            "The output is not finite for {} samples, which the table excludes",
            report.not_finite
        );
    }
    if report.total.mse >= report.total.mse_without {
        text += "Worse than without a network: do not push this package\n";
    } else if report.total.mse >= report.total.mse_constant {
        text += "Worse than a constant: train on a longer or richer recording\n";
    }
    text
}
