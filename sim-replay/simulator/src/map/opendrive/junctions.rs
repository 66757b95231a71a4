//! `<junction>`: connections of roads through a junction.

use super::super::finding::FindingLog;
use super::super::road::{Connection, Junction};
use super::Ids;
use super::element::{Element, Result, children, noted};
use super::links::{read_contact, read_road};

/// Reads a junction; connections that cannot be read are left out.
pub(super) fn read(element: Element, ids: &Ids, log: &mut FindingLog) -> Junction {
    let kind = element.optional_text("type").unwrap_or("default");
    let direct = kind == "direct";
    let action = match kind {
        "default" | "direct" | "" => None,
        "virtual" => Some("built only where its roads begin or end at other roads' ends"),
        "crossing" => Some("left out: pedestrian crossings are not simulated"),
        _ => Some("treated as a common junction"),
    };
    if let Some(action) = action {
        element.note_value(log, "type", action);
    }
    let connections = children(element, "connection").filter_map(|connection| {
        let read = read_connection(connection, ids, direct, log);
        noted(read, log, "connection left out")
    });
    Junction {
        id: element.optional_text("id").unwrap_or_default().to_owned(),
        direct,
        connections: connections.collect(),
    }
}

fn read_connection(
    element: Element,
    ids: &Ids,
    direct: bool,
    log: &mut FindingLog,
) -> Result<Connection> {
    let onto = match direct {
        true => "linkedRoad",
        false => "connectingRoad",
    };
    if element.optional_text(onto).is_none() {
        return Err(element.error_element("names no road that it leads to"));
    }
    let mut lane_links = Vec::new();
    for link in children(element, "laneLink") {
        match (link.lane_id("from"), link.lane_id("to")) {
            (Ok(from), Ok(to)) => lane_links.push((from, to)),
            (Err(error), _) | (_, Err(error)) => error.note(log, "lane link left out"),
        }
    }
    // Without any link, lanes of one id are linked; links that are all unreadable link nothing.
    if lane_links.is_empty() && element.child("laneLink").is_some() {
        return Err(element.error_element("has no lane link that can be read"));
    }
    Ok(Connection {
        incoming: read_road(element, "incomingRoad", ids)?,
        connecting: read_road(element, onto, ids)?,
        contact: read_contact(element)?,
        lane_links,
    })
}
