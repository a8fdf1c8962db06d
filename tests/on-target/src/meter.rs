//! Instructions, counted where the machine can.

/// Counts the instructions that something takes.
pub trait Meter {
    /// Runs `work`; the number is 0 where nothing counts.
    fn count<R>(&mut self, work: impl FnOnce() -> R) -> (R, u32);

    /// Begins to count where the work is not a function's.
    fn start(&mut self);

    /// What has been counted since then.
    fn stop(&mut self) -> u32;
}

/// Counts nothing.
#[derive(Clone, Copy, Debug)]
pub struct NoMeter;

impl Meter for NoMeter {
    fn count<R>(&mut self, work: impl FnOnce() -> R) -> (R, u32) {
        (work(), 0)
    }

    fn start(&mut self) {}

    fn stop(&mut self) -> u32 {
        0
    }
}

/// What is counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Figure {
    /// The inner network 3-12-12-12-5 and the outer weights, 5 x 3.
    Forward,
    /// A step that broadcasts nothing, network and health included.
    Step,
    /// A step whose trigger fires, with the encoded frame.
    Broadcast,
    /// A received frame, decoded and taken into the inbox.
    Frame,
    /// The acceptance of a package without a signature.
    Package,
    /// A turn of a node: two frames received, a step, a broadcast, state and health told.
    Turn,
    /// The same with the outer weights told, too, as in a co-simulation.
    WholeTurn,
}

impl Figure {
    /// Every figure.
    pub const ALL: [Self; 7] = [
        Self::Forward,
        Self::Step,
        Self::Broadcast,
        Self::Frame,
        Self::Package,
        Self::Turn,
        Self::WholeTurn,
    ];

    /// One word.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Forward => "forward",
            Self::Step => "step",
            Self::Broadcast => "broadcast",
            Self::Frame => "frame",
            Self::Package => "package",
            Self::Turn => "turn",
            Self::WholeTurn => "whole-turn",
        }
    }
}

/// Mean and largest number of instructions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Statistics {
    /// How often it was done.
    pub count: u32,
    sum: u64,
    /// Most instructions.
    pub max: u32,
}

/// The statistics of every figure.
#[derive(Clone, Debug)]
pub struct Figures([Statistics; Figure::ALL.len()]);

impl Figures {
    pub(crate) const NONE: Self = Self([Statistics::NONE; Figure::ALL.len()]);

    pub(crate) fn add(&mut self, figure: Figure, instructions: u32) {
        if let Some(statistics) = self.0.get_mut(figure as usize) {
            statistics.add(instructions);
        }
    }

    /// Every figure with its statistics.
    pub fn iter(&self) -> impl Iterator<Item = (Figure, &Statistics)> {
        Figure::ALL.into_iter().zip(&self.0)
    }
}

impl Statistics {
    const NONE: Self = Self { count: 0, sum: 0, max: 0 };

    fn add(&mut self, instructions: u32) {
        self.count += 1;
        self.sum += u64::from(instructions);
        self.max = self.max.max(instructions);
    }

    /// Mean number of instructions, rounded down.
    #[must_use]
    pub fn mean(&self) -> u32 {
        (self.sum / u64::from(self.count.max(1))) as u32
    }
}
