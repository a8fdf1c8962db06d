//! Whether a theorem covers what was run, and the bound that it gives.
//!
//! | coupling | certificate | bound |
//! | --- | --- | --- |
//! | the paper's graph, one gain or separate ones | smallest eigenvalue of the left side of `BMI` | Theorem 1's, with the smallest `delta` that this eigenvalue allows |
//! | trees | [`Certificate`] | [`UltimateBound`](crate::flow::UltimateBound) |
//!
//! `rho` is that of the plant's trajectory: the largest disturbance, stacked over all agents. Along trees, where
//! the outer weights do not adapt, it is the largest rate that the network in use does not explain, plus
//! the limit of the disturbance estimate. Nothing is certified where the scenario departs from what
//! the theorems allow for, apart from the observer itself.

use agent_core::agent::exchange::ExchangeParams;
use agent_core::observer::field::{Coupling, FieldParams, FieldWords};
use agent_core::observer::network::Scratch;
use nalgebra::{DMatrix, DVector};
use thiserror::Error;

use crate::analysis::{
    GainCertificate, StepCheck, TriggerConstants, UltimateBound, laplacian_norm, spectral_norm,
};
use crate::engine::TrainingRecord;
use crate::flow::{Certificate, Plan, PlanError, plant_course, ultimate};
use crate::learning::trained;
use crate::number::significant;
use crate::packages::{PackageBytes, with_node_dimension};
use crate::scenario::{DisturbanceModel, ObserverSettings, Scenario};

/// Above this, the eigenvalues of the graph coupling with separate gains are not computed.
const AGENTS_MAX: usize = 128;

/// Relays announce at up to this share of the radius in the certificate.
const RELAY_SHARE_MAX: f64 = 0.9;

/// Samples of the trajectory between those at which the network is compared with the plant.
const STRIDE: usize = 10;

/// Returns the certified bound on `|e_1|`, all agents stacked, after a long time, with the network in use after these
/// training runs. \[state unit\]
///
/// # Errors
/// Why nothing is certified.
pub(super) fn bound(scenario: &Scenario, trainings: &[TrainingRecord]) -> Result<f64, Vec<String>> {
    let reasons = departures(scenario);
    if !reasons.is_empty() {
        return Err(reasons);
    }
    let bound = match &scenario.observer {
        None => paper(scenario),
        Some(observer) if observer.coupling == Coupling::Trees => {
            with_node_dimension!(
                scenario.dimension(),
                trees(scenario, observer, trainings),
                else Err(NotCertified::Dimension)
            )
        }
        Some(observer) => held(scenario, observer),
    };
    bound.map_err(|reason| vec![reason.to_string()])
}

/// Returns what the theorems do not allow for, apart from the observer itself.
fn departures(scenario: &Scenario) -> Vec<String> {
    let mut reasons: Vec<String> = scenario
        .trigger
        .departure()
        .map(|when| format!("agents broadcast {when}"))
        .into_iter()
        .collect();
    // Heartbeats and repetitions only reset hold errors.
    let resets =
        ExchangeParams { heartbeat: 0, repeat: 0, ..scenario.exchange } == ExchangeParams::PAPER;
    let allowed =
        |clause: &str| clause.contains("[observer]") || (resets && clause.contains("[exchange]"));
    reasons.extend(
        scenario.departures().into_iter().filter(|clause| !allowed(clause)).map(str::to_owned),
    );
    match &scenario.observer {
        Some(observer) if observer.exchange.is_some() => {
            reasons.push("the preset \"robust\" sets gaps, repetitions and a heartbeat".to_owned());
        }
        _ => {}
    }
    if scenario.observer.as_ref().is_some_and(|observer| observer.coupling == Coupling::Current) {
        reasons.push(
            "no certificate is computed for observer.coupling = \"current\"; set it to \"held\" or \
             \"trees\""
                .to_owned(),
        );
    }
    reasons
}

