//! A node on an STM32F405, wired as on Adafruit's Feather STM32F405 Express.
//!
//! CI runs it in QEMU as far as QEMU models the chip; README.md lists what is not modelled. On real
//! hardware, first check the constants below and the table.
//!
//! | function | hardware |
//! | --- | --- |
//! | service port | USART3, TX PB10, RX PB11, 115,200 baud |
//! | link between nodes | USART6, TX PC6, RX PC7, 1 Mbaud, driver enable PB8, for an RS-485 transceiver |
//! | sensor | LSM303AGR on I2C1, SCL PB6, SDA PB7, 400 kHz: `y` is the acceleration along x in m/s^2 |
//! | factory reset | PA0 high for a second at the start: connect it to 3.3 V |
//! | clock | TIM2, free-running at 84 MHz, or at 16 MHz without the crystal |
//! | weights | flash sectors 8 to 11, as in the board's memory map |
//!
//! **Only [`Clock::rest`] waits.** Both ports are queues that their interrupts fill and empty, so
//! no byte is lost during a step. A sample takes 0.25 ms of bus and processor time.
//!
//! **Flash.** While a sector is erased (1 s, at most 2 s) or a word is written (16 us, at most 0.1
//! ms; data sheet DS8626, flash memory programming, 32 bits at once, 2.7 to 3.6 V), the processor
//! stalls when it fetches code. One upload erases one sector: the node says farewell to its
//! neighbours, waits until the link has sent it, and misses the steps during that time, and all
//! messages sent to it. The timer keeps running, so ticks stay correct. The uploader
//! waits for each answer, so no part of the upload is lost.
//!
//! **Faults.** A panic, a processor fault and a reset request all reset the chip. So does the
//! independent watchdog if due work is not done for 8 s, for whatever reason; it is fed by work done,
//! once per iteration. Without its crystal the node runs on the chip's internal oscillator and
//! reports a fault (`clock.rs`). A failed sensor or a stuck bus costs one measurement (`bus.rs`),
//! and the sensor is set up again for the next sample.
#![no_std]
#![no_main]
#![allow(unsafe_code, reason = "accesses flash and unmasks interrupts")]

mod bus;
mod clock;
mod fallback;
mod flash;
mod sensor;
#[cfg(feature = "embassy")]
mod tasks;
mod uart;

#[cfg(all(feature = "embassy", feature = "in-the-loop"))]
compile_error!(
    "in the loop, the node waits for the simulator, so it cannot be a task; choose one of the features"
);

use core::num::NonZeroU32;

use agent_core::health::HealthSettings;
use agent_core::package::StepRange;
use agent_core::service::{BoardFault, ResetCause, Subscription};
use agent_core::store::RateLimit;
use cortex_m::peripheral::{NVIC, SCB};
use cortex_m_rt::entry;
use firmware_template::{
    Memory, Node, QueuedPort, Settings, is_held, memory_map, on_chip, queued_port,
};
use heapless::spsc::Queue;
use static_cell::{ConstStaticCell, StaticCell};
use stm32f4xx_hal as hal;

use hal::pac::{self, Interrupt};
use hal::prelude::*;
use hal::watchdog::IndependentWatchdog;

use clock::Timer;
use flash::Flash;
use uart::{LINK, SERVICE, Uart};

/// State dimension of the plant.
const N: usize = 3;
/// Capacities for features, neighbours and training samples.
const FEATURES: usize = 8;
const NEIGHBOURS: usize = 4;
const SAMPLES: usize = 64;

/// Above the longest erasure, even if the watchdog's own oscillator runs at 47 kHz instead of 32
/// (DS8626, LSI oscillator). \[ms\]
const WATCHDOG_PERIOD: u32 = 8_000;

const SERVICE_BAUD: u32 = 115_200;
const LINK_BAUD: u32 = 1_000_000;
/// Time allowed for sending the service port's queue before a reset: the longest at 168 MHz.
/// \[cycle\]
const FLUSH_DELAY_CYCLES: u32 = 168_000_000 / 10;

type ThisNode = Node<'static, Flash, N, FEATURES, NEIGHBOURS, SAMPLES>;

/// What the sensor's driver waits with.
#[cfg(not(feature = "embassy"))]
type Delay = hal::timer::SysDelay;
#[cfg(feature = "embassy")]
type Delay = embassy_time::Delay;

/// The board with its own sensor, link and clock.
#[cfg(not(feature = "in-the-loop"))]
type ThisBoard = firmware_template::Hardware<
    sensor::Accelerometer<Delay>,
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

#[entry]
fn main() -> ! {
    if let Some(parts) = hardware()
        && let Some(node) = node(parts.flash, parts.fault, parts.is_reset_held)
    {
        #[cfg(feature = "embassy")]
        tasks::run(node, parts.board, parts.led);
        #[cfg(not(feature = "embassy"))]
        node.run(parts.board);
    }
    cortex_m::asm::delay(FLUSH_DELAY_CYCLES);
    SCB::sys_reset()
}

