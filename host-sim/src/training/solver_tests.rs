//! The solver: each stop reason and a counterexample, the returned parameters, and determinism.

use super::testing::{architecture, assert_close, random_data, random_values};
use super::*;
use crate::files::fnv::Fnv;
use agent_core::math::activation::Activation::Tanh;

const GO: ControlFlow<()> = ControlFlow::Continue(());

/// E = ((x − 3)² + offset²) / 2, with a validation error that falls and then rises.
struct Line {
    offset: f64,
    /// The minimum of the validation error.
    validation: Option<f64>,
    /// Whether E appears worse everywhere than at the start.
    deceptive: bool,
}

impl LeastSquares for Line {
    fn parameter_count(&self) -> usize {
        1
    }

    fn cost(&mut self, x: &[f64]) -> f64 {
        if self.deceptive {
            return f64::NAN;
        }
        0.5 * ((x[0] - 3.0) * (x[0] - 3.0) + self.offset * self.offset)
    }

    fn normal_equations(&mut self, x: &[f64], hessian: &mut [f64], gradient: &mut [f64]) -> f64 {
        hessian[0] = 0.5;
        gradient[0] = 0.5 * (x[0] - 3.0);
        0.5 * ((x[0] - 3.0) * (x[0] - 3.0) + self.offset * self.offset)
    }

    fn validation_cost(&mut self, x: &[f64]) -> Option<f64> {
        self.validation.map(|best| (x[0] - best) * (x[0] - best))
    }
}

const LINE: Line = Line { offset: 0.0, validation: None, deceptive: false };

/// Small steps: damping stays at 10 against a curvature of 0.5.
fn slow() -> LevenbergMarquardtSettings {
    LevenbergMarquardtSettings { damping_initial: 10.0, damping_min: 10.0, ..Default::default() }
}

fn solve(mut line: Line, settings: &LevenbergMarquardtSettings) -> (f64, TrainingReport) {
    let (x, report) = minimize(&mut line, vec![0.0], settings, &mut |_| GO).expect("valid");
    (x[0], report)
}

#[test]
fn stops_at_the_goal_if_reachable() {
    let settings = LevenbergMarquardtSettings { goal: 1e-4, ..Default::default() };
    let (_, report) = solve(LINE, &settings);
    assert_eq!(report.stop, StopReason::Goal);
    assert!(report.epochs.last().is_some_and(|last| last.train <= 1e-4));
    assert!(report.epochs.iter().rev().skip(1).all(|epoch| epoch.train > 1e-4));
    let (x, report) = solve(Line { offset: 1.0, ..LINE }, &settings);
    assert_eq!(report.stop, StopReason::Gradient, "the goal is below the minimum");
    assert_close(&[x], &[3.0], 1e-7, 0.0);
}

#[test]
fn each_step_counts_as_an_epoch() {
    for epochs_max in [0, 1, 7] {
        let (_, report) = solve(LINE, &LevenbergMarquardtSettings { epochs_max, ..slow() });
        assert_eq!(report.stop, StopReason::Epochs);
        assert_eq!(report.epochs.len(), epochs_max + 1);
        assert_eq!(report.best_epoch, epochs_max);
    }
}

#[test]
fn damping_follows_the_schedule() {
    let (_, report) = solve(Line { offset: 1.0, ..LINE }, &LevenbergMarquardtSettings::default());
    let damping: Vec<f64> = report.epochs.iter().map(|epoch| epoch.damping).collect();
    assert_close(&damping[..3], &[1e-3, 1e-4, 1e-5], 1e-12, 0.0);
    let floor = LevenbergMarquardtSettings { damping_min: 1e-3, ..Default::default() };
    let (_, report) = solve(Line { offset: 1.0, ..LINE }, &floor);
    assert!(report.epochs.iter().all(|epoch| epoch.damping == 1e-3));
    assert_close(&[report.epochs[0].gradient_norm], &[3.0], 1e-15, 0.0);
}

#[test]
fn stops_at_maximum_damping_if_no_step_helps() {
    let (x, report) = solve(Line { deceptive: true, ..LINE }, &Default::default());
    assert_eq!((report.stop, x, report.epochs.len()), (StopReason::DampingMax, 0.0, 1));
}

/// Improves with every accepted step, and accepts only a limited number.
struct Exhausted {
    steps_left: usize,
    level: f64,
    tries: usize,
}

