//! Boxes and intensities in formats that several layouts share.

use nalgebra::{Isometry3, Point3};
use protocol::Box3d;

use super::AgentFrame;
use crate::generate::lidar::{CHANNELS, ELEVATIONS_DEG};
use dataset::frame::{Object, ObjectClass};
use dataset::ground_truth::upright_box;

/// Intensity value that corresponds to 1.
const FULL_BYTE: f32 = 255.0;

/// An intensity of 0 to 1 as a number of 0 to 255 that comes back bit by bit when it is divided by 255: always for
/// multiples of 1/255, and for all but one number in 250 else, which comes back one step beside.
pub(super) fn of_255(intensity: f32) -> f32 {
    let nearest = intensity * FULL_BYTE;
    let candidates = [nearest, nearest.next_down(), nearest.next_up()];
    let exact = candidates
        .into_iter()
        .find(|candidate| candidate / FULL_BYTE == intensity);
    exact.unwrap_or(nearest)
}

/// An intensity of 0 to 1 as a sensor's byte.
pub(super) fn byte(intensity: f32) -> u8 {
    // A cast saturates, and NaN becomes 0.
    (intensity * FULL_BYTE).round() as u8
}

/// The channel, counted from below, of the LiDAR of generated scenes in the direction of a point.
pub(super) fn ring([x, y, z, _]: [f32; 4]) -> u8 {
    let elevation_deg = z.atan2(x.hypot(y)).to_degrees();
    let [low, high] = ELEVATIONS_DEG;
    let highest = (CHANNELS - 1) as f32;
    let channel = (elevation_deg - low) / (high - low) * highest;
    channel.round().clamp(0.0, highest) as u8
}

/// Little-endian numbers, one after another.
pub(super) fn float_bytes<const N: usize>(
    rows: impl ExactSizeIterator<Item = [f32; N]>,
) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(rows.len() * N * size_of::<f32>());
    bytes.extend(rows.flatten().flat_map(f32::to_le_bytes));
    bytes
}

/// The object as an upright box in the frame of a LiDAR.
pub(super) fn upright_in(frame: &AgentFrame, object: &Object) -> Box3d {
    upright_box(object, &frame.world_from_lidar().inverse())
}

/// The corners of the box in the world, metres: `(+l, +w) (+l, -w) (-l, -w) (-l, +w)` of the bottom face, then of the
/// top face. They keep the tilt of the box.
pub(super) fn world_corners(object: &Object) -> [[f64; 3]; 8] {
    const SIGNS: [(f64, f64); 4] = [(1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0)];
    let world_from_object = object.world_from_object.isometry();
    let [half_l, half_w, half_h] = object.size_m.map(|size| size / 2.0);
    std::array::from_fn(|corner| {
        let (l, w) = SIGNS[corner % 4];
        let h = if corner < 4 { -half_h } else { half_h };
        (world_from_object * Point3::new(l * half_l, w * half_w, h)).into()
    })
}

/// Number of points of the sweep in the object's box.
pub(super) fn points_in(frame: &AgentFrame, object: &Object) -> usize {
    // Multiplied in f64: positions in the world are large.
    let object_from_lidar: Isometry3<f32> =
        (object.world_from_object.isometry().inverse() * frame.world_from_lidar()).cast();
    let half = object.size_m.map(|size| (size / 2.0) as f32);
    let center = object_from_lidar.inverse().translation.vector;
    let reach = half.iter().map(|half| half * half).sum::<f32>().sqrt();
    let points = frame.frame.points.xyzi.iter();
    // Most points are far away in x or y; this test needs no transform.
    let near =
        points.filter(|[x, y, ..]| (x - center.x).abs() <= reach && (y - center.y).abs() <= reach);
    let inside = near.filter(|&&[x, y, z, _]| {
        let local = object_from_lidar * Point3::new(x, y, z);
        (0..3).all(|axis| local[axis].abs() <= half[axis])
    });
    inside.count()
}

/// The name of a class in the types of V2V4Real and V2X-Real.
pub(super) fn real_type(class: ObjectClass) -> &'static str {
    match class {
        ObjectClass::Car => "Car",
        ObjectClass::Van => "Van",
        ObjectClass::Truck => "Truck",
        ObjectClass::Bus => "Bus",
        ObjectClass::TwoWheeler => "BicycleRider",
        ObjectClass::Pedestrian => "Pedestrian",
        ObjectClass::Other => "Other",
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn bytes_come_back_bit_by_bit() {
        for byte in 0..=255u8 {
            let intensity = f32::from(byte) / 255.0;
            assert_eq!(of_255(intensity), f32::from(byte));
            assert_eq!(super::byte(intensity), byte);
        }
        assert_eq!((byte(f32::NAN), byte(2.0), byte(-1.0)), (0, 255, 0));
    }

    fn point_at(elevation_deg: f32) -> [f32; 4] {
        let (sin, cos) = elevation_deg.to_radians().sin_cos();
        [10.0 * cos, 0.0, 10.0 * sin, 0.5]
    }

    #[test]
    fn the_channel_of_a_direction() {
        assert_eq!(
            [-25.0, 2.0, -40.0, 80.0].map(|deg| ring(point_at(deg))),
            [0, 63, 0, 63]
        );
        assert_eq!(ring(point_at(-25.0 + 27.0 * 10.0 / 63.0)), 10);
    }

    proptest! {
        #[test]
        fn intensities_come_back_to_one_step(intensity in 0.0..=1.0f32) {
            let back = of_255(intensity) / 255.0;
            prop_assert!(back == intensity || back == intensity.next_up() || back == intensity.next_down());
        }
    }
}
