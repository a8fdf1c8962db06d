//! Pushes packages to one node, correctly or not, and sends arbitrary requests.
//!
//! It follows the node's answers, as people and programs do: an interrupted push continues where
//! the node says, and restarts after a reset.

use std::num::NonZeroU32;

use agent_core::service::{CHUNK_LENGTH_MAX, Numbers, Request, Subscription};
use agent_core::wire::cobs::Encoder;
use rand::{Rng, RngExt};

use super::judge::Judge;
use super::line::encoded;
use super::links::huge;
use super::rates;
use super::report::Tally;
use super::supply::{Kind, Supply};

/// Number of attempts at a push.
const TRIES: u32 = 4;
/// Largest number of chunks before the next step.
const CHUNKS: u32 = 4;

/// A push in progress.
#[derive(Debug)]
struct Push {
    bytes: Vec<u8>,
    tries: u32,
    /// Number of uploads that were checked before it started.
    judged: u64,
}

/// The operator of one node.
#[derive(Debug, Default)]
pub(super) struct Operator {
    push: Option<Push>,
}

/// What the operator reads and draws from.
pub(super) struct Desk<'d, R> {
    /// From 0.
    pub(super) agent: usize,
    pub(super) judge: &'d Judge,
    pub(super) rates: &'d rates::Operator,
    pub(super) supply: &'d mut Supply,
    pub(super) rng: &'d mut R,
    pub(super) tally: &'d mut Tally,
}

impl Operator {
    /// Returns the requests before the next step, framed.
    pub(super) fn requests(&mut self, desk: &mut Desk<'_, impl Rng>) -> Vec<Vec<u8>> {
        let mut requests = Vec::new();
        let everything = Subscription { state_every: Some(NonZeroU32::MIN), outer_weights: true };
        if desk.judge.subscription != everything && desk.rng.random_bool(0.2) {
            requests.push(encoded(&Request::Subscribe(everything)));
        }
        self.begin_push(desk);
        self.go_on(desk, &mut requests);
        let (rates, store) = (desk.rates, &desk.judge.store);
        let wishes = [
            (store.staged.is_some(), rates.activate, Request::Activate),
            (store.is_on_trial(), rates.confirm, Request::Confirm),
            (store.is_on_trial(), rates.revert, Request::Revert),
        ];
        if desk.rng.random_bool(rates.query) {
            requests.push(encoded(&Request::Query));
        }
        for (possible, rate, request) in wishes {
            if possible && desk.rng.random_bool(rate) {
                requests.push(encoded(&request));
            }
        }
        if desk.rng.random_bool(rates.any_request) {
            desk.tally.fault("request out of turn");
            requests.push(any_request(desk.rng));
        }
        requests
    }

    fn begin_push(&mut self, desk: &mut Desk<'_, impl Rng>) {
        let idle = self.push.is_none() && !desk.judge.store.is_on_trial();
        if !idle || !desk.rng.random_bool(desk.rates.push) {
            return;
        }
        let bad = desk.rng.random_bool(desk.rates.bad_package);
        let kind = if bad { Kind::any_bad(desk.rng) } else { Kind::Valid };
        desk.tally.push(kind.name());
        let in_use = desk.judge.store.in_use.version;
        let bytes = desk.supply.package(kind, desk.agent, in_use, desk.rng);
        self.push = Some(Push { bytes, tries: 0, judged: desk.judge.store.judged });
    }

    fn go_on(&mut self, desk: &mut Desk<'_, impl Rng>, requests: &mut Vec<Vec<u8>>) {
        let Some(push) = &mut self.push else { return };
        let store = &desk.judge.store;
        if push.tries > TRIES || store.judged > push.judged {
            self.push = None;
            return;
        }
        let length = push.bytes.len() as u32;
        let upload = store.upload.as_ref().filter(|_| push.tries > 0);
        let Some(upload) = upload.filter(|upload| upload.length == length) else {
            push.tries += 1;
            requests.push(encoded(&Request::Begin { length }));
            return;
        };
        let mut offset = upload.received();
        if offset == length {
            requests.push(encoded(&Request::Stage));
            return;
        }
        for _ in 0..desk.rng.random_range(1..=CHUNKS) {
            let size = desk.rng.random_range(1..=CHUNK_LENGTH_MAX as u32).max(64);
            let end = length.min(offset + size);
            let mut bytes = push.bytes[offset as usize..end as usize].to_vec();
            let mut place = offset;
            if desk.rng.random_bool(desk.rates.bad_chunk) {
                let kind;
                (kind, place, bytes) = bad_chunk(&push.bytes, offset, bytes, desk.rng);
                desk.tally.fault(kind);
            }
            requests.push(encoded(&Request::Chunk { offset: place, bytes: &bytes }));
            offset = end;
        }
    }
}

/// Returns a wrong chunk in place of the next one, which starts at `offset` and has these bytes.
fn bad_chunk(
    package: &[u8],
    offset: u32,
    mut due: Vec<u8>,
    rng: &mut impl Rng,
) -> (&'static str, u32, Vec<u8>) {
    let length = package.len() as u32;
    let piece = |place: u32| {
        let end = package.len().min(place as usize + CHUNK_LENGTH_MAX);
        package[place as usize..end].to_vec()
    };
    match rng.random_range(0..6) {
        0 => {
            let place = rng.random_range(offset..=length);
            ("chunk too early", place, piece(place))
        }
        1 => {
            let place = rng.random_range(0..=offset);
            ("chunk repeated", place, piece(place))
        }
        2 => {
            let place = rng.random_range(0..=offset);
            let mut bytes = piece(place);
            bytes.iter_mut().for_each(|byte| *byte ^= 0x55);
            ("chunk repeated with other bytes", place, bytes)
        }
        3 => {
            due.resize(CHUNK_LENGTH_MAX, 0);
            // Only the last chunk can reach beyond the end.
            let place = offset.min(length.saturating_sub(rng.random_range(0..128)));
            ("chunk beyond the end", place, due)
        }
        4 => ("chunk at a place of its own", rng.random(), due),
        _ => {
            due.iter_mut().skip(rng.random_range(0..64)).for_each(|byte| *byte ^= 0x55);
            ("chunk with other bytes", offset, due)
        }
    }
}

/// Returns an arbitrary request other than a reset.
fn any_request(rng: &mut impl Rng) -> Vec<u8> {
    encoded(&match rng.random_range(0..10) {
        0 => Request::Query,
        1 => Request::Begin { length: rng.random_range(0..40_000) },
        2 => Request::Stage,
        3 => Request::Activate,
        4 => Request::Confirm,
        5 => Request::Revert,
        6 => Request::Subscribe(Subscription {
            state_every: NonZeroU32::new(rng.random_range(0..10)),
            outer_weights: rng.random(),
        }),
        7 => Request::Samples { from: rng.random_range(0..10_000), most: rng.random_range(0..70) },
        8 => {
            let length = if rng.random_bool(0.7) { 3 } else { rng.random_range(0..=12) };
            let wild = rng.random_bool(0.2);
            let component = |_| match wild {
                true if rng.random() => f32::NAN,
                true => huge(rng, 3.0),
                false => rng.random_range(-3.0..3.0),
            };
            let estimate: Numbers = (0..length).map(component).collect();
            Request::StartAt { estimate }
        }
        _ => return unknown(rng),
    })
}

/// Returns an intact message that is not a request.
fn unknown(rng: &mut impl Rng) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(|block: &[u8]| bytes.extend_from_slice(block));
    // There are fewer kinds of requests than this.
    encoder.extend(&[rng.random_range(20..=127), rng.random(), rng.random()]);
    encoder.finish();
    bytes
}
