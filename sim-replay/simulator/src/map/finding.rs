//! Findings of a map: parts that were not built as the file gives them, each with the action taken.

use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;

/// Findings of different kinds that are kept one by one; the rest of a file that is odd throughout is only counted.
const MAX_FINDINGS: usize = 1000;
/// Longest text taken from a file, characters.
const MAX_TEXT: usize = 100;

/// A part of a map that was left out, treated as absent or built otherwise than the file gives it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// Line in the file, from 1; the first of several. 0 if it concerns no single line.
    pub line: u32,
    /// Id of the road or junction in which it stands.
    pub within: Option<String>,
    /// Name of the element.
    pub element: String,
    /// The value found.
    pub found: String,
    /// Action taken.
    pub action: String,
    /// Elements of this name, in this road, to which this happened.
    pub count: usize,
}

impl fmt::Display for Finding {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.line > 0 {
            write!(out, "line {}: ", self.line)?;
        }
        if let Some(within) = &self.within {
            write!(out, "{within}: ")?;
        }
        write!(out, "<{}> {}; {}", self.element, self.found, self.action)?;
        if self.count > 1 {
            write!(out, " ({} times)", self.count)
        } else {
            Ok(())
        }
    }
}

/// Findings in the order of their first occurrence; the same again in one road is counted.
#[derive(Debug, Default)]
pub(super) struct FindingLog {
    pub(super) list: Vec<Finding>,
    places: BTreeMap<[String; 3], usize>,
    /// Road or junction that is being read.
    within: Option<String>,
}

impl FindingLog {
    /// Assigns further findings to this road or junction.
    pub(super) fn enter(&mut self, kind: &str, id: &str) {
        self.within = Some(format!("{kind} {}", shortened(id)));
    }

    /// Assigns further findings to the file as a whole.
    pub(super) fn leave(&mut self) {
        self.within = None;
    }

    pub(super) fn add(&mut self, line: u32, element: &str, found: &str, action: &str) {
        // Without the value found: the same fault with other numbers counts as one finding.
        let key = [
            self.within.clone().unwrap_or_default(),
            shortened(element),
            shortened(action),
        ];
        if let Some(&place) = self.places.get(&key) {
            self.list[place].count += 1;
            return;
        }
        let [_, element, action] = key.clone();
        let finding = Finding {
            line,
            within: self.within.clone(),
            element,
            found: shortened(found),
            action,
            count: 1,
        };
        if self.list.len() < MAX_FINDINGS {
            self.places.insert(key, self.list.len());
            self.list.push(finding);
        } else if let Some(last) = self.list.get_mut(MAX_FINDINGS) {
            // The entry behind the limit counts all further ones.
            last.count += 1;
        } else {
            let (found, action) = ("and more findings".to_owned(), "counted only".to_owned());
            self.list.push(Finding {
                within: None,
                found,
                action,
                ..finding
            });
        }
    }
}

fn shortened(text: &str) -> String {
    let text: String = text.chars().take(MAX_TEXT).collect();
    text.replace(char::is_control, " ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repeated_findings_of_one_road_are_counted_and_the_total_is_bounded() {
        let mut log = FindingLog::default();
        log.enter("road", "7");
        (1..4).for_each(|line| log.add(line, "speed", "max=\"-1\"", "treated as absent"));
        log.leave();
        log.add(9, "include", "file=\"a\"", "left out");
        assert_eq!(log.list.len(), 2);
        assert_eq!(
            log.list[0].to_string(),
            "line 1: road 7: <speed> max=\"-1\"; treated as absent (3 times)"
        );
        assert_eq!(
            log.list[1].to_string(),
            "line 9: <include> file=\"a\"; left out"
        );
        for road in 0..2 * MAX_FINDINGS {
            log.enter("road", &road.to_string());
            log.add(1, "speed", "max=\"-1\"", "treated as absent");
        }
        let list = log.list;
        assert_eq!(list.len(), MAX_FINDINGS + 1);
        assert_eq!(
            list.iter().map(|finding| finding.count).sum::<usize>(),
            4 + 2 * MAX_FINDINGS
        );
    }
}
