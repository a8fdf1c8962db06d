//! A node on an nRF52840 whose neighbours are in the air, wired as on Nordic's nRF52840 DK.
//!
//! **Compiled and linked by CI, never run there**: no emulator at hand models the radio. The lines
//! to check first on a real board are the constants below and the table.
//!
//! | what | where |
//! | --- | --- |
//! | service port | UART, TX P0.06, RX P0.08 (the DK's USB port), 115,200 baud |
//! | link between nodes | IEEE 802.15.4 radio, [`CHANNEL`], broadcast data frames in [`PAN`] |
//! | sensor | TMP117 on TWIM0 at address 0x48, SDA P0.26, SCL P0.27, 400 kHz: `y` is the temperature in degrees C |
//! | clock | TIMER1, which runs freely at 16 MHz |
//! | weights | the last 64 KiB of flash, as the board's memory map says |
//!
//! **The link.** The radio listens whenever it does not send. Its interrupt puts each whole frame
//! into a queue of [`FRAMES`] and has it listening again within microseconds; the next frame needs
//! 160 us of preamble, so none is lost between two calls. Lost is what arrives while this node
//! sends or, below, erases. To send, it waits for a frame that is just arriving (at most 4.3 ms),
//! then tries up to [`TRIES`] times to find the channel free, listening for up to 2.6 ms between
//! two tries; the frame itself takes about 2 ms. A step that broadcasts thus lasts 2 ms as a rule
//! and 30 ms at worst: choose the sampling period for that, and `epsilon` for the 250 kbit/s that
//! all nodes share.
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

use core::cell::RefCell;
use core::num::NonZeroU32;
use core::panic::PanicInfo;
use core::ptr::NonNull;

use agent_core::health::HealthSettings;
use agent_core::package::signature::PublicKey;
use agent_core::service::Subscription;
use agent_core::store::MappedFlash;
use agent_core::wire::frame::FRAME_LENGTH_MAX;
use cortex_m::peripheral::{NVIC, SCB};
use cortex_m_rt::{ExceptionFrame, entry, exception};
use critical_section::Mutex;
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash, check_erase, check_read, check_write,
};
use firmware_template::registers::Channel as Register;
use firmware_template::{
    Clock, Hardware, Link, Lost, Memory, Node, Periods, QueuedEnd, RegisterSensor, Settings,
    WeightsRegion, memory_map, queued_port,
};
use heapless::spsc::Queue;
use heapless::{Deque, Vec};
use nrf52840_hal as hal;
use static_cell::ConstStaticCell;

use hal::Clocks;
use hal::clocks::{ExternalOscillator, Internal, LfOscStopped};
use hal::gpio::{Level, p0};
use hal::ieee802154::{Channel, Packet, Radio};
use hal::pac::{self, Interrupt, NVMC, RADIO, TIMER1, UART0, interrupt};
use hal::twim::{self, Twim};
use hal::wdt::{Watchdog, WatchdogHandle, count, handles};

/// State components of the plant.
const N: usize = 3;
/// Room for features, neighbours, entries of `Gamma`, samples for training.
const FEATURES: usize = 8;
const NEIGHBOURS: usize = 4;
const GAINS: usize = FEATURES;
const SAMPLES: usize = 64;

/// 2,480 MHz, above the usual channels of wireless networks.
const CHANNEL: Channel = Channel::_26;
/// The network that all nodes of one plant share.
const PAN: u16 = 0x4453;
/// Received frames that wait for a step.
const FRAMES: usize = 2 * NEIGHBOURS;
/// How often the radio looks for a free channel before a frame is given up.
const TRIES: u32 = 4;

/// Address and register of the TMP117; 7.8125 thousandths of a degree a count.
const SENSOR: u8 = 0x48;
static REGISTERS: [Register; 1] = [Register { register: 0, scale: 0.007_812_5, offset: 0.0 }];

/// Frequency of TIMER1. \[Hz\]
const TIMER_FREQUENCY: f32 = 16e6;
/// How often the processor wakes if there is nothing to sample: 0.1 s. \[tick\]
const HEARTBEAT: u32 = 1_600_000;
/// 8 s, far above the 0.6 s that the pages of a slot take to erase. \[1/32768 s\]
const WATCHDOG_PERIOD: u32 = 8 * 32_768;
/// How long what is queued for the service port may take to leave, before a reset. \[cycle\]
const FLUSH_DELAY_CYCLES: u32 = 64_000_000 / 10;

/// The radio needs the crystal, nothing here a clock that runs on while the chip sleeps.
type ClocksForRadio = Clocks<ExternalOscillator, Internal, LfOscStopped>;

