//! All terminal output, with unsafe characters escaped.
//!
//! Results go to standard output, everything else to standard error. If standard error is full or
//! closed, messages are lost and nothing else happens. Errors of standard output are returned to
//! the caller; results already written to files are not affected.
//!
//! Names in files and messages are untrusted: a recipe's name could contain a sequence that clears
//! the screen, or characters that reverse the direction of text. Control characters other than the
//! line breaks and tabs of the text itself are escaped as in Rust: `\u{1b}`. All lines of a message
//! but the first are indented, so that a name with a line break cannot pose as a separate message.

use std::borrow::Cow;
use std::fmt::Display;
use std::io::{self, Write};

use serde::Serialize;

/// Whether a terminal would act on this character, or display the surrounding text out of order.
fn is_hidden(c: char) -> bool {
    c.is_control()
        || matches!(
            c,
            // Marks, embeddings, overrides and isolates of Unicode's bidirectional algorithm.
            '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{206f}'
            // Line and paragraph separators, interlinear annotations, tags.
            | '\u{2028}' | '\u{2029}' | '\u{fff9}'..='\u{fffb}' | '\u{e0000}'..='\u{e007f}'
        )
}

fn escaped(text: &str, stays: impl Fn(char) -> bool) -> Cow<'_, str> {
    let escape = |c: char| is_hidden(c) && !stays(c);
    if !text.chars().any(escape) {
        return Cow::Borrowed(text);
    }
    let mut visible = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        if escape(c) { visible.extend(c.escape_default()) } else { visible.push(c) }
    }
    Cow::Owned(visible)
}

/// Escapes every character that a terminal would act on, except line breaks and tabs.
#[must_use]
pub fn visible(text: &str) -> Cow<'_, str> {
    escaped(text, |c| matches!(c, '\n' | '\t'))
}

/// Escapes a name from a file so that it stays on one line.
#[must_use]
pub fn one_line(name: &str) -> Cow<'_, str> {
    escaped(name, |_| false)
}

/// Prints a result.
///
/// # Errors
/// Standard output cannot be written.
pub fn print(text: &str) -> io::Result<()> {
    write_output(visible(text).as_bytes())
}

/// Prints a result as one line of JSON.
///
/// # Errors
/// The error of standard output.
pub fn print_json(value: &impl Serialize) -> io::Result<()> {
    let mut line = json_text(value)?;
    line.push('\n');
    write_output(line.as_bytes())
}

/// Returns `value` as JSON, with characters escaped that JSON permits but a terminal would act on.
fn json_text(value: &impl Serialize) -> io::Result<String> {
    use std::fmt::Write as _;
    let json = serde_json::to_string(value).map_err(io::Error::from)?;
    if !json.chars().any(is_hidden) {
        return Ok(json);
    }
    let mut text = String::with_capacity(json.len() + 16);
    for c in json.chars() {
        if is_hidden(c) {
            // In JSON such characters appear only inside strings.
            for unit in c.encode_utf16(&mut [0; 2]) {
                // Writing into a string cannot fail.
                let _ = write!(text, "\\u{unit:04x}");
            }
        } else {
            text.push(c);
        }
    }
    Ok(text)
}

#[expect(clippy::disallowed_methods, reason = "the only place that prints")]
fn write_output(bytes: &[u8]) -> io::Result<()> {
    let mut output = io::stdout().lock();
    output.write_all(bytes)?;
    output.flush()
}

/// Prints `message` on standard error.
pub fn note(message: impl Display) {
    write_error(&visible(&format!("{message}\n")));
}

/// Prints a warning on standard error.
pub fn warning(message: impl Display) {
    write_error(&labelled("warning", &message.to_string()));
}

/// Prints an error on standard error.
pub fn error(message: impl Display) {
    write_error(&labelled("error", &message.to_string()));
}

fn labelled(label: &str, message: &str) -> String {
    format!("{label}: {}\n", visible(message).trim_end().replace('\n', "\n  "))
}

#[expect(clippy::disallowed_methods, reason = "the only place that prints")]
fn write_error(text: &str) {
    // If standard error is full or closed, the message is lost.
    let _ = io::stderr().lock().write_all(text.as_bytes());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn escapes_only_control_characters() {
        for (text, shown) in [
            ("Größe α → 3 µm\n\tnext", "Größe α → 3 µm\n\tnext"),
            ("\u{1b}[2J", "\\u{1b}[2J"),
            ("over\rwritten\u{8}", "over\\rwritten\\u{8}"),
            ("\u{9b}31m\u{7f}", "\\u{9b}31m\\u{7f}"),
            ("left\u{202e}right\u{2066}", "left\\u{202e}right\\u{2066}"),
        ] {
            assert_eq!(visible(text), shown);
        }
        assert_eq!(one_line("a\nb\tc"), "a\\nb\\tc");
    }

    #[test]
    fn name_cannot_pose_as_a_message() {
        let message = labelled("error", "no such file: x\nerror: all is lost\r\n");
        assert_eq!(message, "error: no such file: x\n  error: all is lost\\r\n");
    }

    #[test]
    fn escaped_json_round_trips() {
        let names = ["\u{1b}[2J", "\u{9b}31m", "\u{202e}", "\u{e0041}", "Größe"];
        let text = json_text(&names).unwrap();
        assert!(!text.chars().any(is_hidden), "{text}");
        assert!(text.contains("Größe") && text.contains("\\u009b") && text.contains("\\u202e"));
        let read: Vec<String> = serde_json::from_str(&text).unwrap();
        assert_eq!(read, names);
    }
}
