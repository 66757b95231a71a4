//! Surfel map: a place as small planes on one voxel grid, in a file, to which sweeps are registered.
//!
//! The file is a safetensors file of kind `surfel_map`: voxel indices `voxels` `[N, 3]` i16 relative to the origin,
//! centres `centres` `[N, 3]` u8 in 256ths of a voxel, unit normals `normals` `[N, 3]` i8 times 127. A centre is rounded
//! by 1 mm at most in voxels of half a metre.

use std::collections::HashMap;
use std::error::Error;
use std::path::Path;

use nalgebra::Vector3;
use perception::weights::{CONFIG_KEY, FileError, KIND_KEY, parsed, with_header};
use protocol::config::{FieldError, within};
use protocol::text::hex;
use safetensors::tensor::{Dtype, SafeTensors, TensorView, serialize};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use support::file_error::AtFile;
use support::{atomic_file, bounded_file};

use super::surfels::{Surfel, Surfels};
use super::{IcpConfig, IcpLevel, IcpTarget, Plane, RANGE_M};
use crate::covariance_scale::{COVARIANCE_KEY, CovarianceScale};

/// Kind of the file.
const KIND: &str = "surfel_map";
/// Largest file that is read, bytes.
const MAX_BYTES: u64 = 1 << 30;
/// Side of the voxels, metres.
const VOXEL_M: f64 = 0.5;

/// Settings of the file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    /// Side of the voxels, metres.
    voxel_m: f64,
    /// Position of voxel (0, 0, 0) in the world, metres.
    origin_m: [f64; 3],
    /// Nearest and farthest points of a sweep that were used, metres.
    range_m: [f64; 2],
    /// Name of the place, as of its head; empty if it has none.
    #[serde(default)]
    place: String,
}

/// A place to register sweeps to.
#[derive(Debug, Clone)]
pub struct SurfelMap {
    target: IcpTarget,
    /// Name of the place, as of its head; empty if it is not known.
    pub(crate) place: String,
    /// Scale of the covariance of registered poses, if it was fitted.
    pub(crate) covariance_scale: Option<CovarianceScale>,
}

impl SurfelMap {
    /// Settings of registrations to a map: one grid, first with a wide kernel, then with a narrow one.
    pub fn registration() -> IcpConfig {
        IcpConfig {
            levels: vec![
                IcpLevel::new(VOXEL_M, 0.4, 8),
                IcpLevel::new(VOXEL_M, 0.1, 12),
            ],
            max_points: 2000,
        }
    }

    /// Settings of a target that [`Self::write`] takes, of planes in voxels of this side, metres.
    pub fn building(voxel_m: f64) -> IcpConfig {
        let mut config = Self::registration();
        config.levels.truncate(1);
        config.levels[0].voxel_m = voxel_m;
        config
    }

    /// True if a file holds a surfel map.
    pub fn is_in(path: &Path) -> bool {
        let bytes = bounded_file::read(path, MAX_BYTES).unwrap_or_default();
        parsed(&bytes)
            .is_ok_and(|(metadata, _)| metadata.get(KIND_KEY).is_some_and(|kind| kind == KIND))
    }

    /// Planes of one sweep, in the frame of its sensor.
    pub(crate) fn planes_of_sweep(xyzi: &[[f32; 4]]) -> Vec<Plane> {
        let sweep = IcpTarget::of_sweep(xyzi, &Self::building(VOXEL_M));
        sweep.finest_planes().collect()
    }

    /// Planes of the place.
    pub fn target(&self) -> &IcpTarget {
        &self.target
    }

    /// Side of the voxels, metres.
    pub(crate) fn voxel_m(&self) -> f64 {
        self.target
            .levels
            .last()
            .map_or(0.0, |planes| planes.voxel_m)
    }

    /// Writes the finest planes of a fitted target of a place; returns the file's SHA-256.
    ///
    /// # Errors
    /// [`FileError`] when the place is wider than 32,767 voxels, or the file cannot be written.
    pub fn write(path: &Path, place: &str, target: &IcpTarget) -> Result<String, FileError> {
        let (Some(surfels), Some(origin_m)) = (target.levels.last(), target.origin_m) else {
            return Err(FileError::new(path, "the map has no sweep"));
        };
        let mut planes: Vec<([i32; 3], Surfel)> = surfels.planes().collect();
        // In order of the grid, so that the same drives in another order give nearly the same file.
        planes.sort_unstable_by_key(|(voxel, _)| *voxel);
        let (mut voxels, mut centres, mut normals) = (Vec::new(), Vec::new(), Vec::new());
        for (voxel, plane) in &planes {
            for ((index, centre_m), normal) in voxel.iter().zip(&plane.centre_m).zip(&plane.normal)
            {
                let held = i16::try_from(*index).map_err(|_| {
                    FileError::new(path, "the place is wider than 32,767 voxels of the map")
                })?;
                voxels.extend(held.to_le_bytes());
                // 0 to 1 within the voxel. The cast below saturates: a centre on the upper face becomes 255.
                let inside = centre_m / surfels.voxel_m - f64::from(*index);
                centres.push((inside * 256.0) as u8);
                normals.push((normal * 127.0).round() as i8 as u8);
            }
        }
        let config = Config {
            voxel_m: surfels.voxel_m,
            origin_m: origin_m.into(),
            range_m: RANGE_M,
            place: place.to_owned(),
        };
        let bytes = encode(&config, planes.len(), [&voxels, &centres, &normals]).at(path)?;
        atomic_file::write(path, &bytes).at(path)?;
        Ok(hex(&Sha256::digest(&bytes)))
    }

