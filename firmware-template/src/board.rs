//! What an agent needs from its board: three traits, none of which allocates.
//!
//! Only [`Clock::wait`] blocks for longer than a transfer takes. Errors are the board's own
//! type; the agent only decides whether it goes on without this sample or frame.

use core::fmt::Debug;

/// Reads the agent's own part of the output, `y_i`.
pub trait Sensor {
    /// What can go wrong on the way to the sensor.
    type Error: Debug;

    /// Components of `y_i` that [`read`](Self::read) delivers.
    fn outputs(&self) -> usize;

    /// Takes one sample and writes it into `measurement`, in the units of the model that
    /// the agent observes.
    ///
    /// # Errors
    /// The bus or the sensor failed, or `measurement` does not have
    /// [`outputs`](Self::outputs) elements. `measurement` is unchanged then, so that half a
    /// sample never reaches the observer.
    fn read(&mut self, measurement: &mut [f32]) -> Result<(), Self::Error>;
}

/// Moves frames, without looking into them, to and from the neighbours.
///
/// A link may lose, repeat and reorder whole frames. It never delivers a part of one.
pub trait Link {
    /// What can go wrong on the way to the neighbours.
    type Error: Debug;

    /// Hands one frame over for sending to all neighbours. That it arrives is not promised.
    ///
    /// # Errors
    /// The frame could not be handed over, and none of it was sent.
    fn send(&mut self, frame: &[u8]) -> Result<(), Self::Error>;

    /// Takes the oldest received frame, if there is one: copies it to the start of `buffer`
    /// and returns that part of it. Never waits.
    ///
    /// # Errors
    /// The receiver failed, or the frame is longer than `buffer`; it is lost then, and the
    /// next call takes the next one.
    fn poll<'buffer>(
        &mut self,
        buffer: &'buffer mut [u8],
    ) -> Result<Option<&'buffer [u8]>, Self::Error>;
}

/// Paces the agent at the fixed sampling period of its observer.
pub trait Clock {
    /// The sampling period `[s]`.
    fn period(&self) -> f32;

    /// Blocks until the next sampling instant and returns how many periods have begun since
    /// the last call: 1 when the agent keeps up, more when it missed instants, never 0.
    fn wait(&mut self) -> u32;
}
