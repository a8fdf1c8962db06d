//! A node on a board that is a script: in which order it works, and what it tells about its board.

use std::collections::VecDeque;
use std::num::NonZeroU32;

use agent_core::health::{BoardErrors, HealthSettings};
use agent_core::package::StepRange;
use agent_core::service::{
    BoardFault, CHUNK_LENGTH_MAX, Event, Outcome, Problem, Request, Subscription, receive, send,
};
use agent_core::store::{MappedFlash, RateLimit, StoreError};
use agent_core::wire::cobs::{Decoder, SerialError};
use agent_core::{Frame, StateVector, Tick};
use firmware_template::board::RequestBuffer;
use firmware_template::{Board, LinkErrorKind, Memory, Node, Progress, SensorErrorKind, Settings};
use host_sim::service::Message;

use crate::store::packages::{Flash, LAYOUT, new_flash, package};

/// A node of the packages in `crate::store::packages`, with room for 64 samples.
type PolledNode<'m> = Node<'m, Flash, 2, 4, 1, 64>;

/// Between two reports. \[steps\]
const INTERVAL: u32 = 10;

/// What the world does while the node rests.
#[derive(Clone, Debug, Default)]
struct Moment {
    periods: u32,
    /// Requests as they come out of their frames; nothing for one that is damaged.
    requests: Vec<Vec<u8>>,
}

/// What a node has done with its board.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Done {
    Started(f32),
    Measured,
    Took,
    Flushed,
}

struct Script {
    moments: VecDeque<Moment>,
    periods: u32,
    requests: VecDeque<Vec<u8>>,
    frames: VecDeque<Result<Vec<u8>, LinkErrorKind>>,
    measurement: Result<f32, SensorErrorKind>,
    sending: Result<(), LinkErrorKind>,
    done: Vec<Done>,
    said: Vec<u8>,
}

impl Script {
    fn new(moments: Vec<Moment>) -> Self {
        Self {
            moments: moments.into(),
            periods: 0,
            requests: VecDeque::new(),
            frames: VecDeque::new(),
            measurement: Ok(0.25),
            sending: Ok(()),
            done: Vec::new(),
            said: Vec::new(),
        }
    }

    fn ask(&mut self, request: &Request<'_>) {
        self.requests.push_back(encoded(request));
    }

    /// What has been done and said since the last call.
    fn news(&mut self) -> (Vec<Done>, Vec<Message<'static>>) {
        (std::mem::take(&mut self.done), messages(&std::mem::take(&mut self.said)))
    }
}

impl Board for Script {
    fn start(&mut self, period: f32) {
        self.done.push(Done::Started(period));
    }

    fn elapsed(&mut self) -> u32 {
        std::mem::take(&mut self.periods)
    }

    fn rest(&mut self) {
        let moment = self.moments.pop_front().expect("the script ends with a reset");
        self.periods += moment.periods;
        self.requests.extend(moment.requests);
    }

    fn measure(&mut self, measurement: &mut [f32]) -> Result<usize, SensorErrorKind> {
        self.done.push(Done::Measured);
        measurement[0] = self.measurement?;
        Ok(1)
    }

    fn broadcast(&mut self, _: &[u8]) -> Result<(), LinkErrorKind> {
        self.sending
    }

    fn frame<'buffer>(
        &mut self,
        buffer: &'buffer mut [u8],
    ) -> Option<Result<&'buffer [u8], LinkErrorKind>> {
        Some(self.frames.pop_front()?.map(|frame| {
            let place = &mut buffer[..frame.len()];
            place.copy_from_slice(&frame);
            &*place
        }))
    }

    fn request<'buffer>(
        &mut self,
        buffer: &'buffer mut RequestBuffer,
    ) -> Option<Result<&'buffer mut [u8], SerialError>> {
        let request = self.requests.pop_front()?;
        self.done.push(Done::Took);
        if request.is_empty() {
            return Some(Err(SerialError::Checksum));
        }
        let place = &mut buffer[..request.len()];
        place.copy_from_slice(&request);
        Some(Ok(place))
    }

    fn respond(&mut self, bytes: &[u8]) {
        self.said.extend_from_slice(bytes);
    }

    fn flush(&mut self) {
        self.done.push(Done::Flushed);
    }
}

