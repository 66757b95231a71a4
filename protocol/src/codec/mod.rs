//! Feature maps as bytes: how exact, which cells, packed or not.
//!
//! The body of an encoded map, before packing, is up to three parts, each there only where the codec needs it:
//!
//! | part | bytes | where |
//! | --- | --- | --- |
//! | scales, `f32` per channel | `4 C` | dtype `i8` |
//! | mask, one bit per cell, row-major, lowest bit first | `ceil(H W / 8)` | selection top-k |
//! | values `[C, K]`, `K` selected cells in row-major order | `C K` times 4, 2 or 1 | always; dense: `K = H W` |
//!
//! A mask of bits rather than a list of indices: it has one spelling for a set (no order, no duplicate, no index out of
//! range to check for), and it is also the smaller of the two as soon as one cell in sixteen is sent. Channels lead in
//! the values because a channel's cells share a scale, pack better together, and unpack into one plane of `[C, H, W]`.

mod compression;
mod dtype;
mod selection;

use std::ops::Range;

use serde::{Deserialize, Serialize};

use crate::body::check_values;
use crate::{BevFeatures, BevGrid, Body, BodyShape, Limits, WireError};

pub use dtype::Dtype;

/// How an agent encodes its maps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CodecConfig {
    /// How exactly values are written.
    pub dtype: Dtype,
    /// Most bytes of a body: the cells with the highest confidence that fit are sent. `None`, or enough for all: all.
    pub budget_bytes: Option<u64>,
    /// zstd level, 1..=22; `None`: not packed. The budget holds for what is there before packing.
    pub zstd_level: Option<i32>,
}

/// Which cells a map brings.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Selection {
    /// All.
    Dense,
    /// Those with the highest confidence.
    TopK {
        /// How many.
        cells: u32,
    },
}

/// How a body is packed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Packing {
    /// Not at all.
    Raw,
    /// One zstd frame.
    Zstd,
}

/// The codec of one message, named in its metadata.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Codec {
    /// How exactly values are written.
    pub dtype: Dtype,
    /// Which cells are there.
    pub selection: Selection,
    /// How the body is packed.
    pub packing: Packing,
}

/// A feature map as it crosses the air.
#[derive(Debug, Clone, PartialEq)]
pub struct EncodedFeatures {
    /// The lattice.
    pub grid: BevGrid,
    /// Number of channels `C`.
    pub channels: u32,
    /// What the body is.
    pub codec: Codec,
    /// The values, as the codec says.
    pub body: Body,
}

/// A feature map as it was received.
#[derive(Debug, Clone, PartialEq)]
pub struct DecodedFeatures {
    /// `[C, H, W]`, zero where nothing was sent.
    pub features: BevFeatures,
    /// `[H, W]`: which cells were sent; `None` where all were.
    pub sent: Option<Vec<bool>>,
}

/// Where the parts of an unpacked body lie, and how many cells it has.
struct Layout {
    cells: usize,
    selected: usize,
    scales: Range<usize>,
    mask: Range<usize>,
    values: Range<usize>,
}

impl Layout {
    /// All sizes of a map, with every product checked against overflow and limits.
    fn new(grid: &BevGrid, channels: u32, codec: &Codec, limits: &Limits) -> Result<Self, WireError> {
        grid.check(limits)?;
        let cells = u64::from(grid.width) * u64::from(grid.height);
        at_most("channels", u64::from(limits.max_channels), u64::from(channels))?;
        if channels == 0 {
            return Err(WireError::Shape { what: "channels", expected: 1, found: 0 });
        }
        // What a receiver unpacks to is always the whole map, however few bytes claim it.
        let map_bytes = cells.saturating_mul(u64::from(channels)).saturating_mul(4);
        at_most("feature map bytes", limits.max_body_bytes.min(isize::MAX as u64), map_bytes)?;
        let (selected, mask_bytes) = match codec.selection {
            Selection::Dense => (cells, 0),
            Selection::TopK { cells: selected } => (u64::from(selected), cells.div_ceil(8)),
        };
        at_most("selected cells", cells, selected)?;
        let scale_bytes = if codec.dtype == Dtype::I8 { 4 * u64::from(channels) } else { 0 };
        // Below the size of the whole map, which fits: the products cannot overflow.
        let value_bytes = selected * u64::from(channels) * codec.dtype.size();
        let (mask, values) = (scale_bytes + mask_bytes, scale_bytes + mask_bytes + value_bytes);
        let [cells, selected, scales, mask, values] =
            [cells, selected, scale_bytes, mask, values].map(|count| count as usize);
        Ok(Self { cells, selected, scales: 0..scales, mask: scales..mask, values: mask..values })
    }

