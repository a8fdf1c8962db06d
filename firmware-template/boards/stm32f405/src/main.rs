//! A node on an STM32F405, wired as on Adafruit's Feather STM32F405 Express.
//!
//! **Compiled and linked by CI, never run there**: no emulator models this chip far enough. The
//! lines to check first on a real board are the constants below and the table.
//!
//! | what | where |
//! | --- | --- |
//! | service port | USART3, TX PB10, RX PB11, 115,200 baud |
//! | link between nodes | USART6, TX PC6, RX PC7, 1 Mbaud, driver enable PB8, for an RS-485 transceiver |
//! | sensor | LSM303AGR on I2C1, SCL PB6, SDA PB7, 400 kHz: `y` is the acceleration along x in m/s^2 |
//! | clock | TIM2, which runs freely at 84 MHz |
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
//! independent watchdog does the same if the loop stands still for 8 s, whatever it hangs in: the
//! start of the oscillator, the I2C bus, the node. It is fed once for each pass of the loop and
//! nowhere else. A sensor that fails is set up again with the next sample.
#![no_std]
#![no_main]
#![allow(unsafe_code, reason = "flash, and interrupts that are let in")]

use core::cell::RefCell;
use core::num::NonZeroU32;
use core::panic::PanicInfo;

use agent_core::health::HealthSettings;
use agent_core::math::symmetric::SymmetricMatrix;
use agent_core::observer::outer_law::OuterLawParams;
use agent_core::observer::projection::ProjectionParams;
use agent_core::observer::trigger::TriggerParams;
use agent_core::package::signature::PublicKey;
use agent_core::package::{AgentConfig, NeighbourIds};
use agent_core::service::Subscription;
use agent_core::store::MappedFlash;
use cortex_m::peripheral::{NVIC, SCB};
use cortex_m_rt::{ExceptionFrame, entry, exception};
use critical_section::Mutex;
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash, check_erase, check_read, check_write,
};
use firmware_template::{
    Clock, Hardware, Memory, Node, Periods, QueuedEnd, Sensor, SerialLink, Settings, WeightsRegion,
    memory_map, queued_port,
};
use heapless::spsc::Queue;
use lsm303agr::interface::I2cInterface;
use lsm303agr::mode::MagOneShot;
use lsm303agr::{AccelMode, AccelOutputDataRate, Lsm303agr};
use static_cell::ConstStaticCell;
use stm32f4xx_hal as hal;

use hal::gpio::{AnyPin, Output};
use hal::i2c::I2c;
use hal::pac::{self, FLASH, I2C1, Interrupt, TIM2, USART3, USART6, interrupt};
use hal::prelude::*;
use hal::rcc::{Config, Enable, Reset};
use hal::serial::{self, Event, Flag, Instance, Serial};
use hal::timer::SysDelay;
use hal::watchdog::IndependentWatchdog;
use hal::{Listen, ReadFlags};

/// State components of the plant.
const N: usize = 3;
/// Room for features, neighbours, entries of `Gamma`, samples for training.
const FEATURES: usize = 8;
const NEIGHBOURS: usize = 4;
const GAINS: usize = FEATURES;
const SAMPLES: usize = 64;

/// Frequency of the board's crystal. \[MHz\]
const CRYSTAL: u32 = 12;
/// Frequency of TIM2: twice that of its bus. \[Hz\]
const TIMER_FREQUENCY: f32 = 84e6;
/// How often the processor wakes if there is nothing to sample: 0.1 s. \[tick\]
const HEARTBEAT: u32 = 8_400_000;
/// Above the longest erasure, also where the watchdog's own oscillator runs at 47 kHz instead of
/// 32 (DS8626, LSI oscillator). \[ms\]
const WATCHDOG_PERIOD: u32 = 8_000;

const SERVICE_BAUD: u32 = 115_200;
const LINK_BAUD: u32 = 1_000_000;
/// How long what is queued for the service port may take to leave, before a reset. \[cycle\]
const FLUSH_DELAY_CYCLES: u32 = 168_000_000 / 10;

type ThisNode = Node<'static, Flash, N, FEATURES, NEIGHBOURS, GAINS, SAMPLES>;

