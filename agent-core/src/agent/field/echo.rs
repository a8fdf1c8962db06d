//! Echoes: a neighbour that follows an agent shows in each of its own frames what it has received.
//!
//! A relay announces its parent's sample, and any other agent an estimate that follows it. Agent `i` takes
//! a frame of neighbour `j` for the sign of a loss if, in a direction that `i` announces and in which it
//! does not follow `j`,
//!
//! `|xi_tilde_j,c - xi_tilde_i,c| > r_c / 2`,
//!
//! with `i`'s own sample on the right: an event moves a sample by `r_c` at least. What `j` sampled
//! before `i`'s frame can have reached it says nothing, and neither does what arrives before the
//! repetition of an event is due, so an agent answers at most once in that time, whatever its
//! neighbours send.
//!
//! Cost: a comparison for each neighbour; for one of whom a frame has just arrived, some `N^2` operations
//! for each direction.

use crate::Tick;
use crate::agent::exchange::ExchangeParams;
use crate::agent::hold::Hold;
use crate::math::numeric::difference;
use crate::observer::field::{Direction, FieldParams};

/// Share of the radius by which a neighbour may be off.
const SHARE: f32 = 0.5;

/// Returns whether a frame that arrived at `tick` shows that its sender lacks the sample `own`; all samples
/// have advanced to the next tick.
#[inline(never)]
pub(super) fn is_missing<const N: usize>(
    field: &FieldParams<N>,
    exchange: &ExchangeParams,
    own: &Hold<N>,
    holds: &[Option<Hold<N>>],
    tick: Tick,
) -> bool {
    let since = own.age(tick);
    if since < Tick::from(exchange.repeat) {
        return false;
    }
    // What is older than this was sampled before the neighbour had the sample.
    let received = since.saturating_sub(Tick::from(exchange.delay));
    holds.iter().enumerate().any(|(place, hold)| {
        let hold = Hold::present(hold);
        let Some(hold) = hold.filter(|h| h.is_new_at(tick) && h.age_here(tick) < received) else {
            return false;
        };
        let error = difference(hold.estimate(), own.estimate());
        field.directions.iter().enumerate().any(|(c, direction)| {
            is_followed_by(direction, place)
                && field.coordinate(c, &error).abs() > SHARE * direction.radius
        })
    })
}

/// Whether the neighbour in this place may follow the agent in this direction.
fn is_followed_by(direction: &Direction, place: usize) -> bool {
    let is = |other: Option<u8>| other.is_some_and(|other| usize::from(other) == place);
    direction.is_announced && !is(direction.parent) && !is(direction.spare)
}