    /// Bytes of the unpacked body.
    fn len(&self) -> usize {
        self.values.end
    }
}

fn at_most(what: &'static str, max: u64, found: u64) -> Result<(), WireError> {
    if found > max { Err(WireError::Limit { what, max, found }) } else { Ok(()) }
}

/// Encodes a map.
///
/// Dense `f32` without packing moves the values and copies nothing. Packing that does not make the body smaller is left
/// out, so that a body never exceeds its budget.
///
/// # Shapes
/// - `features`: `[C, H, W]`
/// - `confidence`: `[H, W]`, needed where `config` has a budget that not all cells fit in; ties go to the first cell
///
/// # Errors
/// [`WireError`] when values and lattice disagree, a value is not finite (or too large for its dtype), a budget has no
/// confidence map or cannot hold even an empty selection.
pub fn encode_features(
    features: BevFeatures,
    config: &CodecConfig,
    confidence: Option<&[f32]>,
) -> Result<EncodedFeatures, WireError> {
    let BevFeatures { grid, channels, values } = features;
    let dense = Codec { dtype: config.dtype, selection: Selection::Dense, packing: Packing::Raw };
    let layout = Layout::new(&grid, channels, &dense, &Limits::SENDER)?;
    let expected = layout.cells * channels as usize;
    if values.len() != expected {
        return Err(WireError::Shape { what: "features", expected: expected as u64, found: values.len() as u64 });
    }
    let Some(budget) = config.budget_bytes.filter(|budget| *budget < layout.len() as u64) else {
        return encode_selected(grid, channels, dense, values, None, config.zstd_level);
    };
    let confidence = confidence.ok_or(WireError::NoConfidence { cells: layout.cells as u64 })?;
    let selected = selection::within_budget(confidence, layout.cells, channels, config.dtype, budget)?;
    let codec = Codec { selection: Selection::TopK { cells: selected.len() as u32 }, ..dense };
    let values = selection::gather(&values, layout.cells, &selected);
    encode_selected(grid, channels, codec, values, Some(&selected), config.zstd_level)
}

/// Writes the values of the selected cells, `[C, K]`.
fn encode_selected(
    grid: BevGrid,
    channels: u32,
    codec: Codec,
    values: Vec<f32>,
    selected: Option<&[u32]>,
    zstd_level: Option<i32>,
) -> Result<EncodedFeatures, WireError> {
    if codec.dtype == Dtype::F32 && selected.is_none() && zstd_level.is_none() {
        return Ok(EncodedFeatures { grid, channels, codec, body: Body::Floats(values) });
    }
    check_values("feature", &values, Limits::SENDER.max_abs_value)?;
    let layout = Layout::new(&grid, channels, &codec, &Limits::SENDER)?;
    let mut bytes = Vec::with_capacity(layout.len());
    let scales = if codec.dtype == Dtype::I8 { dtype::scales(&values, channels as usize) } else { Vec::new() };
    bytes.extend_from_slice(bytemuck::cast_slice(&scales));
    if let Some(selected) = selected {
        selection::append_mask(&mut bytes, layout.cells, selected);
    }
    dtype::append(codec.dtype, &values, &scales, &mut bytes)?;
    let (packing, bytes) = match zstd_level {
        Some(level) => compression::pack(bytes, level)?,
        None => (Packing::Raw, bytes),
    };
    Ok(EncodedFeatures { grid, channels, codec: Codec { packing, ..codec }, body: Body::Bytes(bytes) })
}

