//! YAML as a tree that remembers lines and tags, so that whatever is wrong can be named by file, line and field.
//!
//! Tags are kept as text and never acted upon. What a document may cost is limited: its size, its depth, and how often
//! aliases may repeat its parts.

use std::fmt;
use std::path::Path;

use serde::de::{Deserialize, Deserializer, Error, MapAccess, SeqAccess, Visitor};
use serde_saphyr::{Spanned, Tagged};

use super::ReadError;
use super::files;

/// Largest YAML file that is read, bytes. Frames with four cameras and fifty objects have about 20 kB.
const MAX_BYTES: u64 = 16 << 20;
/// Deepest nesting.
const MAX_DEPTH: usize = 64;
/// How many nodes all aliases of a document together may stand for.
const MAX_ALIASED_NODES: usize = 200_000;

/// A node of a document.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Node {
    /// The line where it begins, from 1.
    pub(super) line: u64,
    /// Its explicit tag, for example `tag:yaml.org,2002:python/tuple`.
    pub(super) tag: Option<String>,
    pub(super) value: Value,
}

/// What a node says.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Value {
    Null,
    Bool(bool),
    Integer(i64),
    Float(f64),
    Text(String),
    List(Vec<Node>),
    /// In the order of the file; keys as written.
    Map(Vec<(String, Node)>),
}

/// Reads and parses a file.
pub(super) fn read(path: &Path) -> Result<Node, ReadError> {
    parse(path, &files::read_limited(path, MAX_BYTES)?)
}

/// Parses a document; `path` is for messages.
pub(super) fn parse(path: &Path, bytes: &[u8]) -> Result<Node, ReadError> {
    let malformed = |line, reason: String| ReadError::Malformed { path: path.to_owned(), line, field: None, reason };
    let text = std::str::from_utf8(bytes).map_err(|error| {
        let line = bytes[..error.valid_up_to()].iter().filter(|&&byte| byte == b'\n').count() as u64 + 1;
        malformed(Some(line), "the text is not UTF-8".into())
    })?;
    let options = serde_saphyr::options! {
        budget: serde_saphyr::budget! { max_depth: MAX_DEPTH },
        alias_limits: serde_saphyr::alias_limits! { max_total_replayed_events: MAX_ALIASED_NODES },
        // `!!binary` stays base64 text: what it means is the business of who expects it.
        ignore_binary_tag_for_string: true,
        // Whether NaN is wrong depends on where it stands.
        non_finite_float_policy: serde_saphyr::options::NonFiniteFloatPolicy::PassThrough,
        with_snippet: false,
    };
    serde_saphyr::from_str_with_options(text, options).map_err(|error| {
        let line = error.location().map(|location| location.line()).filter(|&line| line > 0);
        malformed(line, format!("no sound YAML: {error}"))
    })
}

impl<'de> Deserialize<'de> for Node {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let Tagged(Spanned { value, referenced, .. }, tag) = Tagged::<Spanned<Value>>::deserialize(deserializer)?;
        Ok(Self { line: referenced.line(), tag, value })
    }
}

impl<'de> Deserialize<'de> for Value {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(ValueVisitor)
    }
}

struct ValueVisitor;

