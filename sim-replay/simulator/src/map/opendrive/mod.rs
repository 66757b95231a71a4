//! Maps in OpenDRIVE format, versions 1.4 to 1.8.
//!
//! Supported: reference lines (line, arc, spiral, poly3, paramPoly3), elevation, superelevation, crossfall and shape,
//! lane offset, lane sections with widths or borders, kinds, links and speeds, traffic on either side, the connections
//! of common and direct junctions, objects, signals, bridges and tunnels. A part that cannot be read or built is left
//! out, as small a part as possible, and listed in [`RoadNetwork::findings`]. Every value from the file is bounded
//! before it is used, so that no file can cause a panic, a hang or unbounded memory.

// Maps come from other programs: an index or a cast that does not fit is an error of the map, not a panic.
#![cfg_attr(not(test), deny(clippy::cast_possible_truncation))]
#![cfg_attr(not(test), deny(clippy::cast_sign_loss))]
#![cfg_attr(not(test), deny(clippy::indexing_slicing))]

mod beside;
mod border;
mod element;
mod encoding;
mod junctions;
mod lanes;
mod links;
mod plan_view;
mod profile;
mod roads;
mod speed;

use std::collections::BTreeMap;

use roxmltree::{Document, ParsingOptions};

use element::{Element, LineIndex, Result, children};
pub use element::{ElementError, OpenDriveError};

use super::finding::FindingLog;
use super::road::{Road, RoadNetwork};

/// Larger files are refused, bytes.
pub(super) const MAX_BYTES: usize = 64 << 20;
/// Files with more XML nodes than this are refused.
const MAX_NODES: u32 = 3_000_000;
/// Roads of a map together may be at most this long, metres.
const MAX_TOTAL_M: f64 = 500_000.0;
/// Lanes of a map together may be at most this long, metres.
const MAX_LANES_M: f64 = 3_000_000.0;
/// Lanes within one junction together may be at most this long, metres; the search for conflicts compares all pairs.
const MAX_JUNCTION_M: f64 = 20_000.0;

/// Indices of roads and junctions by their ids in the file.
struct Ids {
    roads: BTreeMap<String, usize>,
    junctions: BTreeMap<String, usize>,
}

/// Reads a map from the bytes of its file: UTF-8, UTF-16, or the encoding that it declares.
///
/// # Errors
/// [`OpenDriveError`] if the file is no OpenDRIVE map, exceeds a limit, or holds no road that can be read; the latter
/// with line, element, attribute and value of the first road's fault.
pub fn read(bytes: impl AsRef<[u8]>) -> Result<RoadNetwork, OpenDriveError> {
    let bytes = bytes.as_ref();
    if bytes.len() > MAX_BYTES {
        return Err(OpenDriveError::TooLarge(bytes.len()));
    }
    let mut log = FindingLog::default();
    let text = encoding::decode(bytes, &mut log);
    let options = ParsingOptions {
        nodes_limit: MAX_NODES,
        ..ParsingOptions::default()
    };
    let document = Document::parse_with_options(&text, options)
        .map_err(|error| OpenDriveError::Xml(error.to_string()))?;
    let lines = LineIndex::new(&text);
    let root = Element::root(document.root_element(), &lines);
    children(root, "include").for_each(|element| element.note_value(&mut log, "file", "left out"));
    let (mut roads, elements) = read_roads(root, &mut log)?;
    let (junctions, junction_elements) = collect_ids(root, "junction", &mut log);
    let names = roads.iter().map(|road| road.id.clone());
    let ids = Ids {
        roads: names.zip(0..).collect(),
        junctions,
    };
    let mut junctions_m = vec![0.0; ids.junctions.len()];
    for (road, element) in roads.iter_mut().zip(elements) {
        log.enter("road", &road.id);
        links::read(element, road, &ids, &mut log);
        let junction = road.junction;
        if let Some(total_m) = junction.and_then(|junction| junctions_m.get_mut(junction)) {
            *total_m += lanes_length_m(road);
            let what = "the lanes of its junction";
            check_total(element, what, *total_m, MAX_JUNCTION_M)?;
        }
    }
    let mut junctions = Vec::new();
    for element in junction_elements {
        log.enter("junction", element.optional_text("id").unwrap_or_default());
        junctions.push(junctions::read(element, &ids, &mut log));
    }
    Ok(RoadNetwork {
        roads,
        junctions,
        findings: log.list,
    })
}

/// All roads that can be read, each with its element; the others are left out.
fn read_roads<'a, 'input>(
    root: Element<'a, 'input>,
    log: &mut FindingLog,
) -> Result<(Vec<Road>, Vec<Element<'a, 'input>>)> {
    if root.name() != "OpenDRIVE" {
        return Err(root.error_element("is the root; expected <OpenDRIVE>"));
    }
    let (_, elements) = collect_ids(root, "road", log);
    if elements.is_empty() {
        return Err(root.error_element("has no <road>"));
    }
    let (mut roads, mut kept, mut first_error) = (Vec::new(), Vec::new(), None);
    let (mut total_m, mut lanes_m) = (0.0, 0.0);
    for element in elements {
        log.enter("road", element.optional_text("id").unwrap_or_default());
        match roads::read(element, log) {
            Ok(road) => {
                total_m += road.length_m;
                lanes_m += lanes_length_m(&road);
                // Beyond a limit the whole map is refused, as no single road is at fault.
                check_total(element, "all roads so far", total_m, MAX_TOTAL_M)?;
                check_total(element, "all lanes so far", lanes_m, MAX_LANES_M)?;
                roads.push(road);
                kept.push(element);
            }
            Err(error) => {
                error.note(log, "road left out");
                first_error.get_or_insert(error);
            }
        }
    }
    log.leave();
    match first_error {
        Some(error) if roads.is_empty() => Err(error),
        _ => Ok((roads, kept)),
    }
}

fn lanes_length_m(road: &Road) -> f64 {
    let lengths = road.sections.iter().enumerate().map(|(index, section)| {
        let lanes = section.left.len() + section.right.len();
        lanes as f64 * (road.section_end_m(index) - section.s_m).max(0.0)
    });
    lengths.sum()
}

fn check_total(element: Element, what: &str, total_m: f64, limit_m: f64) -> Result<()> {
    if total_m <= limit_m {
        return Ok(());
    }
    Err(element.error_element(&format!(
        "brings {what} to {total_m:.0} m, more than the limit of {limit_m} m"
    )))
}

/// Elements with an id of their own, and their indices by id; others are left out.
fn collect_ids<'a, 'input>(
    root: Element<'a, 'input>,
    name: &'static str,
    log: &mut FindingLog,
) -> (BTreeMap<String, usize>, Vec<Element<'a, 'input>>) {
    let (mut ids, mut elements) = (BTreeMap::new(), Vec::new());
    for element in children(root, name) {
        match element.text("id") {
            Ok(id) if ids.contains_key(id) => {
                let error = element.error_value("id", id, "used by one element only");
                error.note(log, "left out");
            }
            Ok(id) => {
                ids.insert(id.to_owned(), elements.len());
                elements.push(element);
            }
            Err(error) => error.note(log, "left out"),
        }
    }
    (ids, elements)
}

#[cfg(test)]
mod tests;
