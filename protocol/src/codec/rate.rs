//! Fitting a map to what the air takes: in how exact numbers, and how many of its cells.
//!
//! Numbers get coarser before cells are left out: a byte per value costs next to no accuracy, a cell that is missing is
//! missing. Which cells stay is decided by the map's own confidence, as everywhere.

use serde::{Deserialize, Serialize};

use super::{Codec, CodecConfig, Compression, Dtype, EncodedFeatures, Layout, Selection, encode_features, selection};
use crate::BevFeatures;
use crate::Limits;
use crate::WireError;
use crate::string_enum::named;

/// Bytes of a message with a map that are kept free for header and metadata.
pub const HEAD_BYTES: u64 = 256;
/// From the most exact to the coarsest.
const DTYPES_BY_PRECISION: [Dtype; 3] = [Dtype::F32, Dtype::F16, Dtype::I8];
/// Largest absolute value that half precision holds.
const F16_MAX: f32 = 65_504.0;

/// What keeps a message small.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LimitedBy {
    /// A size that no message may exceed.
    MessageSize,
    /// Bytes per second.
    ByteRate,
    /// The sender's own queue: what was offered before has not left yet.
    Queue,
}

/// The most that a message may take, header and metadata included.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ByteLimit {
    /// Bytes.
    pub bytes: u64,
    /// Where the limit comes from.
    pub by: LimitedBy,
}

named! {
    /// Why a map that had to keep within a limit is written as it is.
    pub enum RateReason {
        /// It fits as it is wanted.
        Fits = "fits",
        /// All cells fit the size of a message, in coarser numbers.
        SizeCoarser = "size_coarser",
        /// Not all cells fit the size of a message.
        SizeFewerCells = "size_fewer_cells",
        /// All cells fit the byte rate, in coarser numbers.
        RateCoarser = "rate_coarser",
        /// Not all cells fit the byte rate.
        RateFewerCells = "rate_fewer_cells",
        /// All cells fit what the queue lets through, in coarser numbers.
        QueueCoarser = "queue_coarser",
        /// Not all cells fit what the queue lets through.
        QueueFewerCells = "queue_fewer_cells",
    }
}

/// Why a map is written as it is: in the metadata of its message, beside the codec that says how.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct RateChoice {
    /// Why.
    pub reason: RateReason,
    /// Most bytes that the message was allowed, header and metadata included.
    pub limit_bytes: u64,
}

/// What had to give.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ReducedBy {
    Nothing,
    Exactness,
    Cells,
}

/// Encodes a map so that its whole message keeps within `limit`: in the numbers that `config` wants if all cells that its
/// gate passes fit, else in coarser ones, else in the coarsest with as many cells as fit, the most confident first. The
/// same map, confidence and limit give the same bytes.
///
/// With packing a message is smaller still: what zstd saves is not known before.
///
/// # Shapes
/// As [`encode_features`]; `confidence` is needed wherever not all cells fit.
///
/// # Errors
/// As [`encode_features`]; [`WireError::Budget`] where not even an empty selection fits.
pub fn encode_within(
    features: BevFeatures,
    config: &CodecConfig,
    limit: &ByteLimit,
    confidence: Option<&[f32]>,
) -> Result<EncodedFeatures, WireError> {
    let budget = limit.bytes.saturating_sub(HEAD_BYTES).min(config.budget_bytes.unwrap_or(u64::MAX));
    let (dtype, gave) = choose(&features, config, budget, confidence)?;
    let config = CodecConfig { dtype, budget_bytes: Some(budget), ..*config };
    let encoded = encode_features(features, &config, confidence)?;
    let rate = Some(RateChoice { reason: reason(limit.by, gave), limit_bytes: limit.bytes });
    Ok(EncodedFeatures { rate, ..encoded })
}

/// Bytes that a message with a map may take as `config` wants it, all cells sent: what a limit has to be to be none.
///
/// # Errors
/// [`WireError`] when the map is beyond what may be sent.
pub fn largest_message(features: &BevFeatures, config: &CodecConfig) -> Result<u64, WireError> {
    Ok(HEAD_BYTES + body_bytes(features, config.dtype, Selection::Dense)?)
}