static MEMORY: ConstStaticCell<Memory<N, FEATURES, NEIGHBOURS, SAMPLES>> =
    ConstStaticCell::new(Memory::new());
static SERVICE: Mutex<RefCell<Option<Uart<USART3>>>> = Mutex::new(RefCell::new(None));
static LINK: Mutex<RefCell<Option<Uart<USART6>>>> = Mutex::new(RefCell::new(None));

#[entry]
fn main() -> ! {
    let (Some(chip), Some(core)) = (pac::Peripherals::take(), cortex_m::Peripherals::take()) else {
        SCB::sys_reset()
    };
    let mut watchdog = IndependentWatchdog::new(chip.IWDG);
    watchdog.stop_on_debug(&chip.DBGMCU, true);
    watchdog.start(WATCHDOG_PERIOD.millis());

    let clocks = Config::hse(CRYSTAL.MHz()).sysclk(168.MHz()).pclk1(42.MHz()).pclk2(84.MHz());
    let mut rcc = chip.RCC.freeze(clocks);
    let (gpiob, gpioc) = (chip.GPIOB.split(&mut rcc), chip.GPIOC.split(&mut rcc));

    let queues = cortex_m::singleton!(: [Queue<u8, 2048>; 4] = [const { Queue::new() }; 4]);
    let Some([service_in, service_out, link_in, link_out]) = queues else { SCB::sys_reset() };
    let (service, end) = queued_port(service_in, service_out, || NVIC::pend(Interrupt::USART3));
    let pins = (gpiob.pb10, gpiob.pb11);
    let usart = chip.USART3.serial(pins, SERVICE_BAUD.bps(), &mut rcc);
    Uart::begin(&SERVICE, usart, end, None);
    let (link, end) = queued_port(link_in, link_out, || NVIC::pend(Interrupt::USART6));
    let pins = (gpioc.pc6, gpioc.pc7);
    let usart = chip.USART6.serial(pins, LINK_BAUD.bps(), &mut rcc);
    Uart::begin(&LINK, usart, end, Some(gpiob.pb8.into_push_pull_output().erase()));

    let sensor = Accelerometer {
        device: Lsm303agr::new_with_i2c(I2c::new(
            chip.I2C1,
            (gpiob.pb6, gpiob.pb7),
            400.kHz(),
            &mut rcc,
        )),
        delay: core.SYST.delay(&rcc.clocks),
        ready: false,
    };
    TIM2::enable(&mut rcc);
    TIM2::reset(&mut rcc);
    let clock = Timer::new(chip.TIM2, watchdog);
    for interrupt in [Interrupt::TIM2, Interrupt::USART3, Interrupt::USART6] {
        // SAFETY: what the handlers use is in place, and nobody relies on their being masked.
        unsafe { NVIC::unmask(interrupt) };
    }

    let region = memory_map!().region();
    let settings = Settings {
        layout: region.layout,
        public_key: public_key(),
        health: HealthSettings::RECOMMENDED,
        good_steps: const { NonZeroU32::new(1_000).unwrap() },
        sample_stride: const { NonZeroU32::new(20).unwrap() },
        // Once a second, at the period of 1 ms.
        subscription: Subscription { state_every: NonZeroU32::new(1_000), outer_weights: false },
        fallback: fallback(),
        stack_unused: None,
        version: [0, 1, 0],
    };
    // SAFETY: memory.x gives this region to nobody else, and this is the only call.
    let flash = unsafe { Flash::new(chip.FLASH, &region) };
    let mut board = Hardware::new(sensor, SerialLink::new(link), clock, service);
    let mut node = ThisNode::new(flash, settings, MEMORY.take());
    if let Ok(node) = &mut node {
        node.run(&mut board);
    }
    cortex_m::asm::delay(FLUSH_DELAY_CYCLES);
    SCB::sys_reset()
}

