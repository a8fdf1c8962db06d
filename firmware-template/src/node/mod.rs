//! A whole node above its board: an agent, its weight packages, and what it says and is told.
//!
//! [`Node::poll`] does one piece of work that is due: a step if the board says that a period has
//! begun, or else one request. [`Node::run`] polls and rests in turn.
//!
//! ```text
//!            frames                     requests
//! Board ----------------> turn    +----------------> answer ----> Store (flash)
//!       <---------------- step    |    <----------------
//!            broadcast, state     |         response
//!                   one session: one package in use
//! ```
//!
//! A session lasts as long as one package is in use. It begins by copying what the package says
//! about the agent into RAM; the network and its outer weights stay in flash and are found anew for
//! every step, since no reference may outlive a write to flash. A package is switched in between
//! two sessions, and so between two steps.
//!
//! Without a package that proves itself a node steps nothing and says so, unless it has a
//! [`Settings::fallback`]: then it is the observer without a network.
//!
//! Memory: see docs/performance.md. Invariants: whatever arrives from outside, the node goes on;
//! only a package that passed [`agent_core::package::accept`] is ever in use.

mod answer;
mod errors;
mod load;
mod turn;

use core::mem::MaybeUninit;
use core::num::NonZeroU32;

use agent_core::Tick;
use agent_core::agent::AgentState;
use agent_core::agent::capture::CaptureRing;
use agent_core::agent::hold::Hold;
use agent_core::agent::inbox::Inbox;
use agent_core::health::{Health, HealthParams, HealthSettings, Probation};
use agent_core::observer::network::Scratch;
use agent_core::package::signature::PublicKey;
use agent_core::package::{AgentConfig, NetworkPlace, ParamsPlace};
use agent_core::service::{
    BoardFault, Event, Firmware, PROTOCOL_VERSION, PackageStatus, RefusalReport, Request, Response,
    Rows, Status, Subscription, send,
};
use agent_core::store::{Layout, LayoutError, MappedFlash, Slot, Store};

use crate::board::{Board, RequestBuffer};
use errors::Counts;

/// What the user of a node chooses.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Where slots and journal lie in the flash.
    pub layout: Layout,
    /// If there is a key, only packages signed with its private half are accepted.
    pub public_key: Option<PublicKey>,
    /// How the agent is watched.
    pub health: HealthSettings,
    /// Good steps in a row after which a package on trial is confirmed.
    pub good_steps: NonZeroU32,
    /// One sample in so many ticks is kept for training.
    pub sample_stride: NonZeroU32,
    /// What the node says without being asked, until somebody asks for something else.
    pub subscription: Subscription,
    /// The agent that the node is while it has no package; `None` if its package is to say.
    pub fallback: Option<AgentConfig<'static>>,
    /// Tells how many bytes of the stack have never been used, if the board can.
    pub stack_unused: Option<fn() -> u32>,
    /// Version of the firmware: major, minor, patch.
    pub version: [u8; 3],
}

/// Samples held from neighbours, in as many places as the agent has neighbours.
type Holds<const N: usize, const NEIGHBOURS: usize> = heapless::Vec<Option<Hold<N>>, NEIGHBOURS>;

/// Most of what a node needs, to be placed in a `static`: `N` state components, and room for
/// `FEATURES` features, `NEIGHBOURS` neighbours, and `SAMPLES` samples for training.
#[derive(Debug)]
pub struct Memory<
    const N: usize,
    const FEATURES: usize,
    const NEIGHBOURS: usize,
    const SAMPLES: usize,
> {
    agent: Agent<N, FEATURES, NEIGHBOURS>,
    session: Option<Session<N, NEIGHBOURS>>,
    samples: CaptureRing<N, SAMPLES>,
    /// Where packages are tried out.
    scratch: Scratch,
}

impl<const N: usize, const FEATURES: usize, const NEIGHBOURS: usize, const SAMPLES: usize>
    Memory<N, FEATURES, NEIGHBOURS, SAMPLES>
{
    /// Memory of nothing.
    #[must_use]
    pub const fn new() -> Self {
        let agent = Agent {
            state: AgentState::blank(heapless::Vec::new()),
            inbox: Inbox::blank(heapless::Vec::new()),
            begun: false,
            announced: false,
        };
        Self { agent, session: None, samples: CaptureRing::new(), scratch: Scratch::NEW }
    }
}

