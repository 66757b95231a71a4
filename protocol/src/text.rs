//! Text forms that several crates need: bytes as hexadecimal, excerpts of foreign texts, and texts of messages.

/// Largest text in a message, bytes: a line and a half of a wide terminal.
pub const MAX_MESSAGE_BYTES: usize = 256;

/// Two lower-case hexadecimal digits per byte.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// At most `max_chars` characters from the beginning: a hostile text inside an error must not fill the log.
pub fn excerpt(text: &str, max_chars: usize) -> String {
    text.chars().take(max_chars).collect()
}

/// A text as a message may hold it: control characters, which could forge lines of a terminal, are spaces, and the end
/// beyond a number of bytes, at most [`MAX_MESSAGE_BYTES`], is left out.
pub fn printable(text: &str, max_bytes: usize) -> String {
    let mut shown = text.replace(char::is_control, " ");
    shown.truncate(shown.floor_char_boundary(max_bytes));
    shown
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_two_digits_each_and_excerpts_end_between_characters() {
        assert_eq!(hex(&[0, 10, 255]), "000aff");
        assert_eq!(
            (excerpt("äöü", 2), excerpt("a", 2)),
            ("äö".into(), "a".into())
        );
    }

    #[test]
    fn a_printable_text_has_no_control_characters_and_ends_between_characters() {
        assert_eq!(printable("a\x1b[2J\nbö", 64), "a [2J bö");
        assert_eq!(printable("äöü", 5), "äö");
    }
}