/// Agent 1 of the paper, which measures the first state component and hears agents 2 and 3: what
/// the node is until it gets a package. The numbers are those of host-sim's scenario `paper`.
fn fallback() -> Option<AgentConfig<'static>> {
    Some(AgentConfig {
        agent: 1,
        output_matrix: &[1.0, 0.0, 0.0],
        gain: SymmetricMatrix::Diagonal(&[134.86, 263.23, 263.23]),
        neighbours: NeighbourIds::new(&[2, 0, 3, 0])?,
        edge_weights: &[1.0, 1.0],
        // Without a network there is nothing to adapt.
        outer_law: OuterLawParams {
            gain: SymmetricMatrix::Scalar(3.0),
            projection: ProjectionParams {
                radius: 20.0,
                boundary_layer: 1.0,
                smoothing: 0.1,
                smoothness: 1,
            },
        },
        trigger: TriggerParams {
            hold_error_weight: 311_810.16,
            consensus_weight: 0.277_777_8,
            threshold: 1_000.0,
        },
        step_size: 1e-3,
    })
}

/// The key that packages have to be signed with, if the firmware was built for one.
#[cfg(feature = "signature")]
fn public_key() -> Option<PublicKey> {
    let bytes = const { firmware_template::key_from_hex(env!("NODE_PUBLIC_KEY")) };
    match PublicKey::from_bytes(&bytes) {
        Ok(key) => Some(key),
        // Nobody's signature would do for it, so nothing must be taken without one.
        Err(_) => SCB::sys_reset(),
    }
}

#[cfg(not(feature = "signature"))]
fn public_key() -> Option<PublicKey> {
    None
}

/// What an interrupt does for a serial port.
struct Uart<U: Instance> {
    serial: Serial<U>,
    end: QueuedEnd<'static>,
    /// Turns an RS-485 transceiver to sending.
    driver: Option<AnyPin<Output>>,
}

impl<U: Instance> Uart<U> {
    /// Hands everything to the interrupt, whose place is `place`.
    fn begin(
        place: &Mutex<RefCell<Option<Self>>>,
        serial: Result<Serial<U>, serial::config::InvalidConfig>,
        end: QueuedEnd<'static>,
        driver: Option<AnyPin<Output>>,
    ) {
        // The baud rates above are ones that the hardware has.
        if let Ok(mut serial) = serial {
            serial.listen(Event::RxNotEmpty);
            let uart = Self { serial, end, driver };
            critical_section::with(|token| place.borrow(token).replace(Some(uart)));
        }
    }

    fn serve(place: &Mutex<RefCell<Option<Self>>>) {
        critical_section::with(|token| {
            if let Some(uart) = place.borrow_ref_mut(token).as_mut() {
                uart.receive();
                uart.send();
            }
        });
    }

    fn receive(&mut self) {
        loop {
            match self.serial.read() {
                Ok(byte) => self.end.put(byte),
                Err(hal::nb::Error::WouldBlock) => break,
                // The HAL has taken the damaged byte, and with it the error.
                Err(hal::nb::Error::Other(_)) => (),
            }
        }
    }

    fn send(&mut self) {
        let flags = self.serial.flags();
        if !flags.contains(Flag::TxEmpty) {
            return;
        }
        if let Some(byte) = self.end.take() {
            if let Some(driver) = &mut self.driver {
                driver.set_high();
            }
            // There is room, as the flag said.
            let _ = self.serial.write(byte);
            self.serial.listen(Event::TxEmpty);
        } else if flags.contains(Flag::TransmissionComplete) {
            self.serial.unlisten(Event::TxEmpty | Event::TransmissionComplete);
            if let Some(driver) = &mut self.driver {
                driver.set_low();
            }
        } else {
            self.serial.unlisten(Event::TxEmpty);
            self.serial.listen(Event::TransmissionComplete);
        }
    }
}

#[interrupt]
fn USART3() {
    Uart::serve(&SERVICE);
}

#[interrupt]
fn USART6() {
    Uart::serve(&LINK);
}

/// TIM2, a counter of 32 bits, and the watchdog that is fed with it.
struct Timer {
    timer: TIM2,
    watchdog: IndependentWatchdog,
    periods: Periods,
}

