//! Warnings about samples and about networks trained on them.

use super::quality::{LAST_SHARE, Quality};
use crate::training::{Dataset, Scaling};
use crate::warning::{Warning, WarningCode};

/// Warning threshold for the distance of an input's centre from 0, in standard deviations: beyond
/// it, single precision rounds the input by more than about 1/4000 of its deviation.
const OFFSET_MAX: f64 = 4000.0;

/// Share of the targets' variance below which a network counts as explaining nothing.
const EXPLAINED_MIN: f64 = 0.05;

/// Samples and settings known before training.
pub(super) struct Samples<'a> {
    /// The samples to train on.
    pub(super) train: &'a Dataset,
    /// Their scaling.
    pub(super) scaling: &'a Scaling,
    /// `W_hat`, row-major, shape `[L, n]`.
    pub(super) outer_weights: &'a [f32],
    /// Names of the known inputs.
    pub(super) input_names: &'a [String],
    /// Number of inner parameters to train.
    pub(super) parameters: usize,
    /// Length of the averaging window. \[s\]
    pub(super) window: f64,
    /// Period of the signal. \[s\]
    pub(super) period: Option<f64>,
}

impl Samples<'_> {
    /// Returns the warnings about training on these samples.
    pub(super) fn warnings(&self) -> Vec<Warning> {
        let mut warnings: Vec<Warning> =
            outer_weights(self.outer_weights, self.train.dimension()).into_iter().collect();
        for input in self.scaling.constant_inputs() {
            let (name, what) = self.name(input);
            let text = format!(
                "{name} does not vary in the samples, so the network ignores it; record while \
                 {what} varies"
            );
            warnings.push(Warning::new(WarningCode::ConstantInput, text));
        }
        for (input, offset) in self.scaling.offsets().enumerate() {
            let Some(offset) = offset.filter(|&offset| offset > OFFSET_MAX) else { continue };
            let digits = libm::log10(16_777_216.0 / offset);
            let from =
                if input < self.train.dimension() { "the measurement" } else { "plant.inputs" };
            let text = format!(
                "{} is {offset:.0} standard deviations away from 0, so single precision \
                 leaves only {digits:.1} digits of its variation; subtract a constant from {from}",
                self.name(input).0
            );
            warnings.push(Warning::new(WarningCode::InputResolution, text));
        }
        if let Some(period) = self.period.filter(|&period| self.window >= period) {
            let text = format!(
                "smoothing_window is {} s, longer than the signal's period of about {period:.3} s, so \
                 it averages the signal away; set less than {:.3}, or leave it out",
                self.window,
                0.25 * period
            );
            warnings.push(Warning::new(WarningCode::LongSmoothing, text));
        }
        let numbers = self.train.len() * self.train.dimension();
        if numbers < self.parameters {
            let text = format!(
                "{} training samples of {} components have fewer values than the network's {} inner \
                 parameters; record longer, or use a smaller network",
                self.train.len(),
                self.train.dimension(),
                self.parameters
            );
            warnings.push(Warning::new(WarningCode::FewSamples, text));
        }
        warnings
    }

    /// Returns the name of an input's column, and what it is.
    fn name(&self, input: usize) -> (String, String) {
        match input.checked_sub(self.train.dimension()) {
            None => (format!("xhat{}", input + 1), format!("component {}", input + 1)),
            Some(known) => {
                let name = self.input_names.get(known).map_or("", String::as_str);
                (format!("the known input {name}"), "it".to_owned())
            }
        }
    }
}

/// Returns a warning if outer weights, row-major, shape `[L, n]`, keep the inner network from
/// learning.
#[must_use]
pub fn outer_weights<T: Copy + Default + PartialEq>(
    outer_weights: &[T],
    n: usize,
) -> Option<Warning> {
    let zero = |w: &T| *w == T::default();
    let hint =
        "set network.outer = { random = 5.0 }, with about the magnitude of the state's derivative";
    let warn = |problem: String| Some(Warning::new(WarningCode::OuterWeights, problem));
    if outer_weights.iter().all(zero) {
        return warn(format!(
            "all outer weights are 0, so the network's output is 0 and it cannot learn; {hint}"
        ));
    }
    let mut rows = outer_weights.chunks_exact(n);
    let first = rows.next();
    if outer_weights.len() > n && rows.all(|row| Some(row) == first) {
        return warn(format!(
            "all rows of the outer weights are equal, so training cannot distinguish the state's \
             components; {hint}"
        ));
    }
    let blind = (0..n).find(|&c| outer_weights.iter().skip(c).step_by(n).all(zero))?;
    warn(format!(
        "the outer weights of component {} are all 0, so the network's output for it is 0; {hint}",
        blind + 1
    ))
}

