//! Alignment by sweeps: ICP of the neighbour's sweep against the ego's.

use localization::pose_source::NO_SOURCE;
use localization::registration::icp::{self, IcpConfig, IcpSource, IcpTarget};
use nalgebra::Isometry3;
use protocol::message::{Message, Points};
use protocol::{PointCloud, PoseEstimate};

use super::method::{
    AlignError, AlignInput, Alignment, AlignmentMethod, AlignmentSpec, NotAligned, pose_difference,
};

/// Registers the neighbour's decimated sweep against the ego's own.
#[derive(Debug, Clone)]
pub struct CloudIcp {
    starts_at_gnss: bool,
}

impl CloudIcp {
    /// Starts at the identity, or (`starts_at_gnss`) at the difference of both receivers' poses.
    pub fn spec(starts_at_gnss: bool) -> AlignmentSpec {
        let name = if starts_at_gnss { "icp-gnss" } else { "icp" };
        AlignmentSpec::new(name, false, move || Self { starts_at_gnss })
    }
}

impl AlignmentMethod for CloudIcp {
    fn prepare(&mut self, vehicle: &AlignInput<'_>) -> Result<Message, AlignError> {
        let decimate = IcpSource::of_sweep(&vehicle.frame.points.xyzi);
        let points = decimate.points_m.iter();
        let xyzi = points.map(|p| [p.x as f32, p.y as f32, p.z as f32, 0.0]);
        let points = PointCloud {
            xyzi: xyzi.collect(),
        };
        let measured = vehicle.frame.gnss_world_from_lidar();
        let measured = measured.filter(|_| self.starts_at_gnss);
        let pose = measured.map_or(NO_SOURCE, |pose| PoseEstimate::new(pose, 1.0));
        Ok(Message::Points(Points { pose, points }))
    }

    fn align(&self, ego: &AlignInput<'_>, own: &Message, received: &Message) -> Alignment {
        let (Message::Points(own), Message::Points(received)) = (own, received) else {
            return Err(NotAligned::Message);
        };
        let start = match self.starts_at_gnss {
            true => pose_difference(&own.pose, &received.pose)?,
            false => Isometry3::identity(),
        };
        let config = IcpConfig::default();
        // The ego has its own sweep at full density: flatter planes than from a decimated one.
        let target = IcpTarget::of_sweep(&ego.frame.points.xyzi, &config);
        let source = IcpSource::of_sweep(&received.points.xyzi);
        Ok(icp::register(&source, &target, &start, &config)?.target_from_source)
    }
}
