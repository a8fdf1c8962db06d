#![allow(clippy::print_stdout, reason = "prints timings")]

use super::*;
use std::fmt::Write;

/// Creates a network in which each agent measures one component of a state of `n`.
fn network(
    agents: usize,
    n: usize,
    graph: &str,
    gain: &str,
    measured: impl Fn(usize) -> usize,
) -> Scenario {
    let states: Vec<String> = (1..=n).map(|i| format!("\"s{i}\"")).collect();
    let zeros = vec!["\"0\""; n].join(", ");
    let mut text = format!(
        "name = \"graph\"\n[plant]\nmodel = \"expressions\"\nstates = [{}]\nderivative = [{zeros}]\n\
         initial_state = {:?}\n[time]\nduration = 1.0\nstep = 0.001\n[design]\ngain = {gain}\n\
         k2 = 10.0\nkappa = 1.0\nrho = 2.0\ndelta = 0.3\nepsilon = 1.0\n[graph]\n{graph}\n",
        states.join(", "),
        vec![1.0; n],
    );
    for agent in 0..agents {
        let measured = measured(agent);
        let row: Vec<f64> = (0..n).map(|k| f64::from(u8::from(k == measured))).collect();
        let _ = write!(text, "[[agents]]\noutput_matrix = [{row:?}]\n");
    }
    Scenario::parse("graph.toml", &text).unwrap()
}

/// Returns the full matrix `M`.
fn dense(scenario: &Scenario) -> DMatrix<f64> {
    let (n, laplacian) = (scenario.dimension(), scenario.graph.laplacian());
    let matrix = left_side(scenario, &scenario.design.gain);
    let size = n * scenario.agents.len();
    DMatrix::from_fn(size, size, |row, column| {
        let (i, j) = (row / n, column / n);
        let own = if i == j { matrix.diagonal[i][(row % n, column % n)] } else { 0.0 };
        own + laplacian[(i, j)] * scenario.design.gain[(row % n, column % n)]
    })
}

/// Computes the smallest eigenvalue with nalgebra's dense algebra; separately for each
/// component of the state if they are not coupled.
fn dense_smallest(scenario: &Scenario) -> f64 {
    let (n, agents, matrix) = (scenario.dimension(), scenario.agents.len(), dense(scenario));
    let touching = (0..matrix.nrows())
        .any(|i| (0..matrix.ncols()).any(|j| i % n != j % n && matrix[(i, j)] != 0.0));
    let (parts, stride, order) = if touching { (1, 1, n * agents) } else { (n, n, agents) };
    let smallest = (0..parts).map(|part| {
        let entries =
            DMatrix::from_fn(order, order, |i, j| matrix[(i * stride + part, j * stride + part)]);
        entries.symmetric_eigenvalues().min()
    });
    smallest.fold(f64::INFINITY, f64::min)
}

/// Checks the eigenvalue against dense algebra, within its own uncertainty, which must be small.
fn check(what: &str, scenario: &Scenario) -> GainCertificate {
    let start = std::time::Instant::now();
    let found = GainCertificate::new(scenario);
    let took = start.elapsed();
    let expected = dense_smallest(scenario);
    println!("{what}: {found:?}, dense {expected:.12}, {took:.1?}");
    let scale = scenario.design.gain.norm() * scenario.agents.len() as f64;
    let of_reference = 1e-13 * scale;
    assert!(
        (found.eigenvalue_min - expected).abs() <= found.uncertainty + of_reference,
        "{what}: {found:?}, {expected}"
    );
    assert!(found.uncertainty <= 1e-8 * expected.abs() + 1e-11 * scale, "{what}: {found:?}");
    if (expected - found.k1).abs() > 1e-9 * found.k1 {
        assert_eq!(found.holds(), expected > found.k1, "{what}: {found:?}, {expected}");
    }
    found
}

/// Checks that the advised factor makes a solution, and one percent less does not.
fn check_factor(scenario: &Scenario, found: &GainCertificate) {
    let Some(factor) = found.factor() else { return };
    for (scale, expected) in [(1.0, true), (0.99, false)] {
        let mut scaled = scenario.clone();
        scaled.design.gain *= factor * scale;
        assert_eq!(GainCertificate::new(&scaled).holds(), expected, "{found:?}");
    }
}

#[test]
fn fourteen_graphs_match_dense_algebra() {
    let mut cases = Vec::new();
    for agents in [9, 10, 30, 60, 99] {
        cases.push(("complete", agents, 3));
    }
    for agents in [200, 500, 1_000] {
        cases.push(("star", agents, 2));
    }
    for topology in ["path", "ring"] {
        for agents in [100, 400, 1_000] {
            cases.push((topology, agents, 2));
        }
    }
    assert_eq!(cases.len(), 14);
    for (topology, agents, n) in cases {
        let gain = if n == 2 { "[50.0, 70.0]" } else { "[134.86, 263.23, 263.23]" };
        // All components are measured equally often, or the last one by a single agent.
        let patterns: [(&str, &dyn Fn(usize) -> usize); 2] = [
            ("in turn", &|agent| agent % n),
            ("one alone", &|agent| if agent == 0 { n - 1 } else { agent % (n - 1) }),
        ];
        for (pattern, measured) in patterns {
            let graph = format!("topology = \"{topology}\"");
            let scenario = network(agents, n, &graph, gain, measured);
            let found = check(&format!("{topology}, {agents} agents, {pattern}"), &scenario);
            check_factor(&scenario, &found);
        }
    }
}

