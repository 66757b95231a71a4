//! JSON of one frame, and values with their position for error messages.

use std::path::Path;
use std::str::FromStr;

use protocol::text::excerpt;
use serde_json::Value;

use super::{ReadError, Result, files};

/// Largest file of one frame, bytes: calibrations have some 500, labels of a hundred objects 100 kB.
const MAX_FRAME_BYTES: u64 = 16 << 20;
/// Largest edge of a box, metres.
const MAX_SIZE_M: f64 = 200.0;

/// Reads and parses the file of one frame.
pub(super) fn read(path: &Path) -> Result<Value> {
    parse(&files::read_limited(path, MAX_FRAME_BYTES)?).map_err(|error| {
        let line = Some(error.line() as u64).filter(|&line| line > 0);
        ReadError::malformed_at(path, line, None, format!("no sound JSON: {error}"))
    })
}

/// Parses JSON in which bare words may stand that are no JSON: `NaN` and `Infinity`, as Python writes them, or numbers
/// beyond all floats. Each is read as a text of its letters, so that only the object that needs it is lost, and named.
pub(super) fn parse(bytes: &[u8]) -> serde_json::Result<Value> {
    let bytes = bytes.strip_prefix(files::BYTE_ORDER_MARK).unwrap_or(bytes);
    // Sound files are parsed once. Only others pay for the search of bare words.
    serde_json::from_slice(bytes).or_else(|error| {
        let mended = with_quoted_words(bytes);
        serde_json::from_slice(&mended).map_err(|_| error)
    })
}

/// The text with quotes around each bare word that is no JSON by itself.
pub(super) fn with_quoted_words(bytes: &[u8]) -> Vec<u8> {
    let mut mended = Vec::with_capacity(bytes.len() + 16);
    let (mut rest, mut is_string) = (bytes, false);
    while let Some(&first) = rest.first() {
        let end = match is_string || !is_of_word(first) {
            // An escaped character cannot end a string.
            true if first == b'\\' => rest.len().min(2),
            true => 1,
            false => rest.iter().take_while(|byte| is_of_word(**byte)).count(),
        };
        // Escaped quotes do not arrive here: they are the second byte of the token before.
        is_string ^= first == b'"';
        let (token, after) = rest.split_at_checked(end).unwrap_or((rest, &[]));
        let is_bare = !is_string && is_of_word(first);
        match is_bare && serde_json::from_slice::<Value>(token).is_err() {
            true => mended.extend([b"\"", token, b"\""].concat()),
            false => mended.extend(token),
        }
        rest = after;
    }
    mended
}

fn is_of_word(byte: u8) -> bool {
    byte.is_ascii_alphanumeric() || b"+-._".contains(&byte)
}

/// A value with its position in the document.
pub(super) type JsonField<'a> = super::field::Field<'a, Value>;

impl<'a> JsonField<'a> {
    /// Entry `index` of a list.
    pub(super) fn entry(path: &'a Path, index: usize, value: &'a Value) -> Self {
        Self::root(path, value).child(&index.to_string(), value)
    }

    /// An error about this field.
    pub(super) fn error(&self, reason: impl Into<String>) -> ReadError {
        ReadError::malformed_at(self.path, None, self.place(), reason)
    }

    fn expected(&self, what: &str) -> ReadError {
        self.error(format!("{}, expected {what}", kind(self.node)))
    }

    /// The items of a list.
    pub(super) fn items(&self) -> Result<impl ExactSizeIterator<Item = Self>> {
        let Some(items) = self.node.as_array() else {
            return Err(self.expected("a list"));
        };
        let items = items.iter().enumerate();
        Ok(items.map(|(index, item)| self.child(&index.to_string(), item)))
    }

    /// An entry that may be missing, null or an empty text.
    pub(super) fn optional(&self, key: &str) -> Result<Option<Self>> {
        let Some(map) = self.node.as_object() else {
            return Err(self.expected("a map"));
        };
        let found = map.get(key);
        let found = found.filter(|value| !value.is_null() && value.as_str() != Some(""));
        Ok(found.map(|value| self.child(key, value)))
    }

    /// Value of an optional entry, read by `read`; `None` if the entry is missing or null.
    pub(super) fn optional_of<T>(
        &self,
        key: &str,
        read: impl FnOnce(&Self) -> Result<T>,
    ) -> Result<Option<T>> {
        self.optional(key)?.map(|field| read(&field)).transpose()
    }

    /// A required entry.
    pub(super) fn required(&self, key: &str) -> Result<Self> {
        self.optional(key)?
            .ok_or_else(|| self.child(key, self.node).error("missing"))
    }

    /// A finite number, as such or as text.
    pub(super) fn number(&self) -> Result<f64> {
        let number = self.stated(serde_json::Number::as_f64);
        number
            .filter(|number| number.is_finite())
            .ok_or_else(|| self.expected("a finite number"))
    }

    /// A number as such, or as a text.
    fn stated<T: FromStr>(&self, number: impl Fn(&serde_json::Number) -> Option<T>) -> Option<T> {
        match self.node {
            Value::Number(found) => number(found),
            Value::String(text) => text.trim().parse().ok(),
            _ => None,
        }
    }

    /// A time from 0, as a number or as text, in whatever unit: [`super::time_stamps`] tells it.
    pub(super) fn time(&self) -> Result<f64> {
        let time = Some(self.number()?).filter(|time| *time >= 0.0);
        time.ok_or_else(|| self.expected("a time from 0"))
    }

    /// A whole number from 0, as such or as text.
    pub(super) fn count(&self) -> Result<u64> {
        let count = self.stated(serde_json::Number::as_u64);
        count.ok_or_else(|| self.expected("a whole number from 0"))
    }

