//! A node on an nRF52840 that reaches its neighbours by radio, wired as on Nordic's nRF52840 DK.
//!
//! **CI builds and links this board but does not run it**: no available emulator models the radio.
//! On real hardware, first check the constants below and the table.
//!
//! | function | hardware |
//! | --- | --- |
//! | service port | UART, TX P0.06, RX P0.08 (the DK's USB port), 115,200 baud |
//! | link between nodes | IEEE 802.15.4 radio, channel 26, broadcast data frames in network 0x4453 |
//! | sensor | TMP117 on TWIM0 at address 0x48, SDA P0.26, SCL P0.27, 400 kHz: `y` is the temperature in degrees C |
//! | factory reset | P0.11 low for a second at the start: button 1 of the DK |
//! | clock | TIMER1, free-running at 16 MHz |
//! | weights | the last 64 KiB of flash, as in the board's memory map |
//!
//! **The link.** Before sending, the radio waits for a frame that is being received (at most 4.3
//! ms), then tries up to 4 times to find the channel free, listening for up to 2.6 ms between two
//! tries; the frame itself takes about 2 ms. A step that broadcasts usually takes 2 ms and at worst
//! 30 ms: choose the sampling period accordingly, and `epsilon` for the 250 kbit/s shared by all
//! nodes.
//!
//! **Flash.** While a page is erased (85 ms) or a word is written (41 us; product specification,
//! NVMC electrical specification), the processor is halted. Before an erasure the node says farewell to
//! its neighbours. The timer keeps running, so ticks stay correct.
//!
//! **Faults.** A panic, a processor fault and a reset request all reset the chip. So does the watchdog
//! if the main loop stops for 8 s; it is fed only there, once per iteration. A failed sensor or a held
//! bus costs one measurement (`bus.rs`), and the sensor is set up again for the next sample.
#![no_std]
#![no_main]
#![allow(unsafe_code, reason = "accesses registers and unmasks interrupts")]

mod bus;
mod clock;
mod flash;
mod radio;
mod uart;

use core::num::NonZeroU32;

use agent_core::health::HealthSettings;
use agent_core::package::StepRange;
use agent_core::service::{ResetCause, Subscription};
use agent_core::store::RateLimit;
use cortex_m::peripheral::{NVIC, SCB};
use cortex_m_rt::entry;
use embedded_hal::digital::InputPin;
use firmware_template::registers::{Channel as Register, Format, RegisterValue, SetUp};
use firmware_template::{
    Memory, Node, QueuedPort, RegisterSensor, Settings, is_held, memory_map, on_chip, queued_port,
};
use heapless::spsc::Queue;
use nrf52840_hal as hal;
use static_cell::{ConstStaticCell, StaticCell};

use hal::Clocks;
use hal::clocks::{ExternalOscillator, Internal, LfOscStopped};
use hal::gpio::{Level, p0};
use hal::ieee802154::Radio;
use hal::pac::{self, Interrupt};

use bus::Bus;
use clock::Timer;
use flash::Flash;
use radio::RadioLink;
use uart::{SERVICE, Uart};

/// State dimension of the plant.
const N: usize = 3;
/// Capacities for features, neighbours and training samples.
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

/// Time allowed for sending the service port's queue before a reset. \[cycle\]
const FLUSH_DELAY_CYCLES: u32 = 64_000_000 / 10;

/// The radio needs the crystal; nothing here needs a clock that runs during sleep.
type ClocksForRadio = Clocks<ExternalOscillator, Internal, LfOscStopped>;

/// Interval at which the button is read: a hundredth of the time for which it must be held. \[cycle\]
const BUTTON_CYCLES: u32 = 64_000_000 / 100;

type ThisNode = Node<'static, Flash, N, FEATURES, NEIGHBOURS, SAMPLES>;

/// The board with its own sensor, link and clock.
#[cfg(not(feature = "in-the-loop"))]
type ThisBoard = firmware_template::Hardware<
    RegisterSensor<'static, Bus, 1>,
    RadioLink,
    Timer,
    QueuedPort<'static>,
>;

/// The board in the loop: plant, clock and link come over the service port.
#[cfg(feature = "in-the-loop")]
type ThisBoard = firmware_template::InTheLoop<
    firmware_template::WaitingPort<QueuedPort<'static>, Timer>,
    { 2 * NEIGHBOURS },
>;

/// The queue of bytes in one direction.
type Bytes = Queue<u8, 2048>;

// Large data is static: on the stack it would stay as long as `main` runs.
static MEMORY: ConstStaticCell<Memory<N, FEATURES, NEIGHBOURS, SAMPLES>> =
    ConstStaticCell::new(Memory::new());