impl LeastSquares for Exhausted {
    fn parameter_count(&self) -> usize {
        1
    }

    fn cost(&mut self, _: &[f64]) -> f64 {
        self.tries += 1;
        assert!(self.tries < 10_000, "damping does not rise");
        if self.steps_left == 0 {
            return f64::INFINITY;
        }
        self.steps_left -= 1;
        self.level *= 0.5;
        self.level
    }

    fn normal_equations(&mut self, _: &[f64], hessian: &mut [f64], gradient: &mut [f64]) -> f64 {
        (hessian[0], gradient[0]) = (1.0, 1.0);
        self.level
    }
}

#[test]
fn damping_recovers_from_the_smallest_positive_number() {
    let settings = LevenbergMarquardtSettings {
        damping_min: 0.0,
        damping_decrease: 1e-300,
        ..Default::default()
    };
    let mut problem = Exhausted { steps_left: 2, level: 1.0, tries: 0 };
    let (_, report) = minimize(&mut problem, vec![0.0], &settings, &mut |_| GO).expect("valid");
    assert_eq!((report.stop, report.epochs.len()), (StopReason::DampingMax, 3));
}

#[test]
fn validation_stops_training_and_returns_the_best_epoch() {
    // Steps of about 5 % of the distance: passes 1.5, then has six failures.
    let (x, report) = solve(Line { validation: Some(1.5), ..LINE }, &slow());
    assert_eq!(report.stop, StopReason::Validation);
    let validation = |epoch: &EpochReport| epoch.validation.expect("has a validation set");
    let least = report.epochs.iter().map(validation).fold(f64::INFINITY, f64::min);
    let best = report.best().expect("an epoch");
    assert_eq!(validation(best), least);
    assert_eq!(best.epoch, report.best_epoch);
    assert_eq!((x - 1.5) * (x - 1.5), least, "parameters of that epoch");
    assert_eq!(report.epochs.len(), report.best_epoch + 1 + 6);
    assert!((1..=6).all(|i| report.epochs[report.best_epoch + i].validation_failures == i));
    // The counterexample, whose validation error keeps falling, stops for another reason.
    let (x, report) = solve(Line { validation: Some(4.0), ..LINE }, &slow());
    assert_eq!(report.stop, StopReason::Gradient);
    assert_eq!(report.best_epoch, report.epochs.len() - 1);
    assert_close(&[x], &[3.0], 1e-6, 0.0);
}

#[test]
fn callback_stops_training() {
    let mut seen = 0;
    let (_, report) = minimize(&mut { LINE }, vec![0.0], &slow(), &mut |epoch| {
        seen += 1;
        if epoch.epoch == 3 { ControlFlow::Break(()) } else { GO }
    })
    .expect("valid");
    assert_eq!((report.stop, report.epochs.len(), seen), (StopReason::Callback, 4, 4));
}

#[test]
fn reports_a_non_finite_start() {
    let (x, report) = minimize(&mut { LINE }, vec![f64::NAN], &slow(), &mut |_| GO).expect("valid");
    assert_eq!((report.stop, report.epochs.len()), (StopReason::NotFinite, 1));
    assert!(x[0].is_nan());
}

#[test]
fn rejects_invalid_settings() {
    let wrong = [
        LevenbergMarquardtSettings { damping_initial: 0.0, ..Default::default() },
        LevenbergMarquardtSettings { damping_decrease: 1.0, ..Default::default() },
        LevenbergMarquardtSettings { damping_increase: 1.0, ..Default::default() },
        LevenbergMarquardtSettings { damping_min: -1.0, ..Default::default() },
        LevenbergMarquardtSettings { damping_max: f64::INFINITY, ..Default::default() },
        LevenbergMarquardtSettings { goal: f64::NAN, ..Default::default() },
        LevenbergMarquardtSettings { gradient_min: -1e-7, ..Default::default() },
        LevenbergMarquardtSettings { validation_failures_max: 0, ..Default::default() },
    ];
    for settings in wrong {
        assert!(settings.validate().is_err(), "{settings:?}");
    }
    assert_eq!(LevenbergMarquardtSettings::default().validate(), Ok(()));
    let settings = LevenbergMarquardtSettings { goal: -1.0, ..Default::default() };
    let message = settings.validate().expect_err("negative").to_string();
    assert_eq!(message, "goal is -1, expected a finite number >= 0");
}

