//! The maps of a frozen encoder, computed once and kept on disk in half precision.
//!
//! Methods that share an encoder differ in what they make of its maps; what takes the time, the encoder, need not run
//! again for each of them, nor for each pass over the data. The file belongs to one encoder and one listing of data: both
//! hashes are in its name.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use agent::detector::{Detector, DetectorError};
use agent::weights::{Weights, WeightsError};
use sim_replay::dataset::{self, LoadOptions, ReadError, Scenario};
use tch::{Kind, TchError, Tensor};

/// Digits of each hash in the name of a file.
const HASH_DIGITS: usize = 12;

/// Why maps cannot be kept or read.
#[derive(Debug, thiserror::Error)]
pub enum FeatureStoreError {
    /// The system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A sweep cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// The encoder's weights cannot be used.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The encoder refused.
    #[error(transparent)]
    Detector(#[from] DetectorError),
    /// The tensor library refused.
    #[error("kept maps: {0}")]
    Torch(#[from] TchError),
}

/// Whether a parameter is one of the encoder.
#[must_use]
pub fn is_encoder(name: &str) -> bool {
    ["pillar_vfe.", "backbone.", "shrink_conv."].iter().any(|prefix| name.starts_with(prefix))
}

/// Maps of the sweeps of some scenarios, one after another in a file.
#[derive(Debug)]
pub struct FeatureStore {
    path: PathBuf,
    file: File,
    /// Channels, rows and columns.
    shape: [i64; 3],
    /// Names of the scenarios.
    names: Vec<String>,
    /// Place of each scenario's first sweep, and of the end.
    first: Vec<u64>,
    /// Ticks of each scenario.
    ticks: Vec<u64>,
    /// Sweeps that are there.
    stored: u64,
}

impl FeatureStore {
    /// Opens the file of these scenarios in `folder` and encodes what it does not have yet, up to a size.
    ///
    /// `on_sweep` is told how many sweeps are there, and how many there will be. An interrupted run is gone on with.
    ///
    /// # Errors
    /// [`FeatureStoreError`] names the file.
    pub fn open(
        folder: &Path,
        weights: &Weights,
        scenarios: &[Scenario],
        limit_bytes: u64,
        on_sweep: &mut dyn FnMut(u64, u64),
    ) -> Result<Self, FeatureStoreError> {
        let mut detector = Detector::from_weights(weights, &weights.config().map_err(DetectorError::from)?)?;
        let [encoder, data] = [weights.sha256_of(is_encoder), dataset::listing_sha256(scenarios)];
        let path = folder.join(format!("{}-{}.maps", &encoder[..HASH_DIGITS], &data[..HASH_DIGITS]));
        let io = |source| FeatureStoreError::Io { path: path.clone(), source };
        fs::create_dir_all(folder).map_err(io)?;
        let file = OpenOptions::new().create(true).read(true).append(true).open(&path).map_err(io)?;
        let mut first = vec![0];
        for scenario in scenarios {
            first.push(first[first.len() - 1] + (scenario.agents.len() * scenario.ticks.len()) as u64);
        }
        let ticks = scenarios.iter().map(|scenario| scenario.ticks.len() as u64).collect();
        let names = scenarios.iter().map(|scenario| scenario.name.clone()).collect();
        let mut store = Self { path: path.clone(), file, shape: detector.map_shape(), names, first, ticks, stored: 0 };
        // A record that was cut off is made anew.
        store.stored = store.file.metadata().map_err(io)?.len() / store.record_bytes();
        store.file.set_len(store.stored * store.record_bytes()).map_err(io)?;
        store.fill(&mut detector, scenarios, limit_bytes, on_sweep)?;
        Ok(store)
    }

    fn fill(
        &mut self,
        detector: &mut Detector,
        scenarios: &[Scenario],
        limit_bytes: u64,
        on_sweep: &mut dyn FnMut(u64, u64),
    ) -> Result<(), FeatureStoreError> {
        let wanted = self.first[self.first.len() - 1].min(limit_bytes / self.record_bytes());
        for (index, scenario) in scenarios.iter().enumerate() {
            for sweep in 0..self.first[index + 1] - self.first[index] {
                let place = self.first[index] + sweep;
                if place < self.stored || place >= wanted {
                    continue;
                }
                let (agent, tick) = ((sweep / self.ticks[index]) as usize, (sweep % self.ticks[index]) as usize);
                let frame = scenario.load(agent, tick, &LoadOptions::default())?;
                let bytes = half_bytes(&detector.encode(&frame.points)?.features)?;
                self.file.write_all(&bytes).map_err(|source| self.io(source))?;
                self.stored += 1;
                on_sweep(self.stored, wanted);
            }
        }
        Ok(())
    }

    /// The map of a sweep, `[1, C, H, W]` in half precision, by scenario, agent and tick; nothing where it did not fit.
    ///
    /// # Errors
    /// [`FeatureStoreError::Io`] when the file cannot be read.
    pub fn map(&self, scenario: usize, agent: usize, tick: usize) -> Result<Option<Tensor>, FeatureStoreError> {
        let place = self.first[scenario] + agent as u64 * self.ticks[scenario] + tick as u64;
        if place >= self.stored.min(self.first[scenario + 1]) {
            return Ok(None);
        }
        let mut bytes = vec![0; self.record_bytes() as usize];
        self.file.read_exact_at(&mut bytes, place * self.record_bytes()).map_err(|source| self.io(source))?;
        let [channels, height, width] = self.shape;
        Ok(Some(Tensor::f_from_data_size(&bytes, &[1, channels, height, width], Kind::Half)?))
    }

    /// The index of a scenario.
    #[must_use]
    pub fn index_of(&self, scenario: &str) -> Option<usize> {
        self.names.iter().position(|name| name == scenario)
    }

    /// Sweeps that are there, and all of the scenarios.
    #[must_use]
    pub fn sweeps(&self) -> (u64, u64) {
        (self.stored, self.first[self.first.len() - 1])
    }

    fn record_bytes(&self) -> u64 {
        2 * self.shape.iter().product::<i64>().unsigned_abs()
    }

    fn io(&self, source: io::Error) -> FeatureStoreError {
        FeatureStoreError::Io { path: self.path.clone(), source }
    }
}

/// Maps from a store, and from the encoder where that has none.
#[derive(Debug)]
pub struct MapSource {
    store: Arc<FeatureStore>,
    weights: Arc<Weights>,
    encoder: Option<Detector>,
}

impl Clone for MapSource {
    /// The encoder is made anew where it is needed: every thread has its own.
    fn clone(&self) -> Self {
        Self { store: Arc::clone(&self.store), weights: Arc::clone(&self.weights), encoder: None }
    }
}

impl MapSource {
    /// Reads from `store`, which was made with `weights`.
    #[must_use]
    pub fn new(store: Arc<FeatureStore>, weights: Arc<Weights>) -> Self {
        Self { store, weights, encoder: None }
    }

    /// The index of a scenario.
    #[must_use]
    pub fn index_of(&self, scenario: &str) -> Option<usize> {
        self.store.index_of(scenario)
    }

    /// The map of a sweep, `[1, C, H, W]` in half precision; `scenario` is the one of that index.
    ///
    /// # Errors
    /// [`FeatureStoreError`] when it cannot be read.
    pub fn map(
        &mut self,
        index: usize,
        scenario: &Scenario,
        agent: usize,
        tick: usize,
    ) -> Result<Tensor, FeatureStoreError> {
        if let Some(map) = self.store.map(index, agent, tick)? {
            return Ok(map);
        }
        let frame = scenario.load(agent, tick, &LoadOptions::default())?;
        let encoder = match &mut self.encoder {
            Some(encoder) => encoder,
            None => {
                let config = self.weights.config()?;
                self.encoder.insert(Detector::from_weights(&self.weights, &config)?)
            }
        };
        Ok(encoder.encode(&frame.points)?.features.f_to_kind(Kind::Half)?)
    }
}

fn half_bytes(map: &Tensor) -> Result<Vec<u8>, TchError> {
    let half = map.f_to_kind(Kind::Half)?.f_contiguous()?.f_view([-1])?;
    let mut bytes = vec![0; 2 * half.numel()];
    half.f_copy_data_u8(&mut bytes, half.numel())?;
    Ok(bytes)
}