/// The messages in a stream.
fn contents(stream: &[u8]) -> Vec<Vec<u8>> {
    let mut decoder = Decoder::<4096>::new();
    let message = |&byte| Some(decoder.push(byte)?.unwrap().to_vec());
    let found = stream.iter().filter_map(message);
    found.collect()
}

fn messages(stream: &[u8]) -> Vec<Message<'static>> {
    let owned = |bytes: Vec<u8>| match receive::<Message<'_>>(&bytes).unwrap() {
        Message::Broadcast { .. } => unreachable!("only a node in the loop says so"),
        Message::Status(status) => Message::Status(status),
        Message::Hello(status) => Message::Hello(status),
        Message::Upload(upload) => Message::Upload(upload),
        Message::Staged { version } => Message::Staged { version },
        Message::InUse { version } => Message::InUse { version },
        Message::Done => Message::Done,
        Message::Refused(problem) => Message::Refused(problem),
        Message::State(state) => Message::State(state),
        Message::Health { tick, counters } => Message::Health { tick, counters },
        Message::Event(event) => Message::Event(event),
        Message::BoardErrors { tick, counters } => Message::BoardErrors { tick, counters },
        other => panic!("{other:?}"),
    };
    contents(stream).into_iter().map(owned).collect()
}

fn encoded(request: &Request<'_>) -> Vec<u8> {
    let mut stream = Vec::new();
    send(request, |bytes| stream.extend_from_slice(bytes));
    contents(&stream).remove(0)
}

/// The requests that bring a package of this version into use.
fn push(version: u32) -> Vec<Vec<u8>> {
    let package = package(version);
    let bytes = package.as_bytes();
    let mut requests = vec![encoded(&Request::Begin { length: bytes.len() as u32 })];
    for (index, bytes) in bytes.chunks(CHUNK_LENGTH_MAX).enumerate() {
        let offset = (index * CHUNK_LENGTH_MAX) as u32;
        requests.push(encoded(&Request::Chunk { offset, bytes }));
    }
    requests.extend([Request::Stage, Request::Activate].map(|request| encoded(&request)));
    requests
}

fn settings() -> Settings {
    Settings {
        layout: LAYOUT,
        public_key: None,
        step_range: StepRange::DEFAULT,
        health: HealthSettings { telemetry_interval: INTERVAL, ..HealthSettings::RECOMMENDED },
        update_limit: RateLimit::NONE,
        trial: firmware_template::RECOMMENDED_TRIAL,
        sample_stride: NonZeroU32::MIN,
        subscription: Subscription { state_every: NonZeroU32::new(1), outer_weights: false },
        fallback: None,
        stack_unused: None,
        start: firmware_template::Start::default(),
        keep_epochs: None,
        factory_reset: false,
        version: [0, 1, 0],
    }
}

fn outcome(message: &Message<'_>) -> Option<Outcome> {
    match message {
        Message::State(state) => Some(state.outcome),
        _ => None,
    }
}

fn board_errors(message: &Message<'_>) -> Option<(Tick, BoardErrors)> {
    match message {
        Message::BoardErrors { tick, counters } => Some((*tick, *counters)),
        _ => None,
    }
}

