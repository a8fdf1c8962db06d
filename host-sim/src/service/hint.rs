//! Hints for refusals, and for received bytes that are not messages.

use agent_core::service::Problem;
use agent_core::store::StoreError;

use super::address::BAUD;
use crate::packages::refusal::hint;

/// Returns the hint for a refusal by a node.
#[must_use]
pub fn of_refusal(problem: Problem) -> &'static str {
    match problem {
        Problem::Store(error) => of_store(error),
        Problem::Package(report) => hint(report.kind),
        Problem::NoPackage => "push a package first",
        Problem::NotInTheLoop | Problem::Unknown => {
            "build firmware and host-sim from the same source"
        }
        Problem::Estimate => "give a finite estimate of the state's dimension",
        Problem::NotSealed => "pass the key folder it was provisioned from with `--keys FOLDER`",
        Problem::Seal => {
            "check that `--keys FOLDER` is the folder it was provisioned from and that no other program is \
             using the node, and try again"
        }
        Problem::NotProvisioned => {
            "provision it first with `host-sim node ENDPOINT provision --keys FOLDER --agent N`"
        }
        Problem::NotSigned => {
            "use the key folder whose operator.pub.pem is built into its firmware, or build the firmware \
             with this folder's public key"
        }
    }
}

fn of_store(error: StoreError) -> &'static str {
    match error {
        StoreError::Flash(_) | StoreError::Verify { .. } | StoreError::Unreadable { .. } => {
            "the node's flash failed: check supply voltage and memory map, power-cycle the board, and \
             try again; if it fails again, replace the board"
        }
        StoreError::OnTrial => {
            "end the trial of the current package with `host-sim node ENDPOINT confirm` or `revert`"
        }
        StoreError::NotOnTrial => {
            "only a package on trial can be confirmed or reverted; to go back to an older network, \
             push it with a newer version"
        }
        StoreError::Length { .. } => {
            "train a smaller network, or give the node larger slots in memory.x"
        }
        StoreError::NothingStaged => {
            "no package is waiting to be activated; push the package again"
        }
        StoreError::Damaged => "push it again; if this happens again, the node's flash is failing",
        StoreError::NotLoaded => "reset the node, and try again",
        _ => "wait until the other push has finished, and push again",
    }
}

/// Common baud rates. \[bit/s\]
const RATES: [u32; 9] = [9600, 19_200, 38_400, 57_600, BAUD, 230_400, 460_800, 921_600, 1_000_000];

/// Returns the hint for received bytes that are not messages, on a serial line of `baud` bits per
/// second or another connection. `changes` is the average number of differing adjacent bits per
/// byte: 3.5 in noise, and much less if each bit of a slower sender is read several times.
#[must_use]
pub fn of_garbage(baud: Option<u32>, changes: f64) -> String {
    let Some(baud) = baud else {
        return format!(
            "check that the other end is a node and, if a serial line is in between, that its baud rate \
             matches the node's ({BAUD} with this project's firmware)"
        );
    };
    let slower = changes < SLOWER;
    let mut rates: Vec<_> =
        RATES.into_iter().filter(|&rate| (rate < baud) == slower && rate != baud).collect();
    if slower {
        rates.reverse();
    }
    // Suggest the rate of this project's boards first.
    rates.sort_by_key(|&rate| rate != BAUD);
    let rates: Vec<_> = rates.iter().take(3).map(|rate| format!("@{rate}")).collect();
    let direction = if slower { "slower" } else { "faster" };
    format!(
        "the line is set to {baud} baud, but the received bytes look like a {direction} rate; try another \
         baud rate after the device, such as {}",
        if rates.is_empty() { format!("@{BAUD}") } else { rates.join(", ") }
    )
}

/// Average changes per byte below which the sender is slower.
const SLOWER: f64 = 2.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn store_errors_have_specific_hints() {
        let flash = of_refusal(Problem::Store(StoreError::Verify { offset: 4 }));
        assert!(flash.contains("flash failed") && !flash.contains("train"), "{flash}");
        let other = of_refusal(Problem::Store(StoreError::Conflict { offset: 128 }));
        assert!(other.contains("other push") && !other.contains("train"), "{other}");
        let revert = of_refusal(Problem::Store(StoreError::NotOnTrial));
        assert!(revert.contains("newer version"), "{revert}");
    }

    #[test]
    fn likely_baud_rates_are_suggested() {
        // Reading too fast repeats every bit; reading too slowly yields noise.
        assert!(
            of_garbage(Some(230_400), 1.1).contains("slower rate"),
            "{}",
            of_garbage(Some(230_400), 1.1)
        );
        let hint = of_garbage(Some(230_400), 1.1);
        assert!(hint.ends_with("@115200, @57600, @38400"), "{hint}");
        let hint = of_garbage(Some(9600), 3.5);
        assert!(
            hint.contains("faster rate") && hint.ends_with("@115200, @19200, @38400"),
            "{hint}"
        );
        let hint = of_garbage(Some(BAUD), 3.5);
        assert!(hint.ends_with("@230400, @460800, @921600"), "{hint}");
        assert!(of_garbage(None, 3.5).contains("baud rate"));
    }
}
