//! Probabilities of faults.
//!
//! Each number is the probability of one fault per occasion; the group names the occasion.

/// All probabilities.
#[derive(Clone, Debug)]
pub(super) struct Rates {
    pub(super) message: Message,
    pub(super) frame: Frame,
    pub(super) measurement: Measurement,
    pub(super) node: Node,
    pub(super) operator: Operator,
}

/// For every message on the line to a node.
#[derive(Clone, Debug, Default)]
pub(super) struct Message {
    /// One to three of its bytes change.
    pub(super) flipped: f64,
    /// Its end, including the delimiter, is missing: it runs into the next one.
    pub(super) cut: f64,
    /// None of it arrives.
    pub(super) lost: f64,
    /// It arrives twice.
    pub(super) repeated: f64,
    /// The next one overtakes it.
    pub(super) overtaken: f64,
    /// Up to 300 bytes of noise precede it.
    pub(super) noise: f64,
}

/// For every frame on its way to one neighbour; foreign frames for every step of a node.
#[derive(Clone, Debug, Default)]
pub(super) struct Frame {
    /// One bit changes.
    pub(super) flipped: f64,
    /// Its end is missing.
    pub(super) cut: f64,
    /// It does not arrive.
    pub(super) lost: f64,
    /// It arrives twice.
    pub(super) repeated: f64,
    /// It arrives up to 30 steps late, behind later ones.
    pub(super) delayed: f64,
    /// An intact frame comes from an agent that is not a neighbour, or from the node itself.
    pub(super) stranger: f64,
    /// With a neighbour's number: an estimate that is not finite.
    pub(super) not_finite: f64,
    /// With a neighbour's number: an estimate of 1e6 to 1e38.
    pub(super) implausible: f64,
    /// Up to 120 bytes of noise.
    pub(super) noise: f64,
    /// An old frame is repeated.
    pub(super) old: f64,
    /// With a neighbour's number: a farewell, of any sequence and tick.
    pub(super) farewell: f64,
}

/// For every measurement.
#[derive(Clone, Debug, Default)]
pub(super) struct Measurement {
    pub(super) not_a_number: f64,
    pub(super) infinite: f64,
    /// Between 1e3 and 1e38, of either sign.
    pub(super) huge: f64,
    pub(super) missing: f64,
    /// No component, or two to twelve.
    pub(super) other_length: f64,
}

/// For every step of a node.
#[derive(Clone, Debug, Default)]
pub(super) struct Node {
    /// It misses up to 40 periods, and is told so.
    pub(super) pause: f64,
    /// It is told that an arbitrary number of periods has passed, up to 2^32 - 1.
    pub(super) clock_jump: f64,
    /// It is told that no period has passed.
    pub(super) no_period: f64,
    /// A reset is requested.
    pub(super) reset: f64,
    /// A power cut: the emulator is killed and started again with the same flash.
    pub(super) power: f64,
}

/// For every step of a node.
#[derive(Clone, Debug, Default)]
pub(super) struct Operator {
    /// A push of a package starts.
    pub(super) push: f64,
    /// The package is one that the node must refuse.
    pub(super) bad_package: f64,
    /// A chunk is repeated, too early, beyond the end, or has wrong bytes.
    pub(super) bad_chunk: f64,
    /// A staged package is activated.
    pub(super) activate: f64,
    /// A package on trial is confirmed.
    pub(super) confirm: f64,
    /// A package on trial is reverted.
    pub(super) revert: f64,
    /// The status is requested.
    pub(super) query: f64,
    /// An arbitrary request at the wrong time.
    pub(super) any_request: f64,
}

impl Rates {
    /// No faults and no pushes.
    pub(super) fn calm() -> Self {
        Self {
            message: Message::default(),
            frame: Frame::default(),
            measurement: Measurement::default(),
            node: Node::default(),
            operator: Operator { query: 0.002, ..Operator::default() },
        }
    }

    /// No faults, while valid packages are pushed and confirmed.
    pub(super) fn learning() -> Self {
        let operator =
            Operator { push: 0.01, activate: 0.05, confirm: 0.005, ..Operator::default() };
        Self { operator, ..Self::calm() }
    }

    /// All faults; incidents of nodes are `incidents` times as frequent as in the long run.
    pub(super) fn faulty(incidents: f64) -> Self {
        Self {
            message: Message {
                flipped: 0.004,
                cut: 0.003,
                lost: 0.003,
                repeated: 0.003,
                overtaken: 0.003,
                noise: 0.003,
            },
            frame: Frame {
                flipped: 0.02,
                cut: 0.02,
                lost: 0.05,
                repeated: 0.03,
                delayed: 0.05,
                stranger: 0.005,
                not_finite: 0.003,
                implausible: 0.003,
                noise: 0.003,
                old: 0.005,
                farewell: 0.001,
            },
            measurement: Measurement {
                not_a_number: 0.004,
                infinite: 0.002,
                huge: 0.002,
                missing: 0.004,
                other_length: 0.003,
            },
            node: Node {
                pause: 0.002,
                clock_jump: incidents * 0.0002,
                no_period: 0.002,
                reset: incidents / 3_000.0,
                power: incidents / 6_000.0,
            },
            operator: Operator {
                push: 0.02,
                bad_package: 0.6,
                bad_chunk: 0.02,
                activate: 0.02,
                confirm: 0.0005,
                revert: 0.0005,
                query: 0.002,
                any_request: 0.005,
            },
        }
    }
}
