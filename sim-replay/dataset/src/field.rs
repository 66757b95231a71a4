//! A value of a document with its position, for error messages.

use std::path::Path;

/// A value of type `V` with its position in the document; readers take numbers and texts from it.
#[derive(Debug, Clone)]
pub(super) struct Field<'a, V> {
    pub(super) path: &'a Path,
    /// Dotted names from the root, for example `vehicles.4335.extent`.
    pub(super) name: String,
    pub(super) node: &'a V,
}

impl<'a, V> Field<'a, V> {
    /// The whole document.
    pub(super) fn root(path: &'a Path, node: &'a V) -> Self {
        Self {
            path,
            name: String::new(),
            node,
        }
    }

    /// An entry of a map or list: `vehicles.4335.extent`.
    pub(super) fn child(&self, key: &str, node: &'a V) -> Self {
        let name = match self.name.as_str() {
            "" => key.to_owned(),
            parent => format!("{parent}.{key}"),
        };
        let path = self.path;
        Self { path, name, node }
    }

    /// Its dotted name; `None` for the whole document.
    pub(super) fn place(&self) -> Option<&str> {
        Some(self.name.as_str()).filter(|name| !name.is_empty())
    }
}
