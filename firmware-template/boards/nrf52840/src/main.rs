//! A node on an nRF52840 whose neighbours are in the air, wired as on Nordic's nRF52840 DK.
//!
//! **Compiled and linked by CI, never run there**: no emulator at hand models the radio. The lines
//! to check first on a real board are the constants below and the table.
//!
//! | what | where |
//! | --- | --- |
//! | service port | UART, TX P0.06, RX P0.08 (the DK's USB port), 115,200 baud |
//! | link between nodes | IEEE 802.15.4 radio, channel 26, broadcast data frames in network 0x4453 |
//! | sensor | TMP117 on TWIM0 at address 0x48, SDA P0.26, SCL P0.27, 400 kHz: `y` is the temperature in degrees C |
//! | clock | TIMER1, which runs freely at 16 MHz |
//! | weights | the last 64 KiB of flash, as the board's memory map says |
//!
//! **The link.** To send, the radio waits for a frame that is just arriving (at most 4.3 ms), then
//! tries up to 4 times to find the channel free, listening for up to 2.6 ms between two tries; the
//! frame itself takes about 2 ms. A step that broadcasts thus lasts 2 ms as a rule and 30 ms at worst:
//! choose the sampling period for that, and `epsilon` for the 250 kbit/s that all nodes share.
//!
//! **Flash.** While a page is erased (85 ms) or a word written (41 us; product specification, NVMC
//! electrical specification), the processor stands still. Its clock goes on, so ticks stay true.
//!
//! **What goes wrong.** A panic, a fault and a node that is told to reset all end in a reset. The
//! watchdog does the same if the loop stands still for 8 s; it is fed once for each pass of the
//! loop and nowhere else.
#![no_std]
#![no_main]
#![allow(unsafe_code, reason = "registers, and interrupts that are let in")]

mod clock;
mod flash;
mod radio;
mod uart;

use core::num::NonZeroU32;

use agent_core::health::HealthSettings;
use agent_core::service::Subscription;
use cortex_m::peripheral::{NVIC, SCB};
use cortex_m_rt::entry;
use firmware_template::registers::{Channel as Register, Format, RegisterValue, SetUp};
use firmware_template::{
    Memory, Node, QueuedPort, RegisterSensor, Settings, memory_map, on_chip, queued_port,
};
use heapless::spsc::Queue;
use nrf52840_hal as hal;
use static_cell::{ConstStaticCell, StaticCell};

use hal::Clocks;
use hal::clocks::{ExternalOscillator, Internal, LfOscStopped};
use hal::gpio::{Level, p0};
use hal::ieee802154::Radio;
use hal::pac::{self, Interrupt};
use hal::twim::{self, Twim};

use clock::Timer;
use flash::Flash;
use radio::RadioLink;
use uart::{SERVICE, Uart};

/// State components of the plant.
const N: usize = 3;
/// Room for features, neighbours, samples for training.
const FEATURES: usize = 8;
const NEIGHBOURS: usize = 4;
const SAMPLES: usize = 64;

/// Address of the TMP117, and its temperature: 7.8125 thousandths of a degree a count, and -256 degrees
/// until there is a first one (its data sheet, temperature register).
const SENSOR: u8 = 0x48;
static REGISTERS: [Register; 1] = [Register {
    register: 0,
    format: Format::I16BigEndian,
    scale: 0.007_812_5,
    offset: 0.0,
    not_ready: Some(-0x8000),
}];
/// A conversion every 15.5 ms, without averaging, where the sensor's own default is one a second.
static SET_UP: [SetUp; 1] = [SetUp { register: 1, value: RegisterValue::BigEndian(0) }];

/// How long what is queued for the service port may take to leave, before a reset. \[cycle\]
const FLUSH_DELAY_CYCLES: u32 = 64_000_000 / 10;

/// The radio needs the crystal, nothing here a clock that runs on while the chip sleeps.
type ClocksForRadio = Clocks<ExternalOscillator, Internal, LfOscStopped>;

type ThisNode = Node<'static, Flash, N, FEATURES, NEIGHBOURS, SAMPLES>;

/// The board on its own feet.
#[cfg(not(feature = "in-the-loop"))]
type ThisBoard = firmware_template::Hardware<
    RegisterSensor<'static, Twim<pac::TWIM0>, 1>,
    RadioLink,
    Timer,
    QueuedPort<'static>,
>;

/// The board whose plant, clock and link are played over the service port.
#[cfg(feature = "in-the-loop")]
type ThisBoard = firmware_template::InTheLoop<
    firmware_template::WaitingPort<QueuedPort<'static>, Timer>,
    { 2 * NEIGHBOURS },
