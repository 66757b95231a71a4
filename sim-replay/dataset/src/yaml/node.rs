//! A node of a YAML document: line, tag and content.
//!
//! [`super::tree`] builds nodes. Readers see them through a [`super::YamlField`].

use protocol::text::excerpt;

/// A node of a document.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct YamlNode {
    /// The line where it begins, from 1.
    pub(crate) line: u64,
    /// Its explicit tag without YAML's own prefix, for example `python/tuple` for `!!python/tuple`.
    pub(crate) tag: Option<Box<str>>,
    pub(crate) value: Value,
}

/// Content of a node.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Value {
    Null,
    Bool(bool),
    Integer(i64),
    Float(f64),
    Text(String),
    List(Vec<YamlNode>),
    /// Entries in the order of the file; keys as written.
    Map(Vec<(String, YamlNode)>),
}

impl Value {
    /// Kind and content in few words, for messages.
    pub(crate) fn kind(&self) -> String {
        match self {
            Self::Null => "nothing".into(),
            Self::Bool(value) => value.to_string(),
            Self::Integer(value) => value.to_string(),
            Self::Float(value) => value.to_string(),
            Self::Text(text) => format!("the text {:?}", excerpt(text, 40)),
            Self::List(items) => format!("a list of {}", items.len()),
            Self::Map(entries) => format!("a map of {}", entries.len()),
        }
    }
}