#[test]
fn a_poll_does_one_piece_of_work_and_in_order() {
    let mut memory = Memory::new();
    let mut node = PolledNode::new(new_flash(), settings(), &mut memory).unwrap();
    let mut board = Script::new(Vec::new());
    // Everything is due at once: a period, and two requests.
    board.periods = 1;
    (0..2).for_each(|_| board.ask(&Request::Query));

    assert_eq!(node.poll(&mut board), Progress::Worked);
    let (done, said) = board.news();
    assert_eq!(done, [Done::Flushed]);
    assert!(matches!(said[..], [Message::Hello(_)]), "{said:?}");

    // Nothing is in use, so there is no period to start.
    assert_eq!(node.poll(&mut board), Progress::Worked);
    assert_eq!(board.news(), (vec![], vec![]));

    // The turn comes before the requests, and although the next period has begun, one request comes
    // after it.
    for _ in 0..2 {
        board.periods += 1;
        assert_eq!(node.poll(&mut board), Progress::Worked);
        let (done, said) = board.news();
        assert_eq!(done, [Done::Flushed]);
        assert!(matches!(said[..], [Message::State(_)]), "{said:?}");
        assert_eq!(outcome(&said[0]), Some(Outcome::NoPackage));

        board.periods += 1;
        assert_eq!(node.poll(&mut board), Progress::Worked);
        let (done, said) = board.news();
        assert_eq!(done, [Done::Took, Done::Flushed]);
        assert!(matches!(said[..], [Message::Status(_)]), "{said:?}");
    }
    // The period of the last round, and no request after it.
    assert_eq!(node.poll(&mut board), Progress::Worked);
    assert_eq!(outcome(&board.news().1[0]), Some(Outcome::NoPackage));
    for _ in 0..3 {
        assert_eq!(node.poll(&mut board), Progress::Idle);
        assert_eq!(board.news(), (vec![], vec![]));
    }

    // One request a poll, and what is not one is work, too.
    board.requests.extend([vec![], vec![0xff]]);
    assert_eq!(node.poll(&mut board), Progress::Worked);
    assert_eq!(board.news(), (vec![Done::Took], vec![]));
    assert_eq!(node.poll(&mut board), Progress::Worked);
    let (_, said) = board.news();
    assert!(matches!(said[..], [Message::Refused(_)]), "{said:?}");

    // A package comes into use before anything else that is due.
    let requests = push(1);
    let count = requests.len();
    board.requests.extend(requests);
    for _ in 0..count {
        assert_eq!(node.poll(&mut board), Progress::Worked);
    }
    let (_, said) = board.news();
    assert_eq!(said.len(), count);
    assert_eq!(said.last(), Some(&Message::InUse { version: Some(1) }));
    board.periods = 1;
    board.ask(&Request::Reset);
    assert_eq!(node.poll(&mut board), Progress::Worked);
    let step_size = package(1).package().node.step_size;
    assert_eq!(board.news(), (vec![Done::Started(step_size)], vec![]));
    assert_eq!(node.poll(&mut board), Progress::Worked);
    let (done, said) = board.news();
    assert_eq!(done, [Done::Measured, Done::Flushed]);
    assert_eq!(outcome(&said[0]), Some(Outcome::Stepped));

    assert_eq!(node.poll(&mut board), Progress::Reset);
    assert_eq!(board.news(), (vec![Done::Took, Done::Flushed], vec![Message::Done]));
}

/// Periods, some of them late, a package that comes into use meanwhile, damage, and the end.
fn course() -> Vec<Moment> {
    let period = |requests| Moment { periods: 1, requests };
    let mut moments = vec![Moment::default(), period(vec![])];
    moments.extend(push(1).chunks(3).map(|requests| period(requests.to_vec())));
    for number in 0..40 {
        let request = match number % 8 {
            3 => vec![encoded(&Request::Query)],
            5 => vec![vec![]],
            _ => vec![],
        };
        moments.push(Moment { periods: 1 + number % 3, requests: request });
    }
    moments.extend(push(2).chunks(100).map(|requests| period(requests.to_vec())));
    moments.push(period(vec![encoded(&Request::Query), encoded(&Request::Reset)]));
    moments
}

#[test]
fn running_a_node_and_polling_it_say_the_same_bytes() {
    let mut memory = Memory::new();
    let mut node = PolledNode::new(new_flash(), settings(), &mut memory).unwrap();
    let mut ran = Script::new(course());
    node.run(&mut ran);

    let mut memory = Memory::new();
    let mut node = PolledNode::new(new_flash(), settings(), &mut memory).unwrap();
    let mut polled = Script::new(course());
    loop {
        match node.poll(&mut polled) {
            Progress::Worked => {}
            Progress::Idle => {
                // Something woke it for nothing.
                assert_eq!(node.poll(&mut polled), Progress::Idle);
                polled.rest();
            }
            Progress::Reset => break,
        }
    }
    assert_eq!(ran.said, polled.said);
    assert_eq!(ran.done, polled.done);
    let said = messages(&ran.said);
    let steps = said.iter().filter(|m| outcome(m) == Some(Outcome::Stepped)).count();
    assert!(steps >= 40, "{steps} steps");
    assert!(said.contains(&Message::InUse { version: Some(1) }));
    // A board whose sensor and link work is not talked about.
    assert!(said.iter().all(|message| board_errors(message).is_none()));
    assert_eq!(said.last(), Some(&Message::Done));
}

