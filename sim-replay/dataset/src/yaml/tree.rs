//! Builds the tree of a document from the events of a YAML parser, within limits.

use std::collections::{HashMap, HashSet};

use granit_parser::{Event, Parser, ScalarStyle, StrInput, Tag};
use protocol::text::excerpt;

use super::node::{Value, YamlNode};
use super::{numpy_tags, scalar};

/// Deepest nesting.
const MAX_DEPTH: usize = 64;
/// Most nodes of a document, excluding those repeated by aliases. A frame has about a thousand.
const MAX_NODES: usize = 500_000;
/// Most nodes repeated by all aliases of a document together.
const MAX_ALIASED_NODES: usize = 200_000;
/// YAML's own prefix of tags, written `!!`.
const TAG_PREFIX: &str = "tag:yaml.org,2002:";

/// A fault of a document: the line, from 1, and the reason.
type Unsound = (u64, String);

/// Builds the tree of a text with at most one document.
pub(super) fn build(text: &str) -> Result<YamlNode, Unsound> {
    let mut options = granit_parser::options! {
        flow_nesting_limit: MAX_DEPTH,
        block_nesting_limit: MAX_DEPTH,
    };
    options.set_emit_comments(false);
    let parser = Parser::new_from_str_with_options(text, options);
    TreeBuilder {
        parser,
        line: 1,
        anchors: HashMap::new(),
        nodes: 0,
        aliased: 0,
    }
    .document()
}

struct TreeBuilder<'t> {
    parser: Parser<'t, StrInput<'t>>,
    /// The line of the last event, from 1.
    line: u64,
    /// Targets of aliases, with their numbers of nodes.
    anchors: HashMap<usize, (YamlNode, usize)>,
    nodes: usize,
    aliased: usize,
}

impl<'t> TreeBuilder<'t> {
    fn document(mut self) -> Result<YamlNode, Unsound> {
        let mut root = None;
        loop {
            match self.next()? {
                Event::StreamEnd => break,
                Event::DocumentStart(..) if root.is_some() => {
                    return Err(self.unsound("a second document begins here, expected one"));
                }
                Event::StreamStart | Event::DocumentStart(..) | Event::DocumentEnd => {}
                event => root = Some(self.node(event, 0)?),
            }
        }
        Ok(root.unwrap_or(YamlNode {
            line: 1,
            tag: None,
            value: Value::Null,
        }))
    }

    fn next(&mut self) -> Result<Event<'t>, Unsound> {
        match self.parser.next_event() {
            Some(Ok((event, span))) => {
                self.line = span.start.line().max(1) as u64;
                Ok(event)
            }
            Some(Err(error)) => Err((error.marker().line().max(1) as u64, error.info())),
            None => Ok(Event::StreamEnd),
        }
    }

    fn unsound(&self, reason: impl Into<String>) -> Unsound {
        (self.line, reason.into())
    }

    /// The node that begins with an event.
    fn node(&mut self, event: Event<'t>, depth: usize) -> Result<YamlNode, Unsound> {
        self.nodes += 1;
        if self.nodes > MAX_NODES {
            return Err(self.unsound(format!("more than {MAX_NODES} nodes")));
        }
        if depth > MAX_DEPTH {
            return Err(self.unsound(format!("nested deeper than {MAX_DEPTH}")));
        }
        let line = self.line;
        let (anchor, tag, value) = match event {
            Event::Scalar(text, style, anchor, tag) => {
                let tag = tag.as_deref().map(tag_text);
                // Quoted scalars are texts, unless a tag says that they are numbers.
                let is_resolved = match tag.as_deref() {
                    None => style == ScalarStyle::Plain,
                    Some(tag) => matches!(
                        tag,
                        "int" | "float" | "bool" | "null" | "python/int" | "python/float"
                    ),
                };
                let value = if is_resolved {
                    scalar::plain(&text)
                } else {
                    Value::Text(text.into_owned())
                };
                (anchor, tag, value)
            }
            Event::SequenceStart(_, anchor, tag) => {
                (anchor, tag.as_deref().map(tag_text), self.list(depth)?)
            }
            Event::MappingStart(_, anchor, tag) => {
                (anchor, tag.as_deref().map(tag_text), self.map(depth)?)
            }
            Event::Alias(anchor) => return self.alias(anchor, line),
            _ => return Err(self.unsound("expected a scalar, a list or a map")),
        };
        let node = YamlNode { line, tag, value };
        if anchor > 0 {
            let size = size(&node);
            // The copy that is kept for aliases costs as much as one of them.
            self.count_aliased(size)?;
            self.anchors.insert(anchor, (node.clone(), size));
        }
        Ok(node)
    }

    fn list(&mut self, depth: usize) -> Result<Value, Unsound> {
        let mut items = Vec::new();
        loop {
            match self.next()? {
                Event::SequenceEnd => return Ok(Value::List(items)),
                event => items.push(self.node(event, depth + 1)?),
            }
        }
    }

    fn map(&mut self, depth: usize) -> Result<Value, Unsound> {
        let mut entries = Vec::new();
        let (mut merged, mut of_root) = (Vec::new(), HashSet::new());
        loop {
            let key = match self.next()? {
                Event::MappingEnd => break,
                Event::Scalar(text, ..) => text.into_owned(),
                event => {
                    let node = self.node(event, depth + 1)?;
                    numpy_tags::key_text(&node).unwrap_or_else(|| node.value.kind())
                }
            };
            // Programs use the last one, and lose what the others hold: all objects of a frame, for example.
            if depth == 0 && !of_root.insert(key.clone()) {
                let key = excerpt(&key, 40);
                return Err(self.unsound(format!("the key {key} is here again, expected once")));
            }
            let event = self.next()?;
            let node = self.node(event, depth + 1)?;
            match node.value {
                Value::Map(base) if key == "<<" => merged.extend(base),
                _ => entries.push((key, node)),
            }
        }
        if !merged.is_empty() {
            // A merge key (`<<`): own entries win, and of the merged ones the first.
            let mut known: HashSet<String> = entries.iter().map(|(key, _)| key.clone()).collect();
            merged.retain(|(key, _)| known.insert(key.clone()));
            entries.append(&mut merged);
        }
        Ok(Value::Map(entries))
    }

    fn alias(&mut self, anchor: usize, line: u64) -> Result<YamlNode, Unsound> {
        let Some((node, size)) = self.anchors.get(&anchor).cloned() else {
            return Err(self.unsound("an alias within its own anchor"));
        };
        self.count_aliased(size)?;
        Ok(YamlNode { line, ..node })
    }

    fn count_aliased(&mut self, size: usize) -> Result<(), Unsound> {
        self.aliased += size;
        if self.aliased > MAX_ALIASED_NODES {
            return Err(self.unsound(format!(
                "aliases repeat more than {MAX_ALIASED_NODES} nodes"
            )));
        }
        Ok(())
    }
}

/// Without YAML's own prefix.
fn tag_text(tag: &Tag) -> Box<str> {
    let (handle, suffix) = tag.parts();
    let handle = handle.strip_prefix(TAG_PREFIX).unwrap_or(handle);
    format!("{handle}{suffix}").into()
}

fn size(node: &YamlNode) -> usize {
    match &node.value {
        Value::List(items) => 1 + items.iter().map(size).sum::<usize>(),
        Value::Map(entries) => 1 + entries.iter().map(|(_, node)| size(node)).sum::<usize>(),
        _ => 1,
    }
}
