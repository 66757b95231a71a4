//! Sweeps of all layouts: the single reader of point files, with intensities from 0 to 1.
//!
//! Properties that files do not record (number of floats per point, range of intensities) are determined from the first
//! sweeps of each agent, once, so that every frame is read alike.

mod floats;
mod intensity;
mod plausibility;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use protocol::{CavId, intensity_divisor};

pub use intensity::{IntensityOption, IntensityScale, LiveIntensities};
pub(crate) use intensity::{NO_INTENSITY, faint};
pub use plausibility::Plausibility;

use floats::FloatForm;
use intensity::{SAMPLES, upper_intensity};

use super::{OpenOptions, ReadError, Result, files, npy, ply};
use crate::pcd::{self, IntensityKind, IntensityOrigin, MAX_BYTES, PcdCloud};

/// Storage of the points of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) enum SweepStorage {
    /// By its name: `.pcd` is PCD, `.ply` PLY, `.npy` a NumPy array, `.bin` (also `.pcd.bin`) little-endian `f32`, 4 or 5
    /// per point.
    #[default]
    ByName,
    /// Little-endian `f32`, component by component: all x, all y, all z, all intensities (Oxford).
    Planar,
    /// NCLT's own: `u16` x, y, z in steps of 5 mm from -100 m, `u8` intensity, `u8` laser.
    NcltRaw,
}

/// The sweeps of a scenario, by agent.
#[derive(Debug, Default)]
pub(super) struct Sweeps {
    storage: SweepStorage,
    scale: IntensityScale,
    agents: BTreeMap<CavId, AgentSweeps>,
}

/// Properties determined from the first sweeps of an agent.
#[derive(Debug, Default)]
struct AgentSweeps {
    files: Vec<PathBuf>,
    form: OnceLock<Result<FloatForm, String>>,
    divisor: OnceLock<f32>,
    /// Set once the missing intensities have been reported.
    is_reported: OnceLock<()>,
}

impl Sweeps {
    /// Largest number of files of an agent that are tried to find samples.
    pub(super) const MOST_TRIED: usize = 30;

    /// Sweeps of files with this storage.
    pub(super) fn new(storage: SweepStorage, options: &OpenOptions) -> Self {
        Self {
            storage,
            scale: options.intensity_scale,
            agents: BTreeMap::new(),
        }
    }

    /// Adds an agent with the files of its plain sweeps, in order. The first that can be read and hold points determine
    /// the properties that files do not record; nothing is read before the first [`Self::read`].
    pub(super) fn with_agent(
        mut self,
        agent: CavId,
        files: impl IntoIterator<Item = PathBuf>,
    ) -> Self {
        let files = files.into_iter().take(Self::MOST_TRIED).collect();
        let sweeps = AgentSweeps {
            files,
            ..AgentSweeps::default()
        };
        self.agents.insert(agent, sweeps);
        self
    }

    /// Sweeps of a layout with one vehicle.
    pub(super) fn of_single_vehicle(
        storage: SweepStorage,
        files: impl IntoIterator<Item = PathBuf>,
        options: &OpenOptions,
    ) -> Self {
        Self::new(storage, options).with_agent(super::single_vehicle_id(), files)
    }

    /// Files of an agent that may determine how its others are read, and `others` that its frames are read from.
    pub(super) fn samples(
        &self,
        agent: &CavId,
        others: impl IntoIterator<Item = PathBuf>,
    ) -> Vec<PathBuf> {
        let own = self.agents.get(agent).into_iter();
        let own = own.flat_map(|agent| agent.files.iter().cloned());
        own.chain(others).collect()
    }

    /// Reads a sweep of an agent: plain or a variant, in the frame and handedness of the file, intensities 0 to 1.
    ///
    /// # Errors
    /// [`ReadError`] for a file that cannot be read or is malformed, and for every file of an agent whose numbers are
    /// neither four nor five to a point.
    pub(super) fn read(&self, agent: &CavId, path: &Path) -> Result<PcdCloud> {
        // An unknown agent has no samples: its floats count as four to a point.
        let unknown = AgentSweeps::default();
        let agent = self.agents.get(agent).unwrap_or(&unknown);
        let mut cloud = agent.read_stored(self.storage, path)?;
        if cloud.intensity.is_none() {
            agent.is_reported.get_or_init(|| {
                tracing::warn!("{} (possibly others too): {NO_INTENSITY}", path.display())
            });
        }
        self.scale.apply(&mut cloud, || agent.divisor(self.storage));
        Ok(cloud)
    }
}

impl AgentSweeps {
    /// Divisor of intensities whose type does not determine their scale.
    fn divisor(&self, storage: SweepStorage) -> f32 {
        *self.divisor.get_or_init(|| {
            let files = self.files.iter();
            let clouds = files.filter_map(|path| self.read_stored(storage, path).ok());
            let first = self.files.first().map(PathBuf::as_path);
            divisor_of_first(clouds, first.unwrap_or(Path::new("")))
        })
    }

    /// Number of floats per point.
    fn form(&self, path: &Path) -> Result<FloatForm> {
        let form = self.form.get_or_init(|| {
            let files = self.files.iter();
            let files = files.filter(|path| matches!(FileKind::of(path), Ok(FileKind::Bin)));
            let samples = files.filter_map(|path| files::read_limited(path, MAX_BYTES).ok());
            let samples = samples.filter(|bytes| !bytes.is_empty()).take(SAMPLES);
            FloatForm::of(&samples.collect::<Vec<_>>())
        });
        form.clone()
            .map_err(|reason| ReadError::malformed(path, reason))
    }

