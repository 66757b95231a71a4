//! Samples of drives: sweeps and annotated objects of one time.

use std::collections::HashMap;

use nalgebra::Isometry3;

use crate::frame::Object;

/// A sample of a drive, with the sweeps of all LiDARs.
#[derive(Debug, Default)]
pub(super) struct SceneSample {
    /// Index of the scene.
    pub(super) scene: usize,
    pub(super) micros: u64,
    /// By channel, for example `LIDAR_TOP`.
    pub(super) sweeps: HashMap<String, SampleSweep>,
    /// Annotated objects.
    pub(super) objects: Vec<Object>,
}

/// File of a sweep, and the pose of its LiDAR.
#[derive(Debug, Clone)]
pub(super) struct SampleSweep {
    /// Path below the root of the data set.
    pub(super) file: String,
    /// Time between it and its sample, microseconds; the largest where it is not known.
    pub(super) off_micros: u64,
    pub(super) world_from_vehicle: Isometry3<f64>,
    pub(super) vehicle_from_lidar: Isometry3<f64>,
}
