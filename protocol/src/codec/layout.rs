//! Sizes of an encoded feature map, computed in one place and checked before anything is allocated.

use std::ops::Range;

use super::{Codec, Selection};
use crate::checks::{check_limit, check_size};
use crate::{BevGrid, Limits, WireError};

/// Byte ranges of the parts of an unpacked body, and its number of cells.
pub(super) struct BodyLayout {
    /// Cells of the grid.
    pub(super) cells: usize,
    /// Cells in the body.
    pub(super) selected: usize,
    /// Bytes of the scales.
    pub(super) scales: Range<usize>,
    /// Bytes of the mask.
    pub(super) mask: Range<usize>,
    /// Bytes of the values.
    pub(super) values: Range<usize>,
}

impl BodyLayout {
    /// All sizes of a feature map, with every product checked against overflow and limits.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "no part exceeds the bytes of the whole map, which isize holds"
    )]
    pub(super) fn new(
        grid: &BevGrid,
        channels: u32,
        codec: &Codec,
        limits: &Limits,
    ) -> Result<Self, WireError> {
        grid.check(limits)?;
        let cells = u64::from(grid.width) * u64::from(grid.height);
        let channel_count = u64::from(channels);
        check_limit("channels", channel_count, limits.max_channels.into())?;
        if channels == 0 {
            check_size("channels", 0, 1)?;
        }
        // A receiver always unpacks to the whole feature map, however few bytes claim it.
        let map_bytes = cells.saturating_mul(channel_count).saturating_mul(4);
        // No allocation may exceed isize::MAX bytes. Products that saturate fail here too.
        let max_bytes = limits.max_body_bytes.min(isize::MAX as u64);
        check_limit("feature map bytes", map_bytes, max_bytes)?;
        let (selected, mask_bytes) = match codec.selection {
            Selection::Dense => (cells, 0),
            Selection::TopK { cells: selected } => (u64::from(selected), cells.div_ceil(8)),
        };
        check_limit("selected cells", selected, cells)?;
        let scale_bytes = codec.dtype.scale_bytes(channels);
        // Below the size of the whole feature map, which fits: the products cannot overflow.
        let value_bytes = selected * channel_count * codec.dtype.size();
        let mask = scale_bytes + mask_bytes;
        let values = mask + value_bytes;
        let [cells, selected, scales, mask, values] =
            [cells, selected, scale_bytes, mask, values].map(|count| count as usize);
        Ok(Self {
            cells,
            selected,
            scales: 0..scales,
            mask: scales..mask,
            values: mask..values,
        })
    }

    /// Bytes of the unpacked body.
    pub(super) fn len(&self) -> usize {
        self.values.end
    }
}
