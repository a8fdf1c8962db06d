//! Command lines that are printed for people to copy.

use std::path::Path;

/// `text` as one word of a Unix shell, whatever is in it.
#[must_use]
pub fn quoted(text: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "_-./+:=@%,".contains(c);
    if !text.is_empty() && text.chars().all(plain) {
        text.to_owned()
    } else {
        format!("'{}'", text.replace('\'', r"'\''"))
    }
}

/// The file's name in a form that no program takes for an option.
#[must_use]
pub fn path_argument(file: &Path) -> String {
    let name = file.display().to_string();
    if name.starts_with('-') { format!("./{name}") } else { name }
}

/// The file's name as one word of a Unix shell.
#[must_use]
pub fn shell_word(file: &Path) -> String {
    quoted(&path_argument(file))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_stays_one_word() {
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