    pub(super) fn text(&self) -> Result<&'a str> {
        self.node.as_str().ok_or_else(|| self.expected("a text"))
    }

    /// A text, or a whole number as text: ids are written either way.
    pub(super) fn id(&self) -> Result<String> {
        match self.node {
            Value::String(text) => Ok(text.clone()),
            Value::Number(number) if number.is_u64() => Ok(number.to_string()),
            _ => Err(self.expected("an id")),
        }
    }

    /// Exactly `N` finite numbers, regardless of nesting: `[x, y, z]` and `[[x], [y], [z]]` are the same.
    pub(super) fn numbers<const N: usize>(&self) -> Result<[f64; N]> {
        let mut numbers = Vec::with_capacity(N);
        self.flatten(N, &mut numbers)?;
        numbers
            .try_into()
            .map_err(|found: Vec<f64>| self.error(format!("{} numbers, expected {N}", found.len())))
    }

    /// The edges of a box that this field states, metres: above 0, and not larger than those of any object.
    pub(super) fn checked_size(&self, size_m: [f64; 3]) -> Result<[f64; 3]> {
        if size_m.iter().all(|size| *size > 0.0 && *size <= MAX_SIZE_M) {
            return Ok(size_m);
        }
        Err(self.error(format!(
            "{size_m:?} are no sizes in metres, expected up to {MAX_SIZE_M}"
        )))
    }

    fn flatten(&self, most: usize, numbers: &mut Vec<f64>) -> Result<()> {
        if self.node.is_array() {
            let mut items = self.items()?;
            return items.try_for_each(|item| item.flatten(most, numbers));
        }
        // Checked before the number is added: a long list must not be collected to be refused.
        if numbers.len() == most {
            return Err(self.error(format!("more than {most} numbers, expected {most}")));
        }
        numbers.push(self.number()?);
        Ok(())
    }
}

/// Kind of a value, for messages.
fn kind(value: &Value) -> String {
    match value {
        Value::Null => "nothing".into(),
        Value::Bool(value) => value.to_string(),
        Value::Number(number) => number.to_string(),
        Value::String(text) => format!("the text {:?}", excerpt(text, 40)),
        Value::Array(items) => format!("a list of {}", items.len()),
        Value::Object(map) => format!("a map of {}", map.len()),
    }
}

#[cfg(test)]
mod tests {
    use std::fmt;

    use serde_json::json;

    use super::*;

    fn message(result: Result<impl fmt::Debug, ReadError>) -> String {
        result.unwrap_err().to_string()
    }

    #[test]
    fn a_byte_order_mark_is_skipped() {
        assert_eq!(parse("\u{feff}[1]".as_bytes()).unwrap(), json!([1]));
    }

    #[test]
    fn numbers_come_as_numbers_or_text_and_nested_or_not() {
        let value = json!({"a": [[1], ["2.5"], [-3e-2]], "b": [1, [2, 3]], "c": "7", "d": ["nan"]});
        let root = JsonField::root(Path::new("a.json"), &value);
        assert_eq!(
            root.required("a").unwrap().numbers().unwrap(),
            [1.0, 2.5, -0.03]
        );
        assert_eq!(
            root.required("b").unwrap().numbers().unwrap(),
            [1.0, 2.0, 3.0]
        );
        assert_eq!(
            (
                root.required("c").unwrap().number().unwrap(),
                root.required("c").unwrap().count().unwrap()
            ),
            (7.0, 7)
        );
        assert_eq!(
            message(root.required("b").unwrap().numbers::<2>()),
            "a.json: b.1.1: more than 2 numbers, expected 2"
        );
        assert_eq!(
            message(root.required("b").unwrap().numbers::<4>()),
            "a.json: b: 3 numbers, expected 4"
        );
        assert_eq!(
            message(root.required("d").unwrap().numbers::<1>()),
            "a.json: d.0: the text \"nan\", expected a finite number"
        );
    }

    #[test]
    fn words_that_are_no_json_cost_the_value_alone_and_are_named() {
        let text = br#"[{"x": NaN, "\"NaN, ": "a, NaN\\"}, {"x": -Infinity, "y": [1e999, true, null, -2.5]}]"#;
        let value = parse(text).unwrap();
        let list = JsonField::root(Path::new("a.json"), &value);
        let messages: Vec<String> = list
            .items()
            .unwrap()
            .map(|item| message(item.required("x").unwrap().number()))
            .collect();
        assert_eq!(
            messages,
            [
                "a.json: 0.x: the text \"NaN\", expected a finite number",
                "a.json: 1.x: the text \"-Infinity\", expected a finite number",
            ]
        );
        assert_eq!(value[0]["\"NaN, "], "a, NaN\\");
        assert_eq!(value[1]["y"], json!(["1e999", true, null, -2.5]));
        let cut = parse(br#"[{"x": NaN, "y"#).unwrap_err().to_string();
        assert!(cut.starts_with("expected value"), "{cut}");
    }

    #[test]
    fn missing_and_mistyped_values_are_reported() {
        let value = json!([{"x": null, "y": "", "z": {}}]);
        let entry = JsonField::entry(Path::new("a.json"), 3, &value[0]);
        for key in ["x", "y", "other"] {
            assert!(entry.optional(key).unwrap().is_none());
            assert_eq!(
                message(entry.required(key)),
                format!("a.json: 3.{key}: missing")
            );
        }
        let z = entry.required("z").unwrap();
        assert_eq!(
            message(z.number()),
            "a.json: 3.z: a map of 0, expected a finite number"
        );
        assert_eq!(
            message(z.text()),
            "a.json: 3.z: a map of 0, expected a text"
        );
        assert_eq!(
            message(JsonField::root(Path::new("a.json"), &value).required("x")),
            "a.json: a list of 1, expected a map"
        );
    }
}
