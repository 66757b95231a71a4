//! Typed access to XML elements, with errors that give the position, and findings where a value is treated as absent.

use std::fmt::Display;
use std::str::FromStr;

use roxmltree::Node;

use super::super::finding::FindingLog;
use super::MAX_BYTES;

/// Reasons why a map cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum OpenDriveError {
    /// The file is larger than the limit.
    #[error("the file has {0} bytes, more than the limit of {limit}", limit = MAX_BYTES)]
    TooLarge(usize),
    /// The file is no well-formed XML, or XML of a kind that is refused (entities, too many nodes).
    #[error("not well-formed XML: {0}")]
    Xml(String),
    /// The root is another element, a limit is exceeded, or no road can be read.
    #[error(transparent)]
    Element(#[from] ElementError),
}

/// An element is missing, misplaced or at odds with others, or an attribute of it has an invalid value.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("line {line}: <{element}> {problem}")]
pub struct ElementError {
    /// Line in the file.
    line: u32,
    /// Name of the element.
    element: String,
    /// The fault; for a value its attribute, the value in the file and the valid ones.
    problem: String,
    /// The same as a finding tells it.
    found: String,
}

/// Result of reading a part of a map.
pub(super) type Result<T, E = ElementError> = std::result::Result<T, E>;

impl ElementError {
    /// Records the error as a finding: the affected part was handled by `action`.
    pub(super) fn note(&self, log: &mut FindingLog, action: &str) {
        log.add(self.line, &self.element, &self.found, action);
    }
}

/// The value, or nothing where it cannot be read: then the error is a finding, handled by `action`.
pub(super) fn noted<T>(read: Result<T>, log: &mut FindingLog, action: &str) -> Option<T> {
    read.map_err(|error| error.note(log, action)).ok()
}

/// Line numbers of positions in a text, with one count for each block: the XML document itself would count from its
/// start for each position, and a list of all lines could be larger than the text.
pub(super) struct LineIndex<'input> {
    text: &'input [u8],
    /// Line breaks before each block.
    breaks: Vec<u32>,
}

/// Length of the blocks, bytes.
const BLOCK: usize = 4096;

impl<'input> LineIndex<'input> {
    pub(super) fn new(text: &'input str) -> Self {
        let text = text.as_bytes();
        let mut breaks = vec![0];
        let mut before = 0;
        for block in text.chunks(BLOCK) {
            before += line_breaks(block);
            breaks.push(before);
        }
        Self { text, breaks }
    }

    fn line(&self, place: usize) -> u32 {
        let place = place.min(self.text.len());
        let block = place / BLOCK;
        let before = self.breaks.get(block).copied().unwrap_or_default();
        before + line_breaks(self.text.get(block * BLOCK..place).unwrap_or_default()) + 1
    }
}

fn line_breaks(bytes: &[u8]) -> u32 {
    bytes.iter().map(|&byte| u32::from(byte == b'\n')).sum()
}

/// An XML element.
#[derive(Clone, Copy)]
pub(super) struct Element<'a, 'input> {
    node: Node<'a, 'input>,
    lines: &'a LineIndex<'input>,
}

/// Children of `parent` with a name.
pub(super) fn children<'a, 'input>(
    parent: Element<'a, 'input>,
    name: &'static str,
) -> impl Iterator<Item = Element<'a, 'input>> {
    parent
        .elements()
        .filter(move |element| element.node.has_tag_name(name))
}

impl<'a, 'input> Element<'a, 'input> {
    /// The root of a document with the lines of its text.
    pub(super) fn root(node: Node<'a, 'input>, lines: &'a LineIndex<'input>) -> Self {
        Self { node, lines }
    }