/// A node with a package in use, and its board, with nothing due.
fn with_package(memory: &mut Memory<2, 4, 1, 64>) -> (PolledNode<'_>, Script) {
    let mut node = PolledNode::new(new_flash(), settings(), memory).unwrap();
    let mut board = Script::new(Vec::new());
    board.requests.extend(push(1));
    while node.poll(&mut board) == Progress::Worked {}
    assert_eq!(board.news().1.last(), Some(&Message::InUse { version: Some(1) }));
    (node, board)
}

/// Takes the turn of one more period; returns what it says.
fn turn(node: &mut PolledNode<'_>, board: &mut Script) -> Vec<Message<'static>> {
    board.periods = 1;
    assert_eq!(node.poll(board), Progress::Worked);
    board.news().1
}

#[test]
fn errors_of_the_board_are_counted_by_kind() {
    let mut memory = Memory::new();
    let (mut node, mut board) = with_package(&mut memory);
    // The first sample is told to the neighbours before the step, and cannot be sent.
    board.sending = Err(LinkErrorKind::NotSent);
    turn(&mut node, &mut board);
    board.sending = Ok(());
    let sensor = [
        (SensorErrorKind::NoAnswer, 1),
        (SensorErrorKind::Bus, 2),
        (SensorErrorKind::NotReady, 3),
        (SensorErrorKind::OutOfRange, 4),
        (SensorErrorKind::Other, 5),
    ];
    for (kind, count) in sensor {
        for _ in 0..count {
            board.measurement = Err(kind);
            let said = turn(&mut node, &mut board);
            assert_eq!(said.last().and_then(outcome), Some(Outcome::NoMeasurement));
        }
    }
    board.measurement = Ok(0.25);
    for (kind, count) in
        [(LinkErrorKind::Damaged, 7), (LinkErrorKind::Overflow, 8), (LinkErrorKind::Receiver, 9)]
    {
        for _ in 0..count {
            board.frames.push_back(Err(kind));
            turn(&mut node, &mut board);
        }
    }
    board.ask(&Request::Query);
    while node.poll(&mut board) == Progress::Worked {}
    let (_, said) = board.news();
    let [Message::BoardErrors { tick, counters }, Message::Status(status)] = &said[..] else {
        panic!("{said:?}");
    };
    let not_sent = status.broadcasts_lost;
    assert!(not_sent >= 1);
    let expected = BoardErrors {
        sensor_no_answer: 1,
        sensor_bus: 2,
        sensor_not_ready: 3,
        sensor_out_of_range: 4,
        sensor_other: 5,
        link_not_sent: not_sent,
        link_damaged: 7,
        link_overflow: 8,
        link_receiver: 9,
    };
    assert_eq!((*tick, *counters), (status.tick, expected));
    assert_eq!((status.measurements_missing, status.health.frames_refused), (15, 24));
}

/// No measurement, no correction of its own: what moves the estimate is the consensus term.
#[test]
fn a_node_whose_sensor_fails_goes_on_observing_from_its_neighbours() {
    let neighbour = StateVector::<2>::new(0.8, -0.6);
    // Whether it hears the neighbour; returns the last estimate and the first one.
    let observed = |is_heard: bool| {
        let mut memory = Memory::new();
        let (mut node, mut board) = with_package(&mut memory);
        board.measurement = Err(SensorErrorKind::NoAnswer);
        let mut estimates = Vec::new();
        for sequence in 0..400 {
            if is_heard {
                let tick = sequence.into();
                let frame = Frame::new(2, sequence, tick, neighbour);
                board.frames.push_back(Ok(frame.encode().to_vec()));
            }
            let said = turn(&mut node, &mut board);
            let Some(Message::State(state)) = said.last() else { panic!("{said:?}") };
            assert_eq!(state.outcome, Outcome::NoMeasurement);
            estimates.push(StateVector::<2>::from_column_slice(&state.estimate));
        }
        (estimates[399], estimates[0])
    };
    let (alone, _) = observed(false);
    let (heard, first) = observed(true);
    let distance = |estimate: StateVector<2>| (estimate - neighbour).norm();
    assert!(distance(heard) < 0.9 * distance(first), "{heard} from {first}");
    assert!(distance(heard) < 0.9 * distance(alone), "{heard}, and alone {alone}");
}

#[test]
fn errors_are_reported_at_the_interval_of_the_health_and_only_if_there_are_new_ones() {
    let mut memory = Memory::new();
    let (mut node, mut board) = with_package(&mut memory);
    board.measurement = Err(SensorErrorKind::Bus);
    let mut reports = Vec::new();
    for tick in 0..100 {
        if tick == 45 {
            board.measurement = Ok(0.25);
        }
        let said = turn(&mut node, &mut board);
        reports.extend(said.iter().filter_map(board_errors));
    }
    let ticks: Vec<_> = reports.iter().map(|(tick, _)| *tick).collect();
    assert_eq!(ticks, [0, 10, 20, 30, 40, 50]);
    let counts: Vec<_> = reports.iter().map(|(_, errors)| errors.sensor_bus).collect();
    assert_eq!(counts, [1, 11, 21, 31, 41, 45]);
}

#[test]
fn a_fault_of_the_board_is_told_after_the_greeting_and_before_a_status() {
    let mut memory = Memory::new();
    let mut node = PolledNode::new(new_flash(), settings(), &mut memory).unwrap();
    node.report(BoardFault::Clock);
    let mut board = Script::new(Vec::new());
    board.ask(&Request::Query);
    while node.poll(&mut board) == Progress::Worked {}
    let (_, said) = board.news();
    let fault = Message::Event(Event::BoardFault(BoardFault::Clock));
    assert!(matches!(said[..], [Message::Hello(_), _, _, Message::Status(_)]), "{said:?}");
    assert_eq!(said[1..3], [fault.clone(), fault]);
}

/// Polls until nothing is pending and returns what was said, without states.
fn answers(node: &mut PolledNode<'_>, board: &mut Script) -> Vec<Message<'static>> {
    while node.poll(board) != Progress::Idle {}
    let (_, mut said) = board.news();
    said.retain(|message| !matches!(message, Message::State(_) | Message::Health { .. }));
    said
}

#[test]
fn uploads_that_come_too_often_are_refused_before_anything_is_erased() {
    let limit = RateLimit { per_hour: 20, burst: 2 };
    let mut memory = Memory::new();
    let settings = Settings { update_limit: limit, ..settings() };
    let mut node = PolledNode::new(new_flash(), settings, &mut memory).unwrap();
    let mut board = Script::new(Vec::new());
    // Without a package time stops, and nothing is limited.
    let uploads = |version| push(version).into_iter().rev().skip(1).rev();
    for version in 1..6 {
        board.requests.extend(uploads(version));
        let said = answers(&mut node, &mut board);
        assert_eq!(said.last(), Some(&Message::Staged { version }));
    }
    board.ask(&Request::Activate);
    board.ask(&Request::Confirm);
    let said = answers(&mut node, &mut board);
    assert_eq!(said, [Message::InUse { version: Some(5) }, Message::Done]);

    for version in 6..8 {
        board.requests.extend(uploads(version));
        let said = answers(&mut node, &mut board);
        assert_eq!(said.last(), Some(&Message::Staged { version }));
    }
    let before = node.flash().mapped().to_vec();
    board.requests.extend(uploads(8));
    let too_often = |seconds| {
        let error = StoreError::TooOften { retry_after_seconds: seconds };
        Message::Refused(Problem::Store(error))
    };
    let said = answers(&mut node, &mut board);
    assert!(said.contains(&too_often(180)), "{said:?}");
    assert!(!said.iter().any(|message| matches!(message, Message::Staged { .. })), "{said:?}");
    assert!(node.flash().mapped() == before, "something was written");
    // What was staged before still is, and can be used.
    board.ask(&Request::Query);
    let said = answers(&mut node, &mut board);
    assert!(matches!(&said[..], [Message::Status(status)] if status.staged), "{said:?}");

    // A step takes this long: two minutes later there is a minute left, and then none.
    let step = f64::from(package(8).package().node.step_size);
    for (seconds, left) in [(120.5, Some(60)), (60.0, None)] {
        board.periods += (seconds / step) as u32;
        let _ = answers(&mut node, &mut board);
        board.requests.extend(uploads(8));
        let said = answers(&mut node, &mut board);
        match left {
            Some(left) => assert!(said.contains(&too_often(left)), "{said:?}"),
            None => assert_eq!(said.last(), Some(&Message::Staged { version: 8 })),
        }
    }
}

#[test]
fn boots_are_counted_in_flash() {
    let mut flash = new_flash();
    for expected in 1..80 {
        let mut memory = Memory::new();
        let node = PolledNode::new(flash, settings(), &mut memory).unwrap();
        assert_eq!(node.boots(), expected);
        flash = node.into_flash();
    }
}