type ThisNode = Node<'static, Flash, N, FEATURES, NEIGHBOURS, GAINS, SAMPLES>;

static MEMORY: ConstStaticCell<Memory<N, FEATURES, NEIGHBOURS, SAMPLES>> =
    ConstStaticCell::new(Memory::new());
static SERVICE: Mutex<RefCell<Option<Uart>>> = Mutex::new(RefCell::new(None));
static RECEIVER: Mutex<RefCell<Option<Receiver>>> = Mutex::new(RefCell::new(None));

#[entry]
fn main() -> ! {
    let Some(chip) = pac::Peripherals::take() else { SCB::sys_reset() };
    let watchdog = watchdog(chip.WDT);
    let clocks =
        cortex_m::singleton!(: ClocksForRadio = Clocks::new(chip.CLOCK).enable_ext_hfosc());
    let pins = p0::Parts::new(chip.P0);

    let queues = cortex_m::singleton!(: [Queue<u8, 2048>; 2] = [const { Queue::new() }; 2]);
    let buffer = cortex_m::singleton!(: [u8; Receiver::BUFFER] = [0; _]);
    let (Some(clocks), Some([service_in, service_out]), Some(buffer)) = (clocks, queues, buffer)
    else {
        SCB::sys_reset()
    };
    let wake = || NVIC::pend(Interrupt::UARTE0_UART0);
    let (service, end) = queued_port(service_in, service_out, wake);
    let transmit = pins.p0_06.into_push_pull_output(Level::High).degrade();
    let receive = pins.p0_08.into_floating_input().degrade();
    let uart = Uart::new(chip.UART0, transmit.psel_bits(), receive.psel_bits(), end);
    critical_section::with(|token| SERVICE.borrow(token).replace(Some(uart)));

    let bus = twim::Pins {
        scl: pins.p0_27.into_floating_input().degrade(),
        sda: pins.p0_26.into_floating_input().degrade(),
    };
    let bus = Twim::new(chip.TWIM0, bus, twim::Frequency::K400);
    let Ok(sensor) = RegisterSensor::new(bus, SENSOR, &REGISTERS) else { SCB::sys_reset() };

    // Two bytes of the number that the factory gave this chip.
    let address = chip.FICR.deviceid[0].read().bits() as u16;
    let link = RadioLink::new(Radio::init(chip.RADIO, clocks), buffer, address);
    let clock = Timer::new(chip.TIMER1, watchdog);
    for interrupt in [Interrupt::TIMER1, Interrupt::UARTE0_UART0, Interrupt::RADIO] {
        // SAFETY: what the handlers use is in place, and nobody relies on their being masked.
        unsafe { NVIC::unmask(interrupt) };
    }

    let region = memory_map!().region();
    let settings = Settings {
        layout: region.layout,
        public_key: public_key(),
        health: HealthSettings::RECOMMENDED,
        good_steps: const { NonZeroU32::new(100).unwrap() },
        sample_stride: NonZeroU32::MIN,
        // Once a second, at the period of 0.1 s that a package for this link might have.
        subscription: Subscription { state_every: NonZeroU32::new(10), outer_weights: false },
        // Which agent this is, its package says.
        fallback: None,
        stack_unused: None,
        version: [0, 1, 0],
    };
    // SAFETY: memory.x gives this region to nobody else, and this is the only call.
    let flash = unsafe { Flash::new(chip.NVMC, &region) };
    let mut board = Hardware::new(sensor, link, clock, service);
    let mut node = ThisNode::new(flash, settings, MEMORY.take());
    if let Ok(node) = &mut node {
        node.run(&mut board);
    }
    cortex_m::asm::delay(FLUSH_DELAY_CYCLES);
    SCB::sys_reset()
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

/// Starts the watchdog, or finds the one that has outlived a reset.
fn watchdog(wdt: pac::WDT) -> Option<WatchdogHandle<handles::Hdl0>> {
    let parts = match Watchdog::try_new(wdt) {
        Ok(mut watchdog) => {
            watchdog.set_lfosc_ticks(WATCHDOG_PERIOD);
            watchdog.run_during_sleep(true);
            Some(watchdog.activate::<count::One>())
        }
        Err(wdt) => Watchdog::try_recover::<count::One>(wdt).ok(),
    };
    let (mut handle,) = parts?.handles;
    handle.pet();
    Some(handle)
}

/// What the interrupt does for the service port. The plain UART rather than the one with DMA: its
/// receiver keeps six bytes by itself, and needs no buffer that is full before anybody hears of it.
struct Uart {
    uart: UART0,
    end: QueuedEnd<'static>,
    sending: bool,
}

impl Uart {
    fn new(uart: UART0, transmit: u32, receive: u32, end: QueuedEnd<'static>) -> Self {
        // SAFETY: the pins are ones that this chip has, and the peripheral is not yet enabled.
        unsafe {
            uart.psel.txd.write(|w| w.bits(transmit));
            uart.psel.rxd.write(|w| w.bits(receive));
        }
        uart.baudrate.write(|w| w.baudrate().baud115200());
        uart.enable.write(|w| w.enable().enabled());
        uart.intenset.write(|w| w.rxdrdy().set().txdrdy().set());
        uart.tasks_startrx.write(|w| w.tasks_startrx().set_bit());
        uart.tasks_starttx.write(|w| w.tasks_starttx().set_bit());
        Self { uart, end, sending: false }
    }

    fn serve(&mut self) {
        while self.uart.events_rxdrdy.read().events_rxdrdy().bit_is_set() {
            self.uart.events_rxdrdy.reset();
            self.end.put(self.uart.rxd.read().rxd().bits());
        }
        if self.uart.events_txdrdy.read().events_txdrdy().bit_is_set() {
            self.uart.events_txdrdy.reset();
            self.sending = false;
        }
        if !self.sending
            && let Some(byte) = self.end.take()
        {
            self.sending = true;
            // SAFETY: every value is one that this register takes.
            self.uart.txd.write(|w| unsafe { w.txd().bits(byte) });
        }
    }
}

#[interrupt]
fn UARTE0_UART0() {
    critical_section::with(|token| {
        if let Some(uart) = SERVICE.borrow_ref_mut(token).as_mut() {
            uart.serve();
        }
    });
}

/// The start of a data frame from a short address to all of one network, without acknowledgement
/// (IEEE 802.15.4-2006, 7.2): frame control, sequence number, network, destination, source.
struct Header;

impl Header {
    const LENGTH: usize = 9;
    const CONTROL: [u8; 2] = 0x8841_u16.to_le_bytes();
    const EVERYBODY: [u8; 2] = [0xff; 2];

    fn of(sequence: u8, source: u16) -> [u8; Self::LENGTH] {
        let [[c0, c1], [p0, p1], [e0, e1]] = [Self::CONTROL, PAN.to_le_bytes(), Self::EVERYBODY];
        let [s0, s1] = source.to_le_bytes();
        [c0, c1, sequence, p0, p1, e0, e1, s0, s1]
    }

    /// What such a frame of our network carries.
    fn strip(bytes: &[u8]) -> Option<&[u8]> {
        let (header, content) = bytes.split_first_chunk::<{ Self::LENGTH }>()?;
        let [c0, c1, _, p0, p1, e0, e1, _, _] = *header;
        let expected = [Self::CONTROL, PAN.to_le_bytes(), Self::EVERYBODY];
        ([[c0, c1], [p0, p1], [e0, e1]] == expected).then_some(content)
    }
}

const _: () = assert!(Header::LENGTH + FRAME_LENGTH_MAX <= Packet::CAPACITY as usize);

/// What the interrupt does for the link.
struct Receiver {
    radio: RADIO,
    /// Where the radio writes: length, content, link quality.
    buffer: NonNull<[u8; Receiver::BUFFER]>,
    frames: Deque<Vec<u8, FRAME_LENGTH_MAX>, FRAMES>,
}

// SAFETY: nobody else has a pointer to the buffer, which lives for ever.
unsafe impl Send for Receiver {}

impl Receiver {
    const BUFFER: usize = 128;
    /// Of the frame check sequence, which the length counts and the radio keeps. \[byte\]
    const CHECK: usize = 2;

    /// Begins to listen; the radio must not be sending.
    fn listen(&mut self) {
        self.radio.events_end.reset();
        self.radio.events_framestart.reset();
        // SAFETY: the buffer is as long as the longest frame, and lives for ever.
        self.radio.packetptr.write(|w| unsafe { w.bits(self.buffer.as_ptr() as u32) });
        self.radio.shorts.write(|w| w.rxready_start().set_bit());
        cortex_m::asm::dmb();
        while self.radio.state.read().state().is_tx_disable() {}
        if self.radio.state.read().state().is_rx_idle() {
            self.radio.tasks_start.write(|w| w.tasks_start().set_bit());
        } else {
            self.radio.tasks_rxen.write(|w| w.tasks_rxen().set_bit());
        }
    }

    /// Stops listening, once a frame that is arriving has done so.
    fn stop(&mut self) {
        // 127 bytes of 32 us each, at 64 cycles a microsecond and some cycles for each look.
        for _ in 0..127 * 32 * 64 / 8 {
            let arriving = self.radio.events_framestart.read().events_framestart().bit_is_set();
            if !arriving || self.radio.events_end.read().events_end().bit_is_set() {
                break;
            }
        }
        self.take();
        // A receiver that is still starting would not hear that it is to stop.
        while self.radio.state.read().state().is_rx_ru() {}
        self.radio.shorts.reset();
        self.radio.tasks_stop.write(|w| w.tasks_stop().set_bit());
        while self.radio.state.read().state().is_rx() {}
        cortex_m::asm::dmb();
    }

    /// Puts a frame that has arrived into the queue; returns whether one had.
    fn take(&mut self) -> bool {
        if self.radio.events_end.read().events_end().bit_is_clear() {
            return false;
        }
        self.radio.events_end.reset();
        cortex_m::asm::dmb();
        if self.radio.crcstatus.read().crcstatus().bit_is_set() {
            // SAFETY: the radio has ended its frame and is not started again while this borrows.
            let [length, content @ ..] = unsafe { self.buffer.as_ref() };
            let length = usize::from(*length).checked_sub(Self::CHECK);
            let frame = length.and_then(|length| Header::strip(content.get(..length)?));
            if let Some(frame) = frame.and_then(|frame| Vec::from_slice(frame).ok()) {
                // What there is no room for is lost.
                let _ = self.frames.push_back(frame);
            }
        }
        true
    }
}

#[interrupt]
fn RADIO() {
    critical_section::with(|token| {
        if let Some(receiver) = RECEIVER.borrow_ref_mut(token).as_mut()
            && receiver.take()
        {
            receiver.listen();
        }
    });
}

/// The link through the radio: the HAL sets it up and sends, the interrupt receives.
struct RadioLink {
    radio: Radio<'static>,
    packet: Packet,
    address: u16,
    sequence: u8,
    /// State of the generator of waiting times, different on each node.
    random: u32,
}

impl RadioLink {
    fn new(
        mut radio: Radio<'static>,
        buffer: &'static mut [u8; Receiver::BUFFER],
        address: u16,
    ) -> Self {
        radio.set_channel(CHANNEL);
        // SAFETY: the HAL's radio and this one take turns: the interrupt is masked while the HAL
        // sends, and the HAL is only asked to send.
        let registers = unsafe { pac::Peripherals::steal() }.RADIO;
        registers.intenset.write(|w| w.end().set());
        let mut receiver =
            Receiver { radio: registers, buffer: NonNull::from(buffer), frames: Deque::new() };
        receiver.listen();
        critical_section::with(|token| RECEIVER.borrow(token).replace(Some(receiver)));
        let random = u32::from(address);
        Self { radio, packet: Packet::new(), address, sequence: 0, random }
    }

    /// 1 to 8 times the 320 us that IEEE 802.15.4 counts waiting times in. \[cycle\]
    fn waiting_time(&mut self) -> u32 {
        // A linear congruential generator with the constants of Numerical Recipes.
        self.random = self.random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (1 + (self.random >> 29)) * 320 * 64
    }
}

impl Link for RadioLink {
    type Error = Lost;

    fn send(&mut self, frame: &[u8]) -> Result<(), Lost> {
        let mut bytes = Vec::<u8, { Header::LENGTH + FRAME_LENGTH_MAX }>::new();
        let header = Header::of(self.sequence, self.address);
        self.sequence = self.sequence.wrapping_add(1);
        if bytes.extend_from_slice(&header).is_err() || bytes.extend_from_slice(frame).is_err() {
            return Err(Lost);
        }
        self.packet.copy_from_slice(&bytes);
        // The interrupt would come for ever if it found no receiver, so it is masked. The others
        // go on: sending takes milliseconds.
        NVIC::mask(Interrupt::RADIO);
        let receiver = critical_section::with(|token| RECEIVER.take(token));
        let mut receiver = receiver.ok_or(Lost)?;
        let mut sent = false;
        for attempt in 0..TRIES {
            if attempt > 0 {
                cortex_m::asm::delay(self.waiting_time());
            }
            receiver.stop();
            sent = self.radio.try_send(&mut self.packet).is_ok();
            receiver.listen();
            if sent {
                break;
            }
        }
        critical_section::with(|token| RECEIVER.replace(token, Some(receiver)));
        // SAFETY: it was so before, and what the handler uses is in place.
        unsafe { NVIC::unmask(Interrupt::RADIO) };
        if sent { Ok(()) } else { Err(Lost) }
    }

    fn poll<'buffer>(&mut self, buffer: &'buffer mut [u8]) -> Result<Option<&'buffer [u8]>, Lost> {
        let frame = critical_section::with(|token| {
            RECEIVER.borrow_ref_mut(token).as_mut()?.frames.pop_front()
        });
        let Some(frame) = frame else { return Ok(None) };
        let place = buffer.get_mut(..frame.len()).ok_or(Lost)?;
        place.copy_from_slice(&frame);
        Ok(Some(place))
    }
}

