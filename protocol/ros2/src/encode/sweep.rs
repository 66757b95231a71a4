//! Sweeps as `sensor_msgs/PointCloud2`.

use protocol::PointCloud;

use crate::cdr;

/// Bytes of a point: x, y, z, intensity.
const POINT_STEP: u32 = 16;
/// `sensor_msgs/PointField::FLOAT32`.
const FLOAT32: u8 = 7;

/// A sweep in the frame `frame_id`.
pub(crate) fn point_cloud(nanos: u64, frame_id: &str, cloud: &PointCloud) -> Vec<u8> {
    let count = u32::try_from(cloud.len()).unwrap_or(u32::MAX);
    cdr::message(|cdr| {
        cdr.buffer_mut()
            .reserve(cloud.len() * POINT_STEP as usize + 256);
        cdr::header(cdr, nanos, frame_id);
        // Height 1: a cloud without an order in rows.
        cdr.write_u32(1);
        cdr.write_u32(count);
        let fields = ["x", "y", "z", "intensity"];
        cdr.write_sequence_length(fields.len());
        for (offset, name) in (0..).step_by(4).zip(fields) {
            cdr.write_string(name);
            cdr.write_u32(offset);
            cdr.write_u8(FLOAT32);
            cdr.write_u32(1);
        }
        cdr.write_bool(false);
        cdr.write_u32(POINT_STEP);
        cdr.write_u32(count.saturating_mul(POINT_STEP));
        // All supported machines are little-endian, as the header states.
        cdr.write_bytes(bytemuck::cast_slice(&cloud.xyzi));
        // `is_dense`: no point without coordinates, as decoding refuses them.
        cdr.write_bool(true);
    })
}