/// Returns the warnings about a trained network; `accepted` if it is used.
pub(super) fn judgement(quality: &Quality, accepted: bool, recipe: &str) -> Vec<Warning> {
    let mut warnings = Vec::new();
    let training = quality.training.explained;
    if !training.is_some_and(|share| share >= EXPLAINED_MIN) {
        let text = format!(
            "the trained network explains almost none of the smoothed targets' variance ({}); \
             record longer while the plant moves, or change network.outer, network.layers or \
             the recipe",
            percent(training)
        );
        warnings.push(Warning::new(WarningCode::ExplainsNothing, text));
    }
    let validation = quality.validation.map(|fit| fit.explained);
    if let Some(share) = validation.filter(|share| share.is_some_and(|share| share < 0.0)) {
        let text = format!(
            "on the validation samples, the trained network is worse than a constant (explained \
             variance {}); record longer, raise weight_decay or use a smaller network",
            percent(share)
        );
        warnings.push(Warning::new(WarningCode::WorseThanConstant, text));
    }
    let last = percent(quality.last);
    if !accepted {
        let validation = validation.map_or_else(String::new, |share| {
            format!(" and {} on the validation samples", percent(share))
        });
        let text = format!(
            "the trained network is not used, because it is no better than a constant: it explains \
             {last} of the smoothed targets' variance in the last {} % of the samples' \
             time{validation}; record longer, or set switch_in = \"always\" in [recipes.{recipe}] \
             to use it anyway",
            100.0 * LAST_SHARE,
        );
        warnings.push(Warning::new(WarningCode::NotSwitchedIn, text));
    }
    warnings
}

fn percent(share: Option<f64>) -> String {
    // Constant targets have no variance to explain.
    share.map_or("nothing".to_owned(), |share| format!("{:.1} %", 100.0 * share))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::learning::quality::Fit;

    fn codes(warnings: &[Warning]) -> Vec<WarningCode> {
        warnings.iter().map(|warning| warning.code).collect()
    }

    #[test]
    fn outer_weights_that_prevent_learning_are_reported() {
        let warning = |weights: &[f32], n| outer_weights(weights, n).map(|warning| warning.text);
        assert!(warning(&[0.0; 6], 2).unwrap().contains("all outer weights are 0"));
        assert!(warning(&[1.0, 2.0, 1.0, 2.0], 2).unwrap().contains("rows of the outer weights"));
        assert!(warning(&[1.0, 0.0, 3.0, 0.0], 2).unwrap().contains("component 2 are all 0"));
        assert_eq!(warning(&[1.0, 2.0, 2.0, 1.0], 2), None);
        // One feature is one row.
        assert_eq!(warning(&[1.0, 2.0], 2), None);
    }

    #[test]
    fn each_problem_of_samples_has_its_own_warning() {
        let wave = |s: usize| libm::sin(0.3 * s as f64);
        let data = |offset: f64, size: f64| {
            let inputs = (0..40).flat_map(|s| [offset + wave(s), size * wave(s + 5)]).collect();
            let targets = (0..40).flat_map(|s| [wave(s + 9), wave(s)]).collect();
            Dataset::new(2, inputs, targets).unwrap()
        };
        let warnings = |train: &Dataset, parameters, window| {
            let scaling = Scaling::of(train);
            let outer_weights = &[1.0, 2.0, 2.0, 1.0];
            let period = Some(1.0);
            codes(
                &Samples {
                    train,
                    scaling: &scaling,
                    outer_weights,
                    input_names: &[],
                    parameters,
                    window,
                    period,
                }
                .warnings(),
            )
        };
        assert_eq!(warnings(&data(0.0, 1.0), 80, 0.9), []);
        assert_eq!(warnings(&data(1e3, 1.0), 80, 0.9), []);
        assert_eq!(warnings(&data(1e4, 1.0), 80, 0.9), [WarningCode::InputResolution]);
        assert_eq!(warnings(&data(0.0, 0.0), 80, 0.9), [WarningCode::ConstantInput]);
        assert_eq!(warnings(&data(0.0, 1.0), 81, 0.9), [WarningCode::FewSamples]);
        assert_eq!(warnings(&data(0.0, 1.0), 80, 1.0), [WarningCode::LongSmoothing]);
    }

    #[test]
    fn a_network_that_explains_nothing_is_reported_and_not_used() {
        let quality = |training, validation, last| Quality {
            training: Fit { error: 1.0, explained: Some(training) },
            validation: Some(Fit { error: 1.0, explained: Some(validation) }),
            test: None,
            last,
        };
        let judged = |quality: &Quality, accepted| codes(&judgement(quality, accepted, "better"));
        assert_eq!(judged(&quality(0.9, 0.8, Some(0.5)), true), []);
        assert_eq!(judged(&quality(0.01, 0.0, Some(0.5)), true), [WarningCode::ExplainsNothing]);
        assert_eq!(
            judged(&quality(0.9, -0.1, None), false),
            [WarningCode::WorseThanConstant, WarningCode::NotSwitchedIn]
        );
        let text = judgement(&quality(0.9, 0.8, Some(-1.25)), false, "better")[0].text.clone();
        assert!(text.contains("-125.0 %") && text.contains("[recipes.better]"), "{text}");
        assert!(text.contains(" and 80.0 % on the validation samples"), "{text}");
        let alone = Quality { validation: None, ..quality(0.9, 0.8, None) };
        let text = judgement(&alone, false, "better")[0].text.clone();
        assert!(text.contains("it explains nothing of the smoothed targets'"), "{text}");
        assert!(!text.contains("validation"), "{text}");
    }
}
