//! Text decoding: from the bytes of a map to its text, by byte order mark, declared encoding, or windows-1252.

use std::borrow::Cow;

use encoding_rs::{Encoding, UTF_8, UTF_16BE, UTF_16LE, WINDOWS_1252};

use super::super::finding::FindingLog;

/// The declaration lies within this many bytes.
const DECLARATION_BYTES: usize = 200;

/// The text of a file, without byte order mark. A mark takes precedence over the declaration; where bytes do not fit
/// the encoding, the text is read as Western European (windows-1252), in which every byte is a character.
pub(super) fn decode<'a>(bytes: &'a [u8], log: &mut FindingLog) -> Cow<'a, str> {
    let (encoding, mark) = match Encoding::for_bom(bytes) {
        Some(found) => found,
        None => (unmarked(bytes, log), 0),
    };
    let bytes = bytes.get(mark..).unwrap_or_default();
    if let Some(text) = encoding.decode_without_bom_handling_and_without_replacement(bytes) {
        return text;
    }
    let found = format!("holds bytes that are not {}", encoding.name());
    // Read as windows-1252, every second character of UTF-16 would be NUL.
    if encoding == UTF_16LE || encoding == UTF_16BE {
        log.add(1, "OpenDRIVE", &found, "replaced by U+FFFD");
        return encoding.decode_without_bom_handling(bytes).0;
    }
    log.add(1, "OpenDRIVE", &found, "read as windows-1252");
    WINDOWS_1252.decode_without_bom_handling(bytes).0
}

/// The encoding of a file without byte order mark.
fn unmarked(bytes: &[u8], log: &mut FindingLog) -> &'static Encoding {
    match bytes {
        [b'<', 0, ..] => return UTF_16LE,
        [0, b'<', ..] => return UTF_16BE,
        _ => {}
    }
    let Some(label) = declared(bytes.get(..DECLARATION_BYTES).unwrap_or(bytes)) else {
        return UTF_8;
    };
    match Encoding::for_label(label.as_bytes()) {
        // A declaration that can be read byte by byte is no UTF-16, whatever it declares.
        Some(encoding) if encoding == UTF_16LE || encoding == UTF_16BE => UTF_8,
        Some(encoding) => encoding,
        None => {
            let found = format!("encoding=\"{label}\"");
            log.add(1, "OpenDRIVE", &found, "unknown; read as UTF-8");
            UTF_8
        }
    }
}

/// The label in `<?xml ... encoding="label"?>`.
fn declared(head: &[u8]) -> Option<String> {
    let head = String::from_utf8_lossy(head);
    let declaration = head.trim_start().strip_prefix("<?xml")?;
    let (_, value) = declaration.split("?>").next()?.split_once("encoding")?;
    let value = value.trim_start().strip_prefix('=')?.trim_start();
    let first = value.chars().next();
    let quote = first.filter(|first| matches!(first, '"' | '\''))?;
    let (label, _) = value[1..].split_once(quote)?;
    Some(label.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decoded(bytes: &[u8]) -> (String, Vec<String>) {
        let mut log = FindingLog::default();
        let text = decode(bytes, &mut log).into_owned();
        (text, log.list.iter().map(ToString::to_string).collect())
    }

    #[test]
    fn marks_and_declarations_give_the_encoding() {
        let latin = b"<?xml version=\"1.0\" encoding='ISO-8859-1'?><a b=\"Stra\xdfe\"/>";
        assert_eq!(
            decoded(latin).0,
            "<?xml version=\"1.0\" encoding='ISO-8859-1'?><a b=\"Straße\"/>"
        );
        assert_eq!(decoded(b"\xef\xbb\xbf<a/>"), ("<a/>".into(), vec![]));
        for text in ["\u{feff}<a b=\"ß\"/>", "<a b=\"ß\"/>"] {
            let plain = text.trim_start_matches('\u{feff}');
            for bytes in [u16::to_le_bytes, u16::to_be_bytes] {
                let wide: Vec<u8> = text.encode_utf16().flat_map(bytes).collect();
                assert_eq!(decoded(&wide), (plain.into(), vec![]));
            }
        }
    }

    #[test]
    fn invalid_bytes_are_read_and_reported() {
        let (text, found) =
            decoded(b"<?xml version=\"1.0\" encoding=\"UTF-8\"?><a b=\"Stra\xdfe\"/>");
        assert!(text.contains("Straße"), "{text}");
        assert_eq!(
            found,
            ["line 1: <OpenDRIVE> holds bytes that are not UTF-8; read as windows-1252"]
        );
        let (_, found) = decoded(b"<?xml version=\"1.0\" encoding=\"klingon\"?><a/>");
        assert_eq!(
            found,
            ["line 1: <OpenDRIVE> encoding=\"klingon\"; unknown; read as UTF-8"]
        );
        let (_, found) = decoded(b"\xff\xfe<\0\0\xd8");
        assert_eq!(found.len(), 1);
        assert_eq!(
            decoded(b"<?xml version=\"1.0\" encoding=\"UTF-16\"?><a/>").1,
            Vec::<String>::new()
        );
        assert_eq!(decoded(b""), (String::new(), vec![]));
    }
}
