//! What broadcasts cost on real radios: time on air, charge, and the life of a battery.
//!
//! Frames travel as payloads of the radio's own packets, longer ones in several. The time on air counts
//! at the transmit current, and the time on air of the neighbours' frames at the receive current, as
//! if a receiver were awake for exactly these. Waiting for a free channel, start-up, computing, sleep, and
//! what a battery loses by itself do not count; so lives are upper limits.
//!
//! Sources, typical currents of the data sheets: nRF52840 product specification (radio alone, DC/DC at 3 V),
//! Atmel AT86RF233 (8351), Semtech SX1276 (output RFO, low-noise amplifier without boost; time on air by
//! the formula there); packets of IEEE 802.15.4, 2.4 GHz O-QPSK; batteries Energizer CR2032 (0.2 mA) and
//! E91 (25 mA).

use serde::Serialize;

use crate::graph::Graph;
use crate::number::significant;
use crate::report::columns::Table;

/// A radio at one setting.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Radio {
    pub(super) name: &'static str,
    /// Current while transmitting. \[A\]
    transmit: f64,
    /// Current while receiving. \[A\]
    receive: f64,
    packet: Packet,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Packet {
    /// 250 kbit/s, 6 bytes before the packet, 11 bytes of header and checksum in it.
    Ieee802154,
    /// Spreading factor 7, 125 kHz, code rate 4/5, explicit header, checksum, preamble of 8.
    LoRa7,
}

/// The radios.
pub(super) const RADIOS: [Radio; 3] = [
    Radio {
        name: "nRF52840, 0 dBm, 802.15.4",
        transmit: 4.8e-3,
        receive: 4.6e-3,
        packet: Packet::Ieee802154,
    },
    Radio {
        name: "AT86RF233, 4 dBm, 802.15.4",
        transmit: 13.8e-3,
        receive: 11.8e-3,
        packet: Packet::Ieee802154,
    },
    Radio {
        name: "SX1276, 13 dBm, LoRa SF7",
        transmit: 29.0e-3,
        receive: 10.8e-3,
        packet: Packet::LoRa7,
    },
];

/// Charge of a CR2032, and of two AA cells in series. \[A s\]
pub(super) const BATTERIES: [f64; 2] = [0.235 * 3600.0, 2.5 * 3600.0];

/// \[s\]
pub(super) const DAY: f64 = 86_400.0;

impl Radio {
    /// Returns the time on air of a frame of this many bytes. \[s\]
    fn airtime(&self, bytes: f64) -> f64 {
        let split = |payload: f64, most: f64, one: &dyn Fn(f64) -> f64| {
            let parts = (payload / most).ceil().max(1.0);
            parts * one(payload / parts)
        };
        match self.packet {
            Packet::Ieee802154 => split(bytes, 116.0, &|payload| (6.0 + 11.0 + payload) * 32e-6),
            Packet::LoRa7 => split(bytes, 255.0, &|payload| {
                let symbol = 128.0 / 125e3;
                let coded = ((8.0 * payload - 28.0 + 28.0 + 16.0) / 28.0).ceil().max(0.0) * 5.0;
                (12.25 + 8.0 + coded) * symbol
            }),
        }
    }
}

/// What one node sends and hears in the evaluation window.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Frames {
    pub(super) count: u64,
    pub(super) bytes: u64,
}

/// The cost on one radio, of the node that needs the most charge.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Cost {
    radio: &'static str,
    /// Time on air of all agents together, as a share of the window: they share the channel.
    pub(super) channel_share: f64,
    charge_transmitted_mc: f64,
    charge_received_mc: f64,
    pub(super) life_cr2032_days: Option<f64>,
    pub(super) life_2_aa_days: Option<f64>,
    /// If the receiver is always on.
    life_2_aa_listening_days: Option<f64>,
}

/// Returns the cost on a radio of what each node sends and hears within `window` \[s\].
fn cost(radio: &Radio, nodes: &[[Frames; 2]], window: f64) -> Cost {
    let airtime = |frames: Frames| match frames.count {
        0 => 0.0,
        count => count as f64 * radio.airtime(frames.bytes as f64 / count as f64),
    };
    let charges = nodes
        .iter()
        .map(|&[sent, heard]| [airtime(sent) * radio.transmit, airtime(heard) * radio.receive]);
    let most = |a: [f64; 2], b: [f64; 2]| if b[0] + b[1] > a[0] + a[1] { b } else { a };
    let [sent, heard] = charges.fold([0.0, 0.0], most);
    let channel_share = nodes.iter().map(|&[sent, _]| airtime(sent)).sum::<f64>() / window;
    // What does not fit on the air cannot be sent.
    let life = |charge: f64, current: f64| {
        (channel_share <= 1.0 && current > 0.0).then(|| charge / current / DAY)
    };
    Cost {
        radio: radio.name,
        channel_share,
        charge_transmitted_mc: 1e3 * sent,
        charge_received_mc: 1e3 * heard,
        life_cr2032_days: life(BATTERIES[0], (sent + heard) / window),
        life_2_aa_days: life(BATTERIES[1], (sent + heard) / window),
        life_2_aa_listening_days: life(BATTERIES[1], sent / window + radio.receive),
    }
}