impl Timer {
    /// Lets the counter run.
    fn new(timer: TIM2, watchdog: IndependentWatchdog) -> Self {
        // SAFETY: every value is one that this register takes.
        timer.arr().write(|w| unsafe { w.bits(u32::MAX) });
        timer.dier().write(|w| w.cc1ie().set_bit());
        timer.cr1().write(|w| w.cen().set_bit());
        Self { timer, watchdog, periods: Periods::new(HEARTBEAT) }
    }

    fn now(&self) -> u32 {
        self.timer.cnt().read().bits()
    }
}

impl Clock for Timer {
    fn start(&mut self, period: f32) {
        let now = self.now();
        self.periods.start(period, TIMER_FREQUENCY, now);
    }

    fn elapsed(&mut self) -> u32 {
        self.watchdog.feed();
        let now = self.now();
        self.periods.elapsed(now)
    }

    /// An interrupt that comes before the instruction sets the event that it waits for, so none
    /// is slept through.
    fn rest(&mut self) {
        // SAFETY: every value is one that this register takes.
        self.timer.ccr1().write(|w| unsafe { w.bits(self.periods.next()) });
        // What comes before the register is set does not wake.
        if !self.periods.is_due(self.now()) {
            cortex_m::asm::wfe();
        }
    }
}

#[interrupt]
fn TIM2() {
    /// `CC1IF` of the status register.
    const COMPARE_1: u32 = 1 << 1;
    // SAFETY: only this touches the status register, whose bits are cleared by 0 and ignore 1.
    unsafe { TIM2::steal().sr().write(|w| w.bits(!COMPARE_1)) };
}

/// The accelerometer of an LSM303AGR: 1,344 samples a second, +-2 g, 4 mg a count.
struct Accelerometer {
    device: Lsm303agr<I2cInterface<I2c<I2C1>>, MagOneShot>,
    delay: SysDelay,
    /// Whether the device has been set up, and no error has occurred since.
    ready: bool,
}

impl Accelerometer {
    /// Standard gravity, by definition (CGPM 1901), of a thousandth of a g. \[m/s^2\]
    const MILLIGRAVITY: f32 = 9.806_65e-3;

    fn sample(&mut self) -> Result<f32, lsm303agr::Error<hal::i2c::Error>> {
        if !self.ready {
            let rate = AccelOutputDataRate::Khz1_344;
            self.device.init()?;
            self.device.set_accel_mode_and_odr(&mut self.delay, AccelMode::Normal, rate)?;
        }
        let thousandths = self.device.acceleration()?.x_mg();
        Ok(thousandths as f32 * Self::MILLIGRAVITY)
    }
}

impl Sensor for Accelerometer {
    type Error = lsm303agr::Error<hal::i2c::Error>;

    fn outputs(&self) -> usize {
        1
    }

    fn read(&mut self, measurement: &mut [f32]) -> Result<(), Self::Error> {
        let [place] = measurement else { return Err(lsm303agr::Error::InvalidInputData) };
        let sample = self.sample();
        self.ready = sample.is_ok();
        *place = sample?;
        Ok(())
    }
}

/// The chip's own flash, sectors 5 to 11. The HAL's driver is not used: it writes 8 bits at once,
/// which doubles the time that the processor stands still, it leaves errors standing that then
/// fail every later operation, and it does not clear the cache.
struct Flash {
    flash: FLASH,
    origin: usize,
    length: usize,
}

impl Flash {
    /// What opens the control register (RM0090, 3.6.1).
    const KEYS: [u32; 2] = [0x4567_0123, 0xCDEF_89AB];
    /// The errors in the status register: PGSERR, PGPERR, PGAERR, WRPERR, OPERR.
    const ERRORS: u32 = 0b1111_0010;
    /// With them its end of operation; all are cleared by writing 1.
    const STATUS: u32 = Self::ERRORS | 1;
    /// Where sector 5 begins, the first of 128 KiB (3.4, table 5).
    const SECTOR_5: usize = 0x0802_0000;

    /// # Safety
    /// The region is flash, in whole sectors of 128 KiB, and nobody else may have it.
    unsafe fn new(flash: FLASH, region: &WeightsRegion) -> Self {
        Self { flash, origin: region.origin, length: region.length }
    }

