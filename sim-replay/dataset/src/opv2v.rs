//! Frames of OPV2V, V2XSet, V2X-R, V2VDet and generated scenes, and of V2X-Real and V2XPnP.
//!
//! OPV2V's files are left-handed: points, poses and boxes are mirrored here, all together. V2X-Real comes from real
//! sensors in the same format: the formula of its matrices is the same, and nothing is mirrored.

use std::path::PathBuf;

use protocol::{CavId, Handedness, InvalidPose, Pose};

use super::agent_folders::ScenarioFolder;
use super::annotations::Annotations;
use super::points::Sweeps;
use super::written_pose::WrittenPose;
use super::yaml::{self, Field};
use super::{CameraImages, FrameSource, Problem, Result, Tick, camera_files, points};
use crate::carla_pose::CarlaPose;
use crate::frame::Frame;
use crate::pcd::PcdCloud;

/// A scenario of the family.
#[derive(Debug)]
pub(super) struct Opv2v {
    pub(super) folder: ScenarioFolder,
    pub(super) sweeps: Sweeps,
    pub(super) handedness: Handedness,
}

impl FrameSource for Opv2v {
    fn frame(&self, agent: &CavId, tick: &Tick) -> Result<Frame> {
        if self.folder.without_yaml.contains(agent) {
            return Ok(Frame::empty(
                agent.clone(),
                tick.capture_nanos,
                self.handedness,
            ));
        }
        let path = self.folder.yaml(agent, &tick.stem);
        let node = yaml::read(&path)?;
        self.frame_without_points(agent, tick, Field::root(&path, &node))
    }

    fn points(&self, agent: &CavId, tick: &Tick, variant: Option<&str>) -> Result<PcdCloud> {
        self.sweeps
            .read(agent, &self.points_path(agent, tick, variant))
            .map(|cloud| self.right_handed(cloud))
    }

    fn radar(&self, agent: &CavId, tick: &Tick) -> Result<PcdCloud> {
        points::read_pcd(&self.folder.radar(agent, &tick.stem))
            .map(|cloud| self.right_handed(cloud))
    }

    fn cameras(&self, agent: &CavId, tick: &Tick, numbers: &[u8]) -> CameraImages {
        if self.folder.without_yaml.contains(agent) {
            return CameraImages::default();
        }
        let path = self.folder.yaml(agent, &tick.stem);
        let node = match yaml::read(&path) {
            Ok(node) => node,
            Err(error) => {
                return CameraImages {
                    problems: vec![Problem::from(&error)],
                    ..CameraImages::default()
                };
            }
        };
        let (root, dir) = (Field::root(&path, &node), self.folder.agent_dir(agent));
        let mut found = CameraImages::default();
        // An agent may have fewer cameras than others.
        let own = self.folder.cameras.get(agent);
        for &number in numbers
            .iter()
            .filter(|number| own.is_some_and(|own| own.contains(number)))
        {
            let camera = camera_files::find(&dir, &tick.stem, number).and_then(|file| {
                camera_files::read(&file, number, &root, &|field| self.six_numbers(field))
            });
            found.add(number, camera);
        }
        found
    }

    fn shared_files(&self, agent: &CavId) -> Vec<PathBuf> {
        let mut files = self.sweeps.samples(agent);
        files.push(self.folder.tick_length());
        files
    }

    fn frame_files(&self, agent: &CavId, tick: &Tick) -> Vec<PathBuf> {
        if self.folder.without_yaml.contains(agent) {
            return Vec::new();
        }
        vec![self.folder.yaml(agent, &tick.stem)]
    }

    fn points_path(&self, agent: &CavId, tick: &Tick, variant: Option<&str>) -> PathBuf {
        self.folder.pcd(agent, &tick.stem, variant)
    }
}

impl Opv2v {
    fn frame_without_points(&self, agent: &CavId, tick: &Tick, root: Field<'_>) -> Result<Frame> {
        // A faulty LiDAR pose is an error of the frame: all else in it is relative to it.
        let world_from_lidar = root
            .optional("lidar_pose")?
            .map(|field| self.six_numbers(&field))
            .transpose()?;
        let mut annotations = Annotations::new(root);
        let motion = annotations.motion(self.handedness);
        Ok(Frame {
            world_from_lidar,
            world_from_vehicle: annotations.optional(&["true_ego_pos", "true_ego_pose"], |field| {
                self.six_numbers(field)
            }),
            gnss_world_from_vehicle: annotations
                .optional(&["predicted_ego_pos", "predicted_ego_pose"], |field| {
                    self.six_numbers(field)
                }),
            speed_mps: motion.speed_mps,
            yaw_rate_rad_s: motion.yaw_rate_rad_s,
            objects: annotations.objects(|id, _| Ok(id), |place| self.world_from(place)),
            problems: annotations.into_problems(),
            ..Frame::empty(agent.clone(), tick.capture_nanos, self.handedness)
        })
    }

    /// x, y, z, roll, yaw, pitch in metres and degrees.
    fn six_numbers(&self, field: &Field<'_>) -> Result<Pose> {
        match WrittenPose::read(field)? {
            WrittenPose::SixNumbers(place) => self.world_from(&place).map_err(|error| field.error(error.to_string())),
            WrittenPose::Matrix(_) => Err(field.error(
                "a 4x4 matrix as in V2V4Real, but the scenario's first frame has a lidar_pose of 6 numbers as in OPV2V",
            )),
        }
    }

    fn world_from(&self, place: &CarlaPose) -> Result<Pose, InvalidPose> {
        match self.handedness {
            Handedness::Left => {
                let pose = place.to_pose();
                pose.validate().map(|()| pose)
            }
            Handedness::Right => Pose::from_matrix(&place.left_handed_matrix()),
        }
    }

    fn right_handed(&self, mut cloud: PcdCloud) -> PcdCloud {
        if self.handedness == Handedness::Left {
            points::mirror_y(&mut cloud.points);
        }
        cloud
    }
}

#[cfg(test)]
pub(crate) mod tests;
