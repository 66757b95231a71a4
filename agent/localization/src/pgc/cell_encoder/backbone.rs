//! Levels of a detector's backbone as features of cells.

use std::sync::{Mutex, PoisonError};

use perception::detector::{BackboneLevel, Detector};
use perception::tensor_values::tensor;
use perception::weights::{KIND_KEY, Weights};
use tch::{Device, Kind, Tensor, no_grad};

use super::EncodedCells;
use super::bev_cells::{BevCells, BevFormat};
use crate::pgc::error::{LocalizerError, Result};
use crate::pgc::scene_encoder::{SceneFeatures, mean_over};
use crate::pgc::voxel_batch::ranges;

/// Encoder of a detector, in its fastest form.
#[derive(Debug)]
pub(super) struct BackboneEncoder {
    /// Reuses its buffers from sweep to sweep.
    detector: Mutex<Detector>,
    is_quantised: bool,
    pub(super) format: BevFormat,
    /// Of the features.
    device: Device,
}

impl BackboneEncoder {
    /// True for the weights of a detector; their files need not name a kind.
    pub(super) fn is_in(weights: &Weights) -> bool {
        weights
            .metadata(KIND_KEY)
            .is_none_or(|kind| kind == "detector")
    }

    /// The encoder of a detector's weights.
    pub(super) fn of_detector(weights: &Weights, device: Device) -> Result<Self> {
        let config = weights.detector_config()?;
        let detector = Detector::from_weights(weights, &config, Device::Cpu)?;
        let (format, is_quantised) = (BevFormat::of_detector(&config), detector.is_quantised());
        Ok(Self {
            detector: Mutex::new(detector),
            is_quantised,
            format,
            device,
        })
    }

    /// True for levels in the number format of its own and on the same grids: the same weights may have another area.
    pub(super) fn takes(&self, levels: &[BackboneLevel]) -> bool {
        let shapes = levels.iter().map(BackboneLevel::shape);
        let mut kinds = levels.iter().map(BackboneLevel::is_quantised);
        kinds.all(|is_quantised| is_quantised == self.is_quantised)
            && shapes.eq(self.format.shapes())
    }

    /// Features of some sweeps, one after another.
    pub(super) fn encode(&self, sweeps: &[&BevCells]) -> Result<EncodedCells> {
        let rows = ranges(sweeps.iter().map(|sweep| sweep.cells.len()));
        let (mut cells, mut of_sweeps) = (Vec::new(), Vec::new());
        for sweep in sweeps {
            let encoded = (self.detector.lock().unwrap_or_else(PoisonError::into_inner))
                .encode(&sweep.cloud)?;
            let features = self.features(sweep, &encoded.levels)?;
            cells.push(features.cells);
            of_sweeps.push(features.sweeps);
        }
        let (cells, sweeps) = (Tensor::f_cat(&cells, 0)?, Tensor::f_cat(&of_sweeps, 0)?);
        let features = SceneFeatures { cells, sweeps };
        Ok(EncodedCells { features, rows })
    }

