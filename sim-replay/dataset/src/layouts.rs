//! Table of the supported layouts: name, data sets, the files that identify them, and their readers. Messages and
//! `--help` use it, and a folder is opened by it.

use crate::layout::{Layout, LayoutRow};
use crate::{
    cloud_sequence, dair, kitti_object, kitti_odometry, localization, nuscenes, opv2v_family,
    recorded, rosbag,
};

/// All layouts, in the order in which they are tried on a folder: data sets before sequences.
pub static LAYOUTS: [&LayoutRow; 15] = [
    &recorded::RECORDING,
    &dair::DAIR,
    &dair::V2XSEQ,
    &nuscenes::V2XSIM,
    &nuscenes::MARS,
    &nuscenes::NUSCENES,
    &opv2v_family::OPV2V,
    &opv2v_family::V2V4REAL,
    &opv2v_family::V2XREAL,
    &kitti_object::KITTI_OBJECT,
    &kitti_odometry::KITTI_ODOMETRY,
    &localization::NCLT,
    &localization::OXFORD,
    &cloud_sequence::CLOUDS,
    &rosbag::ROSBAG,
];

impl Layout {
    /// OPV2V, V2XSet, V2X-R, V2VDet and generated scenes: a folder per agent, YAML and PCD per frame, left-handed.
    pub const OPV2V: Self = Self(&opv2v_family::OPV2V);
    /// V2V4Real: the same folders, with pose matrices and objects in the LiDAR frame, right-handed.
    pub const V2V4REAL: Self = Self(&opv2v_family::V2V4REAL);
    /// V2X-Real and V2XPnP: the folders of OPV2V with `.bin` sweeps, right-handed.
    pub const V2XREAL: Self = Self(&opv2v_family::V2XREAL);
    /// DAIR-V2X-C: one vehicle and one roadside unit, JSON per frame.
    pub const DAIR: Self = Self(&dair::DAIR);
    /// V2X-Seq (SPD): DAIR-V2X as sequences with track ids.
    pub const V2XSEQ: Self = Self(&dair::V2XSEQ);
    /// V2X-Sim 2.0: nuScenes tables and sweeps of several agents.
    pub const V2XSIM: Self = Self(&nuscenes::V2XSIM);
    /// Open MARS: nuScenes tables of several vehicles.
    pub const MARS: Self = Self(&nuscenes::MARS);
    /// nuScenes: tables of one vehicle.
    pub const NUSCENES: Self = Self(&nuscenes::NUSCENES);
    /// Localization sequences of NCLT, as recorded or as converted by LightLoc.
    pub const NCLT: Self = Self(&localization::NCLT);
    /// Localization sequences of Oxford and QEOxford, as converted by LightLoc.
    pub const OXFORD: Self = Self(&localization::OXFORD);
    /// KITTI odometry.
    pub const KITTI_ODOMETRY: Self = Self(&kitti_odometry::KITTI_ODOMETRY);
    /// KITTI object detection.
    pub const KITTI_OBJECT: Self = Self(&kitti_object::KITTI_OBJECT);
    /// A recording of a live run ([`recording`]).
    pub const RECORDING: Self = Self(&recorded::RECORDING);
    /// A bag of ROS 2.
    pub const ROSBAG: Self = Self(&rosbag::ROSBAG);
}

/// One line per layout: name, data sets in brackets, and the files that identify it.
pub fn layouts_text() -> String {
    let lines = LAYOUTS.iter().map(|row| {
        let (name, files) = (row.name, row.files);
        let data_sets = match row.data_sets {
            own if own == name => String::new(),
            data_sets => format!(" ({data_sets})"),
        };
        format!("  {name}{data_sets}: {files}\n")
    });
    lines.collect()
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    #[test]
    fn every_layout_has_names_of_its_own_and_a_reader() {
        let keys: HashSet<&str> = LAYOUTS.iter().map(|row| row.key).collect();
        let names: HashSet<&str> = LAYOUTS.iter().map(|row| row.name).collect();
        assert_eq!((keys.len(), names.len()), (LAYOUTS.len(), LAYOUTS.len()));
        assert!(LAYOUTS[0].reader.is_some(), "no row before it");
        let text = layouts_text();
        assert_eq!(text.lines().count(), LAYOUTS.len());
        assert!(text.contains("  Open MARS: <version>"), "{text}");
    }
}
