//! Where the agents of a graph are drawn. Small graphs are drawn on a circle, larger ones by force-directed placement.
//!
//! Agents begin at their distances, in edges, from two pairs of agents that are far apart, so that large
//! graphs do not fold. Then all repel each other and edges pull; the largest movement shrinks with every
//! round. Cost: `N²` per round.
//!
//! Source: T. Fruchterman and E. Reingold, "Graph drawing by force-directed placement" (1991).

use std::collections::VecDeque;

/// Up to this many agents are placed on a circle.
const CIRCLE: usize = 12;
/// Pairs of agents that are looked at in all rounds together, about half a second.
const PAIRS: usize = 200_000_000;
/// Rounds of any graph at most.
const ROUNDS: usize = 400;

/// Returns the places of agents, shape `[N]` of x and y from 0 to 1. `edges` join agents that are counted
/// from 0.
#[must_use]
pub fn places(agents: usize, edges: &[(usize, usize)]) -> Vec<[f64; 2]> {
    let circle = |index: usize| {
        let angle = std::f64::consts::TAU * (index as f64 / agents as f64 - 0.25);
        [0.5 + 0.5 * libm::cos(angle), 0.5 + 0.5 * libm::sin(angle)]
    };
    let rounds = (PAIRS / (agents * agents).max(1)).min(ROUNDS);
    if agents <= CIRCLE || rounds == 0 {
        return (0..agents).map(circle).collect();
    }
    let mut places = by_distances(agents, edges);
    let distance = (1.0 / agents as f64).sqrt();
    let mut moves = vec![[0.0; 2]; agents];
    for round in 0..rounds {
        repel(&places, distance, &mut moves);
        for &(a, b) in edges {
            pull(&places, distance, &mut moves, a, b);
        }
        let left = 1.0 - round as f64 / rounds as f64;
        let most = 0.1 * left * left;
        for (place, step) in places.iter_mut().zip(&mut moves) {
            let length = length(*step);
            if length > 0.0 {
                let share = length.min(most) / length;
                place[0] += share * step[0];
                place[1] += share * step[1];
            }
            *step = [0.0; 2];
        }
    }
    fill_square(&mut places);
    places
}

/// Returns places by the distances from far agents, each a little off, so that no two are the same.
fn by_distances(agents: usize, edges: &[(usize, usize)]) -> Vec<[f64; 2]> {
    let mut neighbours = vec![Vec::new(); agents];
    for &(a, b) in edges {
        neighbours[a].push(b);
        neighbours[b].push(a);
    }
    let farthest = |key: &dyn Fn(usize) -> u32| (0..agents).max_by_key(|&agent| key(agent));
    let from = |agent: Option<usize>| distances(&neighbours, agent.unwrap_or(0));
    let first = from(Some(0));
    let west = from(farthest(&|agent| first[agent]));
    let east = from(farthest(&|agent| west[agent]));
    // As far from both as possible.
    let north = from(farthest(&|agent| west[agent].min(east[agent])));
    let south = from(farthest(&|agent| {
        let apart = west[agent].abs_diff(east[agent]);
        (north[agent] + west[agent].min(east[agent])).saturating_sub(apart)
    }));
    let difference = |a: &[u32], b: &[u32], agent: usize| f64::from(a[agent]) - f64::from(b[agent]);
    let place = |agent: usize| {
        // The golden angle spreads the offsets.
        let angle = 2.399_963 * agent as f64;
        [
            difference(&west, &east, agent) + 0.3 * libm::cos(angle),
            difference(&north, &south, agent) + 0.3 * libm::sin(angle),
        ]
    };
    let mut places = (0..agents).map(place).collect::<Vec<_>>();
    fill_square(&mut places);
    places
}

/// Returns the number of edges from `start` to each agent; 0 if there is no path.
fn distances(neighbours: &[Vec<usize>], start: usize) -> Vec<u32> {
    let mut distances = vec![None; neighbours.len()];
    distances[start] = Some(0);
    let mut next = VecDeque::from([start]);
    while let Some(agent) = next.pop_front() {
        let distance = distances[agent].unwrap_or(0) + 1;
        for &neighbour in &neighbours[agent] {
            if distances[neighbour].is_none() {
                distances[neighbour] = Some(distance);
                next.push_back(neighbour);
            }
        }
    }
    distances.into_iter().map(|distance| distance.unwrap_or(0)).collect()
}

fn length([x, y]: [f64; 2]) -> f64 {
    (x * x + y * y).sqrt()
}

fn repel(places: &[[f64; 2]], distance: f64, moves: &mut [[f64; 2]]) {
    for a in 0..places.len() {
        let mut sum = [0.0; 2];
        for b in 0..a {
            let [x, y] = [places[a][0] - places[b][0], places[a][1] - places[b][1]];
            let force = distance * distance / (x * x + y * y).max(1e-9);
            sum[0] += force * x;
            sum[1] += force * y;
            moves[b][0] -= force * x;
            moves[b][1] -= force * y;
        }
        moves[a][0] += sum[0];
        moves[a][1] += sum[1];
    }
}

fn pull(places: &[[f64; 2]], distance: f64, moves: &mut [[f64; 2]], a: usize, b: usize) {
    let step = [places[b][0] - places[a][0], places[b][1] - places[a][1]];
    let force = length(step) / distance;
    for axis in 0..2 {
        moves[a][axis] += force * step[axis];
        moves[b][axis] -= force * step[axis];
    }
}

/// Scales places to the unit square.
fn fill_square(places: &mut [[f64; 2]]) {
    for axis in 0..2 {
        let values = || places.iter().map(|place| place[axis]);
        let low = values().fold(f64::INFINITY, f64::min);
        let range = (values().fold(f64::NEG_INFINITY, f64::max) - low).max(1e-9);
        places.iter_mut().for_each(|place| place[axis] = (place[axis] - low) / range);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_are_drawn_closer_than_others() {
        let size = 6;
        let at = |row: usize, column: usize| row * size + column;
        let mut edges = Vec::new();
        for row in 0..size {
            for column in 0..size - 1 {
                edges.push((at(row, column), at(row, column + 1)));
                edges.push((at(column, row), at(column + 1, row)));
            }
        }
        let places = places(size * size, &edges);
        let distance =
            |a: usize, b: usize| length([places[a][0] - places[b][0], places[a][1] - places[b][1]]);
        assert!(places.iter().flatten().all(|place| (0.0..=1.0).contains(place)));
        let mean = edges.iter().map(|&(a, b)| distance(a, b)).sum::<f64>() / edges.len() as f64;
        let corners = distance(at(0, 0), at(size - 1, size - 1));
        assert!(mean < 0.3 && corners > 3.0 * mean, "{mean} {corners}");
    }

    #[test]
    fn a_few_agents_are_on_a_circle() {
        let places = places(4, &[(0, 1)]);
        let expected = [[0.5, 0.0], [1.0, 0.5], [0.5, 1.0], [0.0, 0.5]];
        for (place, expected) in places.iter().flatten().zip(expected.iter().flatten()) {
            assert!((place - expected).abs() < 1e-12);
        }
    }
}
