//! A node on an RP2040, wired as on the Raspberry Pi Pico.
//!
//! **CI builds and links this board but does not run it**: no available emulator models this chip.
//! On real hardware, first check the constants below and the table.
//!
//! | function | hardware |
//! | --- | --- |
//! | service port | UART0, TX GP0, RX GP1, 115,200 baud |
//! | link between nodes | UART1, TX GP8, RX GP9, 1 Mbaud, for an RS-485 transceiver that turns around by itself |
//! | sensor | TMP117 on I2C0 at address 0x48, SDA GP4, SCL GP5, 400 kHz: `y` is the temperature in degrees C, every 15.5 ms |
//! | factory reset | GP22 low for a second at the start: connect it to ground |
//! | clock | the timer, which runs freely at 1 MHz |
//! | weights | the last 64 KiB of the flash chip, as memory.x says |
//!
//! **Floating point.** This core has no FPU, and the boot ROM's routines flush subnormal numbers to
//! zero: the HAL's feature `disable-intrinsics` selects the compiler's routines, whose bits equal
//! those of every other processor. A step takes about 170,000 instructions, 1.4 ms at 125 MHz.
//!
//! **Flash.** While a sector is erased (45 ms, at most 400 ms) or a page is written (0.4 ms, at
//! most 3 ms; data sheet of the W25Q16JV), the program is halted with interrupts disabled. Before an
//! erasure the node says farewell to its neighbours and waits until the link has sent it. The
//! timer keeps running, so ticks stay correct. The serial ports buffer 32 bytes in hardware;
//! further bytes are lost.
//!
//! **Faults.** A panic, a processor fault and a reset request all reset the chip. So does the watchdog
//! if the main loop stops for 8 s, including the HAL's wait for the crystal. A failed sensor or a held
//! bus costs one measurement (`bus.rs`), and the sensor is set up again for the next sample. Without
//! its crystal this board does not work: the ring oscillator can run at half or twice its nominal
//! frequency, too inaccurate for a serial port.
#![no_std]
#![no_main]
#![allow(unsafe_code, reason = "accesses flash and registers, and unmasks interrupts")]

mod bus;
mod clock;
mod flash;
mod uart;

use core::num::NonZeroU32;

use agent_core::health::HealthSettings;
use agent_core::package::StepRange;
use agent_core::service::{ResetCause, Subscription};
use agent_core::store::RateLimit;
use cortex_m::peripheral::{NVIC, SCB};
use embedded_hal::digital::InputPin;
use firmware_template::registers::{Channel as Register, Format, RegisterValue, SetUp};
use firmware_template::{
    Memory, Node, QueuedPort, RegisterSensor, Settings, is_held, memory_map, on_chip, queued_port,
};
use heapless::spsc::Queue;
use rp2040_hal as hal;
use static_cell::{ConstStaticCell, StaticCell};

use hal::fugit::{ExtU32, RateExtU32};
use hal::gpio::{FunctionUart, Pins, PullNone, PullUp};
use hal::pac::{self, Interrupt};
use hal::uart::{DataBits, StopBits, UartConfig, UartPeripheral};
use hal::{Clock as _, Sio, Watchdog};

use bus::Bus;
use clock::Timer;
use flash::Flash;
use uart::{LINK, SERVICE, Uart};

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

/// Frequency of the crystal. \[Hz\]
const CRYSTAL: u32 = 12_000_000;
/// Close to the maximum, and far above the 2.8 s needed to erase the sectors of a slot. \[ms\]
const WATCHDOG_PERIOD: u32 = 8_000;
const SERVICE_BAUD: u32 = 115_200;
const LINK_BAUD: u32 = 1_000_000;
/// Time allowed for sending the service port's queue before a reset. \[cycle\]
const FLUSH_DELAY_CYCLES: u32 = 125_000_000 / 10;

/// Interval at which the button is read: a hundredth of the time for which it must be held. \[cycle\]
const BUTTON_CYCLES: u32 = 125_000_000 / 100;

/// The bootloader for the flash chip on this board.
#[unsafe(link_section = ".boot2")]
#[used]
static BOOT2: [u8; 256] = rp2040_boot2::BOOT_LOADER_W25Q080;

type ThisNode = Node<'static, Flash, N, FEATURES, NEIGHBOURS, SAMPLES>;

/// The board with its own sensor, link and clock.
#[cfg(not(feature = "in-the-loop"))]
type ThisBoard = firmware_template::Hardware<
    RegisterSensor<'static, Bus, 1>,
    firmware_template::SerialLink<QueuedPort<'static>>,
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
static QUEUES: ConstStaticCell<[Bytes; 4]> = ConstStaticCell::new([const { Bytes::new() }; 4]);
static BOARD: StaticCell<ThisBoard> = StaticCell::new();
static NODE: StaticCell<ThisNode> = StaticCell::new();

#[hal::entry]
fn main() -> ! {
    if let Some((board, is_reset_held)) = hardware()
        && let Some(node) = node(is_reset_held)
    {
        node.run(board);
    }
    cortex_m::asm::delay(FLUSH_DELAY_CYCLES);
    SCB::sys_reset()
}

