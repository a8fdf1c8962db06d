//! The firmware of the board `stm32f405` on QEMU's `netduinoplus2`, as far as that models the chip:
//! its clock control reads 0, I2C1 is missing, flash cannot be written and the watchdog never
//! resets. The processor, both serial ports, the timer, and resets work. `cargo xtask boot` builds
//! the firmware and runs these tests.

use std::convert::Infallible;
use std::io::{ErrorKind, Read, Write};
use std::num::NonZeroU32;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use agent_core::health::HealthSettings;
use agent_core::package::StepRange;
use agent_core::service::{
    BoardFault, Event, Numbers, Outcome, Request, Response, Subscription, receive, send,
};
use agent_core::store::Layout;
use agent_core::wire::cobs::Decoder;
use agent_core::wire::frame::Frame;
use firmware_template::{InTheLoop, Memory, Node, Settings};
use test_support::nor_flash::{SimulatedFlash, Tear};

#[path = "../../firmware-template/boards/stm32f405/src/fallback.rs"]
mod fallback;

/// The environment variables that name the firmware's ELF files.
const FIRMWARE: &str = "STM32F405_FIRMWARE";
const IN_THE_LOOP: &str = "STM32F405_IN_THE_LOOP_FIRMWARE";
const EMBASSY: &str = "STM32F405_EMBASSY_FIRMWARE";

/// Far longer than the emulator needs for any test.
const TIMEOUT: Duration = Duration::from_secs(60);

/// The emulator, with its ends of the serial ports.
struct Emulated {
    process: Child,
    service: Messages,
    link: Messages,
}

impl Drop for Emulated {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

impl Emulated {
    /// Starts the firmware named by the variable; it runs once both ports are connected.
    fn start(variable: &str, folder: &Path) -> Self {
        let firmware = std::env::var(variable).unwrap_or_else(|_| {
            panic!("{variable} must name the firmware; run `cargo xtask boot`")
        });
        let (service, link) = (folder.join("service"), folder.join("link"));
        let mut command = Command::new("qemu-system-arm");
        command.args(["-machine", "netduinoplus2", "-display", "none", "-monitor", "none"]);
        // USART1 to USART6.
        for port in [None, None, Some(&service), None, None, Some(&link)] {
            let backend =
                port.map_or("null".to_owned(), |path| format!("unix:{},server", path.display()));
            command.args(["-serial", &backend]);
        }
        command.args(["-kernel", &firmware]).stdin(Stdio::null());
        let process = command.spawn().expect("qemu-system-arm is installed");
        let (service, link) = (Messages::connect(&service), Messages::connect(&link));
        Self { process, service, link }
    }
}

/// The messages that arrive on a socket.
struct Messages {
    socket: UnixStream,
    decoder: Decoder<512>,
    unread: Vec<u8>,
}

impl Messages {
    fn connect(path: &Path) -> Self {
        let deadline = Instant::now() + TIMEOUT;
        let socket = loop {
            match UnixStream::connect(path) {
                Ok(socket) => break socket,
                Err(error) if Instant::now() > deadline => panic!("{}: {error}", path.display()),
                Err(_) => std::thread::sleep(Duration::from_millis(10)),
            }
        };
        socket.set_read_timeout(Some(TIMEOUT)).unwrap();
        Self { socket, decoder: Decoder::new(), unread: Vec::new() }
    }

    /// Returns the next undamaged message.
    fn next(&mut self) -> Vec<u8> {
        loop {
            while !self.unread.is_empty() {
                let byte = self.unread.remove(0);
                if let Some(Ok(message)) = self.decoder.push(byte) {
                    return message.to_vec();
                }
            }
            let mut buffer = [0; 512];
            match self.socket.read(&mut buffer) {
                Ok(0) => panic!("the emulator has ended"),
                Ok(length) => self.unread.extend_from_slice(&buffer[..length]),
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => panic!("no more messages from the node: {error}"),
            }
        }
    }

