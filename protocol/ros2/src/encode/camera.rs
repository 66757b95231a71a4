//! Camera images as `sensor_msgs/CompressedImage`, and their calibration as `sensor_msgs/CameraInfo`.

use protocol::{Camera, CameraMetadata, Pinhole};

use crate::cdr;

/// An image in the optical frame `frame_id`, encoded as it was recorded.
pub(crate) fn compressed_image(nanos: u64, frame_id: &str, camera: &Camera) -> Vec<u8> {
    cdr::message(|cdr| {
        cdr.buffer_mut().reserve(camera.image.len() + 256);
        cdr::header(cdr, nanos, frame_id);
        cdr.write_string(camera.metadata.format.name());
        cdr.write_bytes(&camera.image);
    })
}

/// The projection of a camera without distortion; `pinhole` is that of `metadata`.
pub(crate) fn camera_info(
    nanos: u64,
    frame_id: &str,
    metadata: &CameraMetadata,
    pinhole: &Pinhole,
) -> Vec<u8> {
    let [fx, fy] = [pinhole.fx_px, pinhole.fy_px];
    let [cx, cy] = [pinhole.cx_px, pinhole.cy_px];
    // K (3 x 3), R (3 x 3) and P (3 x 4), row-major.
    let intrinsic = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0];
    let rectification = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let projection = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0];
    cdr::message(|cdr| {
        cdr::header(cdr, nanos, frame_id);
        cdr.write_u32(metadata.height_px);
        cdr.write_u32(metadata.width_px);
        cdr.write_string("plumb_bob");
        // A sequence with its length; the matrices after it have fixed sizes, and no length on the wire.
        let distortion = [0.0; 5];
        cdr.write_sequence_length(distortion.len());
        cdr::f64s(cdr, &distortion);
        for matrix in [&intrinsic[..], &rectification, &projection] {
            cdr::f64s(cdr, matrix);
        }
        // No binning, and all of the image is of interest.
        (0..6).for_each(|_| cdr.write_u32(0));
        cdr.write_bool(false);
    })
}
