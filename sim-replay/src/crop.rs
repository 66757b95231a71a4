//! Which points of a sweep a pipeline looks at.
//!
//! The numbers and the handling of borders are OpenCOOD's (`opencood/utils/pcd_utils.py`).

use protocol::PointCloud;

/// x of the sender's own body in its LiDAR frame, metres. The LiDAR sits half a metre behind the vehicle's origin.
const BODY_X_M: [f32; 2] = [-1.95, 2.95];
/// The same for y.
const BODY_Y_M: [f32; 2] = [-1.1, 1.1];

/// Removes hits on the sender's own body: x -1.95..2.95, y -1.1..1.1 m, borders included, at any height.
pub fn remove_own_body(cloud: &mut PointCloud) {
    let within = |value: f32, [low, high]: [f32; 2]| low <= value && value <= high;
    cloud.xyzi.retain(|&[x, y, ..]| !(within(x, BODY_X_M) && within(y, BODY_Y_M)));
}

/// Keeps the points strictly between `low_m` and `high_m` in x, y and z.
pub fn keep_range(cloud: &mut PointCloud, low_m: [f32; 3], high_m: [f32; 3]) {
    cloud.xyzi.retain(|point| (0..3).all(|axis| low_m[axis] < point[axis] && point[axis] < high_m[axis]));
}

#[cfg(test)]
mod tests {
    use super::*;

    fn x_of(cloud: &PointCloud) -> Vec<f32> {
        cloud.xyzi.iter().map(|point| point[0]).collect()
    }

    #[test]
    fn the_body_goes_with_its_border() {
        let mut cloud = PointCloud { xyzi: [-1.96, -1.95, 0.0, 2.95, 2.96].map(|x| [x, 1.1, 50.0, 0.0]).to_vec() };
        cloud.xyzi.push([0.0, -1.2, 0.0, 0.0]);
        remove_own_body(&mut cloud);
        assert_eq!(x_of(&cloud), [-1.96, 2.96, 0.0]);
    }

    #[test]
    fn the_border_of_the_range_is_outside() {
        let mut cloud = PointCloud { xyzi: [-2.0, -1.9, 0.0, 1.0].map(|x| [x, 0.0, 0.0, 0.0]).to_vec() };
        keep_range(&mut cloud, [-2.0, -1.0, -1.0], [1.0, 1.0, 1.0]);
        assert_eq!(x_of(&cloud), [-1.9, 0.0]);
    }
}
