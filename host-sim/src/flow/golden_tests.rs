//! Compares the design with an independent implementation: `tests/golden/flow.json`, created by the
//! script next to it.

use nalgebra::DMatrix;
use serde_json::Value;

use super::testing::{close, graph, references, unit_outputs};
use super::ultimate::ultimate_plain;
use super::{Certificate, Geometry, Model, Statistics, Trajectory, Trees, Wanted, gains, settings};

fn golden() -> Value {
    let text = include_str!("../../../tests/golden/flow.json");
    serde_json::from_str(text).unwrap()
}

fn list(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
}

fn indices(value: &Value) -> Vec<usize> {
    let index = |x: &Value| usize::try_from(x.as_u64().unwrap()).unwrap();
    value.as_array().unwrap().iter().map(index).collect()
}

fn edges(value: &Value) -> Vec<(usize, usize)> {
    let pair = |edge: &Value| (indices(edge)[0], indices(edge)[1]);
    value.as_array().unwrap().iter().map(pair).collect()
}

#[test]
fn kalman_gains() {
    for case in golden()["kalman"].as_array().unwrap() {
        let arguments = case["arguments"].as_array().unwrap();
        let argument = |k: usize| arguments[k].as_f64();
        let [q_x, bias, harmonic, step] = [1, 2, 3, 4].map(|k| argument(k).unwrap());
        let found = gains(argument(0), q_x, bias, harmonic, step);
        let found = [found.state, found.bias, found.cosine, found.sine];
        for (found, expected) in found.iter().zip(list(&case["gains"])) {
            assert!((found - expected).abs() <= 1e-6 * expected.abs(), "{found}, {case}");
        }
    }
}

#[test]
fn trees() {
    for case in golden()["trees"].as_array().unwrap() {
        let agents = usize::try_from(case["agents"].as_u64().unwrap()).unwrap();
        let roots: Vec<Vec<usize>> =
            case["roots"].as_array().unwrap().iter().map(indices).collect();
        let outputs: Vec<DMatrix<f64>> = (0..agents)
            .map(|agent| {
                let measured: Vec<usize> =
                    (0..roots.len()).filter(|&c| roots[c].contains(&agent)).collect();
                DMatrix::from_fn(measured.len(), roots.len(), |row, column| {
                    f64::from(u8::from(measured[row] == column))
                })
            })
            .collect();
        let geometry = Geometry::in_state_units(&references(&outputs)).unwrap();
        let found = Trees::new(&graph(agents, &edges(&case["edges"])), &geometry);
        for c in 0..roots.len() {
            assert_eq!(
                found.depth.iter().map(|row| row[c]).collect::<Vec<_>>(),
                indices(&case["depth"][c])
            );
            for agent in 0..agents {
                let expected = case["parent"][c][agent].as_u64();
                assert_eq!(found.parent[agent][c].map(|parent| parent as u64), expected, "{case}");
            }
        }
    }
}

#[test]
fn certificates() {
    for case in golden()["certificates"].as_array().unwrap() {
        let number = |name: &str| case[name].as_f64().unwrap();
        let agents = usize::try_from(case["agents"].as_u64().unwrap()).unwrap();
        let outputs = unit_outputs(3, agents);
        let geometry = Geometry::in_state_units(&references(&outputs)).unwrap();
        let trees = Trees::new(&graph(agents, &edges(&case["edges"])), &geometry);
        let (root, tree) = ([number("root_gain"); 3], [number("tree_gain"); 3]);
        let relayed = case["relayed"].as_bool().unwrap();
        let found = Certificate::new(&trees, &geometry, &root, &tree, relayed);
        let values = [found.plain, found.eigenvalue_min, found.bound, found.condition];
        let expected = ["plain", "eigenvalue_min", "bound", "condition"].map(number);
        close(&values, &expected, 1e-9);
        for (agent, weights) in case["weights"].as_array().unwrap().iter().enumerate() {
            let found: Vec<f64> = found.weights.row(agent).iter().copied().collect();
            close(&found, &list(weights), 1e-12);
        }
    }
}

/// The table of certified errors for the paper's network, whose rates and bounds a third
/// implementation found.
#[test]
fn certified_errors_of_the_papers_network() {
    let outputs = unit_outputs(3, 3);
    let geometry = Geometry::in_state_units(&references(&outputs)).unwrap();
    let trees = Trees::new(&graph(3, &[(0, 1), (0, 2)]), &geometry);
    for (k_o, k_c, radius, rate, error) in [
        (500.0, 200.0, 0.05, 87.2, 0.81),
        (113.0, 100.0, 0.06, 32.2, 1.39),
        (123.0, 100.0, 0.08, 34.0, 1.69),
    ] {
        let found = Certificate::new(&trees, &geometry, &[k_o; 3], &[k_c; 3], false);
        assert!((found.plain - rate).abs() < 0.05, "{found:?}");
        assert!((found.coupling - 2f64.sqrt() * k_c).abs() < 1e-9, "{found:?}");
        assert_eq!(found.hold, [1.0, 2.0, 2.0]);
        let bound = ultimate_plain(&found, 2.26, &[radius; 3], 3).unwrap();
        assert!((bound.radius - error).abs() < 0.005, "{bound:?}");
    }
}