/// Why a theorem's bound does not hold, or is not known.
#[derive(Clone, Copy, Debug, PartialEq, Error)]
enum NotCertified {
    #[error(
        "the theorem's inequality does not hold for these gains; `host-sim design` finds gains for it"
    )]
    Inequality,
    #[error(
        "relays announce at more than {RELAY_SHARE_MAX} of the radius; set observer.relay_share to at most \
         {RELAY_SHARE_MAX}"
    )]
    RelayShare,
    #[error(
        "outer weights adapt, which the theorem for trees does not allow for; set observer.adapts = false"
    )]
    Adapts,
    #[error(
        "outer weights do not adapt, which Theorem 1 relies on; set observer.adapts = true, or observer.network = \
         false"
    )]
    DoesNotAdapt,
    #[error(
        "agents add an estimated disturbance, which Theorem 1 does not allow for; set observer.disturbance = \"none\""
    )]
    Disturbance,
    #[error(
        "a gain of {} 1/s times the step is {}, and the bound holds only up to 1: use a shorter time.step, or a \
         smaller observer.root_gain or observer.tree_gain",
        significant(*.gain, 4), significant(.gain * .step, 4)
    )]
    Step { gain: f64, step: f64 },
    #[error(
        "rates of {} to {} 1/s are too fast for steps of {} s: use a shorter time.step, or smaller gains",
        significant(*.slow, 4), significant(*.fast, 4), .step
    )]
    Steps { slow: f64, fast: f64, step: f64 },
    #[error("the run is longer than the part of the plant's trajectory that rho is taken from")]
    Long,
    #[error("observer.root_gain, observer.tree_gain and observer.radius are not all given")]
    Settings,
    #[error("there are more than {AGENTS_MAX} agents, whose eigenvalues are not computed")]
    Agents,
    #[error("the state dimension is too large for a weight package, which the certificate needs")]
    Dimension,
    #[error("the plant's trajectory, or the network along it, has no finite values")]
    NotFinite,
    #[error("the observer's settings could not be derived")]
    NotDerived,
}

/// Checks that steps shrink every part of an error at least as much as the slowest part shrinks in continuous time.
fn check_steps(slow: f64, fast: f64, step: f64) -> Result<(), NotCertified> {
    let is_short = (slow + fast) * step <= 2.0;
    if is_short { Ok(()) } else { Err(NotCertified::Steps { slow, fast, step }) }
}

/// Returns the certified bound of the paper's observer.
fn paper(scenario: &Scenario) -> Result<f64, NotCertified> {
    let gain = GainCertificate::new(scenario);
    let slow = gain.eigenvalue_min - gain.uncertainty;
    let rho = largest_disturbance(scenario, None)?;
    let bound = theorem1(scenario, slow, rho)?;
    let step = StepCheck::new(scenario);
    check_steps(slow, step.eigenvalue_max, step.step_size)?;
    Ok(bound)
}

/// Returns Theorem 1's bound for this smallest eigenvalue and `rho` of one agent: `delta` is not in the
/// trigger, so the analysis is free to choose it.
fn theorem1(scenario: &Scenario, eigenvalue: f64, rho: f64) -> Result<f64, NotCertified> {
    // What is left of `[exchange]` only resets hold errors.
    let scenario = &Scenario { exchange: ExchangeParams::PAPER, ..scenario.clone() };
    let bound = UltimateBound::new(scenario).ok_or(NotCertified::Inequality)?;
    let room = eigenvalue - scenario.design.k2;
    let agents = scenario.agents.len() as f64;
    let delta = agents * rho * rho / room;
    let squared = bound.weight_error + 2.0 * (delta + scenario.design.epsilon) / bound.alpha;
    let radius = squared.sqrt();
    if room > 0.0 && radius.is_finite() { Ok(radius) } else { Err(NotCertified::Inequality) }
}

/// The graph coupling with separate gains.
fn held(scenario: &Scenario, observer: &ObserverSettings) -> Result<f64, NotCertified> {
    let agents = scenario.agents.len();
    if agents > AGENTS_MAX {
        return Err(NotCertified::Agents);
    }
    if observer.disturbance != DisturbanceModel::None {
        return Err(NotCertified::Disturbance);
    }
    if observer.network && !observer.adapts {
        return Err(NotCertified::DoesNotAdapt);
    }
    let (Some(root), Some(tree), Some(radii)) =
        (&observer.root_gain, &observer.tree_gain, &observer.radius)
    else {
        return Err(NotCertified::Settings);
    };
    let Ok(Some(plan)) = Plan::new(scenario) else { return Err(NotCertified::NotDerived) };
    let radius = radii.iter().copied().fold(f64::INFINITY, f64::min);
    let geometry = plan.geometry();
    let laplacian = scenario.graph.laplacian();
    let eigenvalues = |c: usize| {
        let measured = |i: usize| if geometry.is_root(i, c) { root[c] } else { 0.0 };
        let own = DMatrix::from_diagonal(&DVector::from_fn(agents, |i, _| measured(i)));
        (own + &laplacian * tree[c]).symmetric_eigenvalues()
    };
    let eigenvalues: Vec<_> = (0..scenario.dimension()).map(eigenvalues).collect();
    let eigenvalue = eigenvalues.iter().map(DVector::min).fold(f64::INFINITY, f64::min);
    let fast = eigenvalues.iter().map(DVector::max).fold(0.0, f64::max);
    check_steps(eigenvalue, fast, scenario.time.step_size)?;
    let rho = largest_disturbance(scenario, Some(&geometry.transform))?;
    // The same trigger as agents run, in the terms of the paper's form.
    let mut scenario = scenario.clone();
    scenario.observer = None;
    let size = laplacian_norm(&scenario.graph) * tree.iter().copied().fold(0.0, f64::max);
    let design = &mut scenario.design;
    let phi1 = 0.5 * design.k2 + 0.5 * design.kappa * size * size;
    design.epsilon = agents as f64 * phi1 * radius * radius;
    Ok(theorem1(&scenario, eigenvalue, rho)? * spectral_norm(&geometry.inverse))
}

