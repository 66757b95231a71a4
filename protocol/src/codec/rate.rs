//! Rate control of feature maps: fits a map into a byte limit by number format, then by number of cells.
//!
//! Number formats get coarser before cells are left out: one byte per value costs next to no accuracy, a missing cell
//! is lost. The map's own confidence decides which cells are sent.

use serde::{Deserialize, Serialize};

use super::{
    BodyLayout, Codec, CodecConfig, Compression, Dtype, EncodedFeatures, Selection,
    encode_features, selection,
};
use crate::string_enum::named;
use crate::{BevFeatures, Limits, Result};

/// Bytes of a message with a feature map that are reserved for header and metadata.
pub const HEAD_BYTES: u64 = 256;
/// From the most precise to the coarsest.
const DTYPES_BY_PRECISION: [Dtype; 3] = [Dtype::F32, Dtype::F16, Dtype::I8];
/// Largest finite absolute value of half precision.
const F16_MAX: f32 = 65_504.0;

/// Origin of a byte limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LimitedBy {
    /// Maximum size of any message.
    MessageSize,
    /// Bytes per second.
    ByteRate,
    /// The sender's own queue: earlier messages have not left yet.
    Queue,
}

/// Maximum size of a message, header and metadata included.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ByteLimit {
    /// Maximum size, bytes.
    pub bytes: u64,
    /// Origin of the limit.
    pub by: LimitedBy,
}

named! {
    /// Reason for the format of a feature map that had to keep within a limit.
    pub enum RateReason {
        /// The map fits in the configured format.
        Fits = "fits",
        /// All cells fit the maximum size of a message, in a coarser format.
        SizeCoarser = "size_coarser",
        /// Not all cells fit the maximum size of a message.
        SizeFewerCells = "size_fewer_cells",
        /// All cells fit the byte rate, in a coarser format.
        RateCoarser = "rate_coarser",
        /// Not all cells fit the byte rate.
        RateFewerCells = "rate_fewer_cells",
        /// All cells fit the limit of the queue, in a coarser format.
        QueueCoarser = "queue_coarser",
        /// Not all cells fit the limit of the queue.
        QueueFewerCells = "queue_fewer_cells",
    }
}

/// Reason for the format of a feature map: in the metadata of its message, beside the codec.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct RateChoice {
    /// Reason for the chosen codec.
    pub reason: RateReason,
    /// Limit of the message, bytes, header and metadata included.
    pub limit_bytes: u64,
}

/// Encodes a feature map so that its whole message keeps within `limit`: in the configured format if all cells that
/// pass the gate fit, else in a coarser one, else in the coarsest with as many cells as fit, the most confident first.
/// The same map, confidence and limit give the same bytes.
///
/// With compression a message is smaller still: the gain of zstd is not known in advance.
///
/// # Shapes
/// As [`encode_features`]; `confidence` is needed if not all cells fit.
///
/// # Errors
/// As [`encode_features`]; [`crate::WireError::Budget`] if not even an empty selection fits.
pub fn encode_within(
    features: BevFeatures,
    config: &CodecConfig,
    limit: &ByteLimit,
    confidence: Option<&[f32]>,
) -> Result<EncodedFeatures> {
    let most = config.budget_bytes.unwrap_or(u64::MAX);
    let budget = limit.bytes.saturating_sub(HEAD_BYTES).min(most);
    let (dtype, reason) = choose(&features, config, limit.by, budget, confidence)?;
    let config = CodecConfig {
        dtype,
        budget_bytes: Some(budget),
        ..*config
    };
    let encoded = encode_features(features, &config, confidence)?;
    let rate = Some(RateChoice {
        reason,
        limit_bytes: limit.bytes,
    });
    Ok(EncodedFeatures { rate, ..encoded })
}

/// Maximum size, bytes, of a message with all cells in the configured format: a limit of this size has no effect.
///
/// # Errors
/// [`crate::WireError`] when the map exceeds the sender's limits.
pub fn largest_message(features: &BevFeatures, config: &CodecConfig) -> Result<u64> {
    Ok(HEAD_BYTES + body_bytes(features, config.dtype, Selection::Dense)?)
}

/// Minimum size, bytes, of a message with a feature map of this shape: an empty selection.
///
/// # Errors
/// As [`largest_message`].
pub fn smallest_message(features: &BevFeatures) -> Result<u64> {
    Ok(HEAD_BYTES + body_bytes(features, Dtype::I8, Selection::TopK { cells: 0 })?)
}