/// TIMER1, a counter of 32 bits, and the watchdog that is fed with it.
struct Timer {
    timer: TIMER1,
    watchdog: Option<WatchdogHandle<handles::Hdl0>>,
    periods: Periods,
}

impl Timer {
    /// Lets the counter run.
    fn new(timer: TIMER1, watchdog: Option<WatchdogHandle<handles::Hdl0>>) -> Self {
        timer.bitmode.write(|w| w.bitmode()._32bit());
        // SAFETY: 16 MHz, undivided.
        timer.prescaler.write(|w| unsafe { w.prescaler().bits(0) });
        timer.intenset.write(|w| w.compare0().set());
        timer.tasks_start.write(|w| w.tasks_start().set_bit());
        Self { timer, watchdog, periods: Periods::new(HEARTBEAT) }
    }

    fn now(&self) -> u32 {
        self.timer.tasks_capture[1].write(|w| w.tasks_capture().set_bit());
        self.timer.cc[1].read().bits()
    }
}

impl Clock for Timer {
    fn start(&mut self, period: f32) {
        let now = self.now();
        self.periods.start(period, TIMER_FREQUENCY, now);
    }

    fn elapsed(&mut self) -> u32 {
        if let Some(watchdog) = &mut self.watchdog {
            watchdog.pet();
        }
        let now = self.now();
        self.periods.elapsed(now)
    }

