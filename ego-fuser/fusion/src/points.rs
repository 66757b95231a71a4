//! Early fusion: the point clouds of several vehicles in the frame of the ego.

use nalgebra::Point3;
use protocol::{PointCloud, Pose};

/// The points of several sweeps in the frame of the ego.
pub fn merge_points<'a>(
    clouds: impl IntoIterator<Item = &'a PointCloud>,
    ego_from_cav: &[Pose],
) -> PointCloud {
    let mut merged = PointCloud::default();
    for (cloud, pose) in clouds.into_iter().zip(ego_from_cav) {
        // Points of the ego itself stay as they are, bit for bit.
        if *pose == Pose::IDENTITY {
            merged.xyzi.extend(&cloud.xyzi);
            continue;
        }
        let ego_from_cav = pose.isometry().cast::<f32>();
        let points = cloud.xyzi.iter().map(|&[x, y, z, intensity]| {
            let moved = ego_from_cav * Point3::new(x, y, z);
            [moved.x, moved.y, moved.z, intensity]
        });
        merged.xyzi.extend(points);
    }
    merged
}
