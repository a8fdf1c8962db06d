//! Properties of an agent that hold bit for bit for all parameters, measurements and frames: changes
//! that must not affect a result, and the times of broadcasts.

use agent_core::StateVector;
use agent_core::agent::hold::Hold;
use agent_core::agent::inbox::Inbox;
use agent_core::agent::{AgentParams, AgentState};
use agent_core::observer::network::{Architecture, InnerNetwork, LAYER_WIDTH_MAX, Layer, Scratch};
use agent_core::package::NetworkPlace;
use agent_core::wire::frame::Frame;
use proptest::prelude::*;
use test_support::close;

use crate::core::bits::{bits, member_bits, output_bits, state_bits};
use crate::core::random_network::{Draw, DrawnAgent, DrawnNetwork, Gain, step_all};

/// Steps of each run.
const STEPS: u64 = 8;

/// Returns a configuration with this many cases; the seed in the message reproduces a failure.
fn cases(cases: u32) -> ProptestConfig {
    ProptestConfig { cases, failure_persistence: None, ..ProptestConfig::default() }
}

/// Biases of one layer and, for each input, a row of weights.
#[derive(Clone, Debug)]
struct Dense {
    biases: Vec<f32>,
    rows: Vec<Vec<f32>>,
}

/// Returns a random agent's inner network, layer by layer.
fn dense_layers<const N: usize>(drawn: &DrawnAgent<N>) -> Vec<Dense> {
    let architecture = Architecture::new(N, &drawn.layers).unwrap();
    let mut rest = &drawn.inner_parameters[..];
    let layers = architecture.shapes().map(|(inputs, layer)| {
        let width = usize::from(layer.width);
        let (biases, after) = rest.split_at(width);
        let (weights, after) = after.split_at(width * inputs);
        rest = after;
        let rows = weights.chunks_exact(width).map(<[f32]>::to_vec).collect();
        Dense { biases: biases.to_vec(), rows }
    });
    layers.collect()
}

/// Returns the network with these layers and a random agent's activations.
fn network<const N: usize>(drawn: &DrawnAgent<N>, dense: &[Dense]) -> InnerNetwork<Vec<f32>> {
    let layers: Vec<Layer> = drawn
        .layers
        .iter()
        .zip(dense)
        .map(|(layer, dense)| Layer { width: dense.biases.len() as u8, ..*layer })
        .collect();
    let parameters = dense.iter().flat_map(|dense| {
        dense.rows.iter().fold(dense.biases.clone(), |all, row| [all, row.clone()].concat())
    });
    InnerNetwork::new(Architecture::new(N, &layers).unwrap(), parameters.collect()).unwrap()
}

/// Runs agent 0 of a random network alongside a copy with capacity for `WIDE` features, arrays for its
/// `PLACES` neighbours, and its network in a larger static buffer.
fn spare_capacity_run<const N: usize, const WIDE: usize, const PLACES: usize>(
    drawn: &DrawnNetwork<N>,
    draw: &mut Draw,
) -> Result<(), TestCaseError> {
    let mut members = drawn.members();
    let reference = drawn.agents[0].inner_network();
    let buffer = heapless::Vec::<f32, 2048>::from_slice(reference.parameters()).unwrap();
    let in_buffer = InnerNetwork::new(reference.architecture().clone(), buffer).unwrap();
    let in_slice =
        InnerNetwork::new(reference.architecture().clone(), reference.parameters()).unwrap();

    let params = drawn.params(0);
    let (estimate, weights) = (drawn.agents[0].estimate, &drawn.agents[0].outer_weights);
    let mut wide =
        AgentState::<N, WIDE, _>::new(&params, estimate, weights, [None; PLACES]).unwrap();
    let mut inbox = Inbox::<N, _>::new([None::<Hold<N>>; PLACES]);
    let mut frames: Vec<_> = members.iter().map(|m| m.state.announcement(&m.params)).collect();
    for tick in 0..STEPS {
        for frame in &frames {
            let known = params.neighbours().iter().any(|n| n.id == frame.sender);
            prop_assert_eq!(inbox.accept(params.neighbours(), &frame.encode()).is_ok(), known);
        }
        let measurements = draw.measurements(drawn);
        let y = &measurements[0];
        let found = match tick % 2 {
            0 => wide.step(&params, Some(&in_buffer), tick, y, &mut inbox),
            _ => wide.step(&params, Some(&in_slice), tick, y, &mut inbox),
        };
        let order = draw.order(members.len());
        let outputs = step_all(&mut members, &order, tick, &measurements);
        prop_assert_eq!(output_bits(&found.unwrap()), output_bits(&outputs[0]));
        prop_assert_eq!(state_bits(&params, &wide), member_bits(&members[0]));
        frames = outputs.iter().filter_map(|output| output.broadcast).collect();
    }
    Ok(())
}