    /// An interrupt that comes before the instruction sets the event that it waits for, so none
    /// is slept through.
    fn rest(&mut self) {
        // SAFETY: every value is one that this register takes.
        self.timer.cc[0].write(|w| unsafe { w.bits(self.periods.next()) });
        // What comes before the register is set does not wake.
        if !self.periods.is_due(self.now()) {
            cortex_m::asm::wfe();
        }
    }
}

#[interrupt]
fn TIMER1() {
    // SAFETY: only this touches the event, and `Timer` is not disturbed by it.
    let timer = unsafe { &*TIMER1::ptr() };
    timer.events_compare[0].reset();
    // The bus takes its time, and the interrupt would come again.
    let _ = timer.events_compare[0].read();
}

/// The chip's own flash. The HAL's driver is not used: it borrows the region exclusively, so that
/// nobody could read a package in place.
struct Flash {
    nvmc: NVMC,
    origin: usize,
    length: usize,
}

impl Flash {
    /// # Safety
    /// The region is flash, in whole pages, and nobody else may have it.
    unsafe fn new(nvmc: NVMC, region: &WeightsRegion) -> Self {
        Self { nvmc, origin: region.origin, length: region.length }
    }

    fn finish(&self) {
        // Also tells the compiler that memory has changed.
        cortex_m::asm::dsb();
        while self.nvmc.ready.read().ready().bit_is_clear() {}
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
    const ERASE_SIZE: usize = 4096;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        check_erase(self, from, to)?;
        self.nvmc.config.write(|w| w.wen().een());
        for page in (from..to).step_by(Self::ERASE_SIZE) {
            let address = self.origin as u32 + page;
            // SAFETY: the page lies in the region that is ours.
            self.nvmc.erasepage().write(|w| unsafe { w.bits(address) });
            self.finish();
        }
        self.nvmc.config.write(|w| w.wen().ren());
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        check_write(self, offset, bytes.len())?;
        let (words, _) = bytes.as_chunks();
        let first = core::ptr::with_exposed_provenance_mut::<u32>(self.origin + offset as usize);
        self.nvmc.config.write(|w| w.wen().wen());
        for (index, word) in words.iter().enumerate() {
            // SAFETY: the word lies in the region that is ours, aligned; nothing borrows from it,
            // since `self` is borrowed exclusively.
            unsafe { first.add(index).write_volatile(u32::from_le_bytes(*word)) };
            self.finish();
        }
        self.nvmc.config.write(|w| w.wen().ren());
        Ok(())
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
