//! PNG encoding of rendered images.

use protocol::CameraMetadata;

/// The bytes of a PNG of `rgb`, three bytes a pixel, row by row.
///
/// # Panics
/// Never: writing to memory does not fail, and the buffer has the size of the image.
pub(super) fn encode(rgb: &[u8], metadata: &CameraMetadata) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(rgb.len() / 4);
    let mut encoder = png::Encoder::new(&mut bytes, metadata.width_px, metadata.height_px);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header().expect("memory takes a header");
    writer
        .write_image_data(rgb)
        .expect("memory takes an image of its size");
    writer.finish().expect("memory takes an end");
    bytes
}
