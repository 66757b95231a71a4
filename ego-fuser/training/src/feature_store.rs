//! Feature store: maps of a frozen encoder, computed once and kept on disk.
//!
//! Methods with a common encoder differ in the fusion of its maps; the encoder, which takes most of the time, need not
//! run again for each of them, nor for each pass over the data. The file belongs to one encoder with its settings, one
//! set of data (its contents), one program and one wire version: all are in its name. It holds one packed message per sweep, as on the wire, each
//! after its length: truncated, changed and exchanged messages are detected, and computed again where they are needed.

mod sweep_encoder;

use crate::Error;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::FileExt;
use std::path::PathBuf;
use std::sync::{Arc, Once};

use dataset::{self, IntensityScale, LoadOptions, Scenario};
use perception::train::Prefetch;
use perception::weights::Weights;
use protocol::message::Bev;
use protocol::text::hex;
use protocol::{Dtype, Limits, WIRE_VERSION, wire};
use sha2::{Digest, Sha256};
use support::file_digests::FileDigests;
use support::file_error::{AtFile, FileError};
use support::output;
use tch::Tensor;

use sweep_encoder::{SweepEncoder, ThreadEncoder};

/// Digits of each hash in the name of a file.
const HASH_DIGITS: usize = 12;

/// Folder, numeric type and largest size of stored maps.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeptMaps {
    /// The folder; a file per encoder, contents of the data and numeric type.
    pub folder: PathBuf,
    /// Numeric type of the values.
    pub dtype: Dtype,
    /// Largest size of a file, bytes; sweeps beyond are encoded whenever they are needed.
    pub limit_bytes: u64,
    /// Scale of the intensities that were encoded: another scale gives other maps.
    pub intensity_scale: IntensityScale,
}

/// True if a parameter belongs to the encoder.
pub fn is_encoder(name: &str) -> bool {
    ["pillar_vfe.", "backbone.", "shrink_conv."]
        .iter()
        .any(|prefix| name.starts_with(prefix))
}

/// Maps of the sweeps of some scenarios, one after another in a file.
#[derive(Debug)]
pub struct FeatureStore {
    path: PathBuf,
    file: File,
    scenarios: Arc<[Scenario]>,
    /// Index of each scenario's first sweep, and of the end.
    first: Vec<usize>,
    /// Offset of each message in the file, and the end of the last one, bytes.
    starts: Vec<u64>,
    /// The note of the first record that was changed.
    noted: Once,
}

impl FeatureStore {
    /// Path of the file of these scenarios: its name has digests of everything that the maps depend on.
    ///
    /// # Errors
    /// [`Error`] when a file cannot be read.
    pub fn file(
        kept: &KeptMaps,
        weights: &Weights,
        scenarios: &[Scenario],
        digests: &FileDigests,
    ) -> Result<PathBuf, Error> {
        let program = digests.program_sha256().at(&kept.folder)?;
        let scales = weights.activation_scales()?;
        let scales = scales.map(|scales| scales.sha256_of(is_encoder));
        let settings = format!(
            "{:?} {:?} {} {scales:?} {program} {WIRE_VERSION}",
            weights.detector_config()?,
            kept.dtype,
            kept.intensity_scale,
        );
        let parts = [
            weights.sha256_of(is_encoder),
            dataset::content_sha256(scenarios, None, digests),
            hex(&Sha256::digest(settings)),
        ];
        let parts = parts.map(|digest| digest.chars().take(HASH_DIGITS).collect::<String>());
        Ok(kept.folder.join(format!("{}.maps", parts.join("-"))))
    }

    /// Opens the file of these scenarios and encodes the missing sweeps on `threads` CPU threads, up to its size;
    /// `digests` has those of files that were read before.
    ///
    /// `on_sweep` gets the number of stored sweeps and of all. An interrupted run is continued.
    ///
    /// # Errors
    /// [`Error`] names the file.
    pub fn open(
        kept: &KeptMaps,
        weights: &Arc<Weights>,
        scenarios: &[Scenario],
        digests: &FileDigests,
        threads: usize,
        on_sweep: &mut dyn FnMut(usize, usize),
    ) -> Result<Self, Error> {
        let path = Self::file(kept, weights, scenarios, digests)?;
        fs::create_dir_all(&kept.folder).at(&path)?;
        let file = OpenOptions::new()
            .create(true)
            .read(true)
            .append(true)
            .open(&path)
            .at(&path)?;
        // Of two trainings that start together one encodes, the other waits for it.
        file.lock().at(&path)?;
        let mut first = vec![0];
        for scenario in scenarios {
            first.push(first[first.len() - 1] + scenario.agents.len() * scenario.ticks.len());
        }
        let starts = starts(&file, first[first.len() - 1]).at(&path)?;
        // A truncated message is encoded again.
        file.set_len(starts[starts.len() - 1]).at(&path)?;
        let scenarios: Arc<[Scenario]> = scenarios.into();
        let encoder = SweepEncoder {
            encoder: ThreadEncoder::new(Arc::clone(weights)),
            scenarios: Arc::clone(&scenarios),
            first: first.as_slice().into(),
            dtype: kept.dtype,
            path: path.clone(),
        };
        let mut store = Self {
            path,
            file,
            scenarios,
            first,
            starts,
            noted: Once::new(),
        };
        store.fill(encoder, kept.limit_bytes, threads, on_sweep)?;
        store.file.unlock().at(&store.path)?;
        Ok(store)
    }