    /// Reads a sweep with the intensities as stored.
    fn read_stored(&self, storage: SweepStorage, path: &Path) -> Result<PcdCloud> {
        match storage {
            SweepStorage::ByName => match FileKind::of(path)? {
                FileKind::Pcd => read_with(path, pcd::decode_stored),
                FileKind::Ply => read_described(path, ply::decode),
                FileKind::Npy => read_described(path, npy::decode),
                FileKind::Bin => {
                    let form = self.form(path)?;
                    read_described(path, |bytes| form.decode(bytes))
                }
            },
            SweepStorage::Planar => read_described(path, planar),
            SweepStorage::NcltRaw => read_described(path, nclt_raw),
        }
    }
}

/// Divisor of intensities by the range of the first clouds that hold points; `path` is that of the first, for messages.
pub(super) fn divisor_of_first(clouds: impl Iterator<Item = PcdCloud>, path: &Path) -> f32 {
    let clouds = clouds
        .filter(|cloud| !cloud.points.is_empty())
        .take(SAMPLES);
    let uppers = clouds.map(|cloud| upper_intensity(&cloud.points));
    let upper = uppers.fold(0.0, f32::max);
    let divisor = intensity_divisor(upper);
    if let Some(finding) = IntensityScale::AUTO.unusual(divisor, upper) {
        tracing::warn!("{} and those after it: {finding}", path.display());
    }
    divisor
}

/// Format of a file, by the ending of its name.
#[derive(strum::EnumString)]
#[strum(serialize_all = "lowercase")]
enum FileKind {
    Pcd,
    Ply,
    Npy,
    /// Bare floats.
    Bin,
}

impl FileKind {
    /// The format of a file.
    ///
    /// # Errors
    /// The ending, if files with it are not read.
    fn of(path: &Path) -> Result<Self> {
        let ending = path.extension().unwrap_or_default().to_ascii_lowercase();
        let ending = ending.to_string_lossy();
        ending.parse().map_err(|_| {
            let reason =
                format!("{ending:?} is no kind of cloud that is read: .pcd, .ply, .npy or .bin");
            ReadError::malformed(path, reason)
        })
    }
}

/// Files of points directly in a folder, in natural order.
pub(super) fn clouds_in(dir: &Path) -> Result<Vec<PathBuf>> {
    let mut names = files::list(dir)?.files;
    names.sort_by(|first, second| files::natural_order(first, second));
    let paths = names.into_iter().map(|name| dir.join(name));
    Ok(paths.filter(|path| FileKind::of(path).is_ok()).collect())
}

fn read_described(
    path: &Path,
    decode: impl FnOnce(&[u8]) -> Result<PcdCloud, String>,
) -> Result<PcdCloud> {
    let bytes = files::read_limited(path, MAX_BYTES)?;
    decode(&bytes).map_err(|reason| ReadError::malformed(path, reason))
}

/// Reads a PCD file. With [`pcd::decode`], for one that is no LiDAR sweep, the fourth value is as stored, or the red byte
/// of a colour from 0 to 1.
pub(super) fn read_with(
    path: &Path,
    decode: fn(&[u8]) -> Result<PcdCloud, pcd::PcdError>,
) -> Result<PcdCloud> {
    let bytes = files::read_limited(path, MAX_BYTES)?;
    decode(&bytes).map_err(|error| {
        ReadError::malformed_at(path, error.line, error.field.as_deref(), error.reason)
    })
}

fn planar(bytes: &[u8]) -> Result<PcdCloud, String> {
    check_whole_points(bytes.len(), 16)?;
    let (numbers, _) = bytes.as_chunks::<4>();
    // Four blocks of equal length: halved twice.
    let (xy, zi) = numbers.split_at(numbers.len() / 2);
    let ((x, y), (z, i)) = (xy.split_at(xy.len() / 2), zi.split_at(zi.len() / 2));
    let points = x.iter().zip(y).zip(z.iter().zip(i));
    let points =
        points.map(|((x, y), (z, i))| [x, y, z, i].map(|number| f32::from_le_bytes(*number)));
    let origin = IntensityOrigin::stored("4th block of floats", IntensityKind::Number);
    let form = "floats by component: x, y, z, intensity";
    Ok(PcdCloud::of_points(points.collect(), Some(origin), form))
}

#[expect(clippy::cast_possible_truncation, reason = "rounded to f32")]
fn nclt_raw(bytes: &[u8]) -> Result<PcdCloud, String> {
    const STEP_M: f64 = 0.005;
    const OFFSET_M: f64 = -100.0;
    check_whole_points(bytes.len(), 8)?;
    let (points, _) = bytes.as_chunks::<8>();
    let points = points
        .iter()
        .map(|&[x0, x1, y0, y1, z0, z1, intensity, _laser]| {
            let [x, y, z] = [[x0, x1], [y0, y1], [z0, z1]]
                // In double precision, rounded once: steps of 5 mm are no binary fractions.
                .map(|bytes| (f64::from(u16::from_le_bytes(bytes)) * STEP_M + OFFSET_M) as f32);
            [x, y, z, f32::from(intensity)]
        });
    let origin = IntensityOrigin::stored("7th byte", IntensityKind::Byte);
    let form = "8 bytes per point, as NCLT records them";
    Ok(PcdCloud::of_points(points.collect(), Some(origin), form))
}

fn check_whole_points(len: usize, point: usize) -> Result<(), String> {
    if len.is_multiple_of(point) {
        return Ok(());
    }
    Err(format!(
        "{len} bytes are not a whole number of points of {point} bytes: the file is cut off"
    ))
}

#[cfg(test)]
pub(crate) mod tests;