fn spare_capacity<const N: usize, const WIDE: usize>(
    drawn: &DrawnNetwork<N>,
    draw: &mut Draw,
) -> Result<(), TestCaseError> {
    match drawn.agents[0].neighbours.len() {
        1 => spare_capacity_run::<N, WIDE, 1>(drawn, draw),
        2 => spare_capacity_run::<N, WIDE, 2>(drawn, draw),
        3 => spare_capacity_run::<N, WIDE, 3>(drawn, draw),
        4 => spare_capacity_run::<N, WIDE, 4>(drawn, draw),
        _ => spare_capacity_run::<N, WIDE, 5>(drawn, draw),
    }
}

/// Adds nodes without influence to the hidden layers, and reorders the last layer.
fn rearranged_network<const N: usize>(seed: u64) -> Result<(), TestCaseError> {
    let mut draw = Draw::new(seed);
    let drawn = draw.network::<N>();
    let agent = &drawn.agents[0];
    let mut dense = dense_layers(agent);
    for layer in 1..dense.len() {
        let [before, after] = &mut dense[layer - 1..=layer] else { unreachable!() };
        let room = LAYER_WIDTH_MAX - before.biases.len();
        for _ in 0..draw.whole(0, room) {
            let place = draw.whole(0, before.biases.len());
            before.biases.insert(place, draw.signed(2.0));
            before.rows.iter_mut().for_each(|row| row.insert(place, draw.signed(2.0)));
            after.rows.insert(place, vec![0.0; after.biases.len()]);
        }
    }
    let order = draw.order(agent.features());
    let last = dense.last_mut().unwrap();
    let reordered = |values: &[f32]| -> Vec<f32> { order.iter().map(|&i| values[i]).collect() };
    last.biases = reordered(&last.biases);
    last.rows.iter_mut().for_each(|row| *row = reordered(row));

    let (plain, changed) = (agent.inner_network(), network(agent, &dense));
    let (mut scratch, mut other_scratch) = (Scratch::NEW, Scratch::NEW);
    for _ in 0..5 {
        let x = draw.vector::<N>(drawn.magnitude);
        let plain = plain.features(x.as_slice(), &mut scratch).unwrap();
        let changed = changed.features(x.as_slice(), &mut other_scratch).unwrap();
        prop_assert_eq!(bits(&reordered(plain)), bits(changed));
    }
    Ok(())
}

/// Steps a network and decides every broadcast independently, in single precision and in the order
/// of the trigger's equation.
fn broadcasts_exactly_when_due<const N: usize>(seed: u64) -> Result<(), TestCaseError> {
    let mut draw = Draw::new(seed);
    let drawn = draw.network::<N>();
    let (phi_1, phi_2) = (drawn.trigger.phi_1 as f32, drawn.trigger.phi_2 as f32);
    let threshold = drawn.trigger.threshold as f32;
    let square = |vector: &StateVector<N>| vector.iter().fold(0.0, |sum, v| sum + v * v);
    let mut members = drawn.members();
    for tick in 0..STEPS {
        let held: Vec<_> = members.iter().map(|m| *m.state.own_hold()).collect();
        let (measurements, order) = (draw.measurements(&drawn), draw.order(members.len()));
        let outputs = step_all(&mut members, &order, tick, &measurements);
        for ((member, held), output) in members.iter().zip(held).zip(&outputs) {
            let estimate = member.state.estimate();
            let hold_error = held.estimate() - estimate;
            let due = phi_1 * square(&hold_error)
                >= phi_2 * square(member.state.consensus_term()) + threshold;
            prop_assert_eq!(output.broadcast.is_some(), due);
            let now = member.state.own_hold();
            let expected =
                if due { Hold::new(*estimate, tick + 1, held.sequence() + 1) } else { held };
            prop_assert_eq!(bits(now.estimate()), bits(expected.estimate()));
            prop_assert_eq!((now.tick(), now.sequence()), (expected.tick(), expected.sequence()));
            if let Some(frame) = output.broadcast {
                prop_assert_eq!(frame, member.state.announcement(&member.params));
                prop_assert_eq!(frame.sender, member.params.id());
                prop_assert_eq!(bits(&frame.estimate), bits(estimate));
                prop_assert_eq!((frame.tick, frame.sequence), (now.tick(), now.sequence()));
            }
        }
    }
    Ok(())
}

