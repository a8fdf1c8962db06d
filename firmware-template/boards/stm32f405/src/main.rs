//! A node on an STM32F405, wired as on Adafruit's Feather STM32F405 Express.
//!
//! CI runs it in QEMU as far as that models the chip; README.md says what is not modelled. The lines to
//! check first on a real board are the constants below and the table.
//!
//! | what | where |
//! | --- | --- |
//! | service port | USART3, TX PB10, RX PB11, 115,200 baud |
//! | link between nodes | USART6, TX PC6, RX PC7, 1 Mbaud, driver enable PB8, for an RS-485 transceiver |
//! | sensor | LSM303AGR on I2C1, SCL PB6, SDA PB7, 400 kHz: `y` is the acceleration along x in m/s^2 |
//! | clock | TIM2, which runs freely at 84 MHz, or at 16 MHz without the crystal |
//! | weights | flash sectors 8 to 11, as the board's memory map says |
//!
//! **Nothing waits but [`Clock::rest`].** Both ports are queues that their interrupts fill and
//! empty, so no byte is lost while a step runs. A sample takes 0.25 ms of the bus and the processor.
//!
//! **Flash.** While a sector is erased (1 s, at most 2 s) or a word written (16 us, at most 0.1 ms;
//! data sheet DS8626, flash memory programming, 32 bits at once, 2.7 to 3.6 V), the processor waits
//! as soon as it fetches code. One upload erases one sector: the node misses the steps of that
//! time, and what it is sent meanwhile. Its clock goes on, so ticks stay true. Whoever uploads
//! waits for each answer, so nothing of the upload is lost.
//!
//! **What goes wrong.** A panic, a fault and a node that is told to reset all end in a reset. The
//! independent watchdog does the same if the loop stands still for 8 s, whatever it hangs in; it is fed
//! once for each pass of the loop and nowhere else. Without its crystal the node runs on the chip's
//! own oscillator and tells so (`clock.rs`). A sensor that fails, or a bus that is stuck, costs a
//! measurement (`bus.rs`), and the sensor is set up again with the next sample.
#![no_std]
#![no_main]
#![allow(unsafe_code, reason = "flash, and interrupts that are let in")]

mod bus;
mod clock;
mod fallback;
mod flash;
mod sensor;
mod uart;

use core::num::NonZeroU32;

use agent_core::health::HealthSettings;
use agent_core::service::{BoardFault, Subscription};
use cortex_m::peripheral::{NVIC, SCB};
use cortex_m_rt::entry;
use firmware_template::{Memory, Node, QueuedPort, Settings, memory_map, on_chip, queued_port};
use heapless::spsc::Queue;
use static_cell::{ConstStaticCell, StaticCell};
use stm32f4xx_hal as hal;

use hal::pac::{self, Interrupt};
use hal::prelude::*;
use hal::watchdog::IndependentWatchdog;

use clock::Timer;
use flash::Flash;
use uart::{LINK, SERVICE, Uart};

/// State components of the plant.
const N: usize = 3;
/// Room for features, neighbours, samples for training.
const FEATURES: usize = 8;
const NEIGHBOURS: usize = 4;
const SAMPLES: usize = 64;

/// Above the longest erasure, also where the watchdog's own oscillator runs at 47 kHz instead of
/// 32 (DS8626, LSI oscillator). \[ms\]
const WATCHDOG_PERIOD: u32 = 8_000;

const SERVICE_BAUD: u32 = 115_200;
const LINK_BAUD: u32 = 1_000_000;
/// How long what is queued for the service port may take to leave, before a reset: the longest at
/// 168 MHz. \[cycle\]
const FLUSH_DELAY_CYCLES: u32 = 168_000_000 / 10;

type ThisNode = Node<'static, Flash, N, FEATURES, NEIGHBOURS, SAMPLES>;

/// The board on its own feet.
#[cfg(not(feature = "in-the-loop"))]
type ThisBoard = firmware_template::Hardware<
    sensor::Accelerometer,
    firmware_template::SerialLink<QueuedPort<'static>>,
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
static QUEUES: ConstStaticCell<[Bytes; 4]> = ConstStaticCell::new([const { Bytes::new() }; 4]);
static BOARD: StaticCell<ThisBoard> = StaticCell::new();
static NODE: StaticCell<ThisNode> = StaticCell::new();

#[entry]
fn main() -> ! {
    if let Some(Parts { board, flash, fault }) = hardware()
        && let Some(node) = node(flash, fault)
    {
        node.run(board);
    }
    cortex_m::asm::delay(FLUSH_DELAY_CYCLES);
    SCB::sys_reset()
}

/// What [`hardware`] sets up.
struct Parts {
    board: &'static mut ThisBoard,
    flash: pac::FLASH,
    fault: Option<BoardFault>,
}

/// Sets the board up in its place. Out of line, so that the stack is free again of what that takes.
#[inline(never)]
fn hardware() -> Option<Parts> {
    let (chip, core) = (pac::Peripherals::take()?, cortex_m::Peripherals::take()?);
    let mut watchdog = IndependentWatchdog::new(chip.IWDG);
    watchdog.stop_on_debug(&chip.DBGMCU, true);
    watchdog.start(WATCHDOG_PERIOD.millis());
    let (mut rcc, crystal_is_ready) = clock::start(chip.RCC);
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
    let sensor = sensor::Accelerometer::new(bus::Bus::new(bus), core.SYST.delay(&rcc.clocks));
    let clock = Timer::new(chip.TIM2, &mut rcc, watchdog);
    for interrupt in [Interrupt::TIM2, Interrupt::USART3, Interrupt::USART6] {
        // SAFETY: what the handlers use is in place, and nothing relies on their being masked.
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
    let fault = (!crystal_is_ready).then_some(BoardFault::Clock);
    Some(Parts { board: BOARD.init(board), flash: chip.FLASH, fault })
}

/// The node above it, in its place; `None` if it cannot be trusted with packages.
#[inline(never)]
fn node(flash: pac::FLASH, fault: Option<BoardFault>) -> Option<&'static mut ThisNode> {
    let region = memory_map!().region();
    // Once a second, at the period of 1 ms.
    let state_every = NonZeroU32::new(1_000).filter(|_| !cfg!(feature = "in-the-loop"));
    let settings = Settings {
        layout: region.layout,
        // No signature would do for a key that is not one, so nothing must be taken without one.
        public_key: on_chip::public_key().ok()?,
        health: HealthSettings::RECOMMENDED,
        good_steps: const { NonZeroU32::new(1_000).unwrap() },
        sample_stride: const { NonZeroU32::new(20).unwrap() },
        subscription: Subscription { state_every, outer_weights: false },
        fallback: fallback::fallback(),
        stack_unused: Some(on_chip::stack_unused),
        version: [0, 1, 0],
    };
    // SAFETY: memory.x gives this region to nothing else, and this is the only call.
    let flash = unsafe { Flash::new(flash, &region) };
    let node = ThisNode::new_in(NODE.uninit(), flash, settings, MEMORY.take()).ok()?;
    if let Some(fault) = fault {
        node.report(fault);
    }
    Some(node)
}

firmware_template::reset_on_fault!();
