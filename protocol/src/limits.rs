//! Limits of a receiver on messages of a peer.

/// Upper bounds, all checked before memory is allocated.
///
/// One set holds for every kind of message, so that the memory that a peer can make a receiver hold at once is
/// `max_metadata_bytes + 2 * max_body_bytes` and a few kilobytes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Metadata of one message, bytes; never more than `Limits::HARD_METADATA_BYTES`.
    pub max_metadata_bytes: u32,
    /// Body of one message, on the wire and decoded, bytes.
    pub max_body_bytes: u64,
    /// Points of one sweep.
    pub max_points: u64,
    /// Boxes of one message: detections, or annotated objects of all agents together.
    pub max_boxes: usize,
    /// Entries of every other list: neighbours, stages, accounts.
    pub max_entries: usize,
    /// Channels of a feature map.
    pub max_channels: u32,
    /// Cells of a feature map.
    pub max_cells: u64,
    /// Largest absolute value of a feature, a coordinate (metres) or an intensity.
    pub max_abs_value: f32,
}

impl Limits {
    /// Limit of the metadata decoder itself, independent of the configuration: 1 MiB.
    pub(crate) const HARD_METADATA_BYTES: u32 = 1 << 20;

    /// Limits of a receiver by default: feature maps of 64 MiB, point clouds of a million points.
    pub const DEFAULT: Self = Self {
        max_metadata_bytes: Self::HARD_METADATA_BYTES,
        max_body_bytes: 64 << 20,
        max_points: 1 << 20,
        max_boxes: 8192,
        max_entries: 1024,
        max_channels: 1024,
        max_cells: 1 << 20,
        max_abs_value: 1e6,
    };

    /// Limits of a sender: values are checked, sizes are limited by the receiver.
    pub(crate) const SENDER: Self = Self {
        max_body_bytes: u64::MAX,
        max_points: u64::MAX,
        max_boxes: usize::MAX,
        max_entries: usize::MAX,
        max_channels: u32::MAX,
        max_cells: u64::MAX,
        ..Self::DEFAULT
    };
}