/// Sets up the board in its static; tells also whether the button for a factory reset is held. Not inlined, so that its stack is free again afterwards.
#[inline(never)]
fn hardware() -> Option<(&'static mut ThisBoard, bool)> {
    let mut chip = pac::Peripherals::take()?;
    let mut watchdog = Watchdog::new(chip.WATCHDOG);
    watchdog.enable_tick_generation((CRYSTAL / 1_000_000) as u8);
    watchdog.pause_on_debug(true);
    watchdog.start(WATCHDOG_PERIOD.millis());
    let clocks = hal::clocks::init_clocks_and_plls(
        CRYSTAL,
        chip.XOSC,
        chip.CLOCKS,
        chip.PLL_SYS,
        chip.PLL_USB,
        &mut chip.RESETS,
        &mut watchdog,
    );
    let clocks = clocks.ok()?;
    let (sio, resets) = (Sio::new(chip.SIO), &mut chip.RESETS);
    let pins = Pins::new(chip.IO_BANK0, chip.PADS_BANK0, sio.gpio_bank0, resets);

    let [service_in, service_out, link_in, link_out] = QUEUES.take();
    let baud = |rate: u32| UartConfig::new(rate.Hz(), DataBits::Eight, None, StopBits::One);
    let frequency = clocks.peripheral_clock.freq();
    let (service, end) = queued_port(service_in, service_out, || NVIC::pend(Interrupt::UART0_IRQ));
    let uart_pins = (
        pins.gpio0.reconfigure::<FunctionUart, PullNone>(),
        pins.gpio1.reconfigure::<FunctionUart, PullUp>(),
    );
    let uart = UartPeripheral::new(chip.UART0, uart_pins, resets);
    SERVICE.set(Uart::new(uart.enable(baud(SERVICE_BAUD), frequency).ok()?.free().0, end));
    let (link, end) = queued_port(link_in, link_out, || NVIC::pend(Interrupt::UART1_IRQ));
    let uart_pins = (
        pins.gpio8.reconfigure::<FunctionUart, PullNone>(),
        pins.gpio9.reconfigure::<FunctionUart, PullUp>(),
    );
    let uart = UartPeripheral::new(chip.UART1, uart_pins, resets);
    LINK.set(Uart::new(uart.enable(baud(LINK_BAUD), frequency).ok()?.free().0, end));

    let clock = Timer::new(hal::Timer::new(chip.TIMER, resets, &clocks), watchdog);
    let bus_pins = (pins.gpio4.reconfigure(), pins.gpio5.reconfigure());
    let bus = Bus::new(chip.I2C0, bus_pins, chip.RESETS);
    let sensor = RegisterSensor::new(bus, SENSOR, &REGISTERS).ok()?.with_set_up(&SET_UP);
    for interrupt in [Interrupt::TIMER_IRQ_0, Interrupt::UART0_IRQ, Interrupt::UART1_IRQ] {
        // SAFETY: everything the handlers use is set up, and nothing relies on their being masked.
        unsafe { NVIC::unmask(interrupt) };
    }
    #[cfg(not(feature = "in-the-loop"))]
    let board = {
        let link = firmware_template::SerialLink::new(link);
        ThisBoard::new(sensor, link, clock, service)
    };
    #[cfg(feature = "in-the-loop")]
    let board = {
        let _ = (sensor, link);
        ThisBoard::new(firmware_template::WaitingPort::new(service, clock))
    };
    let mut button = pins.gpio22.into_pull_up_input();
    let is_reset_held = is_held(
        || InputPin::is_low(&mut button) == Ok(true),
        || cortex_m::asm::delay(BUTTON_CYCLES),
    );
    Some((BOARD.init(board), is_reset_held))
}

/// Creates the node in its static; `None` if the public key is invalid.
#[inline(never)]
fn node(factory_reset: bool) -> Option<&'static mut ThisNode> {
    let region = memory_map!().region();
    // Once a second, at a period of 0.01 s.
    let state_every = NonZeroU32::new(100).filter(|_| !cfg!(feature = "in-the-loop"));
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
    // SAFETY: memory.x reserves this region, this is the only call, and the second core is never
    // started.
    let flash = unsafe { Flash::new(&region) };
    ThisNode::new_in(NODE.uninit(), flash, settings, MEMORY.take()).ok()
}

/// Returns why the chip was reset: the registers WATCHDOG_REASON and CHIP_RESET (RP2040 datasheet, 4.7.6
/// and 2.10.6).
fn reset_cause() -> ResetCause {
    const WATCHDOG_REASON: *const u32 = 0x4005_8008 as *const u32;
    const CHIP_RESET: *const u32 = 0x4006_4008 as *const u32;
    // SAFETY: the registers' addresses; reading has no effect.
    let (watchdog, chip) = unsafe { (WATCHDOG_REASON.read_volatile(), CHIP_RESET.read_volatile()) };
    match (watchdog & 0b11, chip) {
        (0, chip) if chip & 1 << 8 != 0 => ResetCause::PowerOn,
        (0, chip) if chip & 1 << 16 != 0 => ResetCause::Pin,
        // The processor's own reset leaves no trace in these registers.
        (0, _) => ResetCause::Software,
        _ => ResetCause::Watchdog,
    }
}

firmware_template::reset_on_fault!();
