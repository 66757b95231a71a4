//! Typed access to XML elements, with errors that say where.

use roxmltree::Node;

/// Why a map cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum OpenDriveError {
    /// The file is larger than maps are.
    #[error("the file has {bytes} bytes, more than the limit of {limit}")]
    TooLarge {
        /// Size of the file.
        bytes: usize,
        /// Largest size read.
        limit: usize,
    },
    /// The file is no well-formed XML, or XML of a kind that is refused (entities, too many nodes).
    #[error("not well-formed XML: {0}")]
    Xml(String),
    /// An element is missing, misplaced or at odds with others.
    #[error("line {line}: <{element}> {problem}")]
    Element {
        /// Line in the file.
        line: u32,
        /// Name of the element.
        element: String,
        /// What is wrong.
        problem: String,
    },
    /// An attribute is missing.
    #[error("line {line}: <{element}> has no attribute {attribute}")]
    Missing {
        /// Line in the file.
        line: u32,
        /// Name of the element.
        element: String,
        /// Name of the attribute.
        attribute: &'static str,
    },
    /// An attribute's value is not what it has to be.
    #[error("line {line}: <{element}> has {attribute}=\"{value}\"; expected {expected}")]
    Value {
        /// Line in the file.
        line: u32,
        /// Name of the element.
        element: String,
        /// Name of the attribute.
        attribute: &'static str,
        /// What the file says.
        value: String,
        /// What it should say.
        expected: String,
    },
}

/// An XML element.
#[derive(Clone, Copy)]
pub(super) struct Element<'a, 'input>(pub(super) Node<'a, 'input>);

/// Children of `parent` with a name.
pub(super) fn children<'a, 'input>(
    parent: Element<'a, 'input>,
    name: &'static str,
) -> impl Iterator<Item = Element<'a, 'input>> {
    parent.0.children().filter(move |node| node.has_tag_name(name)).map(Element)
}

impl<'a, 'input> Element<'a, 'input> {
    pub(super) fn name(&self) -> &'a str {
        self.0.tag_name().name()
    }

    /// The first child with a name.
    pub(super) fn child(&self, name: &'static str) -> Option<Self> {
        children(*self, name).next()
    }

    /// The first child with a name, which must be there.
    pub(super) fn required(&self, name: &'static str) -> Result<Self, OpenDriveError> {
        self.child(name).ok_or_else(|| self.error_element(&format!("has no <{name}>")))
    }

    pub(super) fn optional_text(&self, attribute: &'static str) -> Option<&'a str> {
        self.0.attribute(attribute)
    }

    pub(super) fn text(&self, attribute: &'static str) -> Result<&'a str, OpenDriveError> {
        self.optional_text(attribute).ok_or_else(|| OpenDriveError::Missing {
            line: self.line(),
            element: self.name().to_owned(),
            attribute,
        })
    }

    /// A finite number within bounds.
    pub(super) fn number(&self, attribute: &'static str, low: f64, high: f64) -> Result<f64, OpenDriveError> {
        let text = self.text(attribute)?;
        let value: f64 = text.trim().parse().map_err(|_| self.error_value(attribute, text, "a number"))?;
        if (low..=high).contains(&value) { Ok(value) } else { Err(self.error_range(attribute, text, low, high)) }
    }

    /// A finite number within bounds, or the default where the attribute is missing.
    pub(super) fn number_or(
        &self,
        attribute: &'static str,
        default: f64,
        low: f64,
        high: f64,
    ) -> Result<f64, OpenDriveError> {
        if self.0.has_attribute(attribute) { self.number(attribute, low, high) } else { Ok(default) }
    }

    /// A lane id.
    pub(super) fn lane_id(&self, attribute: &'static str) -> Result<i32, OpenDriveError> {
        let text = self.text(attribute)?;
        let value: i32 = text.trim().parse().map_err(|_| self.error_value(attribute, text, "a lane id"))?;
        // The lowest number of all has no positive one.
        if value.unsigned_abs() <= MAX_LANES.unsigned_abs() {
            Ok(value)
        } else {
            Err(self.error_range(attribute, text, -MAX_LANES, MAX_LANES))
        }
    }

    /// Coefficients a, b, c, d with a prefix or suffix, such as `aU`.
    pub(super) fn cubic(&self, names: [&'static str; 4]) -> Result<[f64; 4], OpenDriveError> {
        let mut coefficients = [0.0; 4];
        for (coefficient, name) in coefficients.iter_mut().zip(names) {
            *coefficient = self.number(name, -MAX_COORDINATE_M, MAX_COORDINATE_M)?;
        }
        Ok(coefficients)
    }

    pub(super) fn line(&self) -> u32 {
        self.0.document().text_pos_at(self.0.range().start).row
    }

    pub(super) fn error_element(&self, problem: &str) -> OpenDriveError {
        OpenDriveError::Element { line: self.line(), element: self.name().to_owned(), problem: problem.to_owned() }
    }

    pub(super) fn error_value(&self, attribute: &'static str, value: &str, expected: &str) -> OpenDriveError {
        OpenDriveError::Value {
            line: self.line(),
            element: self.name().to_owned(),
            attribute,
            value: value.chars().take(80).collect(),
            expected: expected.to_owned(),
        }
    }

    pub(super) fn error_range(
        &self,
        attribute: &'static str,
        value: impl ToString,
        low: impl std::fmt::Display,
        high: impl std::fmt::Display,
    ) -> OpenDriveError {
        self.error_value(attribute, &value.to_string(), &format!("a value from {low} to {high}"))
    }
}

/// Lanes on one side of a road, at most.
pub(super) const MAX_LANES: i32 = 64;
/// Places farther from the origin than this are refused, metres.
pub(super) const MAX_COORDINATE_M: f64 = 1e7;
