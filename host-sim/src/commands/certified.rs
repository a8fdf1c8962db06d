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

use agent_core::observer::field::{Coupling, FieldParams, FieldWords};
use agent_core::observer::network::Scratch;
use nalgebra::{DMatrix, DVector};

use crate::analysis::{
    GainCertificate, TriggerConstants, UltimateBound, laplacian_norm, spectral_norm,
};
use crate::engine::TrainingRecord;
use crate::flow::{Certificate, Plan, PlanError, plant_course, ultimate};
use crate::learning::trained;
use crate::packages::{PackageBytes, with_node_dimension};
use crate::scenario::{ObserverSettings, Scenario};

/// Above this, the eigenvalues of the graph coupling with separate gains are not computed.
const AGENTS_MAX: usize = 128;

/// Relays announce at up to this share of the radius in the certificate.
const RELAY_SHARE_MAX: f64 = 0.9;

/// Samples of the trajectory between those at which the network is compared with the plant.
const STRIDE: usize = 10;

/// Returns the certified bound on `|e_1|`, all agents stacked, after a long time, with the network in use after these
/// trainings; `None` without a certificate. \[state unit\]
pub(super) fn bound(scenario: &Scenario, trainings: &[TrainingRecord]) -> Option<f64> {
    let own = usize::from(scenario.observer.is_some());
    let is_robust = scenario.observer.as_ref().is_some_and(|observer| observer.exchange.is_some());
    if is_robust || scenario.trigger.departure().is_some() || scenario.departures().len() > own {
        return None;
    }
    let bound = match &scenario.observer {
        None => {
            let gain = GainCertificate::new(scenario);
            let rho = largest_disturbance(scenario, None)?;
            theorem1(scenario, gain.eigenvalue_min - gain.uncertainty, rho)
        }
        Some(observer) if observer.coupling == Coupling::Held => held(scenario, observer),
        Some(observer) if observer.coupling == Coupling::Trees => {
            with_node_dimension!(scenario.dimension(), trees(scenario, observer, trainings), else None)
        }
        Some(_) => None,
    };
    bound.filter(|bound| bound.is_finite())
}

/// Returns Theorem 1's bound for this smallest eigenvalue and `rho` of one agent: `delta` is not in the
/// trigger, so the analysis is free to choose it.
fn theorem1(scenario: &Scenario, eigenvalue: f64, rho: f64) -> Option<f64> {
    let bound = UltimateBound::new(scenario)?;
    let room = eigenvalue - scenario.design.k2;
    let agents = scenario.agents.len() as f64;
    let delta = agents * rho * rho / room;
    let squared = bound.weight_error + 2.0 * (delta + scenario.design.epsilon) / bound.alpha;
    (room > 0.0).then_some(squared.sqrt())
}

/// The graph coupling with separate gains.
fn held(scenario: &Scenario, observer: &ObserverSettings) -> Option<f64> {
    let agents = scenario.agents.len();
    if agents > AGENTS_MAX {
        return None;
    }
    let (root, tree) = (observer.root_gain.as_ref()?, observer.tree_gain.as_ref()?);
    let radius = observer.radius.as_ref()?.iter().copied().fold(f64::INFINITY, f64::min);
    let plan = Plan::new(scenario).ok()??;
    let geometry = plan.geometry();
    let laplacian = scenario.graph.laplacian();
    let smallest = |c: usize| {
        let measured = |i: usize| if geometry.is_root(i, c) { root[c] } else { 0.0 };
        let own = DMatrix::from_diagonal(&DVector::from_fn(agents, |i, _| measured(i)));
        (own + &laplacian * tree[c]).symmetric_eigenvalues().min()
    };
    let eigenvalue = (0..scenario.dimension()).map(smallest).fold(f64::INFINITY, f64::min);
    let rho = largest_disturbance(scenario, Some(&geometry.transform))?;
    // The same trigger as agents run, in the terms of the paper's form.
    let mut scenario = scenario.clone();
    scenario.observer = None;
    let size = laplacian_norm(&scenario.graph) * tree.iter().copied().fold(0.0, f64::max);
    let design = &mut scenario.design;
    let phi1 = 0.5 * design.k2 + 0.5 * design.kappa * size * size;
    design.epsilon = agents as f64 * phi1 * radius * radius;
    Some(theorem1(&scenario, eigenvalue, rho)? * spectral_norm(&geometry.inverse))
}

/// Trees.
fn trees<const N: usize>(
    scenario: &Scenario,
    observer: &ObserverSettings,
    trainings: &[TrainingRecord],
) -> Option<f64> {
    if observer.relay_share > RELAY_SHARE_MAX {
        return None;
    }
    let plan = Plan::new(scenario).ok()??;
    let equipped = equipped(scenario, &plan, trainings)?.ok()?;
    let field = FieldParams::<N>::from_words(FieldWords(equipped.package().node.field)).ok()?;
    if field.options.adapts {
        return None;
    }
    let numbers = |of: fn(&agent_core::observer::field::Direction) -> f32| -> Vec<f64> {
        field.directions.iter().map(|direction| f64::from(of(direction))).collect()
    };
    let (roots, trees) = (numbers(|d| d.root_gain), numbers(|d| d.tree_gain));
    let (radii, clips) = (numbers(|d| d.radius), numbers(|d| d.model.clip));
    let geometry = plan.geometry();
    let certificate = Certificate::new(plan.trees(), geometry, &roots, &trees, true);
    let network = field.options.uses_network.then_some(&equipped);
    let residual = largest_residual(scenario, &geometry.transform, network, &field)?;
    let limit = clips.iter().fold(0.0, |sum, clip| sum + clip * clip).sqrt();
    let agents = scenario.agents.len();
    let rho = (agents as f64).sqrt() * (residual + limit);
    let bound = ultimate(&certificate, rho, &radii, agents);
    Some(bound.radius * spectral_norm(&geometry.inverse))
}

/// Returns the package of agent 1 with the observer's parameters, for the network in use after these trainings;
/// `None` without a network.
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
fn largest_disturbance(scenario: &Scenario, transform: Option<&DMatrix<f64>>) -> Option<f64> {
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
) -> Option<f64> {
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
) -> Option<f64> {
    let course = plant_course(scenario).ok()?;
    let mut rate = vec![0.0; scenario.dimension()];
    let from = scenario.observer.as_ref().map_or(0.0, |observer| observer.from);
    let mut largest = 0.0f64;
    for k in (scenario.time.tick(from) as usize..course.samples()).step_by(STRIDE) {
        write(scenario.time.at(k as u64), course.state(k), &mut rate)?;
        let rate = DVector::from_column_slice(&rate);
        largest =
            largest.max(transform.map_or(rate.norm(), |transform| (transform * &rate).norm()));
    }
    Some(largest)
}