    /// Returns the first message for which `wanted` returns a value.
    fn find<T>(&mut self, wanted: impl Fn(&Response<'_, Numbers>) -> Option<T>) -> T {
        loop {
            let message = self.next();
            let response = receive(&message).expect("a response");
            if let Some(found) = wanted(&response) {
                return found;
            }
        }
    }

    fn ask(&mut self, request: &Request<'_>) {
        let mut bytes = Vec::new();
        send(request, |part| bytes.extend_from_slice(part));
        self.socket.write_all(&bytes).unwrap();
    }
}

#[test]
#[ignore = "requires the firmware and QEMU; run `cargo xtask boot`"]
fn stm32f405_in_qemu_greets_steps_and_broadcasts_without_crystal_and_sensor() {
    greets_steps_and_broadcasts(FIRMWARE);
}

#[test]
#[ignore = "requires the firmware and QEMU; run `cargo xtask boot`"]
fn stm32f405_in_qemu_does_the_same_as_a_task_of_embassy() {
    greets_steps_and_broadcasts(EMBASSY);
}

/// Checks the firmware named by the variable from its greeting to its reset.
fn greets_steps_and_broadcasts(variable: &str) {
    let folder = tempfile::tempdir().unwrap();
    let mut board = Emulated::start(variable, folder.path());
    let status = board.service.find(|response| match response {
        Response::Hello(status) => Some(*status),
        other => panic!("{other:?} before the greeting"),
    });
    assert_eq!((status.tick, status.package.is_none()), (0, true));
    assert!(status.stack_unused.is_some_and(|unused| unused > 100_000), "{status:?}");
    // The crystal's ready bit is not modelled: as on a board with a broken crystal.
    board.service.find(|response| match response {
        Response::Event(Event::BoardFault(BoardFault::Clock)) => Some(()),
        other => panic!("{other:?} instead of the fault of the clock"),
    });
    // The built-in agent broadcasts its first sample.
    let frame = Frame::<3>::decode(&board.link.next()).unwrap();
    assert_eq!((frame.sender, frame.sequence), (1, 0));
    // The sensor's bus is missing: waits on it time out, and time continues.
    let state = board.service.find(|response| match response {
        Response::State(state) => Some(state.clone()),
        _ => None,
    });
    assert_eq!(state.outcome, Outcome::NoMeasurement);
    assert_eq!(state.estimate.len(), 3);
    board.service.ask(&Request::Query);
    let status = board.service.find(|response| match response {
        Response::Status(status) => Some(*status),
        _ => None,
    });
    assert!(status.measurements_missing > 0 && status.tick > 0, "{status:?}");
    // The same after a reset.
    board.service.ask(&Request::Reset);
    board.service.find(|response| matches!(response, Response::Hello(_)).then_some(()));
}

#[test]
#[ignore = "requires the firmware and QEMU; run `cargo xtask boot`"]
fn stm32f405_in_qemu_steps_with_the_bits_of_the_host() {
    let subscription = Subscription { state_every: NonZeroU32::new(1), outer_weights: true };
    let ticks = (0..200).map(|step| {
        let measurement = Numbers::from_slice(&[(0.013 * step as f32).sin() * 3.0]).unwrap();
        Request::Tick { periods: 1, measurement: Some(measurement) }
    });
    let folder = tempfile::tempdir().unwrap();
    let mut board = Emulated::start(IN_THE_LOOP, folder.path());
    board.service.find(|response| matches!(response, Response::Hello(_)).then_some(()));
    board.service.ask(&Request::Subscribe(subscription));
    board.service.find(|response| matches!(response, Response::Done).then_some(()));
    let mut told = Vec::new();
    for tick in ticks.clone() {
        board.service.ask(&tick);
        loop {
            let message = board.service.next();
            let is_state = matches!(receive(&message), Some(Response::<Numbers>::State(_)));
            told.push(message);
            if is_state {
                break;
            }
        }
    }
    let mut requests = vec![Request::Subscribe(subscription)];
    requests.extend(ticks);
    requests.push(Request::Reset);
    let expected = on_the_host(&requests);
    let steps = expected.iter().filter(|message| {
        let response = receive::<Response<'_, Numbers>>(message);
        matches!(response, Some(Response::State(state)) if state.outcome == Outcome::Stepped)
    });
    assert_eq!(steps.count(), 200);
    assert_eq!(told, expected);
}

/// Returns the messages of a node of the same board on the host, except for its greeting and its
/// answers.
fn on_the_host(requests: &[Request<'_>]) -> Vec<Vec<u8>> {
    const UNIT: u32 = 4096;
    let mut input = Vec::new();
    for request in requests {
        send(request, |part| input.extend_from_slice(part));
    }
    let layout =
        Layout { slots: [0, UNIT], slot_length: UNIT, commit: 2 * UNIT, commit_length: 2 * UNIT };
    let settings = Settings {
        layout,
        public_key: None,
        step_range: StepRange::DEFAULT,
        health: HealthSettings::RECOMMENDED,
        update_limit: agent_core::store::RateLimit::NONE,
        trial: firmware_template::RECOMMENDED_TRIAL,
        sample_stride: NonZeroU32::new(20).unwrap(),
        subscription: Subscription { state_every: None, outer_weights: false },
        fallback: fallback::fallback(),
        stack_unused: None,
        start: firmware_template::Start::default(),
        keep_epochs: None,
        factory_reset: false,
        version: [0, 1, 0],
    };
    let mut memory = Memory::new();
    let flash = SimulatedFlash::<4, { UNIT as usize }>::new(4 * UNIT as usize, Tear::Prefix, 1);
    let mut node = Node::<_, 3, 8, 4, 64>::new(flash, settings, &mut memory).unwrap();
    let mut board = InTheLoop::<_, 8>::new(Memorised { input, output: Vec::new() });
    node.run(&mut board);
    let mut decoder = Decoder::<512>::new();
    let output = std::mem::take(&mut board.port().output);
    let messages = output.iter().filter_map(|byte| Some(decoder.push(*byte)?.ok()?.to_vec()));
    let is_from_a_step = |message: &Vec<u8>| {
        !matches!(receive(message), Some(Response::<Numbers>::Hello(_) | Response::Done))
    };
    messages.filter(is_from_a_step).collect()
}

/// A port whose input is complete from the start.
struct Memorised {
    input: Vec<u8>,
    output: Vec<u8>,
}

impl embedded_io::ErrorType for Memorised {
    type Error = Infallible;
}

impl embedded_io::Read for Memorised {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Infallible> {
        let length = buffer.len().min(self.input.len());
        buffer.iter_mut().zip(self.input.drain(..length)).for_each(|(place, byte)| *place = byte);
        Ok(length)
    }
}

impl embedded_io::Write for Memorised {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        self.output.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}