/// The parts that [`hardware`] sets up.
struct Parts {
    board: &'static mut ThisBoard,
    flash: pac::FLASH,
    fault: Option<BoardFault>,
    is_reset_held: bool,
    #[cfg(feature = "embassy")]
    led: hal::gpio::PC1<hal::gpio::Output>,
}

/// Sets up the board in its static. Not inlined, so that its stack is free again afterwards.
#[inline(never)]
fn hardware() -> Option<Parts> {
    let (chip, core) = (pac::Peripherals::take()?, cortex_m::Peripherals::take()?);
    let mut watchdog = IndependentWatchdog::new(chip.IWDG);
    watchdog.stop_on_debug(&chip.DBGMCU, true);
    watchdog.start(WATCHDOG_PERIOD.millis());
    let (mut rcc, crystal_is_ready) = clock::start(chip.RCC);
    let cycles = rcc.clocks.sysclk().raw() / 100;
    let (gpiob, gpioc) = (chip.GPIOB.split(&mut rcc), chip.GPIOC.split(&mut rcc));

    let [service_in, service_out, link_in, link_out] = QUEUES.take();
    let (service, end) = queued_port(service_in, service_out, || NVIC::pend(Interrupt::USART3));
    let pins = (gpiob.pb10, gpiob.pb11);
    let usart = chip.USART3.serial(pins, SERVICE_BAUD.bps(), &mut rcc);
    Uart::begin(&SERVICE, usart, end, None);
    let (link, end) = queued_port(link_in, link_out, || NVIC::pend(Interrupt::USART6));
    let pins = (gpioc.pc6, gpioc.pc7);
    let usart = chip.USART6.serial(pins, LINK_BAUD.bps(), &mut rcc);
    Uart::begin(&LINK, usart, end, Some(gpiob.pb8.into_push_pull_output().erase()));
    let bus = hal::i2c::I2c::new(chip.I2C1, (gpiob.pb6, gpiob.pb7), 400.kHz(), &mut rcc);
    #[cfg(not(feature = "embassy"))]
    let delay: Delay = core.SYST.delay(&rcc.clocks);
    #[cfg(feature = "embassy")]
    let delay: Delay = tasks::start_time(core.SYST, rcc.clocks.sysclk().raw());
    let sensor = sensor::Accelerometer::new(bus::Bus::new(bus), delay);
    let clock = Timer::new(chip.TIM2, &mut rcc, watchdog);
    for interrupt in [Interrupt::TIM2, Interrupt::USART3, Interrupt::USART6] {
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
    let button = chip.GPIOA.split(&mut rcc).pa0.into_pull_down_input();
    let is_reset_held = is_held(|| button.is_high(), || cortex_m::asm::delay(cycles));
    let fault = (!crystal_is_ready).then_some(BoardFault::Clock);
    Some(Parts {
        board: BOARD.init(board),
        flash: chip.FLASH,
        fault,
        is_reset_held,
        #[cfg(feature = "embassy")]
        led: gpioc.pc1.into_push_pull_output(),
    })
}

/// Creates the node in its static; `None` if the public key is invalid.
#[inline(never)]
fn node(
    flash: pac::FLASH,
    fault: Option<BoardFault>,
    factory_reset: bool,
) -> Option<&'static mut ThisNode> {
    let region = memory_map!().region();
    // Once a second, at a period of 1 ms.
    let state_every = NonZeroU32::new(1_000).filter(|_| !cfg!(feature = "in-the-loop"));
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
        sample_stride: const { NonZeroU32::new(20).unwrap() },
        subscription: Subscription { state_every, outer_weights: false },
        fallback: fallback::fallback(),
        stack_unused: Some(on_chip::stack_unused),
        start: on_chip::start(reset_cause()),
        keep_epochs: Some(on_chip::keep_epochs),
        factory_reset,
        version: [0, 1, 0],
    };
    // SAFETY: memory.x reserves this region, and this is the only call.
    let flash = unsafe { Flash::new(flash, &region) };
    let node = ThisNode::new_in(NODE.uninit(), flash, settings, MEMORY.take()).ok()?;
    if let Some(fault) = fault {
        node.report(fault);
    }
    Some(node)
}

/// Returns why the chip was reset: the register RCC_CSR (RM0090, 7.3.21), whose flags stay until they
/// are cleared.
fn reset_cause() -> ResetCause {
    const STATUS: *mut u32 = 0x4002_3874 as *mut u32;
    const CLEAR: u32 = 1 << 24;
    // SAFETY: the register's address; nothing else uses it yet.
    let bits = unsafe { STATUS.read_volatile() };
    // SAFETY: as above; the other bits keep their values.
    unsafe { STATUS.write_volatile(bits | CLEAR) };
    // The flag of the pin is set with every other one.
    for (bit, cause) in [
        (29, ResetCause::Watchdog),
        (30, ResetCause::Watchdog),
        (28, ResetCause::Software),
        (27, ResetCause::PowerOn),
        (25, ResetCause::BrownOut),
        (26, ResetCause::Pin),
    ] {
        if bits & 1 << bit != 0 {
            return cause;
        }
    }
    ResetCause::Unknown
}

firmware_template::reset_on_fault!();
