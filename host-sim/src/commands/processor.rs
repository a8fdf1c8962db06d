//! What computing costs on real microcontrollers: time awake, charge, and what sleeping between steps saves.
//!
//! The instructions of a step are estimated from those that are counted under emulation for an agent of the paper's
//! size (`docs/performance.md`): a constant part, and one for each multiplication of the network at each of its
//! evaluations. Cycles are not counted anywhere: [`CYCLES`] is an assumption. Sensors, the service port, keys, waiting
//! for the radio's channel and waking up do not count.
//!
//! Sources, typical currents at 3 V and 25 degrees C: nRF52840 product specification (CoreMark from flash with cache
//! and DC/DC converter; asleep with 256 kB of RAM retained, woken by the real-time counter on the crystal), nRF54L15
//! preliminary data sheet 0.10 (CoreMark from non-volatile memory with cache; asleep with 256 kB retained, global
//! real-time counter on the crystal).

use agent_core::observer::field::HoldKind;
use serde::Serialize;

use super::radio::{BATTERIES, DAY, Frames, days};
use crate::number::significant;
use crate::report::columns::Table;
use crate::scenario::{Method, Scenario};

/// Cycles of an instruction, with waits for flash: assumed.
const CYCLES: f64 = 2.0;

/// Instructions of a multiplication and addition of the network, with its load and its share of activations.
const FOR_A_WEIGHT: f64 = 2_474.0 / 399.0;
/// Instructions of the paper's observer without the network, with health monitoring.
const PAPER: f64 = 3_362.0 - 2_474.0;
/// Instructions of the field observer with samples that evolve by their rates, without the network.
const FIELD: f64 = 5_050.0 - 2_474.0;
/// Instructions of a sample that evolves by the network, besides the network.
const FOR_A_SAMPLE: f64 = (13_249.0 - 4.0 * 2_474.0 - FIELD) / 3.0;
/// Instructions of a broadcast with its frame, and of a received frame.
const FOR_A_BROADCAST: f64 = 4_672.0 - 3_362.0;
const FOR_A_RECEPTION: f64 = 1_274.0;

/// A microcontroller.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Processor {
    name: &'static str,
    /// \[Hz\]
    frequency: f64,
    /// Current while computing. \[A\]
    running: f64,
    /// Current while asleep, with memory retained and a timer that wakes it. \[A\]
    asleep: f64,
}

const PROCESSORS: [Processor; 2] = [
    Processor { name: "nRF52840, 64 MHz", frequency: 64e6, running: 3.3e-3, asleep: 3.16e-6 },
    Processor { name: "nRF54L15, 128 MHz", frequency: 128e6, running: 2.6e-3, asleep: 3.1e-6 },
];

/// The cost on one microcontroller, of the node that computes most.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Cost {
    processor: &'static str,
    /// Instructions of a step, frames included, on average.
    instructions: f64,
    /// Time awake, as a share of the window; above 1 the processor is too slow.
    busy_share: f64,
    /// In the window, asleep between steps, and if it is always awake.
    charge_mc: f64,
    charge_awake_mc: f64,
    life_cr2032_days: Option<f64>,
    life_2_aa_days: Option<f64>,
}

/// Returns the instructions of a step with a network of this many weights, frames apart, for an agent that keeps
/// `samples`: its own and those of its neighbours.
fn instructions(weights: f64, samples: f64, field: Option<HoldKind>) -> f64 {
    let network = FOR_A_WEIGHT * weights;
    match field {
        None => PAPER + network,
        Some(HoldKind::Model) if weights > 0.0 => {
            FIELD + network + samples * (network + FOR_A_SAMPLE)
        }
        Some(_) => FIELD + network,
    }
}

/// Returns the cost on a microcontroller of `instructions` in every step \[s\] of `window` \[s\].
fn cost(processor: &Processor, instructions: f64, step: f64, window: f64) -> Cost {
    let busy_share = instructions * CYCLES / processor.frequency / step;
    let awake = busy_share.min(1.0);
    let current = awake * processor.running + (1.0 - awake) * processor.asleep;
    let life = |charge: f64| (busy_share <= 1.0).then(|| charge / current / DAY);
    Cost {
        processor: processor.name,
        instructions,
        busy_share,
        charge_mc: 1e3 * current * window,
        charge_awake_mc: 1e3 * processor.running * window,
        life_cr2032_days: life(BATTERIES[0]),
        life_2_aa_days: life(BATTERIES[1]),
    }
}

/// Returns the cost on each microcontroller of the node that computes most, which broadcasts and hears `frames`; none
/// for a method that no node runs.
pub(super) fn costs(scenario: &Scenario, frames: &[[Frames; 2]], window: f64) -> Vec<Cost> {
    if !matches!(scenario.method, Method::Observer | Method::Untrained | Method::NoNetwork) {
        return Vec::new();
    }
    // Of a window in which agents switch to it, the field observer's steps, which are longer.
    let field = scenario.observer.as_ref().filter(|field| field.from < scenario.evaluation.to);
    let uses_network =
        scenario.method != Method::NoNetwork && field.is_none_or(|field| field.network);
    let n = scenario.dimension();
    let weights = match &scenario.network {
        Some(network) if uses_network => {
            let widths = network.architecture.layers().iter().map(|layer| usize::from(layer.width));
            let sizes: Vec<_> =
                std::iter::once(network.architecture.inputs()).chain(widths).collect();
            let inner: usize = sizes.windows(2).map(|pair| pair[0] * pair[1]).sum();
            (inner + network.architecture.features() * n) as f64
        }
        _ => 0.0,
    };
    // Agents whose networks differ go on with rates. A hold that the rules choose may be by the network: an upper limit.
    let have_own =
        scenario.agents.len() > 1 && scenario.learning.iter().any(|cycle| !cycle.is_shared);
    let hold = field.map(|field| match field.hold.unwrap_or(HoldKind::Model) {
        HoldKind::Model if have_own => HoldKind::Rate,
        hold => hold,
    });
    let step = scenario.time.step_size;
    let of_agent = |(i, [sent, heard]): (usize, &[Frames; 2])| {
        let samples = 1.0 + scenario.graph.neighbours(i).len() as f64;
        let frames = FOR_A_BROADCAST * sent.count as f64 + FOR_A_RECEPTION * heard.count as f64;
        instructions(weights, samples, hold) + frames * step / window
    };
    let most = frames.iter().enumerate().map(of_agent).fold(0.0, f64::max);
    PROCESSORS.iter().map(|processor| cost(processor, most, step, window)).collect()
}

