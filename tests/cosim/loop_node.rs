//! A node in its own thread: the firmware's loop at the other end of a socket, with its flash in
//! memory.

use std::cell::Cell;
use std::io::{Read as _, Write as _};
use std::num::NonZeroU32;
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use agent_core::health::HealthSettings;
use agent_core::package::signature::PublicKey;
use agent_core::package::{StepRange, TrialLimits};
use agent_core::service::{Request, Subscription, send};
use agent_core::store::{Layout, MappedFlash, Slot};
use embedded_io::ErrorKind;
use embedded_storage::nor_flash::{ErrorType, NorFlash, ReadNorFlash};
use firmware_template::{InTheLoop, Memory, Node, RECOMMENDED_TRIAL, Settings};
use host_sim::image::Image;
use host_sim::memory_map::{MemoryMap, WeightsRegion};
use host_sim::packages::PackageBytes;

use test_support::nor_flash::{SimulatedError, SimulatedFlash, Tear};

/// Capacities of these nodes: slightly more than the paper's agents need.
type TestNode<'m> = Node<'m, Flash, 3, 8, 2, 64>;

/// Returns the project's memory map.
pub(crate) fn region() -> WeightsRegion {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../memory.x");
    MemoryMap::read(path.as_ref()).unwrap().weights().unwrap()
}

fn layout() -> Layout {
    region().layout()
}

/// Differences between a node and a correct one.
#[derive(Clone, Debug, Default)]
pub(crate) struct Quirks {
    /// The package in its flash after the start, in place of the one it loaded.
    pub(crate) uses: Option<PackageBytes>,
    /// Length of a trial, if not the recommended one. [s]
    pub(crate) trial_seconds: Option<u32>,
    /// If present, only packages signed with the matching private key are accepted.
    pub(crate) public_key: Option<PublicKey>,
}

/// Runs a node with `package` in its flash until the other end of the returned socket is closed.
pub(crate) fn spawn(package: Option<&PackageBytes>, quirks: &Quirks) -> UnixStream {
    let (here, there) = UnixStream::pair().unwrap();
    let (flash, quirks) = (Flash::new(package, quirks.uses.as_ref()), quirks.clone());
    std::thread::spawn(move || run(flash, &quirks, there, Arc::default()));
    here
}

/// Runs nodes without a package, one per connection to this socket, like a real board. Returns the
/// count of their reads.
pub(crate) fn serve(path: &std::path::Path) -> Arc<AtomicU64> {
    let listener = UnixListener::bind(path).unwrap();
    let reads = Arc::new(AtomicU64::new(0));
    let all = reads.clone();
    std::thread::spawn(move || {
        while let Ok((socket, _)) = listener.accept() {
            let (flash, reads) = (Flash::new(None, None), all.clone());
            std::thread::spawn(move || run(flash, &Quirks::default(), socket, reads));
        }
    });
    reads
}

fn run(mut flash: Flash, quirks: &Quirks, socket: UnixStream, reads: Arc<AtomicU64>) {
    let over = Arc::new(AtomicBool::new(false));
    let port = Port { socket, over: over.clone(), reads };
    let mut board = InTheLoop::<_, 8>::new(port);
    while !over.load(Ordering::Relaxed) {
        flash.changed.set(false);
        let settings = Settings {
            layout: layout(),
            public_key: quirks.public_key,
            step_range: StepRange::DEFAULT,
            health: HealthSettings::RECOMMENDED,
            update_limit: agent_core::store::RateLimit::NONE,
            trial: TrialLimits {
                seconds: quirks.trial_seconds.or(RECOMMENDED_TRIAL.seconds),
                ..RECOMMENDED_TRIAL
            },
            sample_stride: NonZeroU32::new(20).unwrap(),
            subscription: Subscription::default(),
            fallback: None,
            stack_unused: None,
            start: firmware_template::Start::default(),
            keep_epochs: None,
            factory_reset: false,
            version: [0, 1, 0],
        };
        let mut memory = Memory::new();
        let mut node = TestNode::new(flash, settings, &mut memory).unwrap();
        node.flash().changed.set(quirks.uses.is_some());
        node.run(&mut board);
        flash = node.into_flash();
    }
}

/// The node's end of the socket.
struct Port {
    socket: UnixStream,
    over: Arc<AtomicBool>,
    reads: Arc<AtomicU64>,
}

impl embedded_io::ErrorType for Port {
    type Error = ErrorKind;
}

impl embedded_io::Read for Port {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize, ErrorKind> {
        let length = self.socket.read(buffer).unwrap_or(0);
        if length > 0 {
            self.reads.fetch_add(1, Ordering::Relaxed);
            return Ok(length);
        }
        // The other end is closed: the last request makes the node stop.
        self.over.store(true, Ordering::Relaxed);
        let mut last = vec![0];
        send(&Request::Reset, |bytes| last.extend_from_slice(bytes));
        buffer[..last.len()].copy_from_slice(&last);
        Ok(last.len())
    }
}

impl embedded_io::Write for Port {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, ErrorKind> {
        self.socket.write(bytes).map_err(|_| ErrorKind::Other)
    }

    fn flush(&mut self) -> Result<(), ErrorKind> {
        Ok(())
    }
}

/// Flash whose contents can change after loading.
struct Flash {
    real: SimulatedFlash<8, 4096>,
    other: Vec<u8>,
    changed: Cell<bool>,
}

impl Flash {
    fn new(package: Option<&PackageBytes>, other: Option<&PackageBytes>) -> Self {
        let flash = |package: Option<&PackageBytes>| {
            let region = region();
            let length = usize::try_from(region.length).unwrap();
            let mut flash = SimulatedFlash::new(length, Tear::Prefix, 0);
            if let Some(package) = package {
                let image = Image::of_package(&region, Slot::A, package).unwrap();
                for segment in image.segments() {
                    let offset = usize::try_from(segment.address - region.origin).unwrap();
                    flash.overwrite(offset, &segment.bytes);
                }
            }
            flash
        };
        let other = flash(other.or(package)).mapped().to_vec();
        Self { real: flash(package), other, changed: Cell::new(false) }
    }
}

impl ErrorType for Flash {
    type Error = SimulatedError;
}

impl ReadNorFlash for Flash {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), SimulatedError> {
        self.real.read(offset, bytes)
    }

    fn capacity(&self) -> usize {
        self.real.capacity()
    }
}

impl NorFlash for Flash {
    const WRITE_SIZE: usize = 8;
    const ERASE_SIZE: usize = 4096;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), SimulatedError> {
        self.real.erase(from, to)
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), SimulatedError> {
        self.real.write(offset, bytes)
    }
}

impl MappedFlash for Flash {
    fn mapped(&self) -> &[u8] {
        if self.changed.get() { &self.other } else { self.real.mapped() }
    }
}
