//! Multi-scale networks on recorded frames.

use std::path::Path;

use dataset::frame::Frame;
use perception::boxes::anchors::Anchors;
use perception::boxes::decode::decode;
use perception::boxes::postprocess::{PostprocessConfig, detections};
use perception::crop::Crop;
use perception::detector::Heads;
use perception::model_config::{DetectorConfig, YAxis};
use perception::pillars::batch::PillarBatch;
use perception::pillars::voxels::{Pillars, Voxeliser};
use protocol::{Detection, PointCloud, Pose};
use tch::{Device, no_grad};

use super::{MapAlignment, MultiScaleNetwork};
use fusion::model::ModelError;
use fusion::points::merge_points;

/// Detects in the recorded sweeps of several vehicles, by their recorded poses.
#[derive(Debug)]
pub struct OfflineDetector {
    network: MultiScaleNetwork,
    crop: Crop,
    voxeliser: Voxeliser,
    anchors: Anchors,
    limits: PostprocessConfig,
}

impl OfflineDetector {
    /// Reads a weights file of a multi-scale network.
    ///
    /// # Errors
    /// [`ModelError`] names the file and what does not fit.
    pub fn load(path: &Path) -> Result<Self, ModelError> {
        let network = MultiScaleNetwork::load(path, Device::Cpu)?;
        let config = &network.network.config;
        Ok(Self {
            crop: Crop::for_detector(config),
            voxeliser: Voxeliser::for_detector(config),
            anchors: Anchors::for_detector(config),
            limits: PostprocessConfig::for_detector(config),
            network,
        })
    }

    /// Configuration of its encoder and head.
    pub fn config(&self) -> &DetectorConfig {
        &self.network.network.config
    }

    /// Detections in the frame of the first of the vehicles in range, and the bytes that each of the others that took part
    /// had to send: those with a pose.
    ///
    /// # Errors
    /// [`ModelError`] when the tensor library reports an error.
    pub fn detect(&mut self, frames: &[Frame]) -> Result<(Vec<Detection>, Vec<u64>), ModelError> {
        let Some((ego, others)) = frames.split_first() else {
            return Ok((Vec::new(), Vec::new()));
        };
        let mut poses = vec![Pose::IDENTITY];
        let mut sweeps = vec![self.pillars(&ego.points, &Pose::IDENTITY)];
        for frame in others {
            let world_from = ego.world_from_lidar.zip(frame.world_from_lidar);
            let Some((world_from_ego, world_from_cav)) = world_from else {
                continue;
            };
            let pose = world_from_ego.from_world(&world_from_cav);
            sweeps.push(self.pillars(&frame.points, &pose));
            poses.push(pose);
        }
        self.boxes(&sweeps, &poses)
    }

    /// The pillars of a vehicle's sweep, in the frame that its network encodes in.
    fn pillars(&mut self, cloud: &PointCloud, ego_from_cav: &Pose) -> Pillars {
        // A vehicle's own body is where its sensor is: removed before its cloud is moved.
        let cloud = self.crop.without_own_body(cloud);
        let cloud = match self.network.config.one_frame {
            true => merge_points([&cloud], &[*ego_from_cav]),
            false => cloud,
        };
        // The area is that of the frame in which the network encodes: cropped after the move.
        let mut kept = Vec::new();
        self.crop.range_only().keep(&cloud.xyzi, &mut kept);
        // Weights from CARLA have y to the right: clouds are mirrored on the way in, boxes on the way out.
        if self.is_mirrored() {
            kept.iter_mut().for_each(|point| point[1] = -point[1]);
        }
        self.voxeliser.voxelise(&kept)
    }

    fn is_mirrored(&self) -> bool {
        self.network.network.config.y_axis == YAxis::Right
    }

    fn boxes(
        &self,
        sweeps: &[Pillars],
        poses: &[Pose],
    ) -> Result<(Vec<Detection>, Vec<u64>), ModelError> {
        let network = &self.network.network;
        let batch = PillarBatch::new(&sweeps.iter().collect::<Vec<_>>(), &network.pillar_grid);
        let mirrored: Vec<Pose> = poses.iter().map(Pose::mirrored_y).collect();
        let poses = if self.is_mirrored() { &mirrored } else { poses };
        let placement = if self.network.config.one_frame {
            MapAlignment {
                agents: poses.len() as i64,
                theta: None,
            }
        } else {
            MapAlignment::of_poses(poses, &network.config.feature_grid())?
        };
        let output = no_grad(|| self.network.forward(&batch, &[placement]))?;
        let heads = Heads::new(&output.heads)?;
        let threshold = self.limits.score_threshold;
        let mut boxes = decode(&heads.scores, &heads.offsets, &self.anchors, threshold)?;
        if self.is_mirrored() {
            for found in &mut boxes {
                found.box3d = found.box3d.mirrored_y();
            }
        }
        // The ego's own map is not transmitted.
        let sent_bytes = output.sent_bytes.into_iter().skip(1).collect();
        Ok((detections(&boxes, &self.limits), sent_bytes))
    }
}