/// The most precise format in which all wanted cells fit, or the coarsest, and the reason.
fn choose(
    features: &BevFeatures,
    config: &CodecConfig,
    by: LimitedBy,
    budget: u64,
    confidence: Option<&[f32]>,
) -> Result<(Dtype, RateReason)> {
    let [coarser, fewer_cells] = match by {
        LimitedBy::MessageSize => [RateReason::SizeCoarser, RateReason::SizeFewerCells],
        LimitedBy::ByteRate => [RateReason::RateCoarser, RateReason::RateFewerCells],
        LimitedBy::Queue => [RateReason::QueueCoarser, RateReason::QueueFewerCells],
    };
    let wanted = wanted(features, config, confidence)?;
    let dtypes = DTYPES_BY_PRECISION
        .into_iter()
        .skip_while(|dtype| *dtype != config.dtype);
    for dtype in dtypes {
        if body_bytes(features, dtype, wanted)? > budget {
            continue;
        }
        if dtype == config.dtype {
            return Ok((dtype, RateReason::Fits));
        }
        // Tested last: an overflow of half precision is rare, and the search for it takes time.
        if dtype != Dtype::F16 || features.values.iter().all(|value| value.abs() <= F16_MAX) {
            return Ok((dtype, coarser));
        }
    }
    // No format holds all wanted cells: the coarsest has room for the most of them.
    Ok((Dtype::I8, fewer_cells))
}

/// Selection without a limit.
fn wanted(
    features: &BevFeatures,
    config: &CodecConfig,
    confidence: Option<&[f32]>,
) -> Result<Selection> {
    // A gate without a confidence is refused when the map is encoded.
    let (Some(gate), Some(confidence)) = (config.gate, confidence) else {
        return Ok(Selection::Dense);
    };
    let cells = features.grid.cells();
    selection::check_confidence(confidence, cells)?;
    let passed = gate.cells(confidence, &features.grid)?.len();
    if passed >= cells {
        return Ok(Selection::Dense);
    }
    let cells = u32::try_from(passed).unwrap_or(u32::MAX);
    Ok(Selection::TopK { cells })
}