    /// Reads a map.
    ///
    /// # Errors
    /// [`FileError`] when the file is missing, truncated, of another kind, or holds values that are no planes.
    pub fn load(path: &Path) -> Result<Self, FileError> {
        let bytes = bounded_file::read(path, MAX_BYTES).at(path)?;
        decode(&bytes).at(path)
    }
}

fn encode(config: &Config, count: usize, columns: [&[u8]; 3]) -> Result<Vec<u8>, Box<dyn Error>> {
    let kinds = [
        ("voxels", Dtype::I16),
        ("centres", Dtype::U8),
        ("normals", Dtype::I8),
    ];
    let mut tensors = Vec::new();
    for ((name, dtype), data) in kinds.into_iter().zip(columns) {
        tensors.push((name, TensorView::new(dtype, vec![count, 3], data)?));
    }
    let metadata = HashMap::from([
        (KIND_KEY.to_owned(), KIND.to_owned()),
        (CONFIG_KEY.to_owned(), serde_json::to_string(config)?),
    ]);
    Ok(with_header(&serialize(tensors, Some(metadata))?, |_| ())?)
}

fn decode(bytes: &[u8]) -> Result<SurfelMap, Box<dyn Error>> {
    let (metadata, file) = parsed(bytes)?;
    let kind = metadata.get(KIND_KEY).map(String::as_str);
    if kind != Some(KIND) {
        return Err(format!("a file of kind {kind:?}, needed is one of kind {KIND:?}").into());
    }
    let config: Config = serde_json::from_str(metadata.get(CONFIG_KEY).map_or("", String::as_str))
        .map_err(|error| format!("metadata {CONFIG_KEY:?}: {error}"))?;
    config.check()?;
    let voxels = column(&file, "voxels", Dtype::I16)?;
    let centres = column(&file, "centres", Dtype::U8)?;
    let normals = column(&file, "normals", Dtype::I8)?;
    let counts = [voxels.len() / 2, centres.len(), normals.len()].map(|values| values / 3);
    if counts.iter().any(|count| *count != counts[0]) {
        return Err(
            format!("{counts:?} voxels, centres and normals, must be as many of each").into(),
        );
    }
    let planes = (0..counts[0]).map(|row| {
        let first = 3 * row;
        let voxel: [i32; 3] = std::array::from_fn(|axis| {
            let at = 2 * (first + axis);
            i32::from(i16::from_le_bytes([voxels[at], voxels[at + 1]]))
        });
        // Half a step is added because the writer rounds down.
        let inside = Vector3::from_fn(|axis, _| (f64::from(centres[first + axis]) + 0.5) / 256.0);
        let centre_m = (Vector3::from(voxel.map(f64::from)) + inside) * config.voxel_m;
        let normal = Vector3::from_fn(|axis, _| f64::from(normals[first + axis] as i8));
        // Bytes have rounded the length. A file may hold a zero normal, which has no direction.
        let normal = normal.try_normalize(0.5).unwrap_or_else(Vector3::z);
        (voxel, Surfel { centre_m, normal })
    });
    let scale = metadata
        .get(COVARIANCE_KEY)
        .map(|text| serde_json::from_str(text));
    let scale: Option<CovarianceScale> = scale
        .transpose()
        .map_err(|error| format!("metadata {COVARIANCE_KEY:?}: {error}"))?;
    scale.as_ref().map_or(Ok(()), CovarianceScale::check)?;
    Ok(SurfelMap {
        target: IcpTarget {
            levels: vec![Surfels::of_planes(config.voxel_m, planes)],
            origin_m: Some(config.origin_m.into()),
        },
        place: config.place,
        covariance_scale: scale,
    })
}