#[test]
fn irregular_graphs_and_full_gains_match_dense_algebra() {
    use rand::{RngExt, SeedableRng};
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(1);
    let full = "[[80.0, 20.0, -5.0], [20.0, 60.0, 10.0], [-5.0, 10.0, 40.0]]";
    for (agents, density) in [(12, 0.0), (40, 0.1), (40, 0.5), (40, 0.93), (25, 0.8)] {
        let mut edges = Vec::new();
        for second in 2..=agents {
            // A tree first, so that the graph is connected.
            let parent = random.random_range(1..second);
            for first in 1..second {
                let chosen: f64 = random.random_range(0.0..1.0);
                if first == parent || chosen < density {
                    // Mostly one weight, sometimes another.
                    let weight = if chosen < 0.1 * density { 1.75 } else { 0.5 };
                    edges.push(format!("[{first}, {second}, {weight:?}]"));
                }
            }
        }
        let graph = format!("edges = [{}]", edges.join(", "));
        let scenario = network(agents, 3, &graph, full, |agent| agent % 3);
        let found = check(&format!("{agents} agents, density {density}"), &scenario);
        check_factor(&scenario, &found);
    }
}

#[test]
fn paper_gain_is_a_solution_and_half_of_it_is_not() {
    let mut scenario = Scenario::parse("paper.toml", crate::scenario::PAPER).unwrap();
    assert_eq!(check("paper", &scenario).advice(), None);
    scenario.design.gain *= 0.5;
    let half = check("half", &scenario);
    // 23.3333 / (36.1356 / 2), rounded up.
    assert_eq!(half.advice().unwrap(), "NOT a solution; multiply design.gain by 1.30");
    check_factor(&scenario, &half);
}

#[test]
fn no_multiple_of_a_skewed_gain_is_a_solution() {
    // Strong coupling in the gain: the symmetric part of K_1 C^T C has a negative eigenvalue, which
    // the path cannot compensate.
    let gain = "[[100.0, 99.0], [99.0, 100.0]]";
    let scenario = network(2, 2, "edges = [[1, 2, 0.01]]", gain, |agent| agent);
    let found = check("skew", &scenario);
    let GainVerdict::Identity { gain } = found.verdict else { panic!("{found:?}") };
    assert!(found.eigenvalue_min < 0.0 && found.advice().unwrap().contains("no multiple"));
    for (scale, expected) in [(1.0, true), (0.99, false)] {
        let mut other = scenario.clone();
        other.design.gain = DMatrix::identity(2, 2) * (gain * scale);
        assert_eq!(GainCertificate::new(&other).holds(), expected, "{gain}");
    }
}

#[test]
fn uncovered_state_has_no_solution() {
    let scenario = network(3, 2, "topology = \"path\"", "50.0", |_| 0);
    let found = check("blind", &scenario);
    assert_eq!(found.verdict, GainVerdict::StateNotCovered);
    assert!(!outputs_determine_state(&scenario));
    assert!(found.advice().unwrap().contains("no gain helps"));
    // Covered, but in small units.
    let mut faint = network(2, 2, "topology = \"path\"", "50.0", |agent| agent);
    faint.agents[1].output_matrix *= 1e-8;
    assert!(outputs_determine_state(&faint));
}

#[test]
fn eigenvalue_equal_to_k1_is_undecided() {
    // One agent that measures everything: M is the gain.
    let exactly = network(1, 1, "edges = []", "1.0", |_| 0);
    let k1 = GainCertificate::new(&exactly).k1;
    for (gain, holds) in [(k1 * (1.0 + 1e-12), true), (k1 * (1.0 - 1e-12), false)] {
        let mut scenario = exactly.clone();
        scenario.design.gain[(0, 0)] = gain;
        let found = GainCertificate::new(&scenario);
        assert_eq!(found.holds(), holds, "{found:?}");
        assert!(
            matches!(found.verdict, GainVerdict::Open { .. }) != (holds || gain < k1),
            "{found:?}"
        );
    }
    let mut scenario = exactly;
    scenario.design.gain[(0, 0)] = k1;
    let found = GainCertificate::new(&scenario);
    assert!(matches!(found.verdict, GainVerdict::Open { factor } if factor > 1.0), "{found:?}");
}

/// Takes a second or two. `cargo test -p host-sim --lib large_dense -- --nocapture` prints the
/// time.
#[test]
fn large_dense_graphs() {
    use rand::{RngExt, SeedableRng};
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(1);
    for (agents, n) in [(300, 3), (1_000, 3)] {
        let mut edges = Vec::new();
        for second in 2..=agents {
            for first in 1..second {
                if first == 1 || random.random_range(0.0..1.0) < 0.5 {
                    edges.push(format!("[{first}, {second}]"));
                }
            }
        }
        let graph = format!("edges = [{}]", edges.join(", "));
        let scenario = network(agents, n, &graph, "20.0", |agent| agent % n);
        let start = std::time::Instant::now();
        let found = GainCertificate::new(&scenario);
        println!(
            "{agents} agents, half of all edges, n = {n}: {found:?} in {:.2?}",
            start.elapsed()
        );
        assert!(found.uncertainty < 1e-6 * found.eigenvalue_min);
    }
    for n in [3, 12] {
        let scenario = network(1_000, n, "topology = \"complete\"", "20.0", |agent| agent % n);
        let start = std::time::Instant::now();
        let found = GainCertificate::new(&scenario);
        println!("1000 agents, complete, n = {n}: {found:?} in {:.2?}", start.elapsed());
        assert!(found.uncertainty < 1e-6 * found.eigenvalue_min);
    }
}