impl<const N: usize, const FEATURES: usize, const NEIGHBOURS: usize, const SAMPLES: usize> Default
    for Memory<N, FEATURES, NEIGHBOURS, SAMPLES>
{
    fn default() -> Self {
        Self::new()
    }
}

/// A node; its numbers are those of its [`Memory`].
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
    probation: Option<Probation>,
    subscription: Subscription,
    next_tick: Tick,
    due: Due,
    in_use: Option<InUsePackage>,
    counts: Counts,
    refused_at_start: [Option<RefusalReport>; 2],
    board_fault: Option<BoardFault>,
}

/// What the observer changes.
#[derive(Debug)]
struct Agent<const N: usize, const FEATURES: usize, const NEIGHBOURS: usize> {
    state: AgentState<N, FEATURES, Holds<N, NEIGHBOURS>>,
    inbox: Inbox<N, Holds<N, NEIGHBOURS>>,
    /// Whether there is an agent at all.
    begun: bool,
    /// Whether the neighbours know the first sample.
    announced: bool,
}

/// What is known of the package in use.
#[derive(Clone, Copy, Debug)]
struct InUsePackage {
    agent: agent_core::AgentId,
    version: u32,
    checksum: u32,
    step_size: f32,
    slot: Slot,
}

/// What does not change while one package is in use.
#[derive(Debug)]
struct Session<const N: usize, const NEIGHBOURS: usize> {
    params: ParamsPlace<N, NEIGHBOURS>,
    health_params: HealthParams<N>,
    /// `None` for the built-in agent, which has no network.
    network: Option<(Slot, NetworkPlace)>,
}

/// What a call of [`Node::poll`] led to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum Progress {
    /// Something was done, and more may be due.
    Worked,
    /// Nothing is due: wait for a period or for a byte at the service port.
    Idle,
    /// The node has been told to reset: let go of it, and make another one.
    Reset,
}

/// What [`Node::poll`] does next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Due {
    Greeting,
    /// Another package is in use.
    Session,
    /// A turn, if a period has begun, or else a request.
    Turn,
    /// A request, if there is one, or else a turn: after every turn, so that a node that is late
    /// can still be told what to do.
    Request,
}