impl<'de> Visitor<'de> for ValueVisitor {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a scalar, a list or a map")
    }

    fn visit_unit<E: Error>(self) -> Result<Value, E> {
        Ok(Value::Null)
    }

    fn visit_none<E: Error>(self) -> Result<Value, E> {
        Ok(Value::Null)
    }

    fn visit_bool<E: Error>(self, value: bool) -> Result<Value, E> {
        Ok(Value::Bool(value))
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<Value, E> {
        Ok(Value::Integer(value))
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<Value, E> {
        Ok(i64::try_from(value).map_or(Value::Float(value as f64), Value::Integer))
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<Value, E> {
        Ok(Value::Float(value))
    }

    fn visit_str<E: Error>(self, value: &str) -> Result<Value, E> {
        Ok(Value::Text(value.to_owned()))
    }

    fn visit_string<E: Error>(self, value: String) -> Result<Value, E> {
        Ok(Value::Text(value))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut access: A) -> Result<Value, A::Error> {
        let mut items = Vec::new();
        while let Some(item) = access.next_element()? {
            items.push(item);
        }
        Ok(Value::List(items))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut access: A) -> Result<Value, A::Error> {
        let mut entries = Vec::new();
        while let Some(entry) = access.next_entry()? {
            entries.push(entry);
        }
        Ok(Value::Map(entries))
    }
}

impl Value {
    /// What kind of thing it is, for messages.
    fn kind(&self) -> String {
        match self {
            Self::Null => "nothing".into(),
            Self::Bool(value) => value.to_string(),
            Self::Integer(value) => value.to_string(),
            Self::Float(value) => value.to_string(),
            Self::Text(text) => format!("the text {:?}", text.chars().take(40).collect::<String>()),
            Self::List(items) => format!("a list of {}", items.len()),
            Self::Map(entries) => format!("a map of {}", entries.len()),
        }
    }
}

/// A node together with where it was found: what readers take values from.
#[derive(Debug, Clone)]
pub(super) struct Field<'a> {
    path: &'a Path,
    /// Dotted names from the root, for example `vehicles.4335.extent`.
    name: String,
    node: &'a Node,
}

impl<'a> Field<'a> {
    /// The whole document.
    pub(super) fn root(path: &'a Path, node: &'a Node) -> Self {
        Self { path, name: String::new(), node }
    }

    pub(super) fn node(&self) -> &'a Node {
        self.node
    }

    /// An error about this field.
    pub(super) fn error(&self, reason: impl Into<String>) -> ReadError {
        ReadError::Malformed {
            path: self.path.to_owned(),
            line: Some(self.node.line),
            field: (!self.name.is_empty()).then(|| self.name.clone()),
            reason: reason.into(),
        }
    }

    fn expected(&self, what: &str) -> ReadError {
        self.error(format!("{}, expected {what}", self.node.value.kind()))
    }

    fn child(&self, key: &str, node: &'a Node) -> Self {
        let name = if self.name.is_empty() { key.to_owned() } else { format!("{}.{key}", self.name) };
        Self { path: self.path, name, node }
    }

    /// The entries of a map.
    pub(super) fn entries(&self) -> Result<Vec<(&'a str, Self)>, ReadError> {
        match &self.node.value {
            Value::Map(entries) => {
                Ok(entries.iter().map(|(key, node)| (key.as_str(), self.child(key, node))).collect())
            }
            _ => Err(self.expected("a map")),
        }
    }

    /// The items of a list.
    pub(super) fn items(&self) -> Result<Vec<Self>, ReadError> {
        match &self.node.value {
            Value::List(items) => {
                Ok(items.iter().enumerate().map(|(index, node)| self.child(&index.to_string(), node)).collect())
            }
            _ => Err(self.expected("a list")),
        }
    }

    /// An entry that may be missing or null.
    pub(super) fn optional(&self, key: &str) -> Result<Option<Self>, ReadError> {
        let Value::Map(entries) = &self.node.value else { return Err(self.expected("a map")) };
        let found = entries.iter().find(|(found, node)| found == key && node.value != Value::Null);
        Ok(found.map(|(_, node)| self.child(key, node)))
    }

    /// An entry that must be there.
    pub(super) fn required(&self, key: &str) -> Result<Self, ReadError> {
        self.optional(key)?.ok_or_else(|| self.child(key, self.node).error("missing"))
    }

    /// A finite number, written in whatever way.
    pub(super) fn number(&self) -> Result<f64, ReadError> {
        let number = match &self.node.value {
            Value::Integer(value) => Some(*value as f64),
            Value::Float(value) => Some(*value),
            // Not every resolver takes `1e-06` or a quoted number for what it is.
            Value::Text(text) => text.parse().ok(),
            _ => None,
        };
        number.filter(|number| number.is_finite()).ok_or_else(|| self.expected("a finite number"))
    }

    pub(super) fn integer(&self) -> Result<i64, ReadError> {
        match &self.node.value {
            Value::Integer(value) => Ok(*value),
            // Ids are written as `-1.0` where they went through an array of floats.
            Value::Float(value) if value.fract() == 0.0 && value.abs() < 1e15 => Ok(*value as i64),
            Value::Text(text) => text.parse().map_err(|_| self.expected("an integer")),
            _ => Err(self.expected("an integer")),
        }
    }

    pub(super) fn text(&self) -> Result<&'a str, ReadError> {
        match &self.node.value {
            Value::Text(text) => Ok(text),
            _ => Err(self.expected("a text")),
        }
    }

    /// A list of exactly `N` finite numbers.
    pub(super) fn numbers<const N: usize>(&self) -> Result<[f64; N], ReadError> {
        let Value::List(items) = &self.node.value else { return Err(self.expected(&format!("a list of {N} numbers"))) };
        if items.len() != N {
            return Err(self.expected(&format!("{N} numbers")));
        }
        let mut numbers = [0.0; N];
        for (number, item) in numbers.iter_mut().zip(self.items()?) {
            *number = item.number()?;
        }
        Ok(numbers)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn parsed(text: &str) -> Node {
        parse(Path::new("a.yaml"), text.as_bytes()).unwrap()
    }

    fn message(result: Result<impl fmt::Debug, ReadError>) -> String {
        result.unwrap_err().to_string()
    }

    #[test]
    fn numbers_come_in_every_spelling() {
        let node = parsed("a: [1, 2.5, 1e-06, 1.0e-06, -3, .5, '7']");
        let field = Field::root(Path::new("a.yaml"), &node).required("a").unwrap();
        assert_eq!(field.numbers::<7>().unwrap(), [1.0, 2.5, 1e-6, 1e-6, -3.0, 0.5, 7.0]);
    }

    #[test]
    fn integer_keys_unknown_keys_and_anchors() {
        let node = parsed("vehicles:\n  4335: &a\n    speed: 1\n    color: 1, 2\n  4336: *a\nunknown: {x: [~]}\n");
        let root = Field::root(Path::new("a.yaml"), &node);
        let vehicles = root.required("vehicles").unwrap().entries().unwrap();
        assert_eq!(vehicles.iter().map(|(key, _)| *key).collect::<Vec<_>>(), ["4335", "4336"]);
        assert_eq!(vehicles[1].1.required("speed").unwrap().number().unwrap(), 1.0);
    }

    #[test]
    fn tags_are_text_and_binary_stays_base64() {
        let node = parsed("a: !!python/tuple\n- 1\n- !!binary |\n  Yg==\n- !!python/name:numpy.ndarray ''\n");
        let root = Field::root(Path::new("a.yaml"), &node);
        let tuple = root.required("a").unwrap();
        assert_eq!(tuple.node().tag.as_deref(), Some("tag:yaml.org,2002:python/tuple"));
        let items = tuple.items().unwrap();
        assert_eq!(items[1].text().unwrap().trim(), "Yg==");
        assert_eq!(items[2].node().tag.as_deref(), Some("tag:yaml.org,2002:python/name:numpy.ndarray"));
    }

    #[test]
    fn errors_name_file_line_and_field() {
        let node = parsed("lidar_pose: [1, 2, 3]\nvehicles:\n  7:\n    extent:\n    - 1\n    - .nan\n    - x\n");
        let root = Field::root(Path::new("a.yaml"), &node);
        let pose = root.required("lidar_pose").unwrap();
        assert_eq!(message(pose.numbers::<6>()), "a.yaml:1: lidar_pose: a list of 3, expected 6 numbers");
        let car = root.required("vehicles").unwrap().required("7").unwrap();
        let extent = car.required("extent").unwrap();
        assert_eq!(message(extent.numbers::<3>()), "a.yaml:6: vehicles.7.extent.1: NaN, expected a finite number");
        assert_eq!(message(car.required("angle")), "a.yaml:4: vehicles.7.angle: missing");
        assert_eq!(
            message(root.required("vehicles").unwrap().number()),
            "a.yaml:3: vehicles: a map of 1, expected a finite number"
        );
    }

    #[test]
    fn broken_yaml_names_the_line() {
        let error = parse(Path::new("a.yaml"), b"a: 1\nb: [1, 2\nc: 3\n").unwrap_err();
        assert!(error.line().is_some(), "{error}");
        let error = parse(Path::new("a.yaml"), b"a: 1\nb: \xff\n").unwrap_err();
        assert_eq!(error.to_string(), "a.yaml:2: the text is not UTF-8");
    }

    #[test]
    fn bombs_are_refused() {
        let deep = "[".repeat(10_000);
        assert!(parse(Path::new("a.yaml"), deep.as_bytes()).is_err());
        let mut aliases = String::from("a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n");
        for level in 1..12 {
            let repeats = vec![format!("*a{}", level - 1); 10].join(", ");
            aliases += &format!("a{level}: &a{level} [{repeats}]\n");
        }
        assert!(parse(Path::new("a.yaml"), aliases.as_bytes()).is_err());
    }

    proptest! {
        #[test]
        fn random_text_never_panics(bytes in prop::collection::vec(prop::sample::select(b"abc:-[]{}&*!|>'\"#\n 019.,~\xff".to_vec()), 0..120)) {
            let _ = parse(Path::new("a.yaml"), &bytes);
        }
    }
}
