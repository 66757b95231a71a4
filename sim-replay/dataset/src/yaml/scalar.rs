//! Resolution of scalars: number, boolean, null or text, by YAML 1.2's core schema.

use super::Value;

/// The value of a plain (unquoted) scalar.
pub(super) fn plain(text: &str) -> Value {
    let known = match text.as_bytes() {
        [b'0'..=b'9' | b'+' | b'-' | b'.', ..] => number(text),
        b"" | b"~" | b"null" | b"Null" | b"NULL" => Some(Value::Null),
        b"true" | b"True" | b"TRUE" => Some(Value::Bool(true)),
        b"false" | b"False" | b"FALSE" => Some(Value::Bool(false)),
        _ => None,
    };
    known.unwrap_or_else(|| Value::Text(text.to_owned()))
}

/// An integer or float; exponents need no point, as in `1e-06`.
fn number(text: &str) -> Option<Value> {
    let unsigned = text.strip_prefix(['+', '-']).unwrap_or(text);
    if !unsigned.is_empty() && unsigned.bytes().all(|byte| byte.is_ascii_digit()) {
        // Beyond 64 bits it is still a number.
        let integer = text.parse().ok().map(Value::Integer);
        return integer.or_else(|| text.parse().ok().map(Value::Float));
    }
    match unsigned {
        ".inf" | ".Inf" | ".INF" => {
            let sign = if text.starts_with('-') { -1.0 } else { 1.0 };
            return Some(Value::Float(sign * f64::INFINITY));
        }
        ".nan" | ".NaN" | ".NAN" => return Some(Value::Float(f64::NAN)),
        _ => {}
    }
    for (prefix, radix) in [("0x", 16), ("0o", 8)] {
        if let Some(digits) = text.strip_prefix(prefix) {
            return i64::from_str_radix(digits, radix).map(Value::Integer).ok();
        }
    }
    // Letters other than the exponent are rejected: Rust would parse `infinity` too. It parses no `1_0`.
    text.bytes()
        .all(|byte| byte.is_ascii_digit() || matches!(byte, b'+' | b'-' | b'.' | b'e' | b'E'))
        .then(|| text.parse().map(Value::Float).ok())
        .flatten()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scalars_follow_the_core_schema() {
        for (text, expected) in [
            ("", Value::Null),
            ("~", Value::Null),
            ("Null", Value::Null),
            ("true", Value::Bool(true)),
            ("False", Value::Bool(false)),
            ("-7", Value::Integer(-7)),
            ("000069", Value::Integer(69)),
            (
                "18446744073709551616",
                Value::Float(18_446_744_073_709_551_616.0),
            ),
            ("1e-06", Value::Float(1e-6)),
            ("-.inf", Value::Float(f64::NEG_INFINITY)),
            ("0x1F", Value::Integer(31)),
        ] {
            assert_eq!(plain(text), expected, "{text}");
        }
        for text in [
            "-",
            ".",
            "1-2",
            "2024-01-01",
            "inf",
            "nan",
            "1, 2, 3",
            "no",
            "none",
            "-e",
            "12abc",
            "0x",
            "+",
        ] {
            assert_eq!(plain(text), Value::Text(text.into()));
        }
        assert!(matches!(plain(".nan"), Value::Float(value) if value.is_nan()));
    }
}
