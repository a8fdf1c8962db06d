//! The node's code in a thread, with its flash in memory.

use std::cell::Cell;
use std::io::{Read as _, Write as _};
use std::net::Shutdown;
use std::num::NonZeroU32;
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::thread::JoinHandle;

use agent_core::health::HealthSettings;
use agent_core::package::StepRange;
use agent_core::service::{Request, Subscription, send};
use agent_core::store::{MappedFlash, Slot};
use embedded_io::ErrorKind;
use firmware_template::{InTheLoop, Memory, Node, Settings, Start};
use host_sim::image::{ERASED, Image};
use host_sim::packages::PackageBytes;
use host_sim::service::Line;

use crate::cosim::loop_node::region;
use test_support::nor_flash::{SimulatedFlash, Tear};

/// As strict as real flash, with the emulated board's word and erase sizes.
type Flash = SimulatedFlash<4, 4096>;
/// With the sizes of the emulated board's firmware.
type TwinNode<'m> = Node<'m, Flash, 3, 8, 4, 64>;
type Loop<'s> = InTheLoop<Port<'s>, 8>;

/// A running twin.
pub(super) struct Twin {
    thread: Option<JoinHandle<Flash>>,
    socket: UnixStream,
    flash: Vec<u8>,
}

impl Twin {
    /// Starts a twin with this package in its flash.
    pub(super) fn start(package: &PackageBytes) -> (Self, Line) {
        let region = region();
        let mut flash = Flash::new(region.length as usize, Tear::Prefix, 0);
        for segment in Image::of_package(&region, Slot::A, package).unwrap().segments() {
            let start = (segment.address - region.origin) as usize;
            for (place, word) in segment.bytes.chunks(4).enumerate() {
                // Erased parts of an image are not written.
                if word != [ERASED; 4] {
                    flash.overwrite(start + 4 * place, word);
                }
            }
        }
        let content = flash.mapped().to_vec();
        let (thread, socket, line) = started(flash);
        (Self { thread: Some(thread), socket, flash: content }, line)
    }

    /// Stops it between two requests, and starts another with the contents of its flash.
    pub(super) fn cycle_power(&mut self) -> Result<Line, String> {
        let flash = self.end().ok_or("the twin has panicked")?;
        self.flash = flash.mapped().to_vec();
        if flash.misuses + flash.rewrites > 0 {
            return Err("the rules of the flash were violated".to_owned());
        }
        let (thread, socket, line) = started(flash);
        (self.thread, self.socket) = (Some(thread), socket);
        Ok(line)
    }

    pub(super) fn flash(&self) -> &[u8] {
        &self.flash
    }

    fn end(&mut self) -> Option<Flash> {
        let _ = self.socket.shutdown(Shutdown::Both);
        self.thread.take()?.join().ok()
    }
}

impl Drop for Twin {
    fn drop(&mut self) {
        let _ = self.end();
    }
}

fn started(flash: Flash) -> (JoinHandle<Flash>, UnixStream, Line) {
    let (here, there) = UnixStream::pair().unwrap();
    let line = Line::over_socket(here.try_clone().unwrap(), &Arc::default()).unwrap();
    (std::thread::spawn(move || live(flash, &there)), here, line)
}

/// Runs the node, again after every reset, until the other end of the socket is closed; returns the
/// flash.
fn live(mut flash: Flash, socket: &UnixStream) -> Flash {
    let over = Cell::new(false);
    // As the board counts them: in memory that a reset keeps and a loss of power does not.
    let mut starts = 0;
    while !over.get() {
        starts += 1;
        let settings = Settings {
            layout: region().layout(),
            public_key: None,
            step_range: StepRange::DEFAULT,
            health: HealthSettings::RECOMMENDED,
            update_limit: agent_core::store::RateLimit::NONE,
            trial: firmware_template::RECOMMENDED_TRIAL,
            sample_stride: NonZeroU32::new(20).unwrap(),
            subscription: Subscription::default(),
            fallback: None,
            stack_unused: None,
            start: Start { boots: Some(starts), ..Start::default() },
            keep_epochs: None,
            factory_reset: false,
            version: [0, 1, 0],
        };
        let mut memory = Memory::new();
        let mut node = TwinNode::new(flash, settings, &mut memory).unwrap();
        node.run(&mut Loop::new(Port { socket, over: &over }));
        flash = node.into_flash();
    }
    flash
}

/// The node's end of the socket.
struct Port<'s> {
    socket: &'s UnixStream,
    over: &'s Cell<bool>,
}

impl embedded_io::ErrorType for Port<'_> {
    type Error = ErrorKind;
}

impl embedded_io::Read for Port<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize, ErrorKind> {
        let length = self.socket.read(buffer).unwrap_or(0);
        if length > 0 {
            return Ok(length);
        }
        // Simulates a power failure: a reset makes the node release its flash without changing it.
        self.over.set(true);
        let mut last = vec![0];
        send(&Request::Reset, |bytes| last.extend_from_slice(bytes));
        buffer[..last.len()].copy_from_slice(&last);
        Ok(last.len())
    }
}

impl embedded_io::Write for Port<'_> {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, ErrorKind> {
        self.socket.write(bytes).map_err(|_| ErrorKind::Other)
    }

    fn flush(&mut self) -> Result<(), ErrorKind> {
        Ok(())
    }
}
