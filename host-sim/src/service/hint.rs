//! What to do about a refusal, and about bytes that are not messages.

use agent_core::service::Problem;
use agent_core::store::StoreError;

use super::address::BAUD;
use crate::packages::refusal::hint;

/// What to do if a node refuses for this reason.
#[must_use]
pub fn of_refusal(problem: Problem) -> &'static str {
    match problem {
        Problem::Store(error) => of_store(error),
        Problem::Package(report) => hint(report.kind),
        Problem::NoPackage => "push a package first",
        Problem::NotInTheLoop | Problem::Unknown => {
            "build firmware and host-sim from the same source"
        }
        Problem::Estimate => "give an estimate with as many finite numbers as the state has",
    }
}

fn of_store(error: StoreError) -> &'static str {
    match error {
        StoreError::Flash(_) | StoreError::Verify { .. } | StoreError::Unreadable { .. } => {
            "the node's flash fails: check its supply voltage and its memory map, switch it off and \
             on, and try again; if it fails again, replace the board"
        }
        StoreError::OnTrial => {
            "decide about the package on trial with `host-sim node ENDPOINT confirm` or `revert`"
        }
        StoreError::NotOnTrial => {
            "only a package on trial can be confirmed or reverted; to go back to an older network, \
             push it under a newer version"
        }
        StoreError::Length { .. } => {
            "train a smaller network, or give the node larger slots in memory.x"
        }
        StoreError::NothingStaged => "nothing waits for its activation; push the package again",
        StoreError::Damaged => "push it again; if this happens again, the node's flash fails",
        StoreError::NotLoaded => "reset the node, and try again",
        _ => "wait until the other push has ended, and push again",
    }
}

/// Usual rates of serial lines. \[bit/s\]
const RATES: [u32; 9] = [9600, 19_200, 38_400, 57_600, BAUD, 230_400, 460_800, 921_600, 1_000_000];

/// What to do about bytes without a message in them, on a serial line of `baud` bits a second or on
/// something else. `changes` is how often, on average, two neighbouring bits of a byte differ: half
/// of seven times in noise, and much less where each bit of a slower sender is read several times.
#[must_use]
pub fn of_garbage(baud: Option<u32>, changes: f64) -> String {
    let Some(baud) = baud else {
        return format!(
            "check that a node is at the other end and, if there is a serial line in between, that its \
             baud rate is that of the node ({BAUD} with the firmware of this project)"
        );
    };
    let slower = changes < SLOWER;
    let mut rates: Vec<_> =
        RATES.into_iter().filter(|&rate| (rate < baud) == slower && rate != baud).collect();
    if slower {
        rates.reverse();
    }
    // The rate of this project's boards is the first guess.
    rates.sort_by_key(|&rate| rate != BAUD);
    let rates: Vec<_> = rates.iter().take(3).map(|rate| format!("@{rate}")).collect();
    let direction = if slower { "slower" } else { "faster" };
    format!(
        "the line is read at {baud} baud, and what arrives looks like a {direction} one: write another \
         baud rate after the line's name, {}",
        if rates.is_empty() { format!("@{BAUD}") } else { rates.join(", ") }
    )
}

/// Fewer changes in a byte than this are those of a slower line.
const SLOWER: f64 = 2.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_push_a_failing_flash_and_an_old_package_have_hints_of_their_own() {
        let flash = of_refusal(Problem::Store(StoreError::Verify { offset: 4 }));
        assert!(flash.contains("flash fails") && !flash.contains("train"), "{flash}");
        let other = of_refusal(Problem::Store(StoreError::Conflict { offset: 128 }));
        assert!(other.contains("other push") && !other.contains("train"), "{other}");
        let revert = of_refusal(Problem::Store(StoreError::NotOnTrial));
        assert!(revert.contains("newer version"), "{revert}");
    }

    #[test]
    fn the_likely_baud_rate_is_named() {
        // A line that is read too fast shows every bit several times, one read too slowly is noise.
        assert!(
            of_garbage(Some(230_400), 1.1).contains("slower one"),
            "{}",
            of_garbage(Some(230_400), 1.1)
        );
        let told = of_garbage(Some(230_400), 1.1);
        assert!(told.ends_with("@115200, @57600, @38400"), "{told}");
        let told = of_garbage(Some(9600), 3.5);
        assert!(told.contains("faster one") && told.ends_with("@115200, @19200, @38400"), "{told}");
        let told = of_garbage(Some(BAUD), 3.5);
        assert!(told.ends_with("@230400, @460800, @921600"), "{told}");
        assert!(of_garbage(None, 3.5).contains("baud rate"));
    }
}
