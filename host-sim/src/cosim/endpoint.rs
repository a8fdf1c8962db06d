//! What nodes run on, as given on the command line.

use std::fmt;
use std::str::FromStr;

use crate::service::Address;

/// What a node runs on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Endpoint {
    /// An emulator started for the node, over two pipes, which is fastest.
    Qemu,
    /// An emulator started for the node, over a serial line like a real board's.
    QemuUart,
    /// A running node: a real board on a serial line, or a separate emulator behind a socket.
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
            _ => Err("expected qemu, qemu-uart, serial:/dev/tty...[@BAUD] or unix:PATH".into()),
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

/// Returns one endpoint per agent, from a list of one for all or one for each.
///
/// # Errors
/// If the number does not match, or a running node is given for more than one agent.
pub fn for_agents(list: &[Endpoint], agents: usize) -> Result<Vec<Endpoint>, String> {
    let endpoints = match list {
        [one] => vec![one.clone(); agents],
        list if list.len() == agents => list.to_vec(),
        list => {
            let found = list.len();
            return Err(format!(
                "{found} boards for {agents} agents; give one for all, or one for each, \
                 separated by commas"
            ));
        }
    };
    for (index, endpoint) in endpoints.iter().enumerate() {
        let shared = matches!(endpoint, Endpoint::At(_)) && endpoints[..index].contains(endpoint);
        if shared {
            return Err(format!("{endpoint} is one board; give a separate one for each agent"));
        }
    }
    Ok(endpoints)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_emulated_board_can_be_given_once_for_all_agents() {
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