/// Fewest bytes that a message takes in which a map of this shape brings nothing but its lattice.
///
/// # Errors
/// As [`largest_message`].
pub fn smallest_message(features: &BevFeatures) -> Result<u64, WireError> {
    Ok(HEAD_BYTES + body_bytes(features, Dtype::I8, Selection::TopK { cells: 0 })?)
}

/// The most exact numbers in which all wanted cells fit, or the coarsest.
fn choose(
    features: &BevFeatures,
    config: &CodecConfig,
    budget: u64,
    confidence: Option<&[f32]>,
) -> Result<(Dtype, ReducedBy), WireError> {
    let wanted = wanted(features, config, confidence)?;
    let coarser = DTYPES_BY_PRECISION.into_iter().skip_while(|dtype| *dtype != config.dtype);
    for dtype in coarser {
        if body_bytes(features, dtype, wanted)? > budget {
            continue;
        }
        let gave = if dtype == config.dtype { ReducedBy::Nothing } else { ReducedBy::Exactness };
        // Asked last: half precision that overflows is rare, and looking for it takes time.
        if gave == ReducedBy::Nothing
            || dtype != Dtype::F16
            || features.values.iter().all(|value| value.abs() <= F16_MAX)
        {
            return Ok((dtype, gave));
        }
    }
    Ok((Dtype::I8, ReducedBy::Cells))
}

/// What would be sent without a limit.
fn wanted(features: &BevFeatures, config: &CodecConfig, confidence: Option<&[f32]>) -> Result<Selection, WireError> {
    let (Some(gate), Some(confidence)) = (config.gate, confidence) else { return Ok(Selection::Dense) };
    let cells = features.grid.cells();
    selection::check_confidence(confidence, cells)?;
    let passed = gate.cells(confidence, &features.grid)?.len();
    Ok(if passed < cells { Selection::TopK { cells: passed as u32 } } else { Selection::Dense })
}

fn body_bytes(features: &BevFeatures, dtype: Dtype, selection: Selection) -> Result<u64, WireError> {
    let codec = Codec { dtype, selection, packing: Compression::Raw };
    Ok(Layout::new(&features.grid, features.channels, &codec, &Limits::SENDER)?.len() as u64)
}