    /// Features of one sweep from levels that the detector computed from it.
    pub(super) fn features(
        &self,
        sweep: &BevCells,
        levels: &[BackboneLevel],
    ) -> Result<SceneFeatures> {
        let Some((coarsest, places)) = levels.last().zip(sweep.places.last()) else {
            return Err(LocalizerError::Config("a backbone without levels".into()));
        };
        no_grad(|| {
            let map = coarsest.map()?;
            let own = (levels.iter().zip(&sweep.places))
                .map(|(level, places)| level.of_cells(&tensor(places, &[-1], map.device())?));
            let mut parts: Vec<Tensor> = own.collect::<Result<_, _>>()?;
            let places = tensor(places, &[-1], map.device())?;
            for window in self.format.windows() {
                // Padding is not counted: the counts of both passes multiply, so the mean of means is exact.
                let means = mean_over(&map, window, false)?
                    .f_permute([0, 2, 3, 1])?
                    .f_reshape([-1, map.size()[1]])?;
                parts.push(means.f_index_select(0, &places)?);
            }
            let mean = map.f_mean_dim([2_i64, 3].as_slice(), false, Kind::Float)?;
            let sweeps = Tensor::f_cat(&[mean, map.f_amax([2_i64, 3].as_slice(), false)?], 1)?;
            let cells = Tensor::f_cat(&parts, 1)?.f_to_device(self.device)?;
            let sweeps = sweeps.f_to_device(self.device)?;
            Ok(SceneFeatures { cells, sweeps })
        })
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::path::{Path, PathBuf};

    use perception::detector::encoder_sha256;
    use perception::model_config::DetectorConfig;
    use perception::pillars::point_pillars::PointPillars;
    use perception::weights::{CONFIG_KEY, Precision, save};
    use protocol::PointCloud;
    use tch::nn::VarStore;

    use super::*;
    use crate::pgc::{CellEncoder, SceneEncoder};

    /// Weights of a small detector.
    fn detector(folder: &Path) -> PathBuf {
        let [path, _] = detectors(folder);
        path
    }

    /// Weights of two small detectors with one encoder and different heads.
    fn detectors(folder: &Path) -> [PathBuf; 2] {
        tch::set_num_threads(1);
        tch::manual_seed(3);
        let config = DetectorConfig {
            lidar_range_m: [-12.8, -6.4, -3.0, 12.8, 6.4, 1.0],
            ..DetectorConfig::lean()
        };
        let network = VarStore::new(Device::Cpu);
        PointPillars::new(&network.root(), &config).unwrap();
        let metadata: BTreeMap<_, _> = [(
            CONFIG_KEY.to_owned(),
            serde_json::to_string(&config).unwrap(),
        )]
        .into();
        [0.0, 1.0].map(|bias| {
            let _ = no_grad(|| {
                network.variables()["cls_head.bias"]
                    .shallow_clone()
                    .fill_(bias)
            });
            let path = folder.join(format!("detector-{bias}.safetensors"));
            save(&path, &network, &metadata, Precision::Single).unwrap();
            path
        })
    }

    fn cloud(shift: f32) -> PointCloud {
        let wall = (0..2000).map(|k| {
            [
                (k % 50) as f32 * 0.4 - 10.0,
                4.0 + shift,
                (k / 50) as f32 * 0.08 - 2.5,
                0.3,
            ]
        });
        PointCloud {
            xyzi: wall.collect(),
        }
    }

    #[test]
    fn given_levels_have_the_features_that_the_encoder_computes_itself() {
        let folder = tempfile::tempdir().unwrap();
        let path = detector(folder.path());
        let (encoder, sha256) = CellEncoder::load(&path, Device::Cpu).unwrap();
        let mut of_vehicle = Detector::load(&path, Device::Cpu).unwrap();
        assert_eq!(sha256, of_vehicle.encoder_sha256());
        let clouds = [cloud(0.0), cloud(1.3)];
        let sweeps = clouds
            .each_ref()
            .map(|cloud| encoder.format().prepare(&cloud.xyzi));
        let both = encoder.encode(&sweeps.each_ref(), Kind::Float).unwrap();
        let count: usize = sweeps.iter().map(|sweep| sweep.cells().len()).sum();
        assert_eq!(
            both.features.cells.size(),
            [count as i64, encoder.format().cell_channels()]
        );
        assert_eq!(
            both.features.sweeps.size(),
            [2, encoder.format().sweep_channels()]
        );
        for (number, (sweep, cloud)) in sweeps.iter().zip(&clouds).enumerate() {
            let levels = of_vehicle.encode(cloud).unwrap().levels;
            let given = encoder.encode_one(sweep, Some(&levels)).unwrap();
            let rows = &both.rows[number];
            assert!(
                given.cells.equal(&both.features.cells.narrow(
                    0,
                    rows.start,
                    rows.end - rows.start
                ))
            );
            assert!(
                given
                    .sweeps
                    .equal(&both.features.sweeps.narrow(0, number as i64, 1))
            );
        }
    }

    #[test]
    fn levels_of_another_area_are_not_used() {
        let folder = tempfile::tempdir().unwrap();
        let path = detector(folder.path());
        let (encoder, _) = CellEncoder::load(&path, Device::Cpu).unwrap();
        let weights = Weights::load(&path).unwrap();
        let larger = DetectorConfig {
            lidar_range_m: [-25.6, -6.4, -3.0, 25.6, 6.4, 1.0],
            ..weights.detector_config().unwrap()
        };
        let mut of_vehicle = Detector::from_weights(&weights, &larger, Device::Cpu).unwrap();
        let levels = of_vehicle.encode(&cloud(0.0)).unwrap().levels;
        let sweep = encoder.format().prepare(&cloud(0.0).xyzi);
        let own = encoder.encode_one(&sweep, None).unwrap();
        assert!(
            encoder
                .encode_one(&sweep, Some(&levels))
                .unwrap()
                .cells
                .equal(&own.cells)
        );
    }

    #[test]
    fn an_empty_sweep_has_no_cells_but_features() {
        let folder = tempfile::tempdir().unwrap();
        let (encoder, _) = CellEncoder::load(&detector(folder.path()), Device::Cpu).unwrap();
        let encoded = encoder
            .encode(&[&encoder.format().prepare(&[])], Kind::Float)
            .unwrap();
        assert_eq!(
            encoded.features.cells.size(),
            [0, encoder.format().cell_channels()]
        );
        assert_eq!((encoded.rows.len(), encoded.rows[0].clone()), (1, 0..0));
    }

    #[test]
    fn detectors_that_share_an_encoder_have_one_digest() {
        let folder = tempfile::tempdir().unwrap();
        let [one, other] = detectors(folder.path()).map(|path| Weights::load(&path).unwrap());
        assert_ne!(one.sha256(), other.sha256());
        assert_eq!(CellEncoder::sha256_of(&one), CellEncoder::sha256_of(&other));
        assert_eq!(CellEncoder::sha256_of(&one), encoder_sha256(&one));
    }

    #[test]
    fn other_networks_are_no_encoders() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("head.safetensors");
        let metadata: BTreeMap<_, _> = [(KIND_KEY.to_owned(), "scene head".to_owned())].into();
        save(
            &path,
            &VarStore::new(Device::Cpu),
            &metadata,
            Precision::Single,
        )
        .unwrap();
        let message = CellEncoder::load(&path, Device::Cpu)
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("scene head") && message.contains(SceneEncoder::KIND),
            "{message}"
        );
    }
}
