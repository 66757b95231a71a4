//! Text forms that several crates need: bytes as hexadecimal, and excerpts of foreign texts.

/// Two lower-case hexadecimal digits per byte.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// At most `max_chars` characters from the beginning: a hostile text inside an error must not fill the log.
pub fn excerpt(text: &str, max_chars: usize) -> String {
    text.chars().take(max_chars).collect()
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
}
