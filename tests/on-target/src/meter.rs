//! Counts instructions where the machine can.

/// A counter of instructions.
pub trait Meter {
    /// Runs `work`; the count is 0 on a machine without a counter.
    fn count<R>(&mut self, work: impl FnOnce() -> R) -> (R, u32);

    /// Starts counting, for work that is not a function.
    fn start(&mut self);

    /// Returns the count since [`start`](Self::start).
    fn stop(&mut self) -> u32;
}

/// A counter that counts nothing.
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

/// A measured operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Figure {
    /// The inner network 3-12-12-12-5 and the outer weights, 5 x 3.
    Forward,
    /// A step without a broadcast, including network and health.
    Step,
    /// A step whose trigger fires, with the encoded frame.
    Broadcast,
    /// A received frame, decoded and taken into the inbox.
    Frame,
    /// The acceptance of a package without a signature.
    Package,
    /// A turn of a node: two frames received, a step, a broadcast, reports of state and health.
    Turn,
    /// The same with the outer weights reported too, as in a co-simulation.
    WholeTurn,
    /// An authentic frame sealed.
    Tag,
    /// An authentic frame opened.
    TagCheck,
    /// The longest sealed request opened.
    Seal,
    /// From the beginning of a period to the end of its turn, while port and radio are flooded.
    Flood,
    /// A step of the field observer without a broadcast, with samples that evolve by their rates.
    FieldRate,
    /// The same with samples that evolve by the network: four evaluations of it.
    FieldModel,
}

impl Figure {
    /// Every figure.
    pub const ALL: [Self; 13] = [
        Self::Forward,
        Self::Step,
        Self::Broadcast,
        Self::Frame,
        Self::Package,
        Self::Turn,
        Self::WholeTurn,
        Self::Tag,
        Self::TagCheck,
        Self::Seal,
        Self::Flood,
        Self::FieldRate,
        Self::FieldModel,
    ];

    /// Returns its name, a single word.
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
            Self::Tag => "tag",
            Self::TagCheck => "tag-check",
            Self::Seal => "seal",
            Self::Flood => "flood",
            Self::FieldRate => "field-rate",
            Self::FieldModel => "field-model",
        }
    }
}

/// Mean and largest number of instructions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Statistics {
    /// Number of measurements.
    pub count: u32,
    sum: u64,
    /// Largest number of instructions.
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

    /// Returns every figure with its statistics.
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

    /// Returns the mean number of instructions, rounded down.
    #[must_use]
    pub fn mean(&self) -> u32 {
        (self.sum / u64::from(self.count.max(1))) as u32
    }
}