/// Returns what each agent sends, and hears of its neighbours.
pub(super) fn nodes(graph: &Graph, sent: &[Frames]) -> Vec<[Frames; 2]> {
    let heard = |agent: usize| {
        let neighbours = graph.neighbours(agent).iter().filter_map(|edge| sent.get(edge.agent));
        neighbours.fold(Frames::default(), |sum, frames| Frames {
            count: sum.count + frames.count,
            bytes: sum.bytes + frames.bytes,
        })
    };
    sent.iter().enumerate().map(|(i, &sent)| [sent, heard(i)]).collect()
}

/// Returns the cost on each of [`RADIOS`] of what nodes send and hear within `window` \[s\].
pub(super) fn costs(nodes: &[[Frames; 2]], window: f64) -> Vec<Cost> {
    RADIOS.iter().map(|radio| cost(radio, nodes, window)).collect()
}

/// Returns the days for which a battery lasts, in words; - if the channel is too slow.
pub(super) fn days(days: Option<f64>) -> String {
    days.map_or("-".to_owned(), |days| significant(days, 3))
}

/// Returns the costs of one run as text.
pub(super) fn text(costs: &[Cost]) -> String {
    let headings = [
        ["", "radio"],
        ["channel", "in use [%]"],
        ["charge [mC]", "to send"],
        ["charge [mC]", "to hear"],
        ["battery [d]", "CR2032"],
        ["battery [d]", "2 AA"],
        ["battery [d]", "2 AA, listening"],
    ];
    let row = |cost: &Cost| {
        vec![
            cost.radio.to_owned(),
            significant(100.0 * cost.channel_share, 2),
            significant(cost.charge_transmitted_mc, 3),
            significant(cost.charge_received_mc, 3),
            days(cost.life_cr2032_days),
            days(cost.life_2_aa_days),
            days(cost.life_2_aa_listening_days),
        ]
    };
    format!(
        "Radio of the busiest node in the evaluation window: how long its battery lasts if it powers nothing but \
         sending\nits frames and hearing those of its neighbours, or listening all the time; - if the channel is \
         too slow\n\n{}\n",
        Table::new(&headings, costs.iter().map(row).collect()).text()
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_on_air_are_those_of_the_standards() {
        let [nordic, _, lora] = RADIOS;
        // 6 + 127 bytes at 32 us each: the longest packet of IEEE 802.15.4.
        assert!((nordic.airtime(116.0) - 4.256e-3).abs() < 1e-9);
        assert!((nordic.airtime(232.0) - 8.512e-3).abs() < 1e-9);
        // What the manufacturer's calculator says for 10 bytes.
        assert!((lora.airtime(10.0) - 41.216e-3).abs() < 1e-6, "{}", lora.airtime(10.0));
    }

    #[test]
    fn an_agent_hears_its_neighbours_only() {
        use crate::graph::Edge;
        let edge = |second| Edge { first: 0, second, weight: 1.0 };
        let graph = Graph::new(3, &[edge(1), edge(2)]).unwrap();
        let frames = |count| Frames { count, bytes: 50 * count };
        let found = costs(&nodes(&graph, &[frames(1), frames(20), frames(30)]), 20.0);
        assert_eq!(found.len(), RADIOS.len());
        // The centre hears 50 frames of 67 bytes and sends one; the others send up to 30 and hear one.
        let airtime = 67.0 * 32e-6;
        assert!((found[0].charge_received_mc - 50.0 * airtime * 4.6).abs() < 1e-9);
        assert!((found[0].charge_transmitted_mc - airtime * 4.8).abs() < 1e-9);
        assert!(text(&found).contains("nRF52840, 0 dBm, 802.15.4"));
    }

    #[test]
    fn the_busiest_node_counts_and_what_does_not_fit_has_no_life() {
        let frames = |count| Frames { count, bytes: 50 * count };
        let nodes = [[frames(10), frames(0)], [frames(100), frames(10)]];
        let found = cost(&RADIOS[0], &nodes, 20.0);
        let airtime = 67.0 * 32e-6;
        assert!((found.channel_share - 110.0 * airtime / 20.0).abs() < 1e-12);
        assert!((found.charge_transmitted_mc - 100.0 * airtime * 4.8).abs() < 1e-9);
        assert!(found.life_cr2032_days.is_some_and(|days| days > 50.0));
        let full = cost(&RADIOS[2], &[[frames(10_000), frames(0)]], 20.0);
        assert_eq!(full.life_2_aa_days, None);
    }
}