#[test]
fn a_network_learns_another_network() {
    let architecture = architecture(2, &[(6, Tanh), (4, Tanh)]);
    let outer = random_values(8, 1);
    let inputs = random_values(2 * 600, 2);
    let teacher = random_values(architecture.parameter_count(), 3);
    // The targets are the teacher's outputs, that is, its residuals for zero targets.
    let zero = Dataset::new(2, inputs.clone(), vec![0.0; inputs.len()]).expect("valid");
    let mut propagation = propagation::Propagation::new(&architecture, &outer, pulp::Arch::new());
    propagation.set_parameters(&teacher);
    let mut targets = Vec::new();
    for row in zero.inputs().chunks_exact(2) {
        let mut batch = vec![0.0; 2 * propagation::BATCH];
        batch[0] = row[0];
        batch[propagation::BATCH] = row[1];
        let estimates = propagation.forward(&batch);
        targets.extend([estimates[0], estimates[propagation::BATCH]]);
    }
    let data = Dataset::new(2, inputs, targets).expect("valid");
    let settings = TrainingSettings {
        trainer: LevenbergMarquardtSettings { goal: 1e-6, ..Default::default() }.into(),
        normalise: false,
        ..Default::default()
    };
    let train = |seed| {
        train_inner_network(&architecture, &outer, &data, &settings, seed, &mut |_| GO)
            .expect("fits")
    };
    let (parameters, report) = train(4);
    assert_eq!(report.stop, StopReason::Goal, "{:?}", report.epochs.last());
    assert!(report.best().and_then(|best| best.test).is_some_and(|test| test < 1e-5));
    assert!(report.epochs.is_sorted_by(|a, b| a.train > b.train), "the error only falls");
    assert_eq!(train(4), (parameters, report), "same seed, same bits");
    assert_ne!(train(4).0, train(5).0);
}

#[test]
fn bits_match_the_recorded_ones() {
    let architecture = architecture(3, &[(12, Tanh), (5, Tanh)]);
    let (data, outer) = (random_data(3, 300, 1), random_values(15, 2));
    let mut settings = TrainingSettings::default();
    *settings.trainer.epochs_max_mut() = 5;
    // Recorded on x86-64; the hashes change if a sum is reordered.
    for (normalise, expected) in [(false, 0xd630_8077_b05d_78ff), (true, 0x3fa2_9033_e1de_a1d8)] {
        settings.normalise = normalise;
        let (parameters, _) =
            train_inner_network(&architecture, &outer, &data, &settings, 7, &mut |_| GO)
                .expect("fits");
        let mut hash = Fnv::default();
        parameters.iter().for_each(|p| hash.add(&p.to_le_bytes()));
        let hash = hash.finish();
        assert_eq!(hash, expected, "{normalise}: {hash:#018x}");
    }
}

/// Scaling by powers of two does not change a bit of the training.
#[test]
fn training_is_independent_of_units() {
    let architecture = architecture(2, &[(6, Tanh), (3, Tanh)]);
    let angle = |s: usize| 0.05 * s as f64;
    let inputs = (0..200).flat_map(|s| [libm::sin(angle(s)), libm::cos(angle(s))]).collect();
    let targets = (0..200).flat_map(|s| [libm::cos(angle(s)), 2.0 * libm::sin(2.0 * angle(s))]);
    let data = Dataset::new(2, inputs, targets.collect()).expect("valid");
    let outer = [1.5, 0.5, -0.5, 2.0, 1.0, -1.0];
    let settings = TrainingSettings {
        trainer: LevenbergMarquardtSettings { epochs_max: 20, ..Default::default() }.into(),
        weight_decay: 1e-4,
        ..Default::default()
    };
    // Component c in units of 1 / units[c], shifted by offset[c] in the old units.
    let train = |units: [f64; 2], offset: [f64; 2]| {
        let change = |values: &[f64], shift: [f64; 2]| -> Vec<f64> {
            values.iter().enumerate().map(|(i, v)| (v + shift[i % 2]) * units[i % 2]).collect()
        };
        let (inputs, targets) = (change(data.inputs(), offset), change(data.targets(), [0.0; 2]));
        let data = Dataset::new(2, inputs, targets).expect("valid");
        let outer = change(&outer, [0.0; 2]);
        train_inner_network(&architecture, &outer, &data, &settings, 3, &mut |_| GO).expect("fits")
    };
    let (parameters, report) = train([1.0; 2], [0.0; 2]);
    assert!(report.epochs.last().is_some_and(|last| last.train < 0.5), "{report:?}");
    for units in [[2f64.powi(20); 2], [2f64.powi(-20); 2], [1024.0, 1.0 / 64.0]] {
        let (other, same) = train(units, [0.0; 2]);
        assert_eq!(same, report, "{units:?}");
        // Weights of the first layer absorb the units, everything else is unchanged.
        for (index, (a, b)) in parameters.iter().zip(&other).enumerate() {
            let unit = match index {
                6..12 => units[0],
                12..18 => units[1],
                _ => 1.0,
            };
            assert_eq!(*a, b * unit, "{units:?}, parameter {index}");
        }
    }
    let best = |report: &TrainingReport| report.best().expect("an epoch").train;
    for (units, offset) in [([1e-6; 2], [0.0; 2]), ([1e6; 2], [0.0; 2]), ([1.0, 3.0], [1e3, -1e3])]
    {
        let (_, other) = train(units, offset);
        assert_close(&[best(&other)], &[best(&report)], 0.01, 0.0);
    }
}

