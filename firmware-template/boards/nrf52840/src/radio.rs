//! The link: IEEE 802.15.4 data frames to all nodes of one network.
//!
//! The radio listens whenever it is not sending. Its interrupt puts each complete frame into a
//! queue of [`FRAMES`] and restarts reception within microseconds; the next frame starts with a
//! preamble of 160 us, so none is lost between two calls. Frames that arrive while this node sends
//! or erases flash are lost.

use core::ptr::NonNull;

use agent_core::wire::LENGTH_MAX;
use cortex_m::peripheral::NVIC;
use firmware_template::on_chip::Shared;
use firmware_template::{Link, LinkErrorKind};
use hal::ieee802154::{Channel, Packet, Radio};
use hal::pac::{self, Interrupt, RADIO, interrupt};
use heapless::{Deque, Vec};
use nrf52840_hal as hal;
use static_cell::{ConstStaticCell, StaticCell};

/// 2,480 MHz, above the usual channels of wireless networks.
const CHANNEL: Channel = Channel::_26;
/// The network shared by all nodes of one plant.
const PAN: u16 = 0x4453;
/// Length of the queue of received frames.
const FRAMES: usize = 2 * crate::NEIGHBOURS;
/// Number of attempts to find the channel free before a frame is dropped.
const TRIES: u32 = 4;

/// Holds the receiver for the interrupt, while the link does not use it.
static RECEIVER: Shared<&'static mut Receiver> = Shared::new();
static RECEIVER_PLACE: StaticCell<Receiver> = StaticCell::new();
static BUFFER: ConstStaticCell<[u8; Receiver::BUFFER]> = ConstStaticCell::new([0; _]);

/// The header of an unacknowledged data frame from a short address to all of one network (IEEE
/// 802.15.4-2006, 7.2): frame control, sequence number, network, destination, source.
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

    /// Returns the payload of a frame of our network.
    fn strip(bytes: &[u8]) -> Option<&[u8]> {
        let (header, content) = bytes.split_first_chunk::<{ Self::LENGTH }>()?;
        let [c0, c1, _, p0, p1, e0, e1, _, _] = *header;
        let expected = [Self::CONTROL, PAN.to_le_bytes(), Self::EVERYBODY];
        ([[c0, c1], [p0, p1], [e0, e1]] == expected).then_some(content)
    }
}

const _: () = assert!(Header::LENGTH + LENGTH_MAX <= Packet::CAPACITY as usize);

/// The interrupt's part of the link.
struct Receiver {
    radio: RADIO,
    /// Receive buffer: length, content, link quality.
    buffer: NonNull<[u8; Receiver::BUFFER]>,
    frames: Deque<Vec<u8, LENGTH_MAX>, FRAMES>,
    /// Why the last frame was lost of those since the link was polled.
    lost: Option<LinkErrorKind>,
}

// SAFETY: there is no other pointer to the buffer, which lives for ever.
unsafe impl Send for Receiver {}

impl Receiver {
    const BUFFER: usize = 128;
    /// Length of the frame check sequence, which the length field includes but the radio does not
    /// store. \[byte\]
    const CHECK: usize = 2;

