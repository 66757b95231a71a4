//! Codec of BEV feature maps: number format, selected cells, compression.
//!
//! The body of an encoded feature map, before compression, has up to three parts, each present only if the codec needs
//! it:
//!
//! | part | bytes | present if |
//! | --- | --- | --- |
//! | scales, `f32` per channel | `4 C` | dtype `i8` |
//! | mask, one bit per cell, row-major, lowest bit first | `ceil(H W / 8)` | selection top-k (by gate, budget or both) |
//! | values `[C, K]`, `K` selected cells in row-major order | `C K` times 4, 2 or 1 | always; dense: `K = H W` |
//!
//! A bit mask rather than a list of indices: a set has one encoding (no order, no duplicates, no index out of range to
//! check for), and the mask is also smaller as soon as one cell in sixteen is sent. Channels are the first dimension of
//! the values because the cells of a channel share a scale, compress better together, and unpack into one plane of `[C,
//! H, W]`.

mod compression;
mod dtype;
mod gate;
mod layout;
mod rate;
mod selection;

use serde::{Deserialize, Serialize};

use crate::body::check_values;
use crate::checks::check_size;
use crate::{BevFeatures, BevGrid, Body, BodyShape, Limits, Result, WireError};

use layout::BodyLayout;

pub use dtype::Dtype;
pub use gate::{ConfidenceGate, Smoothing};
pub use rate::{
    ByteLimit, HEAD_BYTES, LimitedBy, RateChoice, RateReason, encode_within, largest_message,
    smallest_message,
};

/// Codec of BEV feature maps.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[cfg_attr(feature = "config", derive(clap::Args, schemars::JsonSchema))]
#[cfg_attr(
    feature = "config",
    command(next_help_heading = "Codec of BEV feature maps")
)]
pub struct CodecConfig {
    /// Number format of the values.
    #[cfg_attr(feature = "config", arg(long, value_enum))]
    pub dtype: Dtype,
    /// Confidence that a cell must exceed to be sent, smoothed by a Gaussian window first (edge and sigma in cells); a
    /// budget selects among those cells. Absent: default of the method, else all cells.
    #[cfg_attr(
        feature = "config",
        arg(
            long,
            value_name = "THRESHOLD[,CELLS,SIGMA|,none]",
            allow_hyphen_values = true
        )
    )]
    pub gate: Option<ConfidenceGate>,
    /// Most bytes of a map before compression: the cells with the highest confidence that fit are sent. Absent: all cells.
    #[cfg_attr(feature = "config", arg(long, value_name = "BYTES"))]
    pub budget_bytes: Option<u64>,
    /// zstd level, 1 to 22. Absent: not compressed.
    #[cfg_attr(feature = "config", arg(long, value_name = "LEVEL", value_parser = clap::value_parser!(i32).range(1..=22)))]
    #[cfg_attr(feature = "config", schemars(range(min = 1, max = 22)))]
    pub zstd_level: Option<i32>,
}

#[cfg(feature = "config")]
impl CodecConfig {
    /// Checks the values.
    ///
    /// # Errors
    /// [`FieldError`](crate::config::FieldError) of the first value that is out of range.
    pub fn validate(&self) -> Result<(), crate::config::FieldError> {
        crate::config::within("codec.zstd_level", self.zstd_level.unwrap_or(1), 1, 22)?;
        self.gate.map_or(Ok(()), |gate| gate.validate())
    }
}

/// Selection of the cells of a feature map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Selection {
    /// All cells.
    Dense,
    /// Cells with the highest confidence: above a threshold, as many as fit, or both.
    TopK {
        /// Number of cells.
        cells: u32,
    },
}

/// Compression of a body.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Compression {
    /// Not compressed.
    Raw,
    /// One zstd frame that states its content size.
    Zstd,
}

/// The codec of one message, stated in its metadata.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Codec {
    /// Number format of the values.
    pub dtype: Dtype,
    /// Selection of the cells.
    pub selection: Selection,
    /// Compression of the body.
    pub compression: Compression,
}