#[test]
fn constant_start_keeps_the_nodes_of_a_layer_identical() {
    let architecture = architecture(2, &[(3, Tanh), (2, Tanh)]);
    let settings = TrainingSettings {
        initial: InitialParameters::Constant(0.1),
        trainer: LevenbergMarquardtSettings { epochs_max: 5, ..Default::default() }.into(),
        ..Default::default()
    };
    let (data, outer) = (random_data(2, 100, 1), random_values(4, 2));
    let (parameters, _) =
        train_inner_network(&architecture, &outer, &data, &settings, 0, &mut |_| GO).expect("fits");
    for row in parameters[..9].chunks_exact(3) {
        assert_close(&row[1..], &[row[0]; 2], 1e-9, 1e-12);
    }
}

/// A line that counts its evaluations and is stopped during one of them.
struct Stopped {
    line: Line,
    evaluations: std::cell::Cell<usize>,
    at: usize,
}

impl LeastSquares for Stopped {
    fn parameter_count(&self) -> usize {
        self.line.parameter_count()
    }

    fn cost(&mut self, parameters: &[f64]) -> f64 {
        self.evaluations.set(self.evaluations.get() + 1);
        // A stopped evaluation that looks better than any other and must be ignored.
        if self.stopped() { 0.0 } else { self.line.cost(parameters) }
    }

    fn normal_equations(&mut self, p: &[f64], hessian: &mut [f64], gradient: &mut [f64]) -> f64 {
        self.evaluations.set(self.evaluations.get() + 1);
        let cost = self.line.normal_equations(p, hessian, gradient);
        if self.stopped() { 0.0 } else { cost }
    }

    fn stopped(&self) -> bool {
        self.evaluations.get() > self.at
    }
}

#[test]
fn stop_within_an_epoch_keeps_previous_epochs() {
    // Slow steps, so that there are many epochs of two evaluations each.
    let settings = slow();
    let start = vec![0.0; LINE.parameter_count()];
    let mut all = Vec::new();
    let keep = |problem: &mut dyn LeastSquares| {
        minimize(problem, start.clone(), &settings, &mut |_| GO).unwrap()
    };
    for epochs_max in 0..4 {
        let settings = LevenbergMarquardtSettings { epochs_max, ..slow() };
        all.push(minimize(&mut { LINE }, start.clone(), &settings, &mut |_| GO).unwrap());
    }
    for at in 0..8 {
        let mut problem = Stopped { line: LINE, evaluations: 0.into(), at };
        let (parameters, report) = keep(&mut problem);
        assert_eq!(report.stop, StopReason::Callback);
        // One evaluation for the start, two for each further epoch.
        assert_eq!(report.epochs.len(), at.div_ceil(2), "stopped after {at}");
        match report.epochs.len() {
            0 => assert_eq!((parameters, report.best()), (start.clone(), None)),
            count => {
                let (expected, full) = &all[count - 1];
                assert_eq!((&parameters, &report.epochs), (expected, &full.epochs));
                assert_eq!(report.best_epoch, count - 1);
            }
        }
    }
}
