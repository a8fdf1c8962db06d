//! Packages with one thing wrong: a table of what to change, and by how much.

use agent_core::AgentId;
use agent_core::math::activation::Activation;
use agent_core::math::symmetric::SymmetricMatrix;
use agent_core::observer::network::{Architecture, Layer};
use agent_core::observer::projection::ProjectionParams;
use agent_core::observer::trigger::TriggerParams;
use agent_core::package::{NeighbourIds, OnSwitch};
use host_sim::packages::{Draft, DraftError, PackageBytes};

/// The numbers of a package, to be changed one at a time.
#[derive(Clone, Debug)]
pub(crate) struct Parts {
    package: PackageBytes,
    pub(crate) draft: Draft,
    pub(crate) output_matrix: Vec<f32>,
    /// `K_1`, row by row.
    pub(crate) gain: Vec<f32>,
    pub(crate) neighbours: Vec<AgentId>,
    pub(crate) edge_weights: Vec<f32>,
    /// `Gamma`, a multiple of the identity.
    pub(crate) outer_gain: f32,
    pub(crate) step_size: f32,
    pub(crate) trigger: TriggerParams,
    pub(crate) projection: ProjectionParams,
}

impl Parts {
    pub(crate) fn new(package: &PackageBytes, version: u32) -> Self {
        let content = package.package();
        let node = &content.node;
        let mut gain = vec![0.0; 9];
        match node.gain {
            SymmetricMatrix::Diagonal(entries) => {
                (0..3).for_each(|row| gain[4 * row] = entries[row]);
            }
            ref other => panic!("{other:?}"),
        }
        Self {
            package: package.clone(),
            draft: Draft { version, on_switch: OnSwitch::Replace, ..Draft::copy(&content) },
            output_matrix: node.output_matrix.to_vec(),
            gain,
            neighbours: node.neighbours.iter().collect(),
            edge_weights: node.edge_weights.to_vec(),
            outer_gain: node.outer_law.gain.entries()[0],
            step_size: node.step_size,
            trigger: node.trigger,
            projection: node.outer_law.projection,
        }
    }

    pub(crate) fn seal(&self) -> Result<PackageBytes, DraftError> {
        let mut content = self.package.package();
        content.node.output_matrix = &self.output_matrix;
        content.node.gain = SymmetricMatrix::Full(&self.gain);
        content.node.neighbours = NeighbourIds::new(&self.neighbours);
        content.node.edge_weights = &self.edge_weights;
        content.node.outer_law.gain = SymmetricMatrix::Scalar(self.outer_gain);
        content.node.step_size = self.step_size;
        content.node.trigger = self.trigger;
        content.node.outer_law.projection = self.projection;
        let changed = Draft::copy(&content);
        Draft { node: changed.node, ..self.draft.clone() }.seal()
    }
}

/// A package with one thing wrong.
pub(crate) struct Mutant {
    pub(crate) name: String,
    pub(crate) parts: Parts,
}