/// A feature map as it is transmitted. Serialized are its fields without the body: the metadata of a message.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EncodedFeatures {
    /// BEV grid.
    pub grid: BevGrid,
    /// Number of channels `C`.
    pub channels: u32,
    /// As in [`BevFeatures`].
    pub code_of: Option<u32>,
    /// Format of the body.
    pub codec: Codec,
    /// Reason for this format, if the message had to keep within a limit.
    pub rate: Option<RateChoice>,
    /// The values, in the format of the codec.
    #[serde(skip)]
    pub body: Body,
}

/// A feature map as it was received.
#[derive(Debug, Clone, PartialEq)]
pub struct DecodedFeatures {
    /// `[C, H, W]`, zero where nothing was sent.
    pub features: BevFeatures,
    /// `[H, W]`: true for cells that were sent; `None` if all were.
    pub sent: Option<Vec<bool>>,
}

/// Encodes a feature map.
///
/// Dense `f32` without compression moves the values and copies nothing. Compression that does not make the body smaller
/// is omitted, so that a body never exceeds its budget.
///
/// # Shapes
/// - `features`: `[C, H, W]`
/// - `confidence`: `[H, W]`, needed if `config` has a gate, or a budget that not all cells fit in; ties go to the first
///   cell
///
/// # Errors
/// [`WireError`] when values and grid disagree, a value is not finite (or too large for its dtype), a gate or budget
/// has no confidence map, or a budget cannot hold even an empty selection.
pub fn encode_features(
    features: BevFeatures,
    config: &CodecConfig,
    confidence: Option<&[f32]>,
) -> Result<EncodedFeatures> {
    let BevFeatures { grid, channels, .. } = features;
    let dense = Codec {
        dtype: config.dtype,
        selection: Selection::Dense,
        compression: Compression::Raw,
    };
    let layout = BodyLayout::new(&grid, channels, &dense, &Limits::SENDER)?;
    let expected = layout.cells * channels as usize;
    check_size("features", features.values.len() as u64, expected as u64)?;
    // A budget that holds the dense map does not limit it.
    let budget = config
        .budget_bytes
        .filter(|budget| *budget < layout.len() as u64);
    if config.gate.is_none() && budget.is_none() {
        return encode_selected(features, dense, None, config.zstd_level);
    }
    let cells = layout.cells as u64;
    let confidence = confidence.ok_or(WireError::NoConfidence(cells))?;
    selection::check_confidence(confidence, layout.cells)?;
    let gated = config.gate.map(|gate| gate.cells(confidence, &grid));
    let selected = match (gated.transpose()?, budget) {
        (gated, Some(budget)) => {
            selection::within_budget(confidence, gated.as_deref(), channels, config.dtype, budget)?
        }
        (Some(gated), None) if gated.len() < layout.cells => gated,
        // All cells pass the gate: a mask would only add bytes.
        _ => return encode_selected(features, dense, None, config.zstd_level),
    };
    let cells = u32::try_from(selected.len()).unwrap_or(u32::MAX);
    let selection = Selection::TopK { cells };
    let codec = Codec { selection, ..dense };
    let values = selection::gather(&features.values, layout.cells, &selected);
    let features = BevFeatures { values, ..features };
    encode_selected(features, codec, Some(&selected), config.zstd_level)
}

/// Writes the values of the selected cells, `[C, K]`. Dense uncompressed `f32` is checked by its receiver.
fn encode_selected(
    features: BevFeatures,
    mut codec: Codec,
    selected: Option<&[u32]>,
    zstd_level: Option<i32>,
) -> Result<EncodedFeatures> {
    let BevFeatures {
        grid,
        channels,
        code_of,
        values,
    } = features;
    let is_sent_as_it_is = codec.dtype == Dtype::F32 && selected.is_none();
    if !is_sent_as_it_is || zstd_level.is_some() {
        check_values("feature", &values, Limits::SENDER.max_abs_value)?;
    }
    let mut body = if is_sent_as_it_is {
        Body::Floats(values)
    } else {
        let layout = BodyLayout::new(&grid, channels, &codec, &Limits::SENDER)?;
        // Scales, mask and values, concatenated.
        let mut bytes = Vec::with_capacity(layout.len());
        let scales = match codec.dtype {
            Dtype::I8 => dtype::scales(&values, channels as usize),
            Dtype::F32 | Dtype::F16 => Vec::new(),
        };
        bytes.extend_from_slice(bytemuck::cast_slice(&scales));
        if let Some(selected) = selected {
            selection::append_mask(&mut bytes, layout.cells, selected);
        }
        dtype::append(codec.dtype, &values, &scales, &mut bytes)?;
        Body::Bytes(bytes)
    };
    if let Some(level) = zstd_level
        && let Some(packed) = compression::pack(body.as_bytes(), level)?
    {
        codec.compression = Compression::Zstd;
        body = Body::Bytes(packed);
    }
    Ok(EncodedFeatures {
        grid,
        channels,
        code_of,
        codec,
        rate: None,
        body,
    })
}