static QUEUES: ConstStaticCell<[Bytes; 2]> = ConstStaticCell::new([const { Bytes::new() }; 2]);
static CLOCKS: StaticCell<ClocksForRadio> = StaticCell::new();
static BOARD: StaticCell<ThisBoard> = StaticCell::new();
static NODE: StaticCell<ThisNode> = StaticCell::new();

#[entry]
fn main() -> ! {
    if let Some(Parts { board, flash, is_reset_held }) = hardware()
        && let Some(node) = node(flash, is_reset_held)
    {
        node.run(board);
    }
    cortex_m::asm::delay(FLUSH_DELAY_CYCLES);
    SCB::sys_reset()
}

/// The parts that [`hardware`] sets up.
struct Parts {
    board: &'static mut ThisBoard,
    flash: pac::NVMC,
    is_reset_held: bool,
}

/// Sets up the board in its static. Not inlined, so that its stack is free again afterwards.
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

    let bus = Bus::new(chip.TWIM0, pins.p0_26, pins.p0_27);
    let sensor = RegisterSensor::new(bus, SENSOR, &REGISTERS).ok()?.with_set_up(&SET_UP);

    // Two bytes of the chip's factory-programmed number.
    let address = chip.FICR.deviceid[0].read().bits() as u16;
    let link = RadioLink::new(Radio::init(chip.RADIO, clocks), address);
    let clock = Timer::new(chip.TIMER1, watchdog);
    for interrupt in [Interrupt::TIMER1, Interrupt::UARTE0_UART0, Interrupt::RADIO] {
        // SAFETY: everything the handlers use is set up, and nothing relies on their being masked.
        unsafe { NVIC::unmask(interrupt) };
    }
    #[cfg(not(feature = "in-the-loop"))]
    let board = ThisBoard::new(sensor, link, clock, service);
    #[cfg(feature = "in-the-loop")]
    let board = {
        let _ = (sensor, link);
        ThisBoard::new(firmware_template::WaitingPort::new(service, clock))
    };
    let mut button = pins.p0_11.into_pullup_input();
    let is_reset_held = is_held(
        || InputPin::is_low(&mut button) == Ok(true),
        || cortex_m::asm::delay(BUTTON_CYCLES),
    );
    Some(Parts { board: BOARD.init(board), flash: chip.NVMC, is_reset_held })
}

/// Creates the node in its static; `None` if the public key is invalid.
#[inline(never)]
fn node(flash: pac::NVMC, factory_reset: bool) -> Option<&'static mut ThisNode> {
    let region = memory_map!().region();
    // Once a second, for a typical period of 0.1 s on this link.
    let state_every = NonZeroU32::new(10).filter(|_| !cfg!(feature = "in-the-loop"));
    let settings = Settings {
        layout: region.layout,
        // With an invalid key no signature can be verified, so the node must not start.
        public_key: on_chip::public_key().ok()?,
        step_range: StepRange::DEFAULT,
        health: HealthSettings::RECOMMENDED,
        update_limit: if cfg!(feature = "in-the-loop") {
            // A simulation's time is not that of the flash.
            RateLimit::NONE
        } else {
            RateLimit::DEFAULT
        },
        trial: firmware_template::RECOMMENDED_TRIAL,
        sample_stride: NonZeroU32::MIN,
        subscription: Subscription { state_every, outer_weights: false },
        // The package determines which agent this is.
        fallback: None,
        stack_unused: Some(on_chip::stack_unused),
        start: on_chip::start(reset_cause()),
        keep_epochs: Some(on_chip::keep_epochs),
        factory_reset,
        version: [0, 1, 0],
    };
    // SAFETY: memory.x reserves this region, and this is the only call.
    let flash = unsafe { Flash::new(flash, &region) };
    ThisNode::new_in(NODE.uninit(), flash, settings, MEMORY.take()).ok()
}

/// Returns why the chip was reset: the register RESETREAS (nRF52840 product specification, 5.3.7.4),
/// whose bits stay until they are cleared.
fn reset_cause() -> ResetCause {
    const REASON: *mut u32 = 0x4000_0400 as *mut u32;
    // SAFETY: the register's address; it is read once, and cleared by writing its own bits.
    let bits = unsafe { REASON.read_volatile() };
    // SAFETY: as above.
    unsafe { REASON.write_volatile(bits) };
    match bits {
        // Also after a low supply voltage.
        0 => ResetCause::PowerOn,
        bits if bits & 1 << 1 != 0 => ResetCause::Watchdog,
        bits if bits & 1 << 2 != 0 => ResetCause::Software,
        bits if bits & 1 != 0 => ResetCause::Pin,
        _ => ResetCause::Unknown,
    }
}

firmware_template::reset_on_fault!();