fn body_bytes(features: &BevFeatures, dtype: Dtype, selection: Selection) -> Result<u64> {
    let codec = Codec {
        dtype,
        selection,
        compression: Compression::Raw,
    };
    Ok(BodyLayout::new(&features.grid, features.channels, &codec, &Limits::SENDER)?.len() as u64)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::BevGrid;
    use crate::CavId;
    use crate::ConfidenceGate;
    use crate::PoseEstimate;
    use crate::Stamp;
    use crate::WireError;
    use crate::message::Bev;
    use crate::wire;

    const GRID: BevGrid = BevGrid {
        x_min_m: -8.0,
        y_min_m: -6.0,
        cell_m: 1.0,
        width: 16,
        height: 12,
    };

    fn map() -> (BevFeatures, Vec<f32>) {
        let values = (0..8 * 192).map(|n| (n as f32 * 0.37).sin()).collect();
        let confidence = (0..192)
            .map(|cell| ((cell * 89) % 192) as f32 / 192.0)
            .collect();
        (
            BevFeatures {
                grid: GRID,
                channels: 8,
                code_of: None,
                values,
            },
            confidence,
        )
    }

    fn encode(config: &CodecConfig, bytes: u64) -> Result<EncodedFeatures, WireError> {
        let (features, confidence) = map();
        encode_within(
            features,
            config,
            &ByteLimit {
                bytes,
                by: LimitedBy::MessageSize,
            },
            Some(&confidence),
        )
    }

    fn message_bytes(features: EncodedFeatures) -> u64 {
        let cav = CavId::new(&"z".repeat(32)).unwrap();
        let stamp = Stamp {
            cav,
            epoch: u64::MAX,
            sequence: u64::MAX,
            capture_nanos: u64::MAX,
            publish_nanos: u64::MAX,
        };
        let pose = PoseEstimate::new(crate::Pose::from_xyz_yaw([-1e5, 1e5, -1e3], -3.0), 1.0);
        wire::encode(&stamp, Bev { pose, features })
            .unwrap()
            .wire_bytes() as u64
    }

    #[test]
    fn formats_get_coarser_before_cells_are_left_out() {
        // 24 bytes of mask and 8 per cell.
        let fewer = Selection::TopK {
            cells: (1567 - 32 - 24) / 8,
        };
        // 192 cells of 8 channels: 6,144 bytes, 3,072, and 1,536 with 32 of scales.
        for (bytes, dtype, selection, reason) in [
            (6144, Dtype::F32, Selection::Dense, RateReason::Fits),
            (6143, Dtype::F16, Selection::Dense, RateReason::SizeCoarser),
            (3071, Dtype::I8, Selection::Dense, RateReason::SizeCoarser),
            (1567, Dtype::I8, fewer, RateReason::SizeFewerCells),
        ] {
            let encoded = encode(&CodecConfig::default(), HEAD_BYTES + bytes).unwrap();
            assert_eq!(
                (
                    encoded.codec.dtype,
                    encoded.codec.selection,
                    encoded.rate.unwrap().reason
                ),
                (dtype, selection, reason),
                "{bytes} bytes"
            );
        }
    }

    #[test]
    fn the_most_confident_cells_stay() {
        let (_, confidence) = map();
        let encoded = encode(&CodecConfig::default(), HEAD_BYTES + 32 + 24 + 8 * 10).unwrap();
        let sent = encoded.decode(&Limits::DEFAULT).unwrap().sent.unwrap();
        let weakest = confidence
            .iter()
            .zip(&sent)
            .filter(|(_, sent)| **sent)
            .map(|(c, _)| *c)
            .fold(1.0, f32::min);
        let strongest = confidence
            .iter()
            .zip(&sent)
            .filter(|(_, sent)| !**sent)
            .map(|(c, _)| *c)
            .fold(0.0, f32::max);
        assert!(sent.iter().filter(|sent| **sent).count() == 10 && weakest > strongest);
    }

    #[test]
    fn a_gate_leaves_room_for_a_precise_format() {
        let gate = Some(ConfidenceGate {
            threshold: 0.9,
            smoothing: None,
        });
        let config = CodecConfig {
            gate,
            ..CodecConfig::default()
        };
        let encoded = encode(&config, HEAD_BYTES + 1000).unwrap();
        assert_eq!(
            (encoded.codec.dtype, encoded.rate.unwrap().reason),
            (Dtype::F32, RateReason::Fits)
        );
        assert!(matches!(
            encoded.codec.selection,
            Selection::TopK { cells: 1..30 }
        ));
    }

    #[test]
    fn values_beyond_half_precision_are_written_as_i8() {
        let (mut features, confidence) = map();
        features.values[5] = 1e5;
        let limit = ByteLimit {
            bytes: HEAD_BYTES + 4000,
            by: LimitedBy::ByteRate,
        };
        let encoded =
            encode_within(features, &CodecConfig::default(), &limit, Some(&confidence)).unwrap();
        assert_eq!(
            (encoded.codec.dtype, encoded.rate.unwrap().reason),
            (Dtype::I8, RateReason::RateCoarser)
        );
    }

    #[test]
    fn a_limit_below_the_smallest_message_is_an_error() {
        let (features, _) = map();
        let smallest = smallest_message(&features).unwrap();
        assert!(matches!(
            encode(&CodecConfig::default(), smallest - 1),
            Err(WireError::Budget { .. })
        ));
        assert!(matches!(
            encode(&CodecConfig::default(), 0),
            Err(WireError::Budget { .. })
        ));
        let nothing = encode(&CodecConfig::default(), smallest).unwrap();
        assert_eq!(nothing.codec.selection, Selection::TopK { cells: 0 });
        let largest = largest_message(&features, &CodecConfig::default()).unwrap();
        assert_eq!(
            encode(&CodecConfig::default(), largest)
                .unwrap()
                .rate
                .unwrap()
                .reason,
            RateReason::Fits
        );
    }

    proptest! {
        #[test]
        fn a_message_never_exceeds_its_limit_and_is_the_same_again(
            bytes in 330u64..8000, dtype in 0usize..3, level in prop::option::of(1i32..3), own in prop::option::of(80u64..4000),
            by in prop::sample::select(vec![LimitedBy::MessageSize, LimitedBy::ByteRate, LimitedBy::Queue]),
        ) {
            let config =
                CodecConfig { dtype: DTYPES_BY_PRECISION[dtype], zstd_level: level, budget_bytes: own, ..CodecConfig::default() };
            let (features, confidence) = map();
            let limit = ByteLimit { bytes, by };
            let once = encode_within(features.clone(), &config, &limit, Some(&confidence)).unwrap();
            let again = encode_within(features, &config, &limit, Some(&confidence)).unwrap();
            prop_assert_eq!(&once, &again);
            prop_assert!(once.codec.dtype.size() <= config.dtype.size());
            prop_assert!(message_bytes(once) <= bytes);
        }
    }
}