/// What follows from a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Next {
    Continue,
    /// Another package is in use.
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
    /// The node as it finds itself after a reset: with the package in use that its flash holds. What
    /// `memory` held before is forgotten.
    ///
    /// # Errors
    /// A layout that does not fit the flash.
    #[inline(never)] // The stack is to be free again of what opening the store takes.
    pub fn new(
        flash: F,
        settings: Settings,
        memory: &'m mut Memory<N, FEATURES, NEIGHBOURS, SAMPLES>,
    ) -> Result<Self, LayoutError> {
        let mut node = Self::open(flash, settings, memory)?;
        node.load();
        Ok(node)
    }

    /// As [`new`](Self::new), in its place, which takes less stack: packages are checked when nothing
    /// of the node is on it any more.
    ///
    /// # Errors
    /// A layout that does not fit the flash.
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

    #[inline(never)] // The stack is to be free again of the node.
    fn write_to(
        place: &'m mut MaybeUninit<Self>,
        flash: F,
        settings: Settings,
        memory: &'m mut Memory<N, FEATURES, NEIGHBOURS, SAMPLES>,
    ) -> Result<&'m mut Self, LayoutError> {
        Ok(place.write(Self::open(flash, settings, memory)?))
    }

    /// The node with no package in use yet.
    fn open(
        flash: F,
        settings: Settings,
        memory: &'m mut Memory<N, FEATURES, NEIGHBOURS, SAMPLES>,
    ) -> Result<Self, LayoutError> {
        let store = Store::open(flash, settings.layout)?;
        memory.agent.begun = false;
        memory.session = None;
        memory.samples.clear();
        Ok(Self {
            store,
            memory,
            health: Health::new(),
            probation: None,
            subscription: settings.subscription,
            next_tick: 0,
            due: Due::Greeting,
            in_use: None,
            counts: Counts::default(),
            refused_at_start: [None; 2],
            board_fault: None,
            settings,
        })
    }

    /// Lets the node tell of something that does not work on its board.
    pub fn report(&mut self, fault: BoardFault) {
        self.board_fault = Some(fault);
    }

    /// Lets the node work until it is told to reset: then let go of it, and make another one.
    pub fn run<B: Board>(&mut self, board: &mut B) {
        loop {
            match self.poll(board) {
                Progress::Worked => {}
                Progress::Idle => board.rest(),
                Progress::Reset => return,
            }
        }
    }

    /// Does one piece of work that is due, if there is one, and never waits: says hello, takes a
    /// package into use, takes a step, or answers a request.
    ///
    /// An asynchronous main calls this instead of [`run`](Self::run) and waits when nothing is due.
    /// [`Clock::rest`](crate::Clock::rest) is not called, so such a board leaves it empty:
    ///
    /// ```
    /// # use agent_core::store::MappedFlash;
    /// # use firmware_template::{Board, Node, node::Progress};
    /// # async fn period_or_byte() {}
    /// # async fn other_tasks() {}
    /// async fn node_task<F: MappedFlash>(mut node: Node<'_, F, 3, 8, 4, 64>, mut board: impl Board) {
    ///     loop {
    ///         match node.poll(&mut board) {
    ///             // Other tasks get their turn between two pieces of work.
    ///             Progress::Worked => other_tasks().await,
    ///             // A ticker at the package's period, or a byte at the service port.
    ///             Progress::Idle => period_or_byte().await,
    ///             Progress::Reset => return,
    ///         }
    ///     }
    /// }
    /// ```
    ///
    /// The longest piece of work is to check a package or to erase a sector of flash, then a step:
    /// `docs/performance.md` has the times. What must not wait for them belongs into an interrupt.
    pub fn poll<B: Board>(&mut self, board: &mut B) -> Progress {
        match self.due {
            Due::Greeting => {
                self.hello(board);
                self.due = Due::Session;
                return Progress::Worked;
            }
            Due::Session => {
                self.begin_session();
                if let Some(session) = &self.memory.session {
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
            self.turn(board, periods);
            board.flush();
            self.due = Due::Request;
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
        // Ends whatever a receiver may still hold of the time before the reset.
        board.respond(&[agent_core::wire::cobs::DELIMITER]);
        respond::<B, N>(board, &Response::Hello(self.status()));
        self.tell_faults(board);
        board.flush();
    }

    /// Sends what does not work on the board, and what has gone wrong there; nothing if all is well.
    fn tell_faults<B: Board>(&self, board: &mut B) {
        if let Some(fault) = self.board_fault {
            respond::<B, N>(board, &Response::Event(Event::BoardFault(fault)));
        }
        let counters = self.counts.errors;
        if !counters.is_empty() {
            respond::<B, N>(board, &Response::BoardErrors { tick: self.next_tick, counters });
        }
    }

    fn status(&self) -> Status {
        let trial = self.probation.as_ref();
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
                version: package.version,
                checksum: package.checksum,
                step_size: package.step_size,
                slot: package.slot,
                trial: trial.map(|trial| (trial.good_steps(), self.settings.good_steps.get())),
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

    /// The flash driver, for whoever looks at a node from outside.
    #[must_use]
    pub fn flash(&self) -> &F {
        self.store.flash()
    }

    /// Gives the flash driver back, as a reset does.
    #[must_use]
    pub fn into_flash(self) -> F {
        self.store.into_flash()
    }
}

/// Sends a response. One function for all of them, so that the encoder exists once.
#[inline(never)]
fn respond<B: Board, const N: usize>(board: &mut B, response: &Response<'_, Rows<'_, N>>) {
    send(response, |bytes| board.respond(bytes));
}

#[inline]
fn count(counter: &mut u32) {
    *counter = counter.saturating_add(1);
}
