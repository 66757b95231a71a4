//! `<junction>`: the ways through it.

use super::super::road::{Connection, Junction};
use super::element::{Element, children};
use super::roads::read_contact;
use super::{Ids, OpenDriveError};

pub(super) fn read(element: Element, ids: &Ids) -> Result<Junction, OpenDriveError> {
    let mut connections = Vec::new();
    for connection in children(element, "connection") {
        let road = |attribute| {
            let id = connection.text(attribute)?;
            let found = ids.roads.get(id).copied();
            found.ok_or_else(|| connection.error_value(attribute, id, "the id of a <road>"))
        };
        // Connections of virtual junctions name no connecting road.
        if connection.optional_text("connectingRoad").is_none() {
            continue;
        }
        let mut lane_links = Vec::new();
        for link in children(connection, "laneLink") {
            lane_links.push((link.lane_id("from")?, link.lane_id("to")?));
        }
        connections.push(Connection {
            incoming: road("incomingRoad")?,
            connecting: road("connectingRoad")?,
            contact: read_contact(connection)?,
            lane_links,
        });
    }
    Ok(Junction { id: element.text("id")?.to_owned(), connections })
}