impl EncodedFeatures {
    /// Required shape of the body, from metadata only.
    ///
    /// # Errors
    /// [`WireError`] when grid, channels or selection exceed `limits`.
    pub(crate) fn body_shape(
        grid: &BevGrid,
        channels: u32,
        codec: &Codec,
        limits: &Limits,
    ) -> Result<BodyShape> {
        let layout = BodyLayout::new(grid, channels, codec, limits)?;
        let len = layout.len() as u64;
        Ok(match (codec.compression, codec.dtype, codec.selection) {
            (Compression::Raw, Dtype::F32, Selection::Dense) => BodyShape::Floats(len / 4),
            (Compression::Raw, ..) => BodyShape::Bytes { min: len, max: len },
            // A body that compression does not make smaller is sent uncompressed.
            (Compression::Zstd, ..) => BodyShape::Bytes { min: 1, max: len },
        })
    }

    /// Checks the feature map against the announcement of its sender, or the output of the receiver's network.
    ///
    /// # Errors
    /// [`WireError::Grid`] and [`WireError::Shape`] state both.
    pub fn check_shape(&self, grid: &BevGrid, channels: u32, code_of: Option<u32>) -> Result<()> {
        if self.grid != *grid {
            let both = format!("{}, expected {grid}", self.grid);
            return Err(WireError::Grid(both));
        }
        check_size("channels", self.channels.into(), channels.into())?;
        if self.code_of != code_of {
            let expected = code_of.unwrap_or(channels).into();
            let found = self.code_of.unwrap_or(self.channels).into();
            let what = "channels of the map behind the compressor";
            return Err(WireError::shape(what, expected, found));
        }
        Ok(())
    }

    /// Decodes the feature map. Dense `f32` moves the values; all others are converted. Cells that were not sent are
    /// zero.
    ///
    /// # Errors
    /// [`WireError`] when sizes exceed `limits`, the body does not match shape and codec, or a value or scale is not
    /// finite. The values of a dense `f32` body were checked when it was received.
    pub fn decode(self, limits: &Limits) -> Result<DecodedFeatures> {
        let codec = self.codec;
        let layout = BodyLayout::new(&self.grid, self.channels, &codec, limits)?;
        let (values, sent) = match (self.body, codec.compression, codec.dtype, codec.selection) {
            (Body::Floats(values), Compression::Raw, Dtype::F32, Selection::Dense) => {
                let expected = layout.values.len() as u64 / 4;
                check_size("features", values.len() as u64, expected)?;
                (values, None)
            }
            (body, ..) => {
                let raw = unpack(body, codec.compression, layout.len())?;
                let [scales, mask, values] =
                    [layout.scales, layout.mask, layout.values].map(|range| {
                        let (expected, found) = (range.end as u64, raw.len() as u64);
                        let missing = WireError::shape("bytes of a feature map", expected, found);
                        raw.get(range).ok_or(missing)
                    });
                let values = dtype::read(codec.dtype, scales?, values?, layout.selected)?;
                check_values("feature", &values, limits.max_abs_value)?;
                match codec.selection {
                    Selection::Dense => (values, None),
                    Selection::TopK { .. } => {
                        let (cells, channels) = (layout.cells, self.channels as usize);
                        let selected = selection::read_mask(mask?, cells, layout.selected)?;
                        // Freed before the map is allocated: a receiver holds two bodies at most (`Limits`).
                        drop(raw);
                        let (map, sent) = selection::scatter(&values, channels, cells, &selected);
                        (map, Some(sent))
                    }
                }
            }
        };
        let features = BevFeatures {
            grid: self.grid,
            channels: self.channels,
            code_of: self.code_of,
            values,
        };
        Ok(DecodedFeatures { features, sent })
    }
}