    /// Does something to the flash that `begin` begins, and waits for its end.
    fn operate(&mut self, begin: impl FnOnce(&FLASH)) -> Result<(), NorFlashErrorKind> {
        // SAFETY: every value is one that this register takes.
        self.flash.sr().write(|w| unsafe { w.bits(Self::STATUS) });
        begin(&self.flash);
        // Also tells the compiler that memory has changed.
        cortex_m::asm::dsb();
        while self.flash.sr().read().bsy().bit_is_set() {}
        cortex_m::asm::dsb();
        let failed = self.flash.sr().read().bits() & Self::ERRORS != 0;
        if failed { Err(NorFlashErrorKind::Other) } else { Ok(()) }
    }

    /// Opens the flash for `change`, and locks it again.
    fn unlocked(
        &mut self,
        change: impl FnOnce(&mut Self) -> Result<(), NorFlashErrorKind>,
    ) -> Result<(), NorFlashErrorKind> {
        for key in Self::KEYS {
            // SAFETY: the keys in their order are what this register takes while it is locked,
            // as it is outside this function.
            self.flash.keyr().write(|w| unsafe { w.key().bits(key) });
        }
        let outcome = change(self);
        self.flash.cr().write(|w| w.lock().set_bit());
        outcome
    }

    /// Makes the cache forget what was erased; writing goes through it.
    fn clear_cache(&mut self) {
        let acr = self.flash.acr();
        acr.modify(|_, w| w.dcen().clear_bit());
        acr.modify(|_, w| w.dcrst().set_bit());
        acr.modify(|_, w| w.dcrst().clear_bit());
        acr.modify(|_, w| w.dcen().set_bit());
        cortex_m::asm::dsb();
    }
}

impl ErrorType for Flash {
    type Error = NorFlashErrorKind;
}

impl ReadNorFlash for Flash {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        check_read(self, offset, bytes.len())?;
        let place = self.mapped().get(offset as usize..).and_then(|rest| rest.get(..bytes.len()));
        bytes.copy_from_slice(place.ok_or(NorFlashErrorKind::OutOfBounds)?);
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.length
    }
}

impl NorFlash for Flash {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = 128 * 1024;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        check_erase(self, from, to)?;
        let first = 5 + (self.origin - Self::SECTOR_5) / Self::ERASE_SIZE;
        let sectors = from as usize / Self::ERASE_SIZE..to as usize / Self::ERASE_SIZE;
        let outcome = self.unlocked(|flash| {
            for sector in sectors {
                let sector = (first + sector) as u8;
                flash.operate(|flash| {
                    // The register's value after a reset would lock it.
                    let cr = flash.cr();
                    cr.write(|w| w.lock().clear_bit().psize().psize32().ser().set_bit());
                    // SAFETY: the sector lies in the region that is ours.
                    cr.modify(|_, w| unsafe { w.snb().bits(sector).strt().set_bit() });
                })?;
            }
            Ok(())
        });
        self.clear_cache();
        outcome
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        check_write(self, offset, bytes.len())?;
        let (words, _) = bytes.as_chunks();
        let first = core::ptr::with_exposed_provenance_mut::<u32>(self.origin + offset as usize);
        self.unlocked(|flash| {
            for (index, word) in words.iter().enumerate() {
                flash.operate(|flash| {
                    flash.cr().write(|w| w.lock().clear_bit().psize().psize32().pg().set_bit());
                    // SAFETY: the word lies in the region that is ours, aligned; nothing borrows
                    // from it, since `self` is borrowed exclusively.
                    unsafe { first.add(index).write_volatile(u32::from_le_bytes(*word)) };
                })?;
            }
            Ok(())
        })
    }
}

impl MappedFlash for Flash {
    fn mapped(&self) -> &[u8] {
        let first = core::ptr::with_exposed_provenance(self.origin);
        // SAFETY: memory.x places the region in flash of this length, where any content is a valid
        // `u8`; it changes only through an exclusive borrow of `self`.
        unsafe { core::slice::from_raw_parts(first, self.length) }
    }
}

#[exception]
unsafe fn HardFault(_: &ExceptionFrame) -> ! {
    SCB::sys_reset()
}

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    SCB::sys_reset()
}
