//! Table of the supported layouts: name, data sets, and the files that identify them. Messages and `--help` use it.

use std::fmt::Write;

use serde::Serialize;

/// A layout of files on disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Layout {
    /// OPV2V, V2XSet, V2X-R, V2VDet and generated scenes: a folder per agent, YAML and PCD per frame, left-handed.
    Opv2v,
    /// V2V4Real: the same folders, with pose matrices and objects in the LiDAR frame, right-handed.
    V2v4Real,
    /// V2X-Real and V2XPnP: the folders of OPV2V with `.bin` sweeps, right-handed.
    V2xReal,
    /// DAIR-V2X-C: one vehicle and one roadside unit, JSON per frame.
    Dair,
    /// V2X-Seq (SPD): DAIR-V2X as sequences with track ids.
    V2xSeq,
    /// V2X-Sim 2.0: nuScenes tables and sweeps of several agents.
    V2xSim,
    /// Open MARS: nuScenes tables of several vehicles.
    Mars,
    /// nuScenes: tables of one vehicle.
    NuScenes,
    /// Localization sequences of NCLT, as recorded or as converted by LightLoc.
    Nclt,
    /// Localization sequences of Oxford and QEOxford, as converted by LightLoc.
    Oxford,
    /// KITTI odometry.
    KittiOdometry,
    /// KITTI object detection.
    KittiObject,
    /// A recording of a live run ([`recording`]).
    Recording,
}

/// Description of a layout for users.
#[derive(Debug, Clone, Copy)]
pub struct LayoutDescription {
    /// The layout.
    pub layout: Layout,
    /// Its name in messages and tables.
    pub name: &'static str,
    /// The data sets that are published in it.
    pub data_sets: &'static str,
    /// The files that identify it, relative to a scenario's folder or the root of the data set.
    pub files: &'static str,
}

const fn row(layout: Layout, name: &'static str, data_sets: &'static str, files: &'static str) -> LayoutDescription {
    LayoutDescription { layout, name, data_sets, files }
}

/// All layouts, in the order in which they are tried on a folder.
pub const LAYOUTS: [LayoutDescription; 13] = [
    row(
        Layout::Recording,
        "recording of a live run",
        "runs of v2vloc",
        "a file <name>.mcap, or recording.mcap in a run folder",
    ),
    row(
        Layout::Dair,
        "DAIR-V2X",
        "DAIR-V2X-C",
        "cooperative/data_info.json with vehicle_pointcloud_path, vehicle-side/, infrastructure-side/",
    ),
    row(
        Layout::V2xSeq,
        "V2X-Seq",
        "V2X-Seq-SPD",
        "cooperative/data_info.json with vehicle_frame, vehicle-side/, infrastructure-side/",
    ),
    row(
        Layout::V2xSim,
        "V2X-Sim",
        "V2X-Sim 2.0",
        "<version>/sample.json and sample_data.json (nuScenes tables), a LiDAR LIDAR_TOP_id_<agent>",
    ),
    row(
        Layout::Mars,
        "Open MARS",
        "Open MARS",
        "<version>/sample.json and sample_data.json (nuScenes tables), a LiDAR LIDAR_FRONT_CENTER or LIDAR_FRONT_CENTER_<vehicle>",
    ),
    row(
        Layout::NuScenes,
        "nuScenes",
        "nuScenes",
        "<version>/sample.json and sample_data.json (nuScenes tables), the LiDAR LIDAR_TOP",
    ),
    row(
        Layout::Opv2v,
        "OPV2V layout",
        "OPV2V, V2XSet, V2X-R, V2VDet, V2X-Radar, RCooper as its converter writes it, generated scenes",
        "<scenario>/<agent>/<frame>.yaml and .pcd; lidar_pose of 6 numbers",
    ),
    row(
        Layout::V2v4Real,
        "V2V4Real layout",
        "V2V4Real",
        "<scenario>/<agent>/<frame>.yaml and .pcd; lidar_pose a 4x4 matrix or 16 numbers",
    ),
    row(
        Layout::V2xReal,
        "V2X-Real layout",
        "V2X-Real, V2XPnP",
        "<scenario>/<agent>/<frame>.yaml and .bin (float32 x y z intensity); lidar_pose of 6 numbers",
    ),
    row(
        Layout::KittiObject,
        "KITTI object",
        "KITTI object detection",
        "velodyne/<frame>.bin and calib/<frame>.txt (a folder)",
    ),
    row(
        Layout::KittiOdometry,
        "KITTI odometry",
        "KITTI odometry, SemanticKITTI",
        "velodyne/<scan>.bin and calib.txt (a file)",
    ),
    row(
        Layout::Nclt,
        "NCLT localization sequences",
        "NCLT, as published or as LightLoc converts it",
        "<day>/velodyne_sync/<microseconds>.bin, or <day>/velodyne_left/<microseconds>.bin in a folder named by a date",
    ),
    row(
        Layout::Oxford,
        "Oxford localization sequences",
        "Oxford Radar RobotCar and QEOxford as LightLoc converts them",
        "<sequence>/velodyne_left/<microseconds>.bin",
    ),
];

impl Layout {
    /// Its row of [`LAYOUTS`].
    #[must_use]
    pub fn description(self) -> &'static LayoutDescription {
        // A test checks that every layout has a row.
        LAYOUTS.iter().find(|row| row.layout == self).unwrap_or(&LAYOUTS[0])
    }

    /// Its name in messages and tables.
    #[must_use]
    pub fn name(self) -> &'static str {
        self.description().name
    }
}

/// One line per layout: name, data sets in brackets, and the files that identify it.
#[must_use]
pub fn layouts_text() -> String {
    let mut text = String::new();
    for LayoutDescription { name, data_sets, files, .. } in &LAYOUTS {
        let data_sets = if name == data_sets { String::new() } else { format!(" ({data_sets})") };
        // Writing to a String does not fail.
        let _ = writeln!(text, "  {name}{data_sets}: {files}");
    }
    text
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    #[test]
    fn every_layout_has_one_row_of_its_own_name() {
        use Layout::{
            Dair, KittiObject, KittiOdometry, Mars, Nclt, NuScenes, Opv2v, Oxford, Recording, V2v4Real, V2xReal,
            V2xSeq, V2xSim,
        };
        let multi_agent = [Opv2v, V2v4Real, V2xReal, Dair, V2xSeq, V2xSim, Mars];
        let all = [&multi_agent[..], &[NuScenes, Nclt, Oxford, KittiOdometry, KittiObject, Recording]].concat();
        assert!(all.iter().all(|layout| layout.description().layout == *layout));
        let names: HashSet<&str> = LAYOUTS.iter().map(|row| row.name).collect();
        assert_eq!(names.len(), LAYOUTS.len());
        let text = layouts_text();
        assert_eq!(text.lines().count(), LAYOUTS.len());
        assert!(text.contains("  Open MARS: <version>"), "{text}");
    }
}
