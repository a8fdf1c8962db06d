//! A node on Arm's MPS2 board with the AN386 image, a Cortex-M4F, as modelled by QEMU.
//!
//! The node is in the loop: the program that started QEMU provides plant, clock and link, and
//! selects the channel with the semihosting command line:
//!
//! | arguments | channel |
//! | --- | --- |
//! | `node fifo IN OUT` | two named pipes, opened in this order; the faster one |
//! | `node uart` | UART 0, as with a real board |
//!
//! The board's RAM at 0x2100_0000 serves as flash. If QEMU backs it with a file, the contents
//! survive resets and restarts, as those of flash do.
//!
//! Optimised builds cannot panic: the panic handler calls an undefined function, so any call of it
//! would fail to link. With signature verification the verifier's own panics remain, listed in
//! docs/decisions/0006-signatures.md; the handler then resets the board.
#![no_std]
#![no_main]
#![allow(unsafe_code, reason = "accesses registers and a memory region defined by the linker")]

use core::convert::Infallible;
use core::num::NonZeroU32;

use agent_core::health::HealthSettings;
use agent_core::package::StepRange;
use agent_core::service::{ResetCause, Subscription};
use agent_core::store::{MappedFlash, RateLimit};
use cortex_m::peripheral::{NVIC, SCB};
use cortex_m_semihosting::{nr, syscall};
use embedded_io::{ErrorType, Read, Write};
use embedded_storage::nor_flash::{
    ErrorType as FlashErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash, check_erase,
    check_read, check_write,
};
use firmware_template::{InTheLoop, Memory, Node, Settings, WeightsRegion, memory_map, on_chip};
use static_cell::{ConstStaticCell, StaticCell};

/// State dimension of the paper's plant.
const N: usize = 3;
/// Capacities for features, neighbours and training samples.
const FEATURES: usize = 8;
const NEIGHBOURS: usize = 4;
const SAMPLES: usize = 64;

/// The other end has closed the channel.
const EXIT_SUCCESS: usize = 0;
/// The command line names no channel, or the channel cannot be opened.
const EXIT_NO_CHANNEL: usize = 2;
/// memory.x does not describe flash that the store can use.
const EXIT_LAYOUT: usize = 3;
/// The static memory is already taken; unreachable.
const EXIT_MEMORY: usize = 5;
/// The compiled-in public key is invalid.
const EXIT_KEY: usize = 4;

type Loop = InTheLoop<Port, { 2 * NEIGHBOURS }>;
type LoopNode = Node<'static, RamFlash, N, FEATURES, NEIGHBOURS, SAMPLES>;

static MEMORY: ConstStaticCell<Memory<N, FEATURES, NEIGHBOURS, SAMPLES>> =
    ConstStaticCell::new(Memory::new());
static NODE: StaticCell<LoopNode> = StaticCell::new();
static LOOP: StaticCell<Loop> = StaticCell::new();

#[cortex_m_rt::entry]
fn main() -> ! {
    let Some(port) = Port::open() else { exit(EXIT_NO_CHANNEL) };
    let Some(board) = in_the_loop(port) else { exit(EXIT_MEMORY) };
    match node() {
        Ok(node) => node.run(board),
        Err(code) => exit(code),
    }
    // The emulator would keep them open across the reset.
    board.port().close();
    SCB::sys_reset()
}

/// Creates the node in its static. Not inlined, so that the stack it takes is free again afterwards.
#[inline(never)]
fn node() -> Result<&'static mut LoopNode, usize> {
    let region = memory_map!().region();
    // SAFETY: memory.x reserves this region, and this is the only call.
    let flash = unsafe { RamFlash::new(&region) };
    // With an invalid key no signature can be verified, so the node must not start.
    let public_key = on_chip::public_key().map_err(|_| EXIT_KEY)?;
    let settings = Settings {
        layout: region.layout,
        public_key,
        step_range: StepRange::DEFAULT,
        health: HealthSettings::RECOMMENDED,
        // Its flash does not wear out, and its time is that of a simulation.
        update_limit: RateLimit::NONE,
        trial: firmware_template::RECOMMENDED_TRIAL,
        sample_stride: NonZeroU32::new(20).unwrap_or(NonZeroU32::MIN),
        subscription: Subscription { state_every: None, outer_weights: false },
        // The package determines which agent this is.
        fallback: None,
        stack_unused: Some(on_chip::stack_unused),
        start: on_chip::start(ResetCause::Unknown),
        keep_epochs: Some(on_chip::keep_epochs),
        factory_reset: false,
        version: [0, 1, 0],
    };
    let memory = MEMORY.try_take().ok_or(EXIT_MEMORY)?;
    let place = NODE.try_uninit().ok_or(EXIT_MEMORY)?;
    LoopNode::new_in(place, flash, settings, memory).map_err(|_| EXIT_LAYOUT)
}

/// Places the board in its static. Not inlined, so that the stack of the copy is free again
/// afterwards.
#[inline(never)]
fn in_the_loop(port: Port) -> Option<&'static mut Loop> {
    LOOP.try_init_with(|| Loop::new(port))
}

