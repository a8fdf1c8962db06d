//! Authentic frames and sealed requests: their bytes, and what they cost.

use agent_core::service::Seal;
use agent_core::service::seal::PortKey;
use agent_core::wire::authentic::{self, Header, Kind, NetworkKey, Stamp};
use agent_core::wire::secret::Secret;

use crate::Unusable;
use crate::digest::Digest;
use crate::draw::{scaled, triangle};
use crate::meter::{Figure, Figures, Meter};

const ROUNDS: u32 = 100;
/// Length of the longest request before it is sealed: a chunk of a package, with what is around it.
const REQUEST: usize = 140;

#[inline(never)]
pub(crate) fn digest(meter: &mut impl Meter, figures: &mut Figures) -> Result<u64, Unusable> {
    let mut digest = Digest::NEW;
    let (network, port) = (NetworkKey::new(3, Secret::new([0x3c; 16])), Secret::new([0x55; 16]));
    let port = PortKey::new(port);
    for round in 0..ROUNDS {
        let estimate = [0, 75, 150].map(|phase| scaled(triangle(round + phase, 300), 8));
        let stamp = Stamp { epoch: 1_795_952_445 + round, sequence: 41 * round };
        let kind = match round % 10 {
            9 => Kind::Sync { to: 3, epoch: round },
            _ => Kind::Estimate,
        };
        let header = Header { sender: 2, stamp, tick: (1_000 * round).into(), kind };
        let (bytes, instructions) =
            meter.count(|| authentic::seal(&header, &estimate.map(f32::to_le_bytes), &network));
        figures.add(Figure::Tag, instructions);
        digest.bytes(&bytes);
        let (opened, instructions) =
            meter.count(|| authentic::open(&bytes, &[network]).map(|(header, _)| header));
        figures.add(Figure::TagCheck, instructions);
        if opened != Ok(header) {
            return Err(Unusable { what: "a sealed frame cannot be opened" });
        }
        let mut request = [round as u8; REQUEST];
        let seal = Seal { counter: round, salt: [round as u8; 8] };
        let tag = port.seal(stamp.epoch, &seal, &mut request);
        digest.bytes(&request);
        digest.bytes(&tag);
        let mut sealed = [0; REQUEST + 16];
        let all = request.iter().chain(&tag);
        sealed.iter_mut().zip(all).for_each(|(place, byte)| *place = *byte);
        let (is_open, instructions) =
            meter.count(|| port.open(stamp.epoch, &seal, &mut sealed).is_some());
        figures.add(Figure::Seal, instructions);
        digest.number(is_open.into());
    }
    Ok(digest.finish())
}
