//! Report on an OpenDRIVE map: its contents, and parts that are not built as its file gives them.

use std::fmt;
use std::path::Path;

use serde::Serialize;

use simulator::map::{Finding, read_map};
use support::file_error::FileError;

/// Contents of an OpenDRIVE map. Serializes to the JSON of `sim-replay inspect --json MAP.xodr`, prints as its table.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MapReport {
    /// The file, as given.
    pub path: String,
    /// Roads that can be built.
    pub roads: usize,
    /// Total length, metres.
    pub roads_m: f64,
    /// Roads with left-hand traffic; the others have right-hand traffic.
    pub left_hand_roads: usize,
    /// Roads that are not level across: superelevation, crossfall, shape.
    pub banked_roads: usize,
    /// Junctions.
    pub junctions: usize,
    /// Junctions of type `direct` among them.
    pub direct_junctions: usize,
    /// Driving lanes; a road has one for each of its lanes and lane sections.
    pub lanes: usize,
    /// Total length, metres.
    pub lanes_m: f64,
    /// Driving lanes without a successor.
    pub dead_ends: usize,
    /// Lowest and highest point of the driving lanes' centre lines, metres; `None` without driving lanes.
    pub heights_m: Option<[f64; 2]>,
    /// Parts that are not built as the file gives them.
    pub findings: Vec<Finding>,
}

/// Reads an OpenDRIVE map.
///
/// # Errors
/// [`FileError`] if the file cannot be read or is no usable map.
pub fn inspect_map(path: &Path) -> Result<MapReport, FileError> {
    let (network, lanes) = read_map(path)?;
    let (roads, lanes) = (&network.roads, &lanes.lanes);
    let points = lanes.iter().flat_map(|lane| &lane.centerline);
    let heights = points.map(|point| point[2]);
    let range = [
        heights.clone().fold(f64::INFINITY, f64::min),
        heights.fold(f64::NEG_INFINITY, f64::max),
    ];
    let direct = network.junctions.iter().filter(|junction| junction.direct);
    let dead_ends = lanes.iter().filter(|lane| lane.successors.is_empty());
    Ok(MapReport {
        path: path.display().to_string(),
        roads: roads.len(),
        roads_m: roads.iter().map(|road| road.length_m).sum(),
        left_hand_roads: roads.iter().filter(|road| road.left_hand).count(),
        banked_roads: roads.iter().filter(|road| !road.lateral.is_level()).count(),
        junctions: network.junctions.len(),
        direct_junctions: direct.count(),
        lanes: lanes.len(),
        lanes_m: lanes.iter().map(|lane| lane.length_m).sum(),
        dead_ends: dead_ends.count(),
        heights_m: (!lanes.is_empty()).then_some(range),
        findings: network.findings,
    })
}

impl fmt::Display for MapReport {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(out, "{} (OpenDRIVE)", self.path)?;
        let keeps = match self.left_hand_roads {
            0 => "traffic keeps right".to_owned(),
            all if all == self.roads => "traffic keeps left".to_owned(),
            some => format!("traffic keeps left on {some} of them"),
        };
        writeln!(
            out,
            "roads      {} of {:.0} m, {keeps}, {} not level across",
            self.roads, self.roads_m, self.banked_roads
        )?;
        let (junctions, direct) = (self.junctions, self.direct_junctions);
        writeln!(out, "junctions  {junctions}, {direct} of them direct")?;
        writeln!(
            out,
            "lanes      {} of {:.0} m to drive on, {} with none after it",
            self.lanes, self.lanes_m, self.dead_ends
        )?;
        if let Some([low, high]) = self.heights_m {
            writeln!(out, "heights    {low:.2} to {high:.2} m")?;
        }
        write!(out, "findings   {}", self.findings.len())?;
        self.findings
            .iter()
            .try_for_each(|finding| write!(out, "\n  {finding}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_is_counted_and_its_findings_are_listed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.xodr");
        let [left, right] = [1, -1].map(|id| {
            format!(
                r#"<lane id="{id}" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/><speed max="-1"/></lane>"#
            )
        });
        let text = format!(
            r#"<OpenDRIVE><road id="1" length="40" rule="LHT"><planView>
            <geometry s="0" x="0" y="0" hdg="0" length="40"><line/></geometry></planView>
            <lateralProfile><superelevation s="0" a="0.1" b="0" c="0" d="0"/></lateralProfile>
            <lanes><laneSection s="0"><left>{left}</left><right>{right}</right></laneSection></lanes></road></OpenDRIVE>"#
        );
        std::fs::write(&path, text).unwrap();
        let report = inspect_map(&path).unwrap();
        assert_eq!(
            (
                report.roads,
                report.left_hand_roads,
                report.banked_roads,
                report.lanes
            ),
            (1, 1, 1, 2)
        );
        assert_eq!(
            (
                report.dead_ends,
                report.findings.len(),
                report.findings[0].count
            ),
            (2, 1, 2)
        );
        let [low, high] = report.heights_m.unwrap();
        assert!((high - 1.5 * 0.1f64.sin()).abs() < 1e-9 && (low + high).abs() < 1e-9);
        let text = report.to_string();
        assert!(
            text.contains("roads      1 of 40 m, traffic keeps left, 1 not level across"),
            "{text}"
        );
        assert!(
            text.ends_with(
                "expected a value from 0 to 1000; speed limit treated as absent (2 times)"
            ),
            "{text}"
        );
        assert!(inspect_map(&folder.path().join("b.xodr")).is_err());
    }
}
