//! A YAML node with its position: typed access for readers, with errors that give file, line and field.

use super::node::{Value, YamlNode};
use crate::{ReadError, Result};

/// A node with its position in the document.
pub(crate) type YamlField<'a> = crate::field::Field<'a, YamlNode>;

impl<'a> YamlField<'a> {
    /// An error about this field.
    pub(crate) fn error(&self, reason: impl Into<String>) -> ReadError {
        ReadError::malformed_at(self.path, Some(self.node.line), self.place(), reason)
    }

    /// An error with the found and the expected value.
    pub(crate) fn expected(&self, what: &str) -> ReadError {
        self.error(format!("{}, expected {what}", self.node.value.kind()))
    }

    /// The entries of a map.
    pub(crate) fn entries(&self) -> Result<Vec<(&'a str, Self)>> {
        let Value::Map(entries) = &self.node.value else {
            return Err(self.expected("a map"));
        };
        let entries = entries.iter();
        let entries = entries.map(|(key, node)| (key.as_str(), self.child(key, node)));
        Ok(entries.collect())
    }

    /// The items of a list.
    pub(crate) fn items(&self) -> Result<Vec<Self>> {
        let Value::List(items) = &self.node.value else {
            return Err(self.expected("a list"));
        };
        let items = items.iter().enumerate();
        let items = items.map(|(index, node)| self.child(&index.to_string(), node));
        Ok(items.collect())
    }

    /// True if a map has the key, with any value.
    pub(crate) fn has(&self, key: &str) -> bool {
        matches!(&self.node.value, Value::Map(entries) if entries.iter().any(|(found, _)| found == key))
    }

    /// An entry that may be missing or null. Of equal keys the last is used, as in Python.
    pub(crate) fn optional(&self, key: &str) -> Result<Option<Self>> {
        let Value::Map(entries) = &self.node.value else {
            return Err(self.expected("a map"));
        };
        let found = entries
            .iter()
            .rfind(|(found, node)| found == key && node.value != Value::Null);
        Ok(found.map(|(_, node)| self.child(key, node)))
    }

    /// A required entry.
    pub(crate) fn required(&self, key: &str) -> Result<Self> {
        self.optional(key)?
            .ok_or_else(|| self.child(key, self.node).error("missing"))
    }

    pub(crate) fn text(&self) -> Result<&'a str> {
        match &self.node.value {
            Value::Text(text) => Ok(text),
            _ => Err(self.expected("a text")),
        }
    }
}