/// The unpacked body, of exactly `expected` bytes.
fn unpack(body: Body, compression: Compression, expected: usize) -> Result<Vec<u8>> {
    let bytes = match body {
        Body::Bytes(bytes) => bytes,
        other => other.as_bytes().to_vec(),
    };
    let bytes = match compression {
        Compression::Raw => bytes,
        Compression::Zstd => compression::unpack(bytes, expected)?,
    };
    check_size("encoded map bytes", bytes.len() as u64, expected as u64)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    const GRID: BevGrid = BevGrid {
        x_min_m: 0.0,
        y_min_m: 0.0,
        cell_m: 1.0,
        width: 4,
        height: 2,
    };

    fn map(values: Vec<f32>) -> BevFeatures {
        BevFeatures {
            grid: GRID,
            channels: values.len() as u32 / 8,
            code_of: None,
            values,
        }
    }

    #[test]
    fn compression_that_does_not_help_leaves_the_tensor_unchanged() {
        let config = CodecConfig {
            zstd_level: Some(3),
            ..CodecConfig::default()
        };
        let noise: Vec<f32> = (1..=8u8).map(|n| f32::from(n).sin()).collect();
        let encoded = encode_features(map(noise.clone()), &config, None).unwrap();
        assert_eq!(
            (encoded.codec.compression, encoded.body),
            (Compression::Raw, Body::Floats(noise))
        );
        let encoded = encode_features(map(vec![0.1; 800]), &config, None).unwrap();
        assert_eq!(encoded.codec.compression, Compression::Zstd);
        assert!(encoded.body.len() < 100);
    }

    #[test]
    fn a_value_that_is_not_finite_is_never_encoded() {
        for dtype in [Dtype::F32, Dtype::F16, Dtype::I8] {
            for (budget_bytes, zstd_level) in
                [(None, Some(1)), (Some(100), None), (Some(100), Some(1))]
            {
                for bad in [f32::NAN, f32::INFINITY, 1e30] {
                    let config = CodecConfig {
                        dtype,
                        budget_bytes,
                        zstd_level,
                        gate: None,
                    };
                    let error =
                        encode_features(map(vec![bad; 80]), &config, Some(&[1.0; 8])).unwrap_err();
                    assert!(
                        matches!(
                            error,
                            WireError::Value {
                                what: "feature",
                                ..
                            }
                        ),
                        "{error}"
                    );
                }
            }
        }
    }

    #[test]
    fn a_budget_that_fits_all_needs_no_confidence() {
        let config = CodecConfig {
            dtype: Dtype::F16,
            budget_bytes: Some(16),
            ..CodecConfig::default()
        };
        assert_eq!(
            encode_features(map(vec![1.0; 8]), &config, None)
                .unwrap()
                .codec
                .selection,
            Selection::Dense
        );
        let smaller = CodecConfig {
            budget_bytes: Some(15),
            ..config
        };
        let error = encode_features(map(vec![1.0; 8]), &smaller, None).unwrap_err();
        assert_eq!(error, WireError::NoConfidence(8));
        let sparse = encode_features(map(vec![1.0; 8]), &smaller, Some(&[0.5; 8])).unwrap();
        // One byte of mask, two bytes per cell.
        assert_eq!(
            (sparse.codec.selection, sparse.body.len()),
            (Selection::TopK { cells: 7 }, 15)
        );
    }

    #[test]
    fn a_gate_sends_cells_that_pass_and_a_budget_the_best_of_them() {
        let confidence = [0.9, 0.1, 0.8, 0.1, 0.7, 0.1, 0.1, 0.1];
        let gate = Some(ConfidenceGate {
            threshold: 0.5,
            smoothing: None,
        });
        let config = CodecConfig {
            dtype: Dtype::F16,
            gate,
            ..CodecConfig::default()
        };
        let values: Vec<f32> = (0..8u8).map(f32::from).collect();
        let encoded = encode_features(map(values.clone()), &config, Some(&confidence)).unwrap();
        assert_eq!(
            (encoded.codec.selection, encoded.body.len()),
            (Selection::TopK { cells: 3 }, 1 + 3 * 2)
        );
        let decoded = encoded.decode(&Limits::DEFAULT).unwrap();
        assert_eq!(
            decoded.features.values,
            [0.0, 0.0, 2.0, 0.0, 4.0, 0.0, 0.0, 0.0]
        );
        assert_eq!(
            decoded.sent.unwrap().iter().filter(|sent| **sent).count(),
            3
        );
        let tight = CodecConfig {
            budget_bytes: Some(1 + 2 * 2),
            ..config
        };
        let encoded = encode_features(map(values.clone()), &tight, Some(&confidence)).unwrap();
        assert_eq!(
            encoded.decode(&Limits::DEFAULT).unwrap().features.values[4],
            0.0,
            "the least confident cell is left out"
        );
        // All cells that pass fit: the budget removes none.
        let wide = CodecConfig {
            budget_bytes: Some(15),
            ..config
        };
        let encoded = encode_features(map(values.clone()), &wide, Some(&confidence)).unwrap();
        assert_eq!(encoded.codec.selection, Selection::TopK { cells: 3 });
        let error = encode_features(map(values), &config, None).unwrap_err();
        assert_eq!(error, WireError::NoConfidence(8));
    }

    #[test]
    fn an_empty_selection_is_encoded_in_every_dtype() {
        let gate = Some(ConfidenceGate {
            threshold: 1.0,
            smoothing: None,
        });
        for dtype in [Dtype::F32, Dtype::F16, Dtype::I8] {
            for zstd_level in [None, Some(1)] {
                let config = CodecConfig {
                    dtype,
                    gate,
                    zstd_level,
                    budget_bytes: None,
                };
                let encoded =
                    encode_features(map(vec![1.0; 16]), &config, Some(&[0.5; 8])).unwrap();
                let decoded = encoded.decode(&Limits::DEFAULT).unwrap();
                assert_eq!(decoded.features.values, [0.0; 16]);
                assert_eq!(decoded.sent, Some(vec![false; 8]));
            }
        }
    }

    #[test]
    fn a_gate_that_everything_passes_leaves_the_tensor_unchanged() {
        let gate = Some(ConfidenceGate {
            threshold: -1.0,
            smoothing: None,
        });
        let config = CodecConfig {
            gate,
            ..CodecConfig::default()
        };
        let encoded = encode_features(map(vec![1.0; 8]), &config, Some(&[0.0; 8])).unwrap();
        assert_eq!(encoded.codec.selection, Selection::Dense);
    }

    #[test]
    fn a_map_must_fill_its_grid() {
        let features = BevFeatures {
            grid: GRID,
            channels: 2,
            code_of: None,
            values: vec![0.0; 8],
        };
        let error = encode_features(features, &CodecConfig::default(), None).unwrap_err();
        assert_eq!(
            error,
            WireError::Shape {
                what: "features",
                expected: 16,
                found: 8
            }
        );
    }

    #[test]
    fn a_map_of_another_shape_than_announced_is_named() {
        let encoded = encode_features(map(vec![0.0; 16]), &CodecConfig::default(), None).unwrap();
        assert_eq!(encoded.check_shape(&GRID, 2, None), Ok(()));
        assert!(matches!(
            encoded.check_shape(&GRID, 3, None),
            Err(WireError::Shape {
                expected: 3,
                found: 2,
                ..
            })
        ));
        let other = BevGrid {
            cell_m: 0.5,
            ..GRID
        };
        let message = encoded
            .check_shape(&other, 2, None)
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("4 x 2 cells of 1 m") && message.contains("4 x 2 cells of 0.5 m"),
            "{message}"
        );
    }
}
