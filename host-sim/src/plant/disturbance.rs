//! Disturbances of the plant.

use super::{ExpressionFault, ExpressionSystem, RandomDisturbance};

/// `d`, the disturbance.
#[derive(Clone, Debug, PartialEq)]
pub enum Disturbance {
    /// No disturbance.
    None,
    /// A sum of harmonics per component of the state.
    Harmonic(Vec<Harmonic>),
    /// User-defined expressions, one per component of the state.
    Expressions(ExpressionSystem),
    /// An Ornstein-Uhlenbeck process.
    Random(RandomDisturbance),
}

/// `offset + amplitude function(angular_frequency t + phase)` on one component.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Harmonic {
    /// The component of the state it is added to, from 0.
    pub component: usize,
    /// Sine or cosine.
    pub function: Wave,
    /// \[state unit/s\]
    pub amplitude: f64,
    /// \[rad/s\]
    pub angular_frequency: f64,
    /// \[rad\]
    pub phase: f64,
    /// \[state unit/s\]
    pub offset: f64,
}

/// The function of a harmonic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wave {
    /// Sine.
    Sin,
    /// Cosine.
    Cos,
}

impl Disturbance {
    /// Writes `d` at `time` \[s\] and state `x`, shape `[n]`, to `d`, shape `[n]`. Only expressions
    /// may depend on the state.
    ///
    /// # Panics
    /// If `d` (or, for expressions, `x`) has too few components, or a random disturbance has not been
    /// [`drawn`](Self::drawn).
    #[inline]
    pub fn evaluate(&self, time: f64, x: &[f64], d: &mut [f64]) {
        match self {
            Self::None => d.fill(0.0),
            Self::Harmonic(harmonics) => {
                d.fill(0.0);
                for harmonic in harmonics {
                    d[harmonic.component] += harmonic.at(time);
                }
            }
            Self::Expressions(system) => system.evaluate(time, x, d),
            Self::Random(random) => random.evaluate(time, d),
        }
    }

    /// Returns the disturbance of a run with this seed and `steps` steps of `step_size` \[s\]; `None` if it is this
    /// one.
    #[must_use]
    pub fn drawn(&self, seed: u64, step_size: f64, steps: u64) -> Option<Self> {
        match self {
            Self::None | Self::Harmonic(_) | Self::Expressions(_) => None,
            Self::Random(random) => random.drawn(seed, step_size, steps).map(Self::Random),
        }
    }

    /// Returns the expression without a finite value at `time` \[s\] and state `x`, shape `[n]`, if
    /// there is one.
    pub(super) fn fault(&self, time: f64, x: &[f64]) -> Option<ExpressionFault> {
        match self {
            Self::None | Self::Harmonic(_) | Self::Random(_) => None,
            Self::Expressions(system) => system.fault(time, x),
        }
    }
}

impl Harmonic {
    #[inline]
    fn at(&self, time: f64) -> f64 {
        let angle = self.angular_frequency * time + self.phase;
        let wave = match self.function {
            Wave::Sin => libm::sin(angle),
            Wave::Cos => libm::cos(angle),
        };
        self.offset + self.amplitude * wave
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn harmonics_of_one_component_add_up() {
        let sine = Harmonic {
            component: 1,
            function: Wave::Sin,
            amplitude: 2.0,
            angular_frequency: 3.0,
            phase: 0.0,
            offset: 0.5,
        };
        let cosine = Harmonic { function: Wave::Cos, offset: 0.0, ..sine };
        let disturbance = Disturbance::Harmonic(vec![sine, cosine]);
        let mut d = [f64::NAN; 3];
        disturbance.evaluate(0.0, &[0.0; 3], &mut d);
        assert_eq!(d, [0.0, 2.5, 0.0]);
        let time = core::f64::consts::FRAC_PI_6;
        disturbance.evaluate(time, &[0.0; 3], &mut d);
        assert_eq!(d[1], 0.5 + 2.0 * libm::sin(3.0 * time) + 2.0 * libm::cos(3.0 * time));
    }

    #[test]
    fn none_writes_zeros() {
        let mut d = [1.0; 2];
        Disturbance::None.evaluate(1.0, &[0.0; 2], &mut d);
        assert_eq!(d, [0.0; 2]);
    }
}
