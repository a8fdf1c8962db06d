//! Warnings about samples and about the networks trained on them.

use super::quality::{LAST_SHARE, Quality};
use crate::training::{Dataset, Scaling};
use crate::warning::{Warning, WarningCode};

/// An input whose centre lies this many standard deviations from 0 is rounded by about 1/4000 of
/// its deviation in single precision, which shows in the estimate.
const OFFSET_MAX: f64 = 4000.0;

/// A network that explains less than this share of the targets' variance explains nothing.
const EXPLAINED_MIN: f64 = 0.05;

/// What is known before training.
pub(super) struct Samples<'a> {
    /// The samples to train on.
    pub(super) train: &'a Dataset,
    /// Their scaling.
    pub(super) scaling: &'a Scaling,
    /// `W_hat`, row by row, shape `[L, n]`.
    pub(super) outer_weights: &'a [f32],
    /// Inner parameters to train.
    pub(super) parameters: usize,
    /// Length of the averaging window. \[s\]
    pub(super) window: f64,
    /// Period of the signal. \[s\]
    pub(super) period: Option<f64>,
}

impl Samples<'_> {
    /// Warnings about training on them.
    pub(super) fn warnings(&self) -> Vec<Warning> {
        let mut warnings: Vec<Warning> =
            outer_weights(self.outer_weights, self.train.dimension()).into_iter().collect();
        for input in self.scaling.constant_inputs() {
            let text = format!(
                "xhat{0} does not vary in the samples, so the network gives it no weight and \
                 cannot learn what depends on it; record while component {0} moves",
                input + 1
            );
            warnings.push(Warning::new(WarningCode::ConstantInput, text));
        }
        for (input, offset) in self.scaling.offsets().enumerate() {
            let Some(offset) = offset.filter(|&offset| offset > OFFSET_MAX) else { continue };
            let digits = libm::log10(16_777_216.0 / offset);
            let text = format!(
                "xhat{} lies {offset:.0} of its standard deviations from 0: single precision \
                 leaves {digits:.1} digits of its variation; subtract a constant where it is \
                 measured",
                input + 1
            );
            warnings.push(Warning::new(WarningCode::InputResolution, text));
        }
        if let Some(period) = self.period.filter(|&period| self.window >= period) {
            let text = format!(
                "smoothing_window, {} s, is longer than the period of the signal, about \
                 {period:.3} s, which it averages away; write less than {:.3}, or leave it out",
                self.window,
                0.25 * period
            );
            warnings.push(Warning::new(WarningCode::LongSmoothing, text));
        }
        let numbers = self.train.len() * self.train.dimension();
        if numbers < self.parameters {
            let text = format!(
                "{} training samples of {} components are fewer numbers than the network's {} \
                 inner parameters; record longer, or make the network smaller",
                self.train.len(),
                self.train.dimension(),
                self.parameters
            );
            warnings.push(Warning::new(WarningCode::FewSamples, text));
        }
        warnings
    }
}

/// Warns of outer weights, row by row, shape `[L, n]`, that leave the inner network nothing to
/// learn.
#[must_use]
pub fn outer_weights<T: Copy + Default + PartialEq>(
    outer_weights: &[T],
    n: usize,
) -> Option<Warning> {
    let zero = |w: &T| *w == T::default();
    let hint = "write network.outer = { random = 5.0 }, about the size of the state's derivative";
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
            "all rows of the outer weights are equal, so training cannot tell the components of \
             the state apart; {hint}"
        ));
    }
    let blind = (0..n).find(|&c| outer_weights.iter().skip(c).step_by(n).all(zero))?;
    warn(format!(
        "the outer weights of component {} are all 0, so the network's output for it is 0; {hint}",
        blind + 1
    ))
}

/// Warnings about a trained network; `accepted` if it is used.
pub(super) fn judgement(quality: &Quality, accepted: bool, recipe: &str) -> Vec<Warning> {
    let mut warnings = Vec::new();
    let training = quality.training.explained;
    if !training.is_some_and(|share| share >= EXPLAINED_MIN) {
        let text = format!(
            "the trained network explains next to nothing of the smoothed targets' variance ({}); \
             record longer while the plant moves, or change network.outer, network.layers or \
             the recipe",
            percent(training)
        );
        warnings.push(Warning::new(WarningCode::ExplainsNothing, text));
    }
    let validation = quality.validation.map(|fit| fit.explained);
    if let Some(share) = validation.filter(|share| share.is_some_and(|share| share < 0.0)) {
        let text = format!(
            "on the validation samples the trained network explains {}: it is worse than a \
             constant; record longer, raise weight_decay or make the network smaller",
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
            "the trained network is not used, because a constant does as well: it explains {last} \
             of the smoothed targets' variance in the last {} % of the samples' time{validation}; \
             record longer, or write switch_in = \"always\" in [recipes.{recipe}] to use it anyway",
            100.0 * LAST_SHARE,
        );
        warnings.push(Warning::new(WarningCode::NotSwitchedIn, text));
    }
    warnings
}

fn percent(share: Option<f64>) -> String {
    // Targets that do not vary leave nothing to explain.
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
    fn outer_weights_that_leave_nothing_to_learn_are_reported() {
        let told = |weights: &[f32], n| outer_weights(weights, n).map(|warning| warning.text);
        assert!(told(&[0.0; 6], 2).unwrap().contains("all outer weights are 0"));
        assert!(told(&[1.0, 2.0, 1.0, 2.0], 2).unwrap().contains("rows of the outer weights"));
        assert!(told(&[1.0, 0.0, 3.0, 0.0], 2).unwrap().contains("component 2 are all 0"));
        assert_eq!(told(&[1.0, 2.0, 2.0, 1.0], 2), None);
        // One feature is one row.
        assert_eq!(told(&[1.0, 2.0], 2), None);
    }

    #[test]
    fn each_weakness_of_samples_has_its_warning() {
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
                &Samples { train, scaling: &scaling, outer_weights, parameters, window, period }
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
    fn a_network_that_explains_nothing_is_reported_and_left_out() {
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
