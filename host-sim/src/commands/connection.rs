//! Connects commands to a running node.

use std::time::Duration;

use crate::interruption;
use crate::keys::KeyFolder;
use crate::service::address::AddressError;
use crate::service::{Address, Client, RetryPolicy};

/// Timeout and number of tries of a request; erasing flash takes time.
pub(super) const RETRY_POLICY: RetryPolicy =
    RetryPolicy { timeout: Duration::from_secs(3), tries: 3 };

/// Connects to the node at `address`, and delimits the first message. Requests are sealed if there are
/// keys and the node is provisioned.
pub(super) fn connect(address: &Address, keys: Option<&KeyFolder>) -> Result<Client, AddressError> {
    let mut client = Client::new(address.connect(interruption::stop())?);
    if let Some(keys) = keys {
        client.set_keys(keys.fleet().port_keys());
    }
    client.prepare_delimiter();
    Ok(client)
}