/// The channel to the program that provides the plant.
enum Port {
    Pipes { input: File, output: File },
    Uart(Uart),
}

impl Port {
    /// Opens the channel named on the command line.
    fn open() -> Option<Self> {
        let mut buffer = [0; COMMAND_LINE];
        let line = command_line(&mut buffer)?;
        let mut words = line.split(|&byte| byte == b' ').skip(1);
        if words.next()? == b"uart" {
            return Some(Self::Uart(Uart::new()));
        }
        let input = File::open(words.next()?, nr::open::R_BINARY)?;
        let output = File::open(words.next()?, nr::open::W_TRUNC_BINARY)?;
        Some(Self::Pipes { input, output })
    }
}

impl Port {
    fn close(&mut self) {
        if let Self::Pipes { input, output } = self {
            input.close();
            output.close();
        }
    }
}

impl ErrorType for Port {
    type Error = Infallible;
}

impl Read for Port {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Infallible> {
        match self {
            Self::Uart(uart) => Ok(uart.read(buffer)),
            Self::Pipes { input, .. } => match input.read(buffer) {
                // The other end is gone, and the plant with it.
                0 => exit(EXIT_SUCCESS),
                length => Ok(length),
            },
        }
    }
}

impl Write for Port {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        match self {
            Self::Uart(uart) => Ok(uart.write(bytes)),
            Self::Pipes { output, .. } => match output.write(bytes) {
                0 if !bytes.is_empty() => exit(EXIT_SUCCESS),
                length => Ok(length),
            },
        }
    }

    fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}

/// Length of the longest command line.
const COMMAND_LINE: usize = 256;

/// Returns the semihosting command line, up to its terminator.
fn command_line(buffer: &mut [u8; COMMAND_LINE]) -> Option<&[u8]> {
    // SAFETY: GET_CMDLINE (0x15) writes at most as many bytes as its second argument says, which is
    // the length of the buffer.
    let failed = unsafe { syscall!(GET_CMDLINE, buffer.as_mut_ptr(), buffer.len()) };
    let end = buffer.iter().position(|&byte| byte == 0)?;
    buffer.get(..end).filter(|_| failed == 0)
}

/// A file on the host.
struct File(usize);

impl File {
    fn open(path: &[u8], mode: usize) -> Option<Self> {
        let mut name = [0; COMMAND_LINE];
        name.get_mut(..path.len())?.iter_mut().zip(path).for_each(|(place, byte)| *place = *byte);
        // SAFETY: OPEN (0x01) reads the name up to its terminating zero, which is in the buffer:
        // the path is part of the command line, which is shorter than the buffer.
        let handle = unsafe { syscall!(OPEN, name.as_ptr(), mode, path.len()) };
        (handle != usize::MAX).then_some(Self(handle))
    }

    /// Returns how many bytes were read; 0 at the end.
    fn read(&mut self, buffer: &mut [u8]) -> usize {
        // SAFETY: READ (0x06) writes at most as many bytes as its third argument says.
        let missing = unsafe { syscall!(READ, self.0, buffer.as_mut_ptr(), buffer.len()) };
        buffer.len().saturating_sub(missing)
    }

    fn close(&mut self) {
        // SAFETY: CLOSE (0x02) takes a handle that OPEN returned; the host refuses one that is
        // already closed.
        unsafe { syscall!(CLOSE, self.0) };
    }

    /// Returns how many bytes were written.
    fn write(&mut self, bytes: &[u8]) -> usize {
        // SAFETY: WRITE (0x05) reads as many bytes as its third argument says.
        let missing = unsafe { syscall!(WRITE, self.0, bytes.as_ptr(), bytes.len()) };
        bytes.len().saturating_sub(missing)
    }
}

/// Ends the emulator with this exit status.
fn exit(status: usize) -> ! {
    /// ADP_Stopped_ApplicationExit, the reason code that goes with an exit status.
    const APPLICATION_EXIT: usize = 0x20026;
    /// SYS_EXIT_EXTENDED, which passes both on a 32-bit processor.
    const EXIT_EXTENDED: usize = 0x20;
    let arguments = [APPLICATION_EXIT, status];
    loop {
        // SAFETY: the call reads the two words.
        unsafe { cortex_m_semihosting::syscall(EXIT_EXTENDED, &arguments) };
    }
}

/// UART 0: an Arm CMSDK APB UART (Cortex-M System Design Kit, DDI 0479, 4.3).
struct Uart(());

impl Uart {
    const DATA: *mut u32 = 0x4000_4000 as *mut u32;
    const STATE: *mut u32 = 0x4000_4004 as *mut u32;
    const CONTROL: *mut u32 = 0x4000_4008 as *mut u32;
    const INTERRUPT: *mut u32 = 0x4000_400c as *mut u32;
    const BAUD_DIVIDER: *mut u32 = 0x4000_4010 as *mut u32;

