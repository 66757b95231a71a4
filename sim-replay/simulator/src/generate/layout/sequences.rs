//! Layouts of one vehicle: each agent of each scene is a sequence, with a file per sweep and common pose files.

use std::path::{Path, PathBuf};
use std::sync::Mutex;

use protocol::Pose;

use super::disk::{Unfinished, make_folder, make_fresh_folder, write_file, write_origin};
use super::{DAY_MICROS, Moment, Omissions, SceneHeader, SceneWriter, locked};
use crate::generate::error::SynthError;

/// Differences between these layouts.
#[derive(Debug)]
pub(super) struct SequenceStyle {
    /// Time stamps of the first scene start here, microseconds.
    pub(super) epoch_micros: u64,
    /// The folder of a sequence below the root, by its number.
    pub(super) folder: fn(usize) -> String,
    /// The folder of the sweeps below that of the sequence.
    pub(super) sweeps_folder: &'static str,
    /// The name of a sweep's file, by index of its capture time and its time stamp.
    pub(super) file_name: fn(usize, u64) -> String,
    /// The bytes of a sweep.
    pub(super) points: fn(&[[f32; 4]], &Omissions) -> Vec<u8>,
    /// Writes the data common to all sweeps of a sequence, below the root.
    pub(super) write_poses: fn(&Path, &WrittenSequence<'_>) -> Result<(), SynthError>,
}

/// A sequence whose sweeps are written.
#[derive(Debug)]
pub(super) struct WrittenSequence<'a> {
    /// Its folder below the root.
    pub(super) folder: String,
    pub(super) number: usize,
    /// Capture times of the scene's moments, nanoseconds.
    pub(super) capture_nanos: &'a [u64],
    /// Sweeps by rising time.
    pub(super) sweeps: &'a [SweepPose],
}

/// A sweep that was written.
#[derive(Debug, Clone, Copy)]
pub(super) struct SweepPose {
    pub(super) moment: usize,
    pub(super) micros: u64,
    pub(super) world_from_lidar: Pose,
}

/// The writer.
#[derive(Debug)]
pub(super) struct Sequences {
    root: PathBuf,
    style: &'static SequenceStyle,
    /// Number of the scene that is being written, and of its first sequence.
    scene: usize,
    first_sequence: usize,
    capture_nanos: Vec<u64>,
    marks: Vec<Unfinished>,
    /// Sweeps that were written, with their agents.
    sweeps: Mutex<Vec<(usize, SweepPose)>>,
}

impl Sequences {
    pub(super) fn new(root: &Path, style: &'static SequenceStyle) -> Self {
        Self {
            root: root.to_owned(),
            style,
            scene: 0,
            first_sequence: 0,
            capture_nanos: Vec::new(),
            marks: Vec::new(),
            sweeps: Mutex::default(),
        }
    }

    fn folder(&self, sequence: usize) -> PathBuf {
        self.root.join((self.style.folder)(sequence))
    }
}

impl SceneWriter for Sequences {
    fn begin(&mut self, scene: &SceneHeader) -> Result<(), SynthError> {
        for agent in 0..scene.agents.len() {
            let folder = self.folder(self.first_sequence + agent);
            make_fresh_folder(&folder)?;
            self.marks.push(Unfinished::mark(&folder)?);
            write_origin(&folder, scene)?;
            make_folder(&folder.join(self.style.sweeps_folder))?;
        }
        self.capture_nanos.clone_from(&scene.capture_nanos);
        Ok(())
    }

    fn write(&self, moment: &Moment, omitted: &Omissions) -> Result<usize, SynthError> {
        let offset = self.style.epoch_micros + self.scene as u64 * DAY_MICROS;
        let micros = offset + self.capture_nanos[moment.index] / 1000;
        for frame in &moment.frames {
            let folder = self.folder(self.first_sequence + frame.agent);
            let folder = folder.join(self.style.sweeps_folder);
            let file = folder.join((self.style.file_name)(moment.index, micros));
            let points = (self.style.points)(&frame.frame.points.xyzi, omitted);
            write_file(&file, points)?;
            let boxes = frame.frame.objects.len();
            omitted.add("boxes, which the layout does not have", boxes);
            let sweep = SweepPose {
                moment: moment.index,
                micros,
                world_from_lidar: frame.world_from_lidar().into(),
            };
            locked(&self.sweeps).push((frame.agent, sweep));
        }
        Ok(moment.frames.len())
    }

    fn end(&mut self) -> Result<(), SynthError> {
        let mut sweeps = std::mem::take(&mut *locked(&self.sweeps));
        sweeps.sort_by_key(|(agent, sweep)| (*agent, sweep.moment));
        for (agent, mark) in std::mem::take(&mut self.marks).into_iter().enumerate() {
            let number = self.first_sequence;
            let own = sweeps.iter().filter(|(of, _)| *of == agent);
            let own: Vec<SweepPose> = own.map(|(_, sweep)| *sweep).collect();
            let sequence = WrittenSequence {
                folder: (self.style.folder)(number),
                number,
                capture_nanos: &self.capture_nanos,
                sweeps: &own,
            };
            (self.style.write_poses)(&self.root, &sequence)?;
            // Cleared after the poses, without which the sequence is incomplete.
            mark.clear()?;
            self.first_sequence += 1;
        }
        self.scene += 1;
        Ok(())
    }
}

/// A date by number, of months of 28 days each: year, month, day.
pub(super) fn date(first_year: usize, number: usize) -> [usize; 3] {
    let months = number / 28;
    [first_year + months / 12, 1 + months % 12, 1 + number % 28]
}

/// Points in axes with y to the right and z down, as in NCLT and Oxford.
pub(super) fn z_down([x, y, z, intensity]: [f32; 4]) -> [f32; 4] {
    [x, -y, -z, intensity]
}

/// A pose in such axes, of the sensor and of the world.
pub(super) fn pose_z_down(pose: &Pose) -> Pose {
    let ([x, y, z], [qw, qx, qy, qz]) = (pose.translation_m, pose.rotation_wxyz);
    // Half a turn about x on either side.
    Pose {
        translation_m: [x, -y, -z],
        rotation_wxyz: [qw, qx, -qy, -qz],
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use nalgebra::{Isometry3, Vector3};

    use super::*;

    #[test]
    fn dates_are_dates() {
        assert_eq!(
            [0, 27, 28, 335, 336].map(|number| date(2012, number)),
            [
                [2012, 1, 1],
                [2012, 1, 28],
                [2012, 2, 1],
                [2012, 12, 28],
                [2013, 1, 1]
            ]
        );
    }

    #[test]
    fn poses_turn_as_points_do() {
        let pose: Pose =
            Isometry3::new(Vector3::new(1.0, 2.0, 3.0), Vector3::new(0.1, -0.2, 0.7)).into();
        let half_turn = Isometry3::rotation(Vector3::x() * PI);
        let expected = half_turn * pose.isometry() * half_turn.inverse();
        let difference = pose_z_down(&pose).isometry().inv_mul(&expected);
        assert!(
            difference.translation.vector.norm() < 1e-12 && difference.rotation.angle() < 1e-12
        );
    }
}