    pub(super) fn name(&self) -> &'a str {
        self.node.tag_name().name()
    }

    /// All child elements.
    pub(super) fn elements(self) -> impl Iterator<Item = Self> {
        let lines = self.lines;
        self.node
            .children()
            .filter(Node::is_element)
            .map(move |node| Self { node, lines })
    }

    /// The largest magnitude of a number among the descendants with a name; 0 where there is none.
    pub(super) fn largest(&self, name: &'static str, attribute: &'static str) -> f64 {
        let nodes = self.node.descendants();
        let named = nodes.filter(|node| node.has_tag_name(name));
        let values = named.filter_map(|node| node.attribute(attribute)?.trim().parse::<f64>().ok());
        let sizes = values.map(f64::abs).filter(|size| size.is_finite());
        sizes.fold(0.0, f64::max)
    }

    /// The first child with a name.
    pub(super) fn child(&self, name: &'static str) -> Option<Self> {
        children(*self, name).next()
    }

    /// The first child with a name, which must be there.
    pub(super) fn required(&self, name: &'static str) -> Result<Self> {
        self.child(name)
            .ok_or_else(|| self.error_element(&format!("has no <{name}>")))
    }

    pub(super) fn optional_text(&self, attribute: &'static str) -> Option<&'a str> {
        self.node.attribute(attribute)
    }

    pub(super) fn text(&self, attribute: &'static str) -> Result<&'a str> {
        self.optional_text(attribute)
            .ok_or_else(|| self.error_element(&format!("has no attribute {attribute}")))
    }

    /// A finite number within bounds.
    pub(super) fn number(&self, attribute: &'static str, low: f64, high: f64) -> Result<f64> {
        self.parsed(attribute, "a number", low, high)
    }

    fn parsed<T: FromStr + PartialOrd + Display>(
        &self,
        attribute: &'static str,
        what: &str,
        low: T,
        high: T,
    ) -> Result<T> {
        let text = self.text(attribute)?;
        match text.trim().parse() {
            // NaN can be parsed, but lies within no bounds.
            Ok(value) if low <= value && value <= high => Ok(value),
            Ok(_) => Err(self.error_range(attribute, text, low, high)),
            Err(_) => Err(self.error_value(attribute, text, what)),
        }
    }

    /// A finite number within bounds, or 0 where the attribute is missing.
    pub(super) fn number_or_0(&self, attribute: &'static str, low: f64, high: f64) -> Result<f64> {
        match self.node.has_attribute(attribute) {
            true => self.number(attribute, low, high),
            false => Ok(0.0),
        }
    }

    /// A lane id.
    pub(super) fn lane_id(&self, attribute: &'static str) -> Result<i32> {
        self.parsed(attribute, "a lane id", -MAX_LANES, MAX_LANES)
    }

    /// Coefficients a, b, c, d with a prefix or suffix, such as `aU`.
    pub(super) fn cubic(&self, names: [&'static str; 4]) -> Result<[f64; 4]> {
        let mut coefficients = [0.0; 4];
        for (coefficient, name) in coefficients.iter_mut().zip(names) {
            *coefficient = self.number(name, -MAX_COORDINATE_M, MAX_COORDINATE_M)?;
        }
        Ok(coefficients)
    }

    /// Records a finding about this element.
    pub(super) fn note(&self, log: &mut FindingLog, found: &str, action: &str) {
        log.add(self.line(), self.name(), found, action);
    }

    /// Records the value of an attribute as a finding.
    pub(super) fn note_value(&self, log: &mut FindingLog, attribute: &'static str, action: &str) {
        let value = self.optional_text(attribute).unwrap_or_default();
        self.note(log, &format!("{attribute}=\"{value}\""), action);
    }

    pub(super) fn line(&self) -> u32 {
        self.lines.line(self.node.range().start)
    }

    pub(super) fn error_element(&self, problem: &str) -> ElementError {
        ElementError {
            line: self.line(),
            element: self.name().to_owned(),
            problem: problem.to_owned(),
            found: problem.to_owned(),
        }
    }

    pub(super) fn error_value(
        &self,
        attribute: &'static str,
        value: impl ToString,
        expected: &str,
    ) -> ElementError {
        let value: String = value.to_string().chars().take(80).collect();
        ElementError {
            line: self.line(),
            element: self.name().to_owned(),
            problem: format!("has {attribute}=\"{value}\"; expected {expected}"),
            found: format!("{attribute}=\"{value}\", expected {expected}"),
        }
    }

    /// The error of an attribute that falls from one element to the next.
    pub(super) fn error_order(&self, attribute: &'static str, value: f64) -> ElementError {
        self.error_value(attribute, value, "the elements in rising order")
    }

    pub(super) fn error_range(
        &self,
        attribute: &'static str,
        value: impl ToString,
        low: impl Display,
        high: impl Display,
    ) -> ElementError {
        self.error_value(attribute, value, &format!("a value from {low} to {high}"))
    }
}

/// Lanes on one side of a road, at most.
pub(super) const MAX_LANES: i32 = 64;
/// Longest road and longest element of a reference line, metres.
pub(super) const MAX_LENGTH_M: f64 = 100_000.0;
/// Places farther from the origin than this are refused, metres.
pub(super) const MAX_COORDINATE_M: f64 = 1e7;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_counted_over_all_blocks() {
        let text: String = (0..1500).map(|line| "x".repeat(line % 17) + "\n").collect();
        assert!(text.len() > 3 * BLOCK);
        let lines = LineIndex::new(&text);
        for place in
            (0..=text.len())
                .step_by(7)
                .chain([BLOCK, BLOCK - 1, text.len(), text.len() + 9])
        {
            let counted = text
                .bytes()
                .take(place)
                .filter(|&byte| byte == b'\n')
                .count() as u32
                + 1;
            assert_eq!(lines.line(place), counted, "{place}");
        }
    }
}
