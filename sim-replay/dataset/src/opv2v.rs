//! Frames of OPV2V, V2XSet, V2X-R, V2VDet and generated scenes, and of V2X-Real and V2XPnP.
//!
//! OPV2V's files are left-handed: points, poses and boxes are mirrored here, all together. V2X-Real comes from real
//! sensors in the same format: the formula of its matrices is the same, and nothing is mirrored.

use std::path::PathBuf;

use protocol::{CavId, Handedness, InvalidPose, Pose};

use super::agent_folders::ScenarioFolder;
use super::annotations::Annotations;
use super::frame_files::RADAR;
use super::points::Sweeps;
use super::written_pose::WrittenPose;
use super::yaml::{self, YamlField};
use super::{FrameSource, Problem, Result, Tick, camera_files, points, poses, repeats};
use crate::carla_pose::CarlaPose;
use crate::frame::Frame;
use crate::pcd::{self, PcdCloud};

/// A scenario of the family.
#[derive(Debug)]
pub(super) struct Opv2v {
    pub(super) folder: ScenarioFolder,
    pub(super) sweeps: Sweeps,
    pub(super) handedness: Handedness,
}

impl FrameSource for Opv2v {
    fn frame(&self, agent: &CavId, tick: &Tick) -> Result<Frame> {
        let mut frame = Frame::empty(agent.clone(), tick.capture_nanos, self.handedness);
        if self.folder.is_without_yaml(agent) {
            return Ok(frame);
        }
        let path = self.folder.yaml(agent, &tick.stem);
        let node = yaml::read(&path)?;
        let root = YamlField::root(&path, &node);
        // A faulty LiDAR pose is an error of the frame: all else in it is relative to it.
        if let Some(field) = root.optional("lidar_pose")? {
            frame.world_from_lidar = Some(self.six_numbers(&field)?);
        }
        let mut annotations = Annotations::new(root);
        annotations.add_vehicle(&mut frame, |field| self.six_numbers(field));
        frame.objects = annotations.objects(|id, _| Ok(id), |place| self.world_from(place));
        frame.problems = annotations.problems;
        repeats::leave_out(&path, &mut frame.objects, &mut frame.problems);
        Ok(frame)
    }

    fn points(&self, agent: &CavId, tick: &Tick, variant: Option<&str>) -> Result<PcdCloud> {
        self.sweeps
            .read(agent, &self.points_path(agent, tick, variant))
            .map(|cloud| self.right_handed(cloud))
    }

    fn radar(&self, agent: &CavId, tick: &Tick) -> Result<PcdCloud> {
        points::read_with(&self.points_path(agent, tick, Some(RADAR)), pcd::decode)
            .map(|cloud| self.right_handed(cloud))
    }

    fn cameras(&self, agent: &CavId, tick: &Tick, numbers: &[u8], frame: &mut Frame) {
        if self.folder.is_without_yaml(agent) {
            return;
        }
        let path = self.folder.yaml(agent, &tick.stem);
        let node = match yaml::read(&path) {
            Ok(node) => node,
            Err(error) => return frame.problems.push(Problem::from(&error)),
        };
        let (root, dir) = (YamlField::root(&path, &node), self.folder.agent_dir(agent));
        // An agent may have fewer cameras than others.
        let own = self.folder.by_agent.get(agent);
        for &number in numbers
            .iter()
            .filter(|number| own.is_some_and(|own| own.cameras.contains(number)))
        {
            let camera = camera_files::find(&dir, &tick.stem, number).and_then(|file| {
                camera_files::read(&file, number, &root, &|field| self.six_numbers(field))
            });
            frame.add_camera(number, camera);
        }
    }

    fn shared_files(&self, agent: &CavId) -> Vec<PathBuf> {
        self.sweeps.samples(agent, [self.folder.tick_length()])
    }

    fn frame_files(&self, agent: &CavId, tick: &Tick) -> Vec<PathBuf> {
        if self.folder.is_without_yaml(agent) {
            return Vec::new();
        }
        vec![self.folder.yaml(agent, &tick.stem)]
    }

    fn points_path(&self, agent: &CavId, tick: &Tick, variant: Option<&str>) -> PathBuf {
        self.folder.pcd(agent, &tick.stem, variant)
    }
}

impl Opv2v {
    /// x, y, z, roll, yaw, pitch in metres and degrees.
    fn six_numbers(&self, field: &YamlField<'_>) -> Result<Pose> {
        match WrittenPose::read(field)? {
            WrittenPose::SixNumbers(place) => self.world_from(&place).map_err(|error| field.error(error.to_string())),
            WrittenPose::Matrix(_) => Err(field.error(
                "a 4x4 matrix as in V2V4Real, but the scenario's first frame has a lidar_pose of 6 numbers as in OPV2V",
            )),
        }
    }

    fn world_from(&self, place: &CarlaPose) -> Result<Pose, InvalidPose> {
        match self.handedness {
            Handedness::Left => poses::valid(place.to_pose()),
            Handedness::Right => Pose::from_matrix(&place.left_handed_matrix()),
        }
    }

    fn right_handed(&self, mut cloud: PcdCloud) -> PcdCloud {
        if self.handedness == Handedness::Left {
            cloud.points.mirror();
        }
        cloud
    }
}

#[cfg(test)]
pub(crate) mod tests;
