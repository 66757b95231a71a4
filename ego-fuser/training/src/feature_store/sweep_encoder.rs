//! Sweep encoder: stored maps of sweeps by number, each thread with a network of its own.

use std::path::PathBuf;
use std::sync::Arc;

use dataset::{LoadOptions, Scenario};
use perception::detector::Detector;
use perception::weights::Weights;
use protocol::codec::encode_features;
use protocol::message::Bev;
use protocol::{CavId, CodecConfig, Dtype, NoPoseReason, PoseEstimate, Stamp, wire};
use tch::Device;

use crate::Error;
use support::file_error::AtFile;

/// zstd level of a message: more costs time and saves nothing.
const ZSTD_LEVEL: i32 = 1;

/// Frozen encoder of one thread, built on first use; a clone builds its own.
#[derive(Debug)]
pub(super) struct ThreadEncoder {
    weights: Arc<Weights>,
    detector: Option<Detector>,
}

impl Clone for ThreadEncoder {
    fn clone(&self) -> Self {
        Self::new(Arc::clone(&self.weights))
    }
}

impl ThreadEncoder {
    pub(super) fn new(weights: Arc<Weights>) -> Self {
        let detector = None;
        Self { weights, detector }
    }

    /// The network of this thread.
    pub(super) fn detector(&mut self) -> Result<&mut Detector, Error> {
        if let Some(ref mut detector) = self.detector {
            return Ok(detector);
        }
        let config = self.weights.detector_config()?;
        let detector = Detector::from_weights(&self.weights, &config, Device::Cpu)?;
        Ok(self.detector.insert(detector))
    }
}

/// Encoder of the sweeps of some scenarios.
#[derive(Clone)]
pub(super) struct SweepEncoder {
    pub(super) encoder: ThreadEncoder,
    pub(super) scenarios: Arc<[Scenario]>,
    /// Index of each scenario's first sweep, and of the end.
    pub(super) first: Arc<[usize]>,
    /// Numeric type of the values.
    pub(super) dtype: Dtype,
    /// The store, for messages of errors.
    pub(super) path: PathBuf,
}

impl SweepEncoder {
    /// The message of a sweep: by agent, then by tick within its scenario. Empty for a sweep that is absent, or that
    /// cannot be read or computed, and beyond the last.
    pub(super) fn message(&mut self, sweep: usize) -> Result<Vec<u8>, Error> {
        // The last scenario that begins at or before the sweep: those without ticks are passed over.
        let scenario = self.first.partition_point(|&first| first <= sweep) - 1;
        // The end is one more entry of `first`: threads ask for numbers beyond it.
        let frame = self.scenarios.get(scenario).and_then(|of| {
            let within = sweep - self.first[scenario];
            let (agent, tick) = (within / of.ticks.len(), within % of.ticks.len());
            of.load(agent, tick, &LoadOptions::default()).ok()
        });
        let Some(frame) = frame else {
            return Ok(Vec::new());
        };
        let detector = self.encoder.detector()?;
        let map = match detector.encode_sweep(&frame.points) {
            Ok(encoded) => encoded.features,
            // The error comes again where the map is needed.
            Err(error) if error.is_of_frame() => return Ok(Vec::new()),
            Err(error) => return Err(error.into()),
        };
        let features = detector.to_kept(&map)?;
        let codec = CodecConfig {
            dtype: self.dtype,
            zstd_level: Some(ZSTD_LEVEL),
            ..CodecConfig::default()
        };
        // Sender and time of a map follow from its index, by which its record is known again.
        let stamp = Stamp {
            cav: CavId::new("0").at(&self.path)?,
            epoch: 0,
            sequence: sweep as u64,
            capture_nanos: 0,
            publish_nanos: 0,
        };
        let pose = PoseEstimate::no_pose(NoPoseReason::NoSource, 0);
        let features = encode_features(features, &codec, None).at(&self.path)?;
        let message = wire::encode(&stamp, Bev { pose, features }).at(&self.path)?;
        Ok(message.to_vec())
    }
}