/// Returns the costs of one run as text.
pub(super) fn text(costs: &[Cost]) -> String {
    if costs.is_empty() {
        return String::new();
    }
    let headings = [
        ["", "processor"],
        ["instructions", "of a step"],
        ["awake", "[%]"],
        ["charge [mC]", "asleep between"],
        ["charge [mC]", "always awake"],
        ["battery [d]", "CR2032"],
        ["battery [d]", "2 AA"],
    ];
    let row = |cost: &Cost| {
        vec![
            cost.processor.to_owned(),
            significant(cost.instructions, 3),
            significant(100.0 * cost.busy_share, 3),
            significant(cost.charge_mc, 3),
            significant(cost.charge_awake_mc, 3),
            days(cost.life_cr2032_days),
            days(cost.life_2_aa_days),
        ]
    };
    format!(
        "Processor of the node that computes most, if it sleeps between steps, assuming {CYCLES} cycles per \
         instruction.\nBattery life if it powers nothing else and never waits for the sensor or the radio; \
         - if the processor is too slow\n\n{}\n",
        Table::new(&headings, costs.iter().map(row).collect()).text()
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counted_steps_are_reproduced() {
        let paper = 399.0;
        assert!((instructions(paper, 3.0, None) - 3_362.0).abs() < 1e-9);
        assert!((instructions(paper, 3.0, Some(HoldKind::Rate)) - 5_050.0).abs() < 1e-9);
        assert!((instructions(paper, 3.0, Some(HoldKind::Model)) - 13_249.0).abs() < 1e-9);
        // Without a network there is nothing for samples to evolve by.
        assert!((instructions(0.0, 3.0, Some(HoldKind::Model)) - FIELD).abs() < 1e-9);
    }

    #[test]
    fn charges_are_those_of_the_time_awake_and_asleep() {
        let found = cost(&PROCESSORS[0], 3_200.0, 1e-3, 10.0);
        // 6,400 cycles take 0.1 ms of each millisecond.
        assert!((found.busy_share - 0.1).abs() < 1e-12);
        assert!((found.charge_mc - 10.0 * (0.1 * 3.3 + 0.9 * 3.16e-3)).abs() < 1e-9);
        assert!((found.charge_awake_mc - 33.0).abs() < 1e-9);
        // 2.5 Ah at a third of a milliampere last for about ten months.
        assert!(found.life_2_aa_days.is_some_and(|days| (days - 312.9).abs() < 0.1), "{found:?}");
        let slow = cost(&PROCESSORS[0], 40_000.0, 1e-3, 10.0);
        assert!(slow.busy_share > 1.0 && slow.life_2_aa_days.is_none());
        assert!((slow.charge_mc - slow.charge_awake_mc).abs() < 1e-9, "it never sleeps");
    }

    #[test]
    fn samples_that_evolve_by_a_network_cost_an_evaluation_each() {
        let text = include_str!("../../examples/field-observer/flow-eso.toml");
        let counted = |text: &str| {
            let scenario = Scenario::parse("flow-eso.toml", text).unwrap();
            costs(&scenario, &[[Frames::default(); 2]; 3], 20.0)[0].instructions
        };
        // The centre of the star keeps three samples.
        assert!((counted(text) - 13_249.0).abs() < 1e-9, "{}", counted(text));
        let by_rates = [
            text.replace("shared = true", "shared = false"),
            text.replace("hold = \"model\"", "hold = \"rate\""),
        ];
        for other in by_rates {
            assert!((counted(&other) - 5_050.0).abs() < 1e-9, "{}", counted(&other));
        }
        let later = text.replace("from = 20.0\nto", "from = 10.0\nto");
        assert!((counted(&later) - 13_249.0).abs() < 1e-9);
    }

    #[test]
    fn the_shipped_scenario_counts_its_network_and_its_frames() {
        let mut scenario = Scenario::parse("paper.toml", crate::scenario::PAPER).unwrap();
        let frames = |count| Frames { count, bytes: 25 * count };
        let sent =
            [[frames(100), frames(200)], [frames(50), frames(100)], [frames(50), frames(100)]];
        let counted = |scenario: &Scenario| costs(scenario, &sent, 20.0)[0].instructions;
        let expected = 3_362.0 + (100.0 * 1_310.0 + 200.0 * 1_274.0) / 20_000.0;
        assert!((counted(&scenario) - expected).abs() < 1e-9, "{}", counted(&scenario));
        scenario.method = Method::NoNetwork;
        assert!((counted(&scenario) - expected + 2_474.0).abs() < 1e-9);
        scenario.method = Method::Kalman;
        assert!(costs(&scenario, &sent, 20.0).is_empty());
    }
}
