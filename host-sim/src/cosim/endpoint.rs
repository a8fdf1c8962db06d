//! What nodes run on, as a command line names it.

use std::fmt;
use std::str::FromStr;

use crate::service::Address;

/// What a node runs on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Endpoint {
    /// An emulator that is started for it, with two pipes: the fastest way.
    Qemu,
    /// An emulator that is started for it, with the serial line that a real board has, too.
    QemuUart,
    /// Something that runs already: a real board on a serial line, or an emulator of one's own behind
    /// a socket.
    At(Address),
}

impl FromStr for Endpoint {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "qemu" => Ok(Self::Qemu),
            "qemu-uart" => Ok(Self::QemuUart),
            _ if text.starts_with("serial:") || text.starts_with("unix:") => {
                text.parse().map(Self::At)
            }
            _ => Err("there are qemu, qemu-uart, serial:/dev/tty...[@BAUD] and unix:PATH".into()),
        }
    }
}

impl fmt::Display for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Qemu => f.write_str("qemu"),
            Self::QemuUart => f.write_str("qemu-uart"),
            Self::At(address) => write!(f, "{address}"),
        }
    }
}

/// One endpoint for each of `agents` agents, from a list of one for all or one for each.
///
/// # Errors
/// Another number of them, or something that runs already for more than one agent.
pub fn for_agents(list: &[Endpoint], agents: usize) -> Result<Vec<Endpoint>, String> {
    let endpoints = match list {
        [one] => vec![one.clone(); agents],
        list if list.len() == agents => list.to_vec(),
        list => {
            let found = list.len();
            return Err(format!(
                "{found} boards for {agents} agents; name one for all, or one for each, \
                 separated by commas"
            ));
        }
    };
    for (index, endpoint) in endpoints.iter().enumerate() {
        let shared = matches!(endpoint, Endpoint::At(_)) && endpoints[..index].contains(endpoint);
        if shared {
            return Err(format!("{endpoint} is one board; name another for each agent"));
        }
    }
    Ok(endpoints)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_board_stands_for_all_that_can_be_started() {
        let list = |text: &str| -> Vec<Endpoint> {
            text.split(',').map(|entry| entry.parse().unwrap()).collect()
        };
        assert_eq!(for_agents(&list("qemu"), 3).unwrap(), list("qemu,qemu,qemu"));
        let mixed = list("qemu,qemu-uart,serial:/dev/ttyUSB0@9600");
        assert_eq!(for_agents(&mixed, 3).unwrap(), mixed);
        assert!(for_agents(&mixed, 4).unwrap_err().starts_with("3 boards for 4 agents"));
        let one = for_agents(&list("serial:/dev/ttyUSB0"), 2).unwrap_err();
        assert!(one.contains("is one board"), "{one}");
        assert!("renode".parse::<Endpoint>().is_err());
    }
}