impl EncodedFeatures {
    /// What the body has to be, from metadata alone.
    ///
    /// # Errors
    /// [`WireError`] when lattice, channels or selection are beyond `limits`.
    pub(crate) fn body_shape(
        grid: &BevGrid,
        channels: u32,
        codec: &Codec,
        limits: &Limits,
    ) -> Result<BodyShape, WireError> {
        let layout = Layout::new(grid, channels, codec, limits)?;
        Ok(match (codec.packing, codec.dtype, codec.selection) {
            (Packing::Raw, Dtype::F32, Selection::Dense) => BodyShape::Floats((layout.values.len() / 4) as u64),
            (Packing::Raw, ..) => BodyShape::Bytes { min: layout.len() as u64, max: layout.len() as u64 },
            // What would not get smaller is sent unpacked.
            (Packing::Zstd, ..) => BodyShape::Bytes { min: 1, max: layout.len() as u64 },
        })
    }

    /// Checks the map against what its sender announced.
    ///
    /// # Errors
    /// [`WireError::Grid`] and [`WireError::Shape`] name both.
    pub fn check_shape(&self, grid: &BevGrid, channels: u32) -> Result<(), WireError> {
        if self.grid != *grid {
            return Err(WireError::Grid { expected: grid.to_string(), found: self.grid.to_string() });
        }
        if self.channels == channels {
            return Ok(());
        }
        Err(WireError::Shape { what: "channels", expected: channels.into(), found: self.channels.into() })
    }

    /// Decodes the map. Dense `f32` moves the values; all others are converted, cells that were not sent are zero.
    ///
    /// # Errors
    /// [`WireError`] when sizes exceed `limits`, the body is not what shape and codec demand, or a value or scale is not
    /// finite. The values of a dense `f32` body were checked when it was received.
    pub fn decode(self, limits: &Limits) -> Result<DecodedFeatures, WireError> {
        let Self { grid, channels, codec, body } = self;
        let layout = Layout::new(&grid, channels, &codec, limits)?;
        let body = match (body, codec) {
            (Body::Floats(values), Codec { dtype: Dtype::F32, selection: Selection::Dense, packing: Packing::Raw }) => {
                let (expected, found) = (layout.values.len() as u64 / 4, values.len() as u64);
                if expected != found {
                    return Err(WireError::Shape { what: "features", expected, found });
                }
                return Ok(DecodedFeatures { features: BevFeatures { grid, channels, values }, sent: None });
            }
            (body, _) => body,
        };
        let raw = unpack(body, codec.packing, layout.len())?;
        let values =
            dtype::read(codec.dtype, &raw[layout.scales.clone()], &raw[layout.values.clone()], layout.selected)?;
        check_values("feature", &values, limits.max_abs_value)?;
        let (values, sent) = match codec.selection {
            Selection::Dense => (values, None),
            Selection::TopK { .. } => {
                let selected = selection::read_mask(&raw[layout.mask.clone()], layout.cells, layout.selected)?;
                drop(raw);
                let (map, sent) = selection::scatter(&values, channels as usize, layout.cells, &selected);
                (map, Some(sent))
            }
        };
        Ok(DecodedFeatures { features: BevFeatures { grid, channels, values }, sent })
    }
}

/// The unpacked body, of exactly `expected` bytes.
fn unpack(body: Body, packing: Packing, expected: usize) -> Result<Vec<u8>, WireError> {
    let bytes = match body {
        Body::Bytes(bytes) => bytes,
        other => other.as_bytes().to_vec(),
    };
    let bytes = match packing {
        Packing::Raw => bytes,
        Packing::Zstd => compression::unpack(bytes, expected)?,
    };
    if bytes.len() == expected {
        return Ok(bytes);
    }
    Err(WireError::Shape { what: "encoded map bytes", expected: expected as u64, found: bytes.len() as u64 })
}
