//! Maps in OpenDRIVE format, version 1.4 (what RoadRunner writes for CARLA) and its close relatives.
//!
//! Read are reference lines (line, arc, spiral, poly3, paramPoly3), elevation, lane offset, lane sections with widths,
//! kinds, links and speeds, junction connections, objects, signals, bridges and tunnels. Superelevation is left out
//! and counted. Everything from the file is bounded before it is used, so that no file can make the program
//! panic, hang or take memory without limit.

mod element;
mod junctions;
mod lanes;
mod roads;

use std::collections::BTreeMap;

use roxmltree::{Document, ParsingOptions};

pub use element::OpenDriveError;
use element::{Element, children};

use super::road::{Ignored, Road, RoadNetwork};

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

/// Places of roads and junctions by their ids in the file.
struct Ids {
    roads: BTreeMap<String, usize>,
    junctions: BTreeMap<String, usize>,
}

/// Reads a map from the text of its file.
///
/// # Errors
/// [`OpenDriveError`] with line, element, attribute and value of the first thing that cannot be used.
pub fn read(text: &str) -> Result<RoadNetwork, OpenDriveError> {
    if text.len() > MAX_BYTES {
        return Err(OpenDriveError::TooLarge { bytes: text.len(), limit: MAX_BYTES });
    }
    let options = ParsingOptions { nodes_limit: MAX_NODES, ..ParsingOptions::default() };
    let document =
        Document::parse_with_options(text, options).map_err(|error| OpenDriveError::Xml(error.to_string()))?;
    let root = Element(document.root_element());
    if root.name() != "OpenDRIVE" {
        return Err(root.error_element("is the root; expected <OpenDRIVE>"));
    }
    let ids = Ids { roads: collect_ids(root, "road")?, junctions: collect_ids(root, "junction")? };
    if ids.roads.is_empty() {
        return Err(root.error_element("has no <road>"));
    }
    let mut ignored = Ignored::default();
    let mut roads = Vec::new();
    let (mut total_m, mut lanes_m, mut junctions_m) = (0.0, 0.0, vec![0.0; ids.junctions.len()]);
    for element in children(root, "road") {
        let road = roads::read(element, &ids, &mut ignored)?;
        let own_lanes_m = lanes_length_m(&road);
        total_m += road.length_m;
        lanes_m += own_lanes_m;
        check_total(element, "all roads so far", total_m, MAX_TOTAL_M)?;
        check_total(element, "all lanes so far", lanes_m, MAX_LANES_M)?;
        if let Some(junction) = road.junction {
            junctions_m[junction] += own_lanes_m;
            check_total(element, "the lanes of its junction", junctions_m[junction], MAX_JUNCTION_M)?;
        }
        roads.push(road);
    }
    let mut junctions = Vec::new();
    for element in children(root, "junction") {
        junctions.push(junctions::read(element, &ids)?);
    }
    Ok(RoadNetwork { roads, junctions, ignored })
}

fn lanes_length_m(road: &Road) -> f64 {
    let lengths = road.sections.iter().enumerate().map(|(index, section)| {
        let lanes = section.left.len() + section.right.len();
        lanes as f64 * (road.section_end_m(index) - section.s_m).max(0.0)
    });
    lengths.sum()
}

fn check_total(element: Element, what: &str, total_m: f64, limit_m: f64) -> Result<(), OpenDriveError> {
    if total_m <= limit_m {
        return Ok(());
    }
    Err(element.error_element(&format!("brings {what} to {total_m:.0} m, more than the limit of {limit_m} m")))
}

fn collect_ids(root: Element, name: &'static str) -> Result<BTreeMap<String, usize>, OpenDriveError> {
    let mut ids = BTreeMap::new();
    for (place, element) in children(root, name).enumerate() {
        let id = element.text("id")?;
        if ids.insert(id.to_owned(), place).is_some() {
            return Err(element.error_value("id", id, "used by one element only"));
        }
    }
    Ok(ids)
}

#[cfg(test)]
mod tests;