/// Trees.
fn trees<const N: usize>(
    scenario: &Scenario,
    observer: &ObserverSettings,
    trainings: &[TrainingRecord],
) -> Result<f64, NotCertified> {
    if observer.relay_share > RELAY_SHARE_MAX {
        return Err(NotCertified::RelayShare);
    }
    let Ok(Some(plan)) = Plan::new(scenario) else { return Err(NotCertified::NotDerived) };
    let Some(Ok(equipped)) = equipped(scenario, &plan, trainings) else {
        return Err(NotCertified::NotDerived);
    };
    let field = FieldParams::<N>::from_words(FieldWords(equipped.package().node.field))
        .map_err(|_| NotCertified::NotDerived)?;
    if field.options.adapts {
        return Err(NotCertified::Adapts);
    }
    let numbers = |of: fn(&agent_core::observer::field::Direction) -> f32| -> Vec<f64> {
        field.directions.iter().map(|direction| f64::from(of(direction))).collect()
    };
    let (roots, trees) = (numbers(|d| d.root_gain), numbers(|d| d.tree_gain));
    // Theorem F2 at steps; rounded to single precision, a gain may be above by that.
    let step = scenario.time.step_size;
    let gain = roots.iter().chain(&trees).copied().fold(0.0, f64::max);
    if gain * step > 1.0 + 1e-6 {
        return Err(NotCertified::Step { gain, step });
    }
    let (radii, clips) = (numbers(|d| d.radius), numbers(|d| d.model.clip));
    let geometry = plan.geometry();
    let certificate = Certificate::new(plan.trees(), geometry, &roots, &trees, true);
    let network = field.options.uses_network.then_some(&equipped);
    let residual = largest_residual(scenario, &geometry.transform, network, &field)?;
    let limit = clips.iter().fold(0.0, |sum, clip| sum + clip * clip).sqrt();
    let agents = scenario.agents.len();
    let rho = (agents as f64).sqrt() * (residual + limit);
    let bound = ultimate(&certificate, rho, &radii, agents);
    let radius = bound.radius * spectral_norm(&geometry.inverse);
    if radius.is_finite() { Ok(radius) } else { Err(NotCertified::Inequality) }
}

/// Returns the package of agent 1 with the observer's parameters, for the network in use after these training
/// runs; `None` without a network.
pub(super) fn equipped(
    scenario: &Scenario,
    plan: &Plan<'_>,
    trainings: &[TrainingRecord],
) -> Option<Result<PackageBytes, PlanError>> {
    let package = in_use(scenario, trainings)?;
    // A trained package has gains for the frequencies that were found.
    Some(match package.package().node.field {
        [] => plan.equip(&package, 0, &[]),
        _ => Ok(package),
    })
}

/// Returns the last package of agent 1 that was switched in, or its initial one.
fn in_use(scenario: &Scenario, trainings: &[TrainingRecord]) -> Option<PackageBytes> {
    let trained = trainings.iter().rev().find(|t| t.agent == 1 && t.switched_in);
    if let Some(training) = trained {
        return Some(training.package.clone());
    }
    if let Some(given) = &scenario.agents.first()?.package {
        return Some(given.clone());
    }
    let network = scenario.network.as_ref()?;
    let inner = vec![0.0; network.architecture.parameter_count()];
    let trigger = TriggerConstants::new(scenario);
    trained::initial(scenario, &trigger, network, &inner, 0, 0).ok()
}

/// Returns the largest `|T d|` along the plant's trajectory.
fn largest_disturbance(
    scenario: &Scenario,
    transform: Option<&DMatrix<f64>>,
) -> Result<f64, NotCertified> {
    largest_rate(scenario, transform, |time, state, rate| {
        scenario.disturbance.evaluate(time, state, rate);
        Some(())
    })
}