>;

/// Bytes that wait in one direction.
type Bytes = Queue<u8, 2048>;

// What is large lies here and not on the stack, where it would stay as long as `main` does.
static MEMORY: ConstStaticCell<Memory<N, FEATURES, NEIGHBOURS, SAMPLES>> =
    ConstStaticCell::new(Memory::new());
static QUEUES: ConstStaticCell<[Bytes; 2]> = ConstStaticCell::new([const { Bytes::new() }; 2]);
static CLOCKS: StaticCell<ClocksForRadio> = StaticCell::new();
static BOARD: StaticCell<ThisBoard> = StaticCell::new();
static NODE: StaticCell<ThisNode> = StaticCell::new();

#[entry]
fn main() -> ! {
    if let Some(Parts { board, flash }) = hardware()
        && let Some(node) = node(flash)
    {
        node.run(board);
    }
    cortex_m::asm::delay(FLUSH_DELAY_CYCLES);
    SCB::sys_reset()
}

/// What [`hardware`] sets up.
struct Parts {
    board: &'static mut ThisBoard,
    flash: pac::NVMC,
}

/// Sets the board up in its place. Out of line, so that the stack is free again of what that takes.
#[inline(never)]
fn hardware() -> Option<Parts> {
    let chip = pac::Peripherals::take()?;
    let watchdog = clock::watchdog(chip.WDT);
    let clocks = CLOCKS.init(Clocks::new(chip.CLOCK).enable_ext_hfosc());
    let pins = p0::Parts::new(chip.P0);

    let [service_in, service_out] = QUEUES.take();
    let wake = || NVIC::pend(Interrupt::UARTE0_UART0);
    let (service, end) = queued_port(service_in, service_out, wake);
    let transmit = pins.p0_06.into_push_pull_output(Level::High).degrade();
    let receive = pins.p0_08.into_floating_input().degrade();
    SERVICE.set(Uart::new(chip.UART0, transmit.psel_bits(), receive.psel_bits(), end));

    let bus = twim::Pins {
        scl: pins.p0_27.into_floating_input().degrade(),
        sda: pins.p0_26.into_floating_input().degrade(),
    };
    let bus = Twim::new(chip.TWIM0, bus, twim::Frequency::K400);
    let sensor = RegisterSensor::new(bus, SENSOR, &REGISTERS).ok()?.with_set_up(&SET_UP);

    // Two bytes of the number that the factory gave this chip.
    let address = chip.FICR.deviceid[0].read().bits() as u16;
    let link = RadioLink::new(Radio::init(chip.RADIO, clocks), address);
    let clock = Timer::new(chip.TIMER1, watchdog);
    for interrupt in [Interrupt::TIMER1, Interrupt::UARTE0_UART0, Interrupt::RADIO] {
        // SAFETY: what the handlers use is in place, and nothing relies on their being masked.
        unsafe { NVIC::unmask(interrupt) };
    }
    #[cfg(not(feature = "in-the-loop"))]
    let board = ThisBoard::new(sensor, link, clock, service);
    #[cfg(feature = "in-the-loop")]
    let board = {
        let _ = (sensor, link);
        ThisBoard::new(firmware_template::WaitingPort::new(service, clock))
    };
    Some(Parts { board: BOARD.init(board), flash: chip.NVMC })
}

/// The node above it, in its place; `None` if it cannot be trusted with packages.
#[inline(never)]
fn node(flash: pac::NVMC) -> Option<&'static mut ThisNode> {
    let region = memory_map!().region();
    // Once a second, at the period of 0.1 s that a package for this link might have.
    let state_every = NonZeroU32::new(10).filter(|_| !cfg!(feature = "in-the-loop"));
    let settings = Settings {
        layout: region.layout,
        // No signature would do for a key that is not one, so nothing must be taken without one.
        public_key: on_chip::public_key().ok()?,
        health: HealthSettings::RECOMMENDED,
        good_steps: const { NonZeroU32::new(100).unwrap() },
        sample_stride: NonZeroU32::MIN,
        subscription: Subscription { state_every, outer_weights: false },
        // Which agent this is, its package says.
        fallback: None,
        stack_unused: Some(on_chip::stack_unused),
        version: [0, 1, 0],
    };
    // SAFETY: memory.x gives this region to nothing else, and this is the only call.
    let flash = unsafe { Flash::new(flash, &region) };
    ThisNode::new_in(NODE.uninit(), flash, settings, MEMORY.take()).ok()
}

firmware_template::reset_on_fault!();
