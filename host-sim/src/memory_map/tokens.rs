//! Splits the text of a linker script into tokens with line numbers.

use core::fmt;

use super::error::Fault;

/// One token.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Token {
    /// A name or a keyword.
    Word(String),
    /// A number, with its suffix applied.
    Number(u64),
    /// A string, without its quotes.
    Text(String),
    /// One of [`SIGNS`].
    Sign(&'static str),
    /// A number that linkers do not accept: its text, the problem, and the hint.
    BadNumber(String, &'static str, &'static str),
    /// A character that appears only in skipped parts, such as the pattern of a section's name.
    Other(char),
    /// End of the input.
    End,
}

/// Operators and delimiters; longer ones come before their prefixes.
const SIGNS: [&str; 38] = [
    "<<=", ">>=", "<<", ">>", "<=", ">=", "==", "!=", "&&", "||", "+=", "-=", "*=", "/=", "&=",
    "|=", "^=", "<", ">", "=", "!", "+", "-", "*", "/", "%", "&", "|", "^", "~", "?", "(", ")",
    "{", "}", ",", ":", ";",
];

impl fmt::Display for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Word(word) => write!(f, "`{word}`"),
            Self::Number(number) => write!(f, "the number {number}"),
            Self::Text(text) => write!(f, "the string \"{text}\""),
            Self::BadNumber(word, ..) => write!(f, "`{word}`"),
            Self::Other(character) => write!(f, "{character:?}"),
            Self::Sign(sign) => write!(f, "`{sign}`"),
            Self::End => f.write_str("the end of the file"),
        }
    }
}

/// Returns the tokens of `text` with their lines, from 1; the last one is [`Token::End`].
///
/// # Errors
/// If a comment or string is not closed, or a comment has the syntax of another language.
pub(super) fn tokens(text: &str) -> Result<Vec<(Token, usize)>, Fault> {
    let mut found = Vec::new();
    let mut line = 1;
    let mut rest = text;
    while let Some(first) = rest.chars().next() {
        let started = line;
        if first.is_whitespace() {
            line += usize::from(first == '\n');
            rest = &rest[first.len_utf8()..];
        } else if let Some(comment) = rest.strip_prefix("/*") {
            let Some((inside, after)) = comment.split_once("*/") else {
                return Err(Fault::new(started, "unclosed comment", "close it with */"));
            };
            line += inside.matches('\n').count();
            rest = after;
        } else if first == '#' {
            // A comment in LLD, Rust's default linker.
            rest = &rest[rest.find('\n').unwrap_or(rest.len())..];
        } else if rest.starts_with("//") {
            return Err(Fault::new(
                started,
                "`//` does not start a comment in a linker script",
                "write comments as /* ... */",
            ));
        } else if let Some(quoted) = rest.strip_prefix('"') {
            let end = quoted.find(['"', '\n']).filter(|&at| quoted[at..].starts_with('"'));
            let Some(end) = end else {
                return Err(Fault::new(
                    started,
                    "unclosed string",
                    "close it with \" on the same line",
                ));
            };
            found.push((Token::Text(quoted[..end].to_owned()), started));
            rest = &quoted[end + 1..];
        } else if is_in_word(first) {
            let end = rest.find(|c| !is_in_word(c)).unwrap_or(rest.len());
            let (word, after) = rest.split_at(end);
            let token = if first.is_ascii_digit() {
                number(word).map_or_else(
                    |(problem, hint)| Token::BadNumber(word.to_owned(), problem, hint),
                    Token::Number,
                )
            } else {
                Token::Word(word.to_owned())
            };
            found.push((token, started));
            rest = after;
        } else if let Some(sign) = SIGNS.into_iter().find(|&sign| rest.starts_with(sign)) {
            found.push((Token::Sign(sign), started));
            rest = &rest[sign.len()..];
        } else {
            found.push((Token::Other(first), started));
            rest = &rest[first.len_utf8()..];
        }
    }
    found.push((Token::End, line));
    Ok(found)
}

fn is_in_word(c: char) -> bool {
    c.is_ascii_alphanumeric() || matches!(c, '_' | '.' | '$')
}

/// Parses `0x1F`, `31`, `4K` or `0x2m`; the error is problem and hint.
fn number(word: &str) -> Result<u64, (&'static str, &'static str)> {
    const FORMS: &str = "write it as 12, 0x1F, 64K or 3M";
    let (digits, unit) = match word.as_bytes().last() {
        Some(b'K' | b'k') => (&word[..word.len() - 1], 1 << 10),
        Some(b'M' | b'm') => (&word[..word.len() - 1], 1 << 20),
        _ => (word, 1),
    };
    let (digits, radix) = match digits.strip_prefix("0x").or(digits.strip_prefix("0X")) {
        Some(hexadecimal) => (hexadecimal, 16),
        None => (digits, 10),
    };
    if digits.is_empty() || !digits.chars().all(|digit| digit.is_digit(radix)) {
        return Err(("is not a number", FORMS));
    }
    if radix == 10 && digits.len() > 1 && digits.starts_with('0') {
        return Err(("starts with 0, which linkers read as octal", FORMS));
    }
    u64::from_str_radix(digits, radix)
        .ok()
        .and_then(|value| value.checked_mul(unit))
        .ok_or(("overflows 64 bits", "use a smaller number"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers() {
        for (word, value) in [
            ("0", 0),
            ("12", 12),
            ("64K", 65_536),
            ("3m", 3 << 20),
            ("0x1F", 31),
            ("0X10k", 16 << 10),
            ("0xFFFFFFFFFFFFFFFF", u64::MAX),
        ] {
            assert_eq!(number(word), Ok(value), "{word}");
        }
        for word in ["0x", "K", "12G", "1F", "010", "0xK", "4KB", "99999999999999999999", "1_000"] {
            assert!(number(word).is_err(), "{word}");
        }
        assert!(number("0xFFFFFFFFFFFFFFFFK").is_err());
    }

    #[test]
    fn tokens_carry_their_first_line() {
        let found = tokens("a /* two\nlines */ <= 4K\n\"text\";").unwrap();
        let expected = [
            (Token::Word("a".to_owned()), 1),
            (Token::Sign("<="), 2),
            (Token::Number(4096), 2),
            (Token::Text("text".to_owned()), 3),
            (Token::Sign(";"), 3),
            (Token::End, 3),
        ];
        assert_eq!(found, expected);
    }

    #[test]
    fn errors_name_the_line_of_unclosed_tokens() {
        for (text, line, part) in [
            ("/* never", 1, "*/"),
            ("\n\"open\n\"", 2, "unclosed string"),
            ("\n\n// comment", 3, "/* ... */"),
        ] {
            let fault = tokens(text).unwrap_err();
            assert_eq!(fault.line, line, "{text}");
            let said = format!("{}; {}", fault.problem, fault.hint);
            assert!(said.contains(part), "{said}");
        }
    }

    #[test]
    fn accepts_section_patterns_and_lld_comments() {
        let found = tokens("# a comment\n*(.text [a-z]) 010 << 2").unwrap();
        let kinds: Vec<_> = found.iter().map(|(token, _)| token.to_string()).collect();
        let expected = [
            "`*`",
            "`(`",
            "`.text`",
            "'['",
            "`a`",
            "`-`",
            "`z`",
            "']'",
            "`)`",
            "`010`",
            "`<<`",
            "the number 2",
            "the end of the file",
        ];
        assert_eq!(kinds, expected);
        assert!(found.iter().all(|&(_, line)| line == 2));
    }
}
