//! Quoting for command lines that are printed for the user to copy.

use std::path::Path;

/// Returns `text` as one word of a Unix shell.
#[must_use]
pub fn quoted(text: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "_-./+:=@%,".contains(c);
    if !text.is_empty() && text.chars().all(plain) {
        text.to_owned()
    } else {
        format!("'{}'", text.replace('\'', r"'\''"))
    }
}

/// Returns the path in a form that no program mistakes for an option.
#[must_use]
pub fn path_argument(file: &Path) -> String {
    let name = file.display().to_string();
    if name.starts_with('-') { format!("./{name}") } else { name }
}

/// Returns the path as one word of a Unix shell.
#[must_use]
pub fn shell_word(file: &Path) -> String {
    quoted(&path_argument(file))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_become_one_shell_word() {
        let words = [
            ("out/node-1.weights", "out/node-1.weights"),
            ("my node", "'my node'"),
            ("-f", "./-f"),
            ("it's", r"'it'\''s'"),
            ("$(reboot)", "'$(reboot)'"),
            ("", "''"),
        ];
        for (name, word) in words {
            assert_eq!(shell_word(Path::new(name)), word);
        }
    }
}