impl Config {
    fn check(&self) -> Result<(), String> {
        check_voxel(self.voxel_m).map_err(|error| error.to_string())?;
        let (origin_m, range_m) = (&self.origin_m, &self.range_m);
        let mut values = origin_m.iter().chain(range_m);
        match values.all(|value| value.is_finite()) {
            true => Ok(()),
            false => Err(format!(
                "origin_m {origin_m:?} and range_m {range_m:?} must be finite"
            )),
        }
    }
}

/// Checks the side of the voxels, metres.
///
/// # Errors
/// [`FieldError`] outside 5 cm to 10 m.
pub fn check_voxel(voxel_m: f64) -> Result<(), FieldError> {
    within("voxel_m", voxel_m, 0.05, 10.0)
}

/// Bytes of a tensor `[N, 3]`.
fn column<'a>(file: &SafeTensors<'a>, name: &str, dtype: Dtype) -> Result<&'a [u8], String> {
    let view = file
        .tensor(name)
        .map_err(|error| format!("tensor {name:?}: {error}"))?;
    match view.dtype() == dtype && matches!(view.shape(), [_, 3]) {
        true => Ok(view.data()),
        false => Err(format!(
            "tensor {name:?} is {:?} of shape {:?}, must be {dtype:?} of shape [N, 3]",
            view.dtype(),
            view.shape()
        )),
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use nalgebra::Isometry3;

    use super::super::{IcpSource, register};
    use super::*;

    /// Ground and two walls around the origin, 2 m below and around the sensor.
    pub(crate) fn yard() -> Vec<[f32; 4]> {
        let ground = (0..6400).map(|k| {
            [
                (k % 80) as f32 * 0.5 - 20.0,
                (k / 80) as f32 * 0.5 - 20.0,
                -2.0,
                0.1,
            ]
        });
        let walls = (0..8000).map(|k| {
            let (along, up) = (
                (k % 100) as f32 * 0.35 - 17.5,
                (k / 100 % 40) as f32 * 0.15 - 2.0,
            );
            match k / 4000 {
                0 => [along, 12.0, up, 0.1],
                _ => [-15.0, along, up, 0.1],
            }
        });
        ground.chain(walls).collect()
    }

    /// A map of the yard in a file, and the pose from which it was seen.
    pub(crate) fn stored() -> (tempfile::TempDir, std::path::PathBuf, Isometry3<f64>) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("yard.safetensors");
        let pose = Isometry3::new(Vector3::new(1200.0, -340.0, 20.0), Vector3::z() * 0.8);
        let mut target = IcpTarget::new(&SurfelMap::building(VOXEL_M));
        target.add(&yard(), &pose);
        target.fit();
        let sha256 = SurfelMap::write(&path, "yard", &target).unwrap();
        assert_eq!(SurfelMap::write(&path, "yard", &target).unwrap(), sha256);
        (folder, path, pose)
    }

    #[test]
    fn a_sweep_is_registered_to_a_map_from_a_file() {
        let (_folder, path, truth) = stored();
        let map = SurfelMap::load(&path).unwrap();
        let config = SurfelMap::registration();
        let source = IcpSource::of_sweep(&yard());
        let start = truth * Isometry3::new(Vector3::new(0.3, -0.2, 0.1), Vector3::z() * 0.02);
        let fit = register(&source, map.target(), &start, &config).unwrap();
        let off = truth.inv_mul(&fit.target_from_source);
        assert!(
            off.translation.vector.norm() < 5e-3 && off.rotation.angle() < 1e-3,
            "{off}"
        );
        assert!(
            fit.overlap > 0.9 && fit.overlap_above_ground > 0.7,
            "{fit:?}"
        );
        // Two hundred metres beside it nothing above the ground has a partner.
        let elsewhere = Isometry3::translation(200.0, 0.0, 0.0) * truth;
        assert!(register(&source, map.target(), &elsewhere, &config).is_err());
        assert_eq!(map.place, "yard");
    }

    #[test]
    fn a_file_that_is_no_map_is_named_with_its_fault() {
        let (folder, path, _) = stored();
        let whole = std::fs::read(&path).unwrap();
        let other = folder.path().join("other.safetensors");
        let config = Config {
            voxel_m: 0.0,
            origin_m: [0.0; 3],
            range_m: [1.0, 80.0],
            place: String::new(),
        };
        let one = encode(&config, 1, [&[0; 6], &[0; 3], &[0; 3]]).unwrap();
        for (bytes, fault) in [
            (&whole[..whole.len() - 9], "not a complete safetensors file"),
            (one.as_slice(), "voxel_m is 0: must be "),
        ] {
            std::fs::write(&other, bytes).unwrap();
            let message = SurfelMap::load(&other).unwrap_err().to_string();
            assert!(message.contains(fault), "{message}");
        }
    }
}