/// Integrates one of the script's plants.
fn trajectory(name: &str, golden: &Value) -> Trajectory {
    let integer = |name: &str| golden[name].as_u64().unwrap() as usize;
    let (step, samples, settled) =
        (golden["step"].as_f64().unwrap(), integer("samples"), integer("settled"));
    let (mut x, amplitude) = match name {
        "lorenz" => (vec![1.0, 2.0, 20.0], vec![2.0, 3.0, 2.0]),
        "duffing" => (vec![1.0, 0.0, -1.0, 0.5], vec![0.2, 1.5, 0.2, 1.2]),
        _ => (vec![0.5, 0.0, -0.5, 0.2, 0.3, 0.0], vec![0.05, 0.3, 0.05, 0.3, 0.05, 0.3]),
    };
    let n = x.len();
    let mut states = Vec::new();
    let mut f = vec![0.0; n];
    for k in 0..samples {
        if k >= settled {
            states.extend_from_slice(&x);
        }
        drift(name, &x, &mut f);
        for c in 0..n {
            let phase = (1.3 + 0.4 * c as f64) * (k as f64 * step);
            x[c] += step * (f[c] + amplitude[c] * libm::sin(phase));
        }
    }
    Trajectory { dimension: n, step, states }
}

fn drift(name: &str, x: &[f64], dx: &mut [f64]) {
    match name {
        "lorenz" => {
            dx[0] = 10.0 * (x[1] - x[0]);
            dx[1] = x[0] * (28.0 - x[2]) - x[1];
            dx[2] = x[0] * x[1] - 8.0 / 3.0 * x[2];
        }
        "duffing" => {
            let cube = |x: f64| x * x * x;
            dx[0] = x[1];
            dx[1] = -0.2 * x[1] - x[0] - cube(x[0]) + 0.5 * (x[2] - x[0]);
            dx[2] = x[3];
            dx[3] = -0.3 * x[3] - 0.8 * x[2] - 0.7 * cube(x[2]) + 0.5 * (x[0] - x[2]);
        }
        _ => {
            for q in 0..3 {
                let mut force = -(2.0 + 3.0 * q as f64) * x[2 * q] - 0.04 * x[2 * q + 1];
                if q > 0 {
                    force += x[2 * q - 2] - x[2 * q];
                }
                if q < 2 {
                    force += x[2 * q + 2] - x[2 * q];
                }
                (dx[2 * q], dx[2 * q + 1]) = (x[2 * q + 1], force);
            }
        }
    }
}

#[test]
fn rules_on_three_plants_and_random_geometries() {
    let golden = golden();
    for case in golden["rules"].as_array().unwrap() {
        let name = case["plant"].as_str().unwrap();
        let states = trajectory(name, &golden);
        close(states.state(states.samples() - 1), &list(&case["last"]), 1e-6);
        let n = states.dimension;
        let outputs: Vec<DMatrix<f64>> = case["outputs"]
            .as_array()
            .unwrap()
            .iter()
            .map(|rows| {
                let rows: Vec<f64> = rows.as_array().unwrap().iter().flat_map(list).collect();
                DMatrix::from_row_slice(rows.len() / n, n, &rows)
            })
            .collect();
        let flag = |name: &str| case[name].as_bool().unwrap();
        let geometry = if flag("scaled") {
            Geometry::scaled(&references(&outputs), &states).unwrap()
        } else {
            Geometry::in_state_units(&references(&outputs)).unwrap()
        };
        let transform: Vec<f64> = geometry.transform.transpose().iter().copied().collect();
        close(&transform, &list(&case["transform"]), 1e-6);

        let deviation = states.deviation();
        let model = |_: f64, x: &[f64], dx: &mut [f64]| {
            drift(name, x, dx);
            for c in 0..n {
                let next = (c + 1) % n;
                dx[c] = 1.05 * dx[c] + 0.05 * deviation[c] * libm::sin(x[next] / deviation[next]);
            }
        };
        let model: Option<&Model<'_>> = if flag("modelled") { Some(&model) } else { None };
        let found = Statistics::new(&states, &geometry, model);
        close(&found.speed, &list(&case["speed"]), 1e-6);
        close(&found.residual, &list(&case["residual"]), 1e-6);
        close(&[found.lipschitz], &[case["lipschitz"].as_f64().unwrap()], 1e-3);

        let noise = case["noise"].as_f64();
        let wanted = Wanted {
            error: case["error"].as_f64().unwrap(),
            // Given in standard deviations there.
            noise: noise.map(|sigma| found.spread.iter().map(|spread| sigma * spread).collect()),
            hop_delay: 0.0,
            step: states.step,
        };
        let derived = settings(&geometry, &found, &wanted);
        assert_eq!(derived.is_ok(), flag("passes"), "{derived:?}");
        let Ok(derived) = derived else { continue };
        let each = |name: &str, of: &dyn Fn(&super::DirectionSettings) -> f64, tolerance: f64| {
            let found: Vec<f64> = derived.directions.iter().map(of).collect();
            close(&found, &list(&case[name]), tolerance);
        };
        each("radius", &|d| d.radius, 1e-6);
        each("bandwidth", &|d| d.bandwidth, 1e-6);
        each("root_gain", &|d| d.root_gain, 1e-6);
        each("tree_gain", &|d| d.tree_gain, 1e-3);
        each("clip", &|d| d.clip, 1e-6);
        each("root_gain", &|d| (2.0 * d.bias_gain).sqrt(), 1e-6);
        close(&derived.expected_error, &list(&case["expected_error"]), 1e-6);
        close(&[derived.bias_decay], &[case["bias_decay"].as_f64().unwrap()], 1e-6);
        assert_eq!(derived.model_hold, flag("model_hold"));
    }
}