/// Runs the same network twice, stepping its agents in different orders.
fn any_order_of_stepping<const N: usize>(seed: u64) -> Result<(), TestCaseError> {
    let mut draw = Draw::new(seed);
    let drawn = draw.network::<N>();
    let (mut members, mut others) = (drawn.members(), drawn.members());
    for tick in 0..STEPS {
        let measurements = draw.measurements(&drawn);
        let (order, other) = (draw.order(members.len()), draw.order(members.len()));
        let outputs = step_all(&mut members, &order, tick, &measurements);
        let other_outputs = step_all(&mut others, &other, tick, &measurements);
        for agent in 0..members.len() {
            prop_assert_eq!(output_bits(&outputs[agent]), output_bits(&other_outputs[agent]));
            prop_assert_eq!(member_bits(&members[agent]), member_bits(&others[agent]));
        }
    }
    Ok(())
}

/// Runs agent 0 with neighbours some of which are never heard, alongside one without them.
fn silent_neighbours_contribute_nothing<const N: usize>(seed: u64) -> Result<(), TestCaseError> {
    let mut draw = Draw::new(seed);
    let full = draw.network::<N>();
    let mut reduced = full.clone();
    reduced.agents[0].neighbours.retain(|_| draw.whole(0, 1) == 1);
    let mut with_silent = full.silent_members().swap_remove(0);
    let mut without = reduced.silent_members().swap_remove(0);
    for tick in 0..STEPS {
        for neighbour in &reduced.agents[0].neighbours {
            let frame =
                Frame::new(neighbour.id, tick as u32, tick, draw.vector::<N>(full.magnitude));
            for member in [&mut with_silent, &mut without] {
                member.inbox.accept(member.params.neighbours(), &frame.encode()).unwrap();
            }
        }
        let measurement = draw.measurements(&full).swap_remove(0);
        let found = with_silent.step(tick, &measurement);
        let expected = without.step(tick, &measurement);
        prop_assert_eq!(output_bits(&found), output_bits(&expected));
        prop_assert_eq!(
            bits(with_silent.state.consensus_term()),
            bits(without.state.consensus_term())
        );
        let weights = |rows: &[StateVector<N>]| bits(rows.iter().flatten());
        prop_assert_eq!(
            weights(with_silent.state.outer_weights().rows()),
            weights(without.state.outer_weights().rows())
        );
        if reduced.agents[0].neighbours.is_empty() {
            prop_assert_eq!(with_silent.state.consensus_term(), &StateVector::<N>::zeros());
        }
    }
    Ok(())
}

/// Replaces the inner network between two steps: only the derivative jumps, by the difference of
/// the two networks' contributions.
fn a_new_network_only_bends_the_estimate<const N: usize>(seed: u64) -> Result<(), TestCaseError> {
    let mut draw = Draw::new(seed);
    let mut drawn = draw.network::<N>();
    // Without the projection, the change of the outer weights has a simple bound.
    for agent in &mut drawn.agents {
        agent.projection.radius = 1e6;
    }
    let mut members = drawn.members();
    for tick in 0..STEPS {
        let (measurements, order) = (draw.measurements(&drawn), draw.order(members.len()));
        step_all(&mut members, &order, tick, &measurements);
    }
    let old = members.swap_remove(0);
    let mut new = old.clone();
    let mut scaled = dense_layers(&drawn.agents[0]);
    for dense in &mut scaled {
        dense.biases = draw.signed_many(dense.biases.len(), 3.0);
    }
    new.inner_network = network(&drawn.agents[0], &scaled);

    let features = |member: &InnerNetwork<Vec<f32>>| {
        let mut scratch = Scratch::NEW;
        member.features(old.state.estimate().as_slice(), &mut scratch).unwrap().to_vec()
    };
    let (old_features, new_features) = (features(&old.inner_network), features(&new.inner_network));
    let weights = old.state.outer_weights().rows().to_vec();
    let before = member_bits(&old);
    prop_assert_eq!(&before, &member_bits(&new));

    let measurement = draw.measurements(&drawn).swap_remove(0);
    let mut old = old;
    let (with_old, with_new) = (old.step(STEPS, &measurement), new.step(STEPS, &measurement));
    prop_assert_eq!(bits(&with_old.sample.estimate), bits(&with_new.sample.estimate));
    prop_assert_eq!(bits(old.state.consensus_term()), bits(new.state.consensus_term()));
    let step_size = f64::from(drawn.step_size);
    for component in 0..N {
        let jump = f64::from(with_new.sample.derivative[component])
            - f64::from(with_old.sample.derivative[component]);
        let terms = weights.iter().zip(old_features.iter().zip(&new_features));
        let (mut expected, mut size) = (0.0, 0.0);
        for (row, (&old, &new)) in terms {
            let weight = f64::from(row[component]);
            expected += weight * (f64::from(new) - f64::from(old));
            size += weight.abs() * (f64::from(new).abs() + f64::from(old).abs());
        }
        size += f64::from(with_old.sample.derivative[component].abs());
        size += f64::from(with_new.sample.derivative[component].abs());
        // Two sums of at most 21 terms in single precision: gamma_21 of their sizes.
        prop_assert!(close(jump, expected, 0.0, 21.0 * f64::from(f32::EPSILON) * size));
        // During the step, the estimate moves by the derivative times the step.
        let start = f64::from(with_new.sample.estimate[component]);
        let moved = f64::from(new.state.estimate()[component]) - start;
        let rate = f64::from(with_new.sample.derivative[component]);
        let rounding = f64::from(f32::EPSILON) * (start.abs() + step_size * rate.abs());
        prop_assert!(close(moved, step_size * rate, 0.0, rounding));
    }
    // The outer weights move by at most dt |Gamma| |sigma| |C^T e_3|.
    let gained = match &drawn.agents[0].outer_gain {
        Gain::Scalar(gain) => f64::from(*gain),
        Gain::Diagonal(entries) | Gain::Full(entries) => {
            entries.iter().map(|&entry| f64::from(entry).powi(2)).sum::<f64>().sqrt()
        }
    };
    let norm = |values: &[f32]| values.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt();
    let outputs = drawn.agents[0].output_rows.iter().flatten().copied().collect::<Vec<_>>();
    let innovation = norm(&outputs) * norm(new.state.output_error(&new.params));
    let bound = step_size * gained * norm(&new_features) * innovation;
    let change: Vec<f32> = new
        .state
        .outer_weights()
        .rows()
        .iter()
        .zip(&weights)
        .flat_map(|(after, before)| (after - before).iter().copied().collect::<Vec<_>>())
        .collect();
    let size = weights.iter().map(|row| f64::from(row.norm_squared())).sum::<f64>().sqrt();
    prop_assert!(norm(&change) <= bound * (1.0 + 1e-4) + f64::from(f32::EPSILON) * size);
    Ok(())
}