    /// Starts listening; the radio must not be sending.
    fn listen(&mut self) {
        self.radio.events_end.reset();
        self.radio.events_framestart.reset();
        // SAFETY: the buffer is as long as the longest frame, and static.
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

    /// Stops listening, after any frame that is being received.
    fn stop(&mut self) {
        // 127 bytes of 32 us each, at 64 cycles per microsecond and some cycles per poll.
        for _ in 0..127 * 32 * 64 / 8 {
            let arriving = self.radio.events_framestart.read().events_framestart().bit_is_set();
            if !arriving || self.radio.events_end.read().events_end().bit_is_set() {
                break;
            }
        }
        self.take();
        // A receiver that is still starting would ignore the stop task.
        while self.radio.state.read().state().is_rx_ru() {}
        self.radio.shorts.reset();
        self.radio.tasks_stop.write(|w| w.tasks_stop().set_bit());
        while self.radio.state.read().state().is_rx() {}
        cortex_m::asm::dmb();
    }

    /// Moves a received frame into the queue; returns whether there was one.
    fn take(&mut self) -> bool {
        if self.radio.events_end.read().events_end().bit_is_clear() {
            return false;
        }
        self.radio.events_end.reset();
        cortex_m::asm::dmb();
        if self.radio.crcstatus.read().crcstatus().bit_is_set() {
            // SAFETY: the radio has finished its frame and is not restarted during this borrow.
            let [length, content @ ..] = unsafe { self.buffer.as_ref() };
            let length = usize::from(*length).checked_sub(Self::CHECK);
            let frame = length.and_then(|length| Header::strip(content.get(..length)?));
            // What others say on this channel is not a frame of this link.
            if let Some(frame) = frame.and_then(|frame| Vec::from_slice(frame).ok())
                && self.frames.push_back(frame).is_err()
            {
                self.lost = Some(LinkErrorKind::Overflow);
            }
        } else {
            self.lost = Some(LinkErrorKind::Damaged);
        }
        true
    }
}

#[interrupt]
fn RADIO() {
    RECEIVER.with(|receiver| {
        if receiver.take() {
            receiver.listen();
        }
    });
}

/// The radio link: the HAL sets up the radio and sends, the interrupt receives.
pub(crate) struct RadioLink {
    radio: Radio<'static>,
    packet: Packet,
    address: u16,
    sequence: u8,
    /// State of the random back-off generator, different on each node.
    random: u32,
}

impl RadioLink {
    pub(crate) fn new(mut radio: Radio<'static>, address: u16) -> Self {
        radio.set_channel(CHANNEL);
        // SAFETY: the HAL's radio and this one are never used at the same time: the interrupt is
        // masked while the HAL sends, and the HAL only sends.
        let registers = unsafe { pac::Peripherals::steal() }.RADIO;
        registers.intenset.write(|w| w.end().set());
        let buffer = NonNull::from(BUFFER.take());
        let receiver = RECEIVER_PLACE.init_with(|| Receiver {
            radio: registers,
            buffer,
            frames: Deque::new(),
            lost: None,
        });
        receiver.listen();
        RECEIVER.set(receiver);
        let random = u32::from(address);
        Self { radio, packet: Packet::new(), address, sequence: 0, random }
    }

    /// Returns a random back-off time: 1 to 8 times the 320 us unit of IEEE 802.15.4. \[cycle\]
    fn waiting_time(&mut self) -> u32 {
        // A linear congruential generator with the constants of Numerical Recipes.
        self.random = self.random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (1 + (self.random >> 29)) * 320 * 64
    }
}

impl Link for RadioLink {
    type Error = LinkErrorKind;

    fn send(&mut self, frame: &[u8]) -> Result<(), LinkErrorKind> {
        let mut bytes = Vec::<u8, { Header::LENGTH + LENGTH_MAX }>::new();
        let header = Header::of(self.sequence, self.address);
        self.sequence = self.sequence.wrapping_add(1);
        if bytes.extend_from_slice(&header).is_err() || bytes.extend_from_slice(frame).is_err() {
            return Err(LinkErrorKind::NotSent);
        }
        self.packet.copy_from_slice(&bytes);
        // Without a receiver the interrupt would fire endlessly, so it is masked. The others stay
        // enabled: sending takes milliseconds.
        NVIC::mask(Interrupt::RADIO);
        let receiver = RECEIVER.take().ok_or(LinkErrorKind::NotSent)?;
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
        RECEIVER.set(receiver);
        // SAFETY: it was unmasked before, and everything the handler uses is set up.
        unsafe { NVIC::unmask(Interrupt::RADIO) };
        if sent { Ok(()) } else { Err(LinkErrorKind::NotSent) }
    }

    /// Returns what has been lost once there are no more frames, so that it holds none up.
    fn poll<'buffer>(
        &mut self,
        buffer: &'buffer mut [u8],
    ) -> Result<Option<&'buffer [u8]>, LinkErrorKind> {
        let received = RECEIVER.with(|receiver| match receiver.frames.pop_front() {
            Some(frame) => Ok(Some(frame)),
            None => receiver.lost.take().map_or(Ok(None), Err),
        });
        let Some(frame) = received.transpose()?.flatten() else { return Ok(None) };
        let place = buffer.get_mut(..frame.len()).ok_or(LinkErrorKind::Overflow)?;
        place.copy_from_slice(&frame);
        Ok(Some(place))
    }
}