fn reason(by: LimitedBy, gave: ReducedBy) -> RateReason {
    match (by, gave) {
        (_, ReducedBy::Nothing) => RateReason::Fits,
        (LimitedBy::MessageSize, ReducedBy::Exactness) => RateReason::SizeCoarser,
        (LimitedBy::MessageSize, ReducedBy::Cells) => RateReason::SizeFewerCells,
        (LimitedBy::ByteRate, ReducedBy::Exactness) => RateReason::RateCoarser,
        (LimitedBy::ByteRate, ReducedBy::Cells) => RateReason::RateFewerCells,
        (LimitedBy::Queue, ReducedBy::Exactness) => RateReason::QueueCoarser,
        (LimitedBy::Queue, ReducedBy::Cells) => RateReason::QueueFewerCells,
    }
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
    use crate::message::Bev;
    use crate::wire;

    const GRID: BevGrid = BevGrid { x_min_m: -8.0, y_min_m: -6.0, cell_m: 1.0, width: 16, height: 12 };

    fn map() -> (BevFeatures, Vec<f32>) {
        let values = (0..8 * 192).map(|n| (n as f32 * 0.37).sin()).collect();
        let confidence = (0..192).map(|cell| ((cell * 89) % 192) as f32 / 192.0).collect();
        (BevFeatures { grid: GRID, channels: 8, code_of: None, values }, confidence)
    }

    fn encode(config: &CodecConfig, bytes: u64) -> Result<EncodedFeatures, WireError> {
        let (features, confidence) = map();
        encode_within(features, config, &ByteLimit { bytes, by: LimitedBy::MessageSize }, Some(&confidence))
    }

    fn message_bytes(features: EncodedFeatures) -> u64 {
        let cav = CavId::new(&"z".repeat(32)).unwrap();
        let stamp =
            Stamp { cav, epoch: u64::MAX, sequence: u64::MAX, capture_nanos: u64::MAX, publish_nanos: u64::MAX };
        let pose = PoseEstimate::new(crate::Pose::from_xyz_yaw([-1e5, 1e5, -1e3], -3.0), 1.0);
        wire::encode(&stamp, Bev { pose, features }).unwrap().wire_bytes() as u64
    }

    #[test]
    fn numbers_get_coarser_before_cells_are_left_out() {
        // 192 cells of 8 channels: 6,144 bytes, 3,072, and 1,536 with 32 of scales.
        let choice = |bytes| {
            let encoded = encode(&CodecConfig::default(), HEAD_BYTES + bytes).unwrap();
            (encoded.codec.dtype, encoded.codec.selection, encoded.rate.unwrap().reason)
        };
        assert_eq!(choice(6144), (Dtype::F32, Selection::Dense, RateReason::Fits));
        assert_eq!(choice(6143), (Dtype::F16, Selection::Dense, RateReason::SizeCoarser));
        assert_eq!(choice(3071), (Dtype::I8, Selection::Dense, RateReason::SizeCoarser));
        // 24 bytes of mask and 8 a cell.
        let fewer = Selection::TopK { cells: (1567 - 32 - 24) / 8 };
        assert_eq!(choice(1567), (Dtype::I8, fewer, RateReason::SizeFewerCells));
    }

    #[test]
    fn the_most_confident_cells_stay() {
        let (_, confidence) = map();
        let encoded = encode(&CodecConfig::default(), HEAD_BYTES + 32 + 24 + 8 * 10).unwrap();
        let sent = encoded.decode(&Limits::DEFAULT).unwrap().sent.unwrap();
        let weakest = confidence.iter().zip(&sent).filter(|(_, sent)| **sent).map(|(c, _)| *c).fold(1.0, f32::min);
        let strongest = confidence.iter().zip(&sent).filter(|(_, sent)| !**sent).map(|(c, _)| *c).fold(0.0, f32::max);
        assert!(sent.iter().filter(|sent| **sent).count() == 10 && weakest > strongest);
    }

    #[test]
    fn a_gate_leaves_room_for_exact_numbers() {
        let gate = Some(ConfidenceGate { threshold: 0.9, smoothing: None });
        let config = CodecConfig { gate, ..CodecConfig::default() };
        let encoded = encode(&config, HEAD_BYTES + 1000).unwrap();
        assert_eq!((encoded.codec.dtype, encoded.rate.unwrap().reason), (Dtype::F32, RateReason::Fits));
        assert!(matches!(encoded.codec.selection, Selection::TopK { cells: 1..30 }));
    }

    #[test]
    fn what_half_precision_cannot_hold_is_written_in_bytes() {
        let (mut features, confidence) = map();
        features.values[5] = 1e5;
        let limit = ByteLimit { bytes: HEAD_BYTES + 4000, by: LimitedBy::ByteRate };
        let encoded = encode_within(features, &CodecConfig::default(), &limit, Some(&confidence)).unwrap();
        assert_eq!((encoded.codec.dtype, encoded.rate.unwrap().reason), (Dtype::I8, RateReason::RateCoarser));
    }

    #[test]
    fn a_limit_below_the_smallest_message_is_an_error() {
        let (features, _) = map();
        let smallest = smallest_message(&features).unwrap();
        assert!(matches!(encode(&CodecConfig::default(), smallest - 1), Err(WireError::Budget { .. })));
        assert!(matches!(encode(&CodecConfig::default(), 0), Err(WireError::Budget { .. })));
        let nothing = encode(&CodecConfig::default(), smallest).unwrap();
        assert_eq!(nothing.codec.selection, Selection::TopK { cells: 0 });
        let largest = largest_message(&features, &CodecConfig::default()).unwrap();
        assert_eq!(encode(&CodecConfig::default(), largest).unwrap().rate.unwrap().reason, RateReason::Fits);
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