    /// Enables transmitter, receiver and the receive interrupt.
    const ENABLE: u32 = 0b1011;
    const TRANSMIT_FULL: u32 = 1;
    const RECEIVE_FULL: u32 = 2;
    /// The hardware's minimum; QEMU does not simulate bit times.
    const DIVIDER: u32 = 16;
    /// UART 0's receive interrupt, in the vector table of the AN386 image.
    const IRQ: Irq = Irq(0);

    fn new() -> Self {
        // A pending interrupt wakes the core even if it is masked, so no handler is needed.
        cortex_m::interrupt::disable();
        write(Self::BAUD_DIVIDER, Self::DIVIDER);
        write(Self::CONTROL, Self::ENABLE);
        // SAFETY: PRIMASK masks the interrupt permanently, so no handler runs.
        unsafe { NVIC::unmask(Self::IRQ) };
        Self(())
    }

    /// Waits for the first byte, and takes all bytes received so far.
    fn read(&mut self, buffer: &mut [u8]) -> usize {
        let mut length = 0;
        for place in buffer {
            while read(Self::STATE) & Self::RECEIVE_FULL == 0 {
                if length > 0 {
                    return length;
                }
                cortex_m::asm::wfi();
                write(Self::INTERRUPT, Self::RECEIVE_FULL);
                NVIC::unpend(Self::IRQ);
            }
            *place = read(Self::DATA) as u8;
            length += 1;
        }
        length
    }

    fn write(&mut self, bytes: &[u8]) -> usize {
        for &byte in bytes {
            while read(Self::STATE) & Self::TRANSMIT_FULL != 0 {}
            write(Self::DATA, byte.into());
        }
        bytes.len()
    }
}

#[derive(Clone, Copy)]
struct Irq(u16);

// SAFETY: the number is one of the board's and constant.
unsafe impl cortex_m::interrupt::InterruptNumber for Irq {
    fn number(self) -> u16 {
        self.0
    }
}

fn read(register: *mut u32) -> u32 {
    // SAFETY: only called with the addresses of the UART's registers.
    unsafe { register.read_volatile() }
}

fn write(register: *mut u32, value: u32) {
    // SAFETY: only called with the addresses of the UART's registers.
    unsafe { register.write_volatile(value) }
}

/// RAM that behaves like NOR flash: a write only clears bits.
struct RamFlash {
    bytes: &'static mut [u8],
}

impl RamFlash {
    /// # Safety
    /// The region must have no other owner.
    unsafe fn new(region: &WeightsRegion) -> Self {
        let first = core::ptr::with_exposed_provenance_mut(region.origin);
        // SAFETY: memory.x places the region in RAM of this length; the caller guarantees that it
        // has no other owner, and any content is a valid `u8`.
        Self { bytes: unsafe { core::slice::from_raw_parts_mut(first, region.length) } }
    }
}

impl FlashErrorType for RamFlash {
    type Error = NorFlashErrorKind;
}

impl ReadNorFlash for RamFlash {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        check_read(self, offset, bytes.len())?;
        let place = self.bytes.get(offset as usize..).and_then(|rest| rest.get(..bytes.len()));
        let place = place.ok_or(NorFlashErrorKind::OutOfBounds)?;
        // `copy_from_slice` would keep a panicking path when the compiler optimises for size.
        bytes.iter_mut().zip(place).for_each(|(byte, found)| *byte = *found);
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.bytes.len()
    }
}

impl NorFlash for RamFlash {
    const WRITE_SIZE: usize = 4;
    /// As in memory.x; for real flash it is in the data sheet.
    const ERASE_SIZE: usize = 4096;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        check_erase(self, from, to)?;
        let place = self.bytes.get_mut(from as usize..to as usize);
        place.ok_or(NorFlashErrorKind::OutOfBounds)?.fill(0xff);
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        check_write(self, offset, bytes.len())?;
        let place = self.bytes.get_mut(offset as usize..).ok_or(NorFlashErrorKind::OutOfBounds)?;
        place.iter_mut().zip(bytes).for_each(|(place, byte)| *place &= byte);
        Ok(())
    }
}

impl MappedFlash for RamFlash {
    fn mapped(&self) -> &[u8] {
        self.bytes
    }
}

/// No interrupt is ever taken, so the vector table has the single entry that the linker script
/// requires. The script names no others: see device.x.
#[unsafe(link_section = ".vector_table.interrupts")]
#[unsafe(no_mangle)]
static __INTERRUPTS: [usize; 1] = [0];

/// With the verifier, or without optimisation, some paths can panic.
#[cfg(any(feature = "signature", debug_assertions))]
#[panic_handler]
fn panic(info: &core::panic::PanicInfo<'_>) -> ! {
    on_chip::record_failure(info.location().map(|place| (place.file(), place.line())));
    SCB::sys_reset()
}

#[cfg(not(any(feature = "signature", debug_assertions)))]
#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    unsafe extern "C" {
        safe fn the_firmware_has_a_path_that_panics() -> !;
    }
    the_firmware_has_a_path_that_panics()
}