proptest! {
    #![proptest_config(cases(48))]

    #[test]
    fn spare_capacity_and_the_kind_of_storage_change_no_bit(seed: u64) {
        let mut draw = Draw::new(seed);
        let drawn = draw.network::<3>();
        spare_capacity::<3, 64>(&drawn, &mut draw)?;
        let mut small = draw.network::<3>();
        while small.agents[0].features() > 5 {
            small = draw.network();
        }
        spare_capacity::<3, 5>(&small, &mut Draw::new(seed))?;
        spare_capacity::<3, 64>(&small, &mut Draw::new(seed))?;
        let large = draw.network::<12>();
        spare_capacity::<12, 64>(&large, &mut draw)?;
    }

    #[test]
    fn nodes_without_influence_and_their_order_change_no_bit(seed: u64) {
        rearranged_network::<1>(seed)?;
        rearranged_network::<3>(seed)?;
        rearranged_network::<12>(seed)?;
    }

    #[test]
    fn an_agent_broadcasts_exactly_when_the_trigger_says_so(seed: u64) {
        broadcasts_exactly_when_due::<1>(seed)?;
        broadcasts_exactly_when_due::<3>(seed)?;
        broadcasts_exactly_when_due::<12>(seed)?;
    }

    #[test]
    fn the_order_in_which_agents_are_stepped_changes_no_bit(seed: u64) {
        any_order_of_stepping::<1>(seed)?;
        any_order_of_stepping::<3>(seed)?;
        any_order_of_stepping::<12>(seed)?;
    }

    #[test]
    fn a_neighbour_that_was_never_heard_contributes_nothing(seed: u64) {
        silent_neighbours_contribute_nothing::<1>(seed)?;
        silent_neighbours_contribute_nothing::<3>(seed)?;
        silent_neighbours_contribute_nothing::<12>(seed)?;
    }

    #[test]
    fn estimate_and_outer_weights_are_continuous_over_a_switch(seed: u64) {
        a_new_network_only_bends_the_estimate::<1>(seed)?;
        a_new_network_only_bends_the_estimate::<3>(seed)?;
        a_new_network_only_bends_the_estimate::<12>(seed)?;
    }
}

#[test]
fn an_agent_of_the_papers_size_fits_into_two_kibibytes() {
    // Three states, five features, two neighbours; the network stays in flash.
    type ParamBuffers = [Option<Hold<3>>; 2];
    let sizes = [
        size_of::<AgentParams<'_, 3>>(),
        size_of::<AgentState<3, 5, ParamBuffers>>(),
        size_of::<Inbox<3, ParamBuffers>>(),
        size_of::<NetworkPlace>(),
    ];
    println!("parameters, state, inbox, place: {sizes:?} bytes");
    assert!(sizes.iter().sum::<usize>() <= 2 * 1024, "{sizes:?} bytes");
}
