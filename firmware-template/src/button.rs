//! A button that must be held for a while.

/// Returns whether a button is pressed, and stays so while `wait` is called 100 times. Ends the first
/// time that it is not, so that a start without the button takes no time.
pub fn is_held(mut is_pressed: impl FnMut() -> bool, mut wait: impl FnMut()) -> bool {
    (0..100).all(|_| {
        let is_pressed = is_pressed();
        if is_pressed {
            wait();
        }
        is_pressed
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// For a button that is pressed for this many looks.
    fn held(looks: u32) -> (bool, u32) {
        let (mut seen, mut waits) = (0, 0);
        let is_pressed = || {
            seen += 1;
            seen <= looks
        };
        (is_held(is_pressed, || waits += 1), waits)
    }

    #[test]
    fn only_a_button_that_stays_held_counts() {
        assert_eq!(held(0), (false, 0));
        assert_eq!(held(1), (false, 1));
        assert_eq!(held(99), (false, 99));
        assert_eq!(held(100), (true, 100));
    }
}
