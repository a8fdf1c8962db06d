//! A complete node above its board: an agent, its weight packages, and the service protocol.
//!
//! [`Node::poll`] does one piece of pending work: a step if a period has begun, or else one
//! request. [`Node::run`] polls and rests alternately.
//!
//! ```text
//!            frames                     requests
//! Board ----------------> turn    +----------------> answer ----> Store (flash)
//!       <---------------- step    |    <----------------
//!            broadcast, state     |         response
//!                   one session: one package in use
//! ```
//!
//! A session lasts as long as one package is in use. At its start the package's agent parameters
//! are copied to RAM; the network and its outer weights stay in flash and are located again in
//! every step, because no reference can outlive a write to flash. Packages are switched between two
//! sessions, and therefore between two steps.
//!
//! Without a valid package a node takes no steps and reports that, unless it has a
//! [`Settings::fallback`]: then it runs the observer without a network.
//!
//! Memory: see docs/performance.md. Invariants: the node keeps running whatever it receives; only a
//! package that passed [`agent_core::package::accept`] is ever in use.

mod answer;
mod errors;
#[cfg_attr(not(feature = "authentic-frames"), path = "no_guard.rs")]
mod guard;
mod limits;
mod load;
mod settings;
mod turn;

use core::mem::MaybeUninit;

use agent_core::agent::AgentState;
use agent_core::agent::capture::CaptureRing;
use agent_core::agent::hold::Hold;
use agent_core::agent::inbox::Inbox;
use agent_core::health::{Health, HealthParams, Performance, RevertReason, Trial};
use agent_core::observer::network::Scratch;
use agent_core::package::{NetworkPlace, ParamsPlace, Serial};
use agent_core::service::{
    self, BoardFault, Event, Firmware, LastRevert, PROTOCOL_VERSION, PackageStatus,
    Performance as PerformanceReport, RefusalReport, Report, Request, Response,
    Session as PortSession, Status, Subscription, TrialReport,
};
use agent_core::store::{Change, LayoutError, MappedFlash, Slot, Store};
use agent_core::{AgentId, Tick};

pub use settings::{Epochs, RECOMMENDED_TRIAL, Settings, Start};

use crate::board::{Board, RequestBuffer};
use errors::Counts;
use guard::Guard;
use limits::Limits;

/// Samples held from neighbours, one slot per neighbour of the agent.
type Holds<const N: usize, const NEIGHBOURS: usize> = heapless::Vec<Option<Hold<N>>, NEIGHBOURS>;

/// Most of a node's memory, for a `static`: `N` is the state dimension, with capacities for
/// `FEATURES` features, `NEIGHBOURS` neighbours and `SAMPLES` training samples.
#[derive(Debug)]
pub struct Memory<
    const N: usize,
    const FEATURES: usize,
    const NEIGHBOURS: usize,
    const SAMPLES: usize,
> {
    agent: Agent<N, FEATURES, NEIGHBOURS>,
    /// At most one. An empty vector is all zeros, so a static memory takes no flash; `None` is not.
    session: heapless::Vec<Session<N, NEIGHBOURS>, 1>,
    samples: CaptureRing<N, SAMPLES>,
    /// Working memory for checking packages.
    scratch: Scratch,
}

impl<const N: usize, const FEATURES: usize, const NEIGHBOURS: usize, const SAMPLES: usize>
    Memory<N, FEATURES, NEIGHBOURS, SAMPLES>
{
    /// Creates empty memory.
    #[must_use]
    pub const fn new() -> Self {
        let agent = Agent {
            state: AgentState::blank(heapless::Vec::new()),
            inbox: Inbox::blank(heapless::Vec::new()),
            begun: false,
            announced: false,
        };
        Self {
            agent,
            session: heapless::Vec::new(),
            samples: CaptureRing::new(),
            scratch: Scratch::NEW,
        }
    }
}

impl<const N: usize, const FEATURES: usize, const NEIGHBOURS: usize, const SAMPLES: usize> Default
    for Memory<N, FEATURES, NEIGHBOURS, SAMPLES>
{
    fn default() -> Self {
        Self::new()
    }
}

/// A node; its const parameters are those of its [`Memory`].
#[derive(Debug)]
pub struct Node<
    'm,
    F,
    const N: usize,
    const FEATURES: usize,
    const NEIGHBOURS: usize,
    const SAMPLES: usize,
