//! `<link>`: links at the ends of a road, and the junction that it leads through.

use super::super::finding::FindingLog;
use super::super::road::{Contact, Road, RoadEnd, RoadLink};
use super::Ids;
use super::element::{Element, Result, noted};

/// Fills the links of a road; links to elements that are not in this map are treated as absent.
pub(super) fn read(element: Element, road: &mut Road, ids: &Ids, log: &mut FindingLog) {
    let link = element.child("link");
    [road.predecessor, road.successor] = ["predecessor", "successor"].map(|name| {
        let end = link.and_then(|link| link.child(name))?;
        noted(read_link(end, ids), log, "link treated as absent")
    });
    road.junction = match element.optional_text("junction").map(str::trim) {
        // -1 stands for a road outside junctions.
        None | Some("-1" | "") => None,
        Some(id) => {
            let junction = ids.junctions.get(id).copied();
            if junction.is_none() {
                let action = "no such junction in this map; treated as none";
                element.note_value(log, "junction", action);
            }
            junction
        }
    };
}

fn read_link(element: Element, ids: &Ids) -> Result<RoadLink> {
    let id = element.text("elementId")?;
    match element.text("elementType")? {
        "junction" => match ids.junctions.get(id) {
            Some(&junction) => Ok(RoadLink::Junction(junction)),
            None => Err(element.error_value("elementId", id, "the id of a junction of this map")),
        },
        "road" => {
            let road = read_road(element, "elementId", ids)?;
            let end = element.optional_text("contactPoint");
            if let (None, Some(at)) = (end, element.optional_text("elementS")) {
                let problem =
                    format!("meets road {id} at s={at}, between its ends (virtual junction)");
                return Err(element.error_element(&problem));
            }
            let contact = read_contact(element)?;
            Ok(RoadLink::Road(RoadEnd { road, contact }))
        }
        other => Err(element.error_value("elementType", other, "road or junction")),
    }
}

/// The road of an id in this map.
pub(super) fn read_road(element: Element, attribute: &'static str, ids: &Ids) -> Result<usize> {
    let id = element.text(attribute)?;
    let found = ids.roads.get(id).copied();
    found.ok_or_else(|| element.error_value(attribute, id, "the id of a road of this map"))
}

pub(super) fn read_contact(element: Element) -> Result<Contact> {
    match element.text("contactPoint")? {
        "start" => Ok(Contact::Start),
        "end" => Ok(Contact::End),
        other => Err(element.error_value("contactPoint", other, "start or end")),
    }
}