/// All kinds of mutants of `package`.
pub(crate) fn mutants(package: &PackageBytes, version: u32) -> Vec<Mutant> {
    let good = Parts::new(package, version);
    let mut all = Vec::new();
    let mut add = |name: String, change: &dyn Fn(&mut Parts)| {
        let mut parts = good.clone();
        change(&mut parts);
        all.push(Mutant { name, parts });
    };
    let factors = [-10.0, -1.0, 0.0, 1e-3, 0.1, 10.0, 1e3];
    for factor in [-100.0, -3.0, 0.01, 3.0, 30.0].into_iter().chain(factors) {
        add(format!("gain x {factor}"), &|parts| scale(&mut parts.gain, factor));
        add(format!("output matrix x {factor}"), &|parts| scale(&mut parts.output_matrix, factor));
        add(format!("outer weights x {factor}"), &|parts| {
            scale(&mut parts.draft.outer_weights, factor);
        });
        add(format!("outer gain x {factor}"), &|parts| parts.outer_gain *= factor);
        add(format!("edge weights x {factor}"), &|parts| scale(&mut parts.edge_weights, factor));
    }
    add("gain -500".into(), &|parts| {
        (0..3).for_each(|row| parts.gain[4 * row] = -500.0);
    });
    for entry in 0..3 {
        for factor in factors {
            add(format!("gain entry {entry} x {factor}"), &|parts| parts.gain[4 * entry] *= factor);
        }
        for value in [-200.0, 200.0] {
            add(format!("gain off the diagonal {entry}: {value}"), &|parts| {
                let (row, column) = [(0, 1), (0, 2), (1, 2)][entry];
                parts.gain[3 * row + column] = value;
                parts.gain[3 * column + row] = value;
            });
        }
        for value in [-1.0, 0.3, 1.0, 10.0] {
            add(format!("output matrix entry {entry} + {value}"), &|parts| {
                parts.output_matrix[entry] += value;
            });
        }
        for shift in [-1e4, -100.0, 100.0, 1e4] {
            add(format!("box of component {entry} shifted by {shift}"), &|parts| {
                parts.draft.low[entry] += shift;
                parts.draft.high[entry] += shift;
            });
        }
    }
    for turn in 1..3 {
        add(format!("output matrix turned by {turn}"), &|parts| {
            parts.output_matrix.rotate_right(turn);
        });
        add(format!("gain turned by {turn}"), &|parts| {
            let gain: Vec<_> = (0..3).map(|row| parts.gain[4 * row]).collect();
            (0..3).for_each(|row| parts.gain[4 * row] = gain[(row + turn) % 3]);
        });
    }
    for exponent in [-30, -12, -6, -3, 3, 6, 12, 30] {
        let factor = 10f32.powi(exponent);
        add(format!("trigger threshold x 1e{exponent}"), &|parts| {
            parts.trigger.threshold *= factor;
        });
        add(format!("trigger hold error x 1e{exponent}"), &|parts| {
            parts.trigger.hold_error_weight *= factor;
        });
        add(format!("trigger consensus x 1e{exponent}"), &|parts| {
            parts.trigger.consensus_weight *= factor;
        });
        add(format!("outer gain x 1e{exponent}"), &|parts| parts.outer_gain *= factor);
        add(format!("projection radius x 1e{exponent}"), &|parts| {
            parts.projection.radius *= factor;
            parts.projection.boundary_layer *= factor;
        });
    }
    for factor in [1e-42, 1e-6, 1e-3, 0.1, 0.5, 2.0, 5.0, 10.0, 100.0, 1e3] {
        add(format!("step x {factor:e}"), &|parts| parts.step_size *= factor);
    }
    for factor in [-30.0, -10.0, -1.0, 0.0, 3.0, 10.0, 100.0, 1e4, 1e20, 1e30] {
        add(format!("inner weights x {factor:e}"), &|parts| scale(&mut parts.draft.inner, factor));
    }
    add("weights x 10, outer weights negated".into(), &|parts| {
        scale(&mut parts.draft.inner, 10.0);
        scale(&mut parts.draft.outer_weights, -1.0);
    });
    for column in 0..3 {
        for factor in [-10.0, -1.0, 10.0, 100.0] {
            add(format!("outer weights of component {column} x {factor}"), &|parts| {
                let column = parts.draft.outer_weights.iter_mut().skip(column).step_by(3);
                column.for_each(|weight| *weight *= factor);
            });
        }
    }
    for row in 0..5 {
        for value in [-19.0, 19.0] {
            add(format!("outer weights of feature {row} are {value}"), &|parts| {
                let row = &mut parts.draft.outer_weights[3 * row..3 * row + 3];
                row.fill(value / 3.0);
            });
        }
    }
    for (name, other) in Activation::NAMES {
        add(format!("activation {name}"), &|parts| {
            let architecture = &parts.draft.architecture;
            let layers: Vec<_> = architecture
                .layers()
                .iter()
                .map(|layer| Layer { activation: other, ..*layer })
                .collect();
            parts.draft.architecture = Architecture::new(architecture.inputs(), &layers).unwrap();
        });
    }
    for scale_box in [1e-6, 1e-3, 1e3, 1e6] {
        add(format!("box x {scale_box:e}"), &|parts| {
            for (low, high) in parts.draft.low.iter_mut().zip(&mut parts.draft.high) {
                let (middle, half) = ((*low + *high) / 2.0, (*high - *low) / 2.0);
                (*low, *high) = (middle - half * scale_box, middle + half * scale_box);
            }
        });
    }
    add("neighbours that do not exist".into(), &|parts| {
        parts.neighbours.iter_mut().for_each(|id| *id += 1000);
    });
    add("without neighbours".into(), &|parts| {
        parts.neighbours.clear();
        parts.edge_weights.clear();
    });
    for index in 0..good.edge_weights.len() {
        for factor in [1e-6, 1e-3, 100.0, 1e4, 1e10] {
            add(format!("edge weight {index} x {factor:e}"), &|parts| {
                parts.edge_weights[index] *= factor;
            });
        }
    }
    all
}

fn scale(numbers: &mut [f32], factor: f32) {
    numbers.iter_mut().for_each(|number| *number *= factor);
}