> {
    settings: Settings,
    store: Store<F>,
    memory: &'m mut Memory<N, FEATURES, NEIGHBOURS, SAMPLES>,
    health: Health,
    performance: Performance<N>,
    trial: Option<Trial>,
    subscription: Subscription,
    next_tick: Tick,
    due: Due,
    in_use: Option<InUsePackage>,
    counts: Counts,
    refused_at_start: [Option<RefusalReport>; 2],
    board_fault: Option<BoardFault>,
    limits: Limits,
    guard: Guard<NEIGHBOURS>,
    /// How often the node has booted.
    boots: u32,
    /// Number of the request that is being answered, if it has one.
    number: Option<u16>,
    /// Whether flash has been erased or written since the last turn.
    flash_used: bool,
    stalled_ticks: u32,
}

/// The observer's mutable data.
#[derive(Debug)]
struct Agent<const N: usize, const FEATURES: usize, const NEIGHBOURS: usize> {
    state: AgentState<N, FEATURES, Holds<N, NEIGHBOURS>>,
    inbox: Inbox<N, Holds<N, NEIGHBOURS>>,
    /// Whether an agent has been initialised.
    begun: bool,
    /// Whether the neighbours have the first sample.
    announced: bool,
}

/// Properties of the package in use.
#[derive(Clone, Copy, Debug)]
struct InUsePackage {
    agent: AgentId,
    serial: Serial,
    checksum: u32,
    /// CRC-32 of its output matrix.
    outputs: u32,
    step_size: f32,
    slot: Slot,
}

/// What does not change while one package is in use.
#[derive(Debug)]
struct Session<const N: usize, const NEIGHBOURS: usize> {
    agent: AgentId,
    params: ParamsPlace<N, NEIGHBOURS>,
    health_params: HealthParams<N>,
    /// `None` for the built-in agent, which has no network.
    network: Option<(Slot, NetworkPlace)>,
}

/// Result of [`Node::poll`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum Progress {
    /// Some work was done, and more may be pending.
    Worked,
    /// Nothing is pending: wait for a period or for a byte at the service port.
    Idle,
    /// A reset was requested: drop this node and create another one.
    Reset,
}

/// The next action of [`Node::poll`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Due {
    Greeting,
    /// Start a session with another package.
    Session,
    /// A turn if a period has begun, or else a request.
    Turn,
    /// A request if there is one, or else a turn. Follows every turn, so that a late node still
    /// answers requests.
    Request,
}

/// Action after a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Next {
    Continue,
    /// Switch to another package.
    Switch,
    Reset,
}

impl<
    'm,
    F: MappedFlash,
    const N: usize,
    const FEATURES: usize,
    const NEIGHBOURS: usize,
    const SAMPLES: usize,