/// Returns the largest `|T (f + d - f_hat)|` along the plant's trajectory, with `f_hat` zero without a
/// network.
fn largest_residual<const N: usize>(
    scenario: &Scenario,
    transform: &DMatrix<f64>,
    network: Option<&PackageBytes>,
    field: &FieldParams<N>,
) -> Result<f64, NotCertified> {
    let mut drift = vec![0.0; N];
    let mut scratch = Scratch::NEW;
    largest_rate(scenario, Some(transform), |time, state, rate| {
        scenario.disturbance.evaluate(time, state, rate);
        scenario.plant.derivative(time, state, &mut drift);
        rate.iter_mut().zip(&drift).for_each(|(rate, drift)| *rate += drift);
        if let Some(package) = network {
            let x = agent_core::StateVector::<N>::from_fn(|c, _| state[c] as f32);
            let known = scenario.plant.known_inputs(time);
            let known = known.iter().take(package.package().known_inputs).map(|&u| u as f32);
            let inputs: Vec<f32> = field.limited(&x).iter().copied().chain(known).collect();
            let (_, output) = package.package().evaluate::<N>(&inputs, &mut scratch)?;
            rate.iter_mut().zip(output.iter()).for_each(|(rate, &f)| *rate -= f64::from(f));
        }
        Some(())
    })
}

/// Returns the largest norm of `T` times a rate along the plant's trajectory, from the observer's start on.
fn largest_rate(
    scenario: &Scenario,
    transform: Option<&DMatrix<f64>>,
    mut write: impl FnMut(f64, &[f64], &mut [f64]) -> Option<()>,
) -> Result<f64, NotCertified> {
    let course = plant_course(scenario).map_err(|_| NotCertified::NotFinite)?;
    if scenario.steps() >= course.samples() as u64 {
        return Err(NotCertified::Long);
    }
    let mut rate = vec![0.0; scenario.dimension()];
    let from = scenario.observer.as_ref().map_or(0.0, |observer| observer.from);
    let mut largest = 0.0f64;
    for k in (scenario.time.tick(from) as usize..course.samples()).step_by(STRIDE) {
        write(scenario.time.at(k as u64), course.state(k), &mut rate)
            .ok_or(NotCertified::NotFinite)?;
        let rate = DVector::from_column_slice(&rate);
        largest =
            largest.max(transform.map_or(rate.norm(), |transform| (transform * &rate).norm()));
    }
    Ok(largest)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::PAPER;

    fn certified(settings: &str) -> Result<f64, Vec<String>> {
        let tables = format!("{settings}\n[evaluation]");
        let text = PAPER.replacen("[evaluation]", &tables, 1);
        let mut scenario = Scenario::parse("paper", &text).unwrap();
        scenario.learning.clear();
        bound(&scenario, &[])
    }

    #[test]
    fn a_bound_has_the_premises_of_its_theorem() {
        let field = "[observer]\npreset = \"field\"\n";
        let bound = certified(field).unwrap();
        let resets = "[exchange]\nheartbeat = 0.3\nrepeat = 0.03\n";
        assert_eq!(certified(&format!("{field}{resets}")), Ok(bound));
        let held = format!(
            "{field}coupling = \"held\"\nradius = 0.1\nroot_gain = 500.0\ntree_gain = 60.0\n"
        );
        assert_eq!(certified(&format!("{held}{resets}")), Ok(certified(&held).unwrap()));
        assert_eq!(certified(resets), Ok(certified("").unwrap()));
        let mut wrong = Vec::new();
        for (settings, reason) in [
            (
                "tree_gain = 1500.0",
                "a gain of 1500 1/s times the step is 1.500, and the bound holds only up to 1",
            ),
            ("root_gain = 1500.0", "a gain of 1500 1/s times the step is 1.500"),
            ("relay_share = 1.0", "set observer.relay_share to at most 0.9"),
            (
                "coupling = \"current\"\nradius = 0.1\nroot_gain = 100.0\ntree_gain = 100.0",
                "no certificate is computed for observer.coupling = \"current\"",
            ),
            (
                "coupling = \"held\"\nradius = 0.1\nroot_gain = 100.0\ntree_gain = 700.0",
                "are too fast for steps of 0.001 s",
            ),
            (
                "coupling = \"held\"\nradius = 0.1\nroot_gain = 500.0\ntree_gain = 60.0\ndisturbance = \"bias\"",
                "an estimated disturbance",
            ),
            (
                "coupling = \"held\"\nradius = 0.1\nroot_gain = 500.0\ntree_gain = 60.0\nadapts = false",
                "do not adapt",
            ),
            ("[exchange]\ngap = 0.01", "([exchange])"),
        ] {
            let found = certified(&format!("{field}{settings}\n"));
            let is_refused = matches!(&found, Err(reasons) if reasons.concat().contains(reason));
            wrong.extend((!is_refused).then(|| format!("{settings}: {found:?}")));
        }
        assert_eq!(wrong, [""; 0]);
    }
}
