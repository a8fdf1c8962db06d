//! What a board tells its node: settings, and what it knows of its resets.

use core::num::NonZeroU32;

use agent_core::health::HealthSettings;
use agent_core::package::signature::PublicKey;
use agent_core::package::{AgentConfig, StepRange, TrialLimits};
use agent_core::service::{PanicPlace, ResetCause, Subscription};
use agent_core::store::{Layout, RateLimit};

/// User settings of a node.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Positions of slots and journal in flash.
    pub layout: Layout,
    /// If present, only packages signed with the matching private key are accepted.
    pub public_key: Option<PublicKey>,
    /// The steps that the board can keep; packages with another one are refused. \[s\]
    pub step_range: StepRange,
    /// Settings of the health monitoring.
    pub health: HealthSettings,
    /// How often uploads, complete packages and activations are accepted, each counted separately.
    pub update_limit: RateLimit,
    /// Limits of every package on trial, besides those that it carries itself.
    /// [`RECOMMENDED_TRIAL`] is a start.
    pub trial: TrialLimits,
    /// Interval between samples kept for training. \[ticks\]
    pub sample_stride: NonZeroU32,
    /// The initial unsolicited reports, until a request changes them.
    pub subscription: Subscription,
    /// The agent to run while there is no package; `None` to wait for a package.
    pub fallback: Option<AgentConfig<'static>>,
    /// Returns how many bytes of the stack have never been used, if the board can tell.
    pub stack_unused: Option<fn() -> u32>,
    /// What the board knows of its resets.
    pub start: Start,
    /// Keeps epochs during a reset, if the board can: what it was called with last becomes
    /// [`Start::epochs`].
    pub keep_epochs: Option<fn(Epochs)>,
    /// Whether to forget all keys and packages first: the way back for an operator who has lost the
    /// port key. A board sets it while its button is held: [`is_held`](crate::is_held).
    pub factory_reset: bool,
    /// Version of the firmware: major, minor, patch.
    pub version: [u8; 3],
}

/// What a board knows of its resets.
#[derive(Clone, Copy, Debug, Default)]
pub struct Start {
    /// Why it has started.
    pub cause: ResetCause,
    /// Where the firmware panicked before, if it did.
    pub panic: Option<PanicPlace>,
    /// How often it has started since the supply was switched on, this time included, if it can
    /// tell: then the journal records only every 16th start.
    pub boots: Option<u32>,
    /// The epochs that [`Settings::keep_epochs`] kept.
    pub epochs: Epochs,
}

/// Epochs that have been reserved in the journal: from `next` up to, but excluding, `end`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Epochs {
    /// The next one.
    pub next: u32,
    /// The end.
    pub end: u32,
}

impl Epochs {
    /// Returns how many are left.
    #[must_use]
    pub const fn left(&self) -> u32 {
        self.end.saturating_sub(self.next)
    }
}

/// Limits of a trial that suit most nodes: a minute, three restarts, and one percent of skipped ticks
/// at 100 Hz. What was in use before, or the package itself, bounds innovation and broadcasts.
pub const RECOMMENDED_TRIAL: TrialLimits = TrialLimits {
    seconds: Some(60),
    restarts: Some(3),
    overflows: Some(30),
    skipped_ticks: Some(60),
    ..TrialLimits::NONE
};