    fn fill(
        &mut self,
        mut encoder: SweepEncoder,
        limit_bytes: u64,
        threads: usize,
        on_sweep: &mut dyn FnMut(usize, usize),
    ) -> Result<(), Error> {
        let (stored, all) = self.sweeps();
        if stored == all || self.bytes() >= limit_bytes {
            return Ok(());
        }
        let threads = threads.min(all - stored);
        let mut messages = Prefetch::start(threads, stored as u64, move |sweep| {
            encoder.message(sweep as usize)
        });
        while self.sweeps().0 < all && self.bytes() < limit_bytes {
            let message = messages.next_batch()??;
            let length = u32::try_from(message.len())
                .map_err(|_| io::Error::from(io::ErrorKind::FileTooLarge))
                .at(&self.path)?;
            // In one write: an interruption truncates the last record only.
            let record = [&length.to_le_bytes()[..], &message].concat();
            self.file.write_all(&record).at(&self.path)?;
            self.starts.push(self.bytes() + record.len() as u64);
            on_sweep(self.sweeps().0, all);
        }
        Ok(())
    }

    /// The map of a sweep, `[1, C, H, W]`, by scenario, agent and tick; `None` where it did not fit, the sweep could not
    /// be read, or its record was changed, of which the first is noted.
    ///
    /// # Errors
    /// [`Error`] when the file cannot be read.
    pub fn map(&self, scenario: usize, agent: usize, tick: usize) -> Result<Option<Tensor>, Error> {
        let place = self.first[scenario] + agent * self.scenarios[scenario].ticks.len() + tick;
        let Some(&[start, end]) = self.starts.get(place..place + 2) else {
            return Ok(None);
        };
        // An empty message stands for a sweep that could not be read or computed.
        if start + LENGTH_BYTES == end {
            return Ok(None);
        }
        let message = message_of(place, &self.file, start, end).at(&self.path)?;
        let message = message.inspect_err(|problem| {
            let what = format!("map of sweep {place}: {problem}; it is computed again");
            let note = FileError::new(&self.path, what);
            self.noted.call_once(|| output::note(note));
        });
        let Ok(message) = message else {
            return Ok(None);
        };
        let decoded = message.features.decode(&Limits::DEFAULT);
        let features = decoded.at(&self.path)?.features;
        let (channels, grid) = (features.channels, features.grid);
        let size = [1, channels, grid.height, grid.width].map(i64::from);
        Ok(Some(Tensor::f_from_slice(&features.values)?.f_view(size)?))
    }

    /// Number of stored sweeps, and of all sweeps of the scenarios.
    pub fn sweeps(&self) -> (usize, usize) {
        (self.starts.len() - 1, self.first[self.first.len() - 1])
    }

    fn bytes(&self) -> u64 {
        self.starts[self.starts.len() - 1]
    }
}

/// Bytes of the length before each message.
const LENGTH_BYTES: u64 = 4;

/// Offset of each complete message of a file, at most `all`, and the end of the last one.
fn starts(file: &File, all: usize) -> io::Result<Vec<u64>> {
    let end = file.metadata()?.len();
    let mut starts = vec![0];
    let mut next = 0;
    // The last record is incomplete where a process ended while it wrote.
    while starts.len() <= all && next + LENGTH_BYTES <= end {
        let mut length = [0; LENGTH_BYTES as usize];
        file.read_exact_at(&mut length, next)?;
        next += LENGTH_BYTES + u64::from(u32::from_le_bytes(length));
        if next <= end {
            starts.push(next);
        }
    }
    // A power cut may leave zeros from some place on: in the last message that is not empty, then as empty messages.
    while let &[.., start, end] = starts.as_slice()
        && message_of(starts.len() - 2, file, start, end)?.is_err()
    {
        starts.pop();
    }
    Ok(starts)
}

/// The message of a sweep in the record between two offsets; an inner error where the record holds none that can be read,
/// or that of another sweep.
fn message_of(sweep: usize, file: &File, start: u64, end: u64) -> io::Result<Result<Bev, String>> {
    let mut bytes = vec![0; (end - start - LENGTH_BYTES) as usize];
    // At an offset of its own: threads share the file without moving a common position.
    file.read_exact_at(&mut bytes, start + LENGTH_BYTES)?;
    Ok(match wire::decode([bytes.as_slice()], &Limits::DEFAULT) {
        Ok((header, message)) if header.stamp.sequence == sweep as u64 => Ok(message),
        Ok((header, _)) => Err(format!("its record is of sweep {}", header.stamp.sequence)),
        Err(error) => Err(error.to_string()),
    })
}

/// Maps from a store, and from the encoder for sweeps that it does not hold.
#[derive(Debug, Clone)]
pub struct MapSource {
    store: Arc<FeatureStore>,
    encoder: ThreadEncoder,
}

impl MapSource {
    /// Reads from `store`, which was made with `weights`.
    pub fn new(store: Arc<FeatureStore>, weights: Arc<Weights>) -> Self {
        let encoder = ThreadEncoder::new(weights);
        Self { store, encoder }
    }

    /// The index of a scenario.
    pub fn index_of(&self, scenario: &str) -> Option<usize> {
        let mut scenarios = self.store.scenarios.iter();
        scenarios.position(|of| of.name == scenario)
    }

    /// The map of a sweep, `[1, C, H, W]`; `scenario` is the one of that index.
    ///
    /// # Errors
    /// [`Error`] when it cannot be read.
    pub fn map(
        &mut self,
        index: usize,
        scenario: &Scenario,
        agent: usize,
        tick: usize,
    ) -> Result<Tensor, Error> {
        if let Some(map) = self.store.map(index, agent, tick)? {
            return Ok(map);
        }
        let frame = scenario.load(agent, tick, &LoadOptions::default())?;
        let encoded = self.encoder.detector()?.encode_sweep(&frame.points)?;
        Ok(encoded.features)
    }
}
