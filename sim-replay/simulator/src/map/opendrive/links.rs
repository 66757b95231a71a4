//! `<link>`: links at the ends of a road, and the junction that it leads through.

use super::super::finding::FindingLog;
use super::super::road::{Contact, Road, RoadLink};
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
        "road" => match ids.roads.get(id) {
            Some(&road) if element.optional_text("contactPoint").is_some() => Ok(RoadLink::Road {
                road,
                contact: read_contact(element)?,
            }),
            Some(_) if element.optional_text("elementS").is_some() => {
                let at = element.optional_text("elementS").unwrap_or_default();
                let problem =
                    format!("meets road {id} at s={at}, between its ends (virtual junction)");
                Err(element.error_element(&problem))
            }
            Some(_) => Err(element.error_element("has no attribute contactPoint")),
            None => Err(element.error_value("elementId", id, "the id of a road of this map")),
        },
        other => Err(element.error_value("elementType", other, "road or junction")),
    }
}

pub(super) fn read_contact(element: Element) -> Result<Contact> {
    match element.text("contactPoint")? {
        "start" => Ok(Contact::Start),
        "end" => Ok(Contact::End),
        other => Err(element.error_value("contactPoint", other, "start or end")),
    }
}