> Node<'m, F, N, FEATURES, NEIGHBOURS, SAMPLES>
{
    /// Creates a node as after a reset, with the package that is in use according to its flash. Any
    /// earlier contents of `memory` are discarded.
    ///
    /// # Errors
    /// A layout that does not match the flash.
    #[inline(never)] // Frees the stack that opening the store takes.
    pub fn new(
        flash: F,
        settings: Settings,
        memory: &'m mut Memory<N, FEATURES, NEIGHBOURS, SAMPLES>,
    ) -> Result<Self, LayoutError> {
        let mut node = Self::open(flash, settings, memory)?;
        node.load();
        Ok(node)
    }

    /// Like [`new`](Self::new), but in place, which takes less stack: packages are checked when the
    /// node itself is not on the stack.
    ///
    /// # Errors
    /// A layout that does not match the flash.
    pub fn new_in(
        place: &'m mut MaybeUninit<Self>,
        flash: F,
        settings: Settings,
        memory: &'m mut Memory<N, FEATURES, NEIGHBOURS, SAMPLES>,
    ) -> Result<&'m mut Self, LayoutError> {
        let node = Self::write_to(place, flash, settings, memory)?;
        node.load();
        Ok(node)
    }

    #[inline(never)] // Frees the node's stack.
    fn write_to(
        place: &'m mut MaybeUninit<Self>,
        flash: F,
        settings: Settings,
        memory: &'m mut Memory<N, FEATURES, NEIGHBOURS, SAMPLES>,
    ) -> Result<&'m mut Self, LayoutError> {
        Ok(place.write(Self::open(flash, settings, memory)?))
    }

    /// Creates the node without reading its flash.
    fn open(
        flash: F,
        settings: Settings,
        memory: &'m mut Memory<N, FEATURES, NEIGHBOURS, SAMPLES>,
    ) -> Result<Self, LayoutError> {
        let store = Store::closed(flash, settings.layout)?;
        memory.agent.begun = false;
        memory.session.clear();
        memory.samples.clear();
        Ok(Self {
            store,
            memory,
            health: Health::new(),
            performance: Performance::new(settings.trial.seconds.unwrap_or(0), 1.0),
            trial: None,
            subscription: settings.subscription,
            next_tick: 0,
            due: Due::Greeting,
            in_use: None,
            counts: Counts::default(),
            refused_at_start: [None; 2],
            board_fault: None,
            limits: Limits::new(settings.update_limit),
            guard: Guard::new(),
            boots: 0,
            number: None,
            flash_used: false,
            stalled_ticks: 0,
            settings,
        })
    }

    /// Makes the node report a fault of its board.
    pub fn report(&mut self, fault: BoardFault) {
        self.board_fault = Some(fault);
    }

    /// Runs the node until a reset is requested: then drop it and create another one.
    pub fn run<B: Board>(&mut self, board: &mut B) {
        loop {
            match self.poll(board) {
                Progress::Worked => {}
                Progress::Idle => board.rest(),
                Progress::Reset => return,
            }
        }
    }

    /// Does one piece of pending work, if any, without waiting: sends the greeting, loads a
    /// package, takes a step, or answers a request.
    ///
    /// An asynchronous main loop calls this instead of [`run`](Self::run) and waits when nothing is
    /// pending. [`Clock::rest`](crate::Clock::rest) is not called, so such a board leaves it empty:
    ///
    /// ```
    /// # use agent_core::store::MappedFlash;
    /// # use firmware_template::{Board, Node, node::Progress};
    /// # async fn period_or_byte() {}
    /// # async fn other_tasks() {}
    /// async fn node_task<F: MappedFlash>(mut node: Node<'_, F, 3, 8, 4, 64>, mut board: impl Board) {
    ///     loop {
    ///         match node.poll(&mut board) {
    ///             // Let other tasks run between two pieces of work.
    ///             Progress::Worked => other_tasks().await,
    ///             // A ticker at the package's period, or a byte at the service port.
    ///             Progress::Idle => period_or_byte().await,
    ///             Progress::Reset => return,
    ///         }
    ///     }
    /// }
    /// ```
    ///
    /// The longest pieces of work are checking a package and erasing a sector of flash, then a
    /// step: `docs/performance.md` has the times. Work that cannot wait for them belongs in an
    /// interrupt.
    pub fn poll<B: Board>(&mut self, board: &mut B) -> Progress {
        match self.due {
            Due::Greeting => {
                self.hello(board);
                self.due = Due::Session;
                return Progress::Worked;
            }
            Due::Session => {
                self.begin_session();
                // It may have to reserve epochs.
                self.leave_for(board, Change::Records(1));
                self.prepare_guard();
                if let Some(session) = self.memory.session.first() {
                    board.start(session.params.step_size());
                }
                self.due = Due::Turn;
                return Progress::Worked;
            }
            Due::Request => {
                self.due = Due::Turn;
                if let Some(progress) = self.take_request(board) {
                    return progress;
                }
            }
            Due::Turn => {}
        }
        let periods = board.elapsed();
        if periods > 0 {
            self.due = Due::Request;
            // May make another session due.
            self.turn(board, periods);
            board.flush();
            board.done();
            return Progress::Worked;
        }
        self.take_request(board).unwrap_or(Progress::Idle)
    }

    /// Answers a request, if there is one.
    fn take_request<B: Board>(&mut self, board: &mut B) -> Option<Progress> {
        let mut buffer: RequestBuffer = [0; _];
        let Ok(bytes) = board.request(&mut buffer)? else {
            count(&mut self.counts.messages_damaged);
            return Some(Progress::Worked);
        };
        let next = self.answer(board, bytes);
        board.flush();
        match next {
            Next::Continue => {}
            Next::Switch => self.due = Due::Session,
            Next::Reset => return Some(Progress::Reset),
        }
        Some(Progress::Worked)
    }

    fn hello<B: Board>(&self, board: &mut B) {
        // Ends any message that was interrupted by the reset.
        board.respond(&[agent_core::wire::cobs::DELIMITER]);
        respond(board, &Response::Hello(self.status()));
        self.tell_faults(board);
        board.flush();
    }

    /// Sends what does not work on the board, and what has gone wrong there; nothing if all is well.
    fn tell_faults<B: Board>(&self, board: &mut B) {
        if let Some(fault) = self.board_fault {
            respond(board, &Response::Event(Event::BoardFault(fault)));
        }
        let counters = self.counts.errors;
        if !counters.is_empty() {
            respond(board, &Response::BoardErrors { tick: self.next_tick, counters });
        }
    }

    fn status(&self) -> Status {
        let trial = self.trial.as_ref().filter(|_| self.store.is_on_trial());
        Status {
            protocol: PROTOCOL_VERSION,
            firmware: Firmware {
                version: self.settings.version,
                dimension: N as u8,
                features: FEATURES as u8,
                neighbours: NEIGHBOURS as u8,
                signed_only: self.settings.public_key.is_some(),
                sample_stride: self.settings.sample_stride.get(),
            },
            tick: self.next_tick,
            package: self.in_use.map(|package| PackageStatus {
                agent: package.agent,
                version: package.serial.version,
                checksum: package.checksum,
                step_size: package.step_size,
                slot: package.slot,
                trial: trial.map(|trial| {
                    let (good, needed) = trial.steps();
                    (good, needed.get())
                }),
                network_in_use: self.health.network_in_use(),
            }),
            staged: self.store.staged().is_some(),
            upload: self.store.received().map(|received| agent_core::service::Upload { received }),
            refused_at_start: self.refused_at_start,
            stack_unused: self.settings.stack_unused.map(|stack_unused| stack_unused()),
            samples: u32::try_from(self.memory.samples.len()).unwrap_or(u32::MAX),
            messages_damaged: self.counts.messages_damaged,
            measurements_missing: self.counts.measurements_missing,
            broadcasts_lost: self.counts.broadcasts_lost,
            health: *self.health.counters(),
        }
    }

    /// Returns what a laptop must know to seal requests; `None` if the node has no port key.
    #[must_use]
    pub fn session(&self) -> Option<PortSession> {
        self.guard.session()
    }

    /// Returns how often the node has booted, as its flash counts it.
    #[must_use]
    pub fn boots(&self) -> u32 {
        self.boots
    }

    fn current_report(&self) -> Report {
        let step_size = self.memory.session.first().map(|session| session.params.step_size());
        let performance = self.performance.means().zip(step_size);
        Report {
            performance: performance
                .map(|(means, step_size)| PerformanceReport::new(means, 1, step_size)),
            trial: self.trial.as_ref().map(TrialReport::new),
            last_revert: self.store.last_revert().map(|revert| LastRevert {
                version: revert.serial.version,
                epoch: revert.serial.epoch,
                reason: RevertReason::from_code(revert.reason),
            }),
            epoch: self.in_use.map(|package| package.serial.epoch),
            boots: Some(self.boots),
            reset_cause: self.settings.start.cause,
            panic: self.settings.start.panic,
            stalled_ticks: self.stalled_ticks,
        }
    }

    /// Returns the flash driver, for inspection.
    #[must_use]
    pub fn flash(&self) -> &F {
        self.store.flash()
    }

    /// Consumes the node and returns the flash driver, as after a reset.
    #[must_use]
    pub fn into_flash(self) -> F {
        self.store.into_flash()
    }
}

/// Sends a response that answers no request.
#[inline]
fn respond<B: Board>(board: &mut B, response: &Response<'_, &[f32]>) {
    respond_to(board, None, response);
}

/// Sends a response.
fn respond_to<B: Board>(board: &mut B, number: Option<u16>, response: &Response<'_, &[f32]>) {
    service::respond(number, response, &mut |bytes| board.respond(bytes));
}

#[inline]
fn count(counter: &mut u32) {
    *counter = counter.saturating_add(1);
}
