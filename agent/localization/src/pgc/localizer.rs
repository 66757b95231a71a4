//! Localizer of a scene: its networks and solver, and what they compute from one sweep.

use std::path::Path;

use perception::inference::Inference;
use perception::int8::ScaleSearch;
use perception::tensor_values::values;
use perception::weights::{FileError, Weights};
use protocol::PointCloud;
use protocol::config::FieldError;
use serde::de::DeserializeOwned;
use support::output;
use support::stage_times::StageTimes;
use tch::{Kind, Tensor, no_grad};

use super::cell_choice::choose_evenly;
use super::cell_encoder::{CellEncoder, PreparedSweep};
use super::confidence::{CONFIDENCE_KEY, Confidence, ConfidenceModel};
use super::driven_area::{DRIVEN_AREA_KEY, DrivenArea};
use super::error::Result;
use super::extensions::other_parts::MOST_PARTS;
use super::head_config::SceneHeadConfig;
use super::localization::{ENCODE, REGRESS, VOXELISE, stopwatch};
use super::localize::LocalizerInput;
use super::pose_refinement::SweepCells;
use super::pose_solver::{MIN_CELLS, PoseSolver};
use super::scene_coordinates::SceneCoordinates;
use super::scene_encoder::SceneFeatures;
use super::scene_regression::SceneHead;
use crate::covariance_scale::{COVARIANCE_KEY, CovarianceScale};
use crate::registration::icp::surfel_map::SurfelMap;

/// Largest number of regressed cells, where the head allows for more: more cells hardly improve poses, and they take
/// time.
pub(crate) const CELLS: usize = 256;
/// Largest number of cells of the pose refinement: each costs little, and their errors average out.
const REFINEMENT_CELLS: usize = 768;

/// A sweep behind the encoder.
pub(super) struct SweepFeatures {
    sweep: PreparedSweep,
    features: SceneFeatures,
    /// Cells of the pose refinement.
    pub(super) refinement_cells: SweepCells,
}

/// Encoder, scene-specific head and solver.
#[derive(Debug)]
pub struct Localizer {
    pub(super) encoder: CellEncoder,
    pub(super) head: SceneHead,
    /// Search for a pose, and judgement of it.
    pub solver: PoseSolver,
    /// Largest number of parts of the scene in which a sweep is sought whose pose few cells confirm.
    pub(crate) most_parts: usize,
    /// Of the file, or of the encoder in a detector's file.
    pub(super) encoder_sha256: String,
    /// Area of the drives of the head, if its file states it.
    pub(super) driven_area: Option<DrivenArea>,
}

impl Localizer {
    /// Reads encoder and head.
    ///
    /// # Errors
    /// [`LocalizerError`](super::LocalizerError) when a file is missing, truncated or of another kind, when its confidence
    /// model is not valid, or when the head was trained on the features of another encoder.
    pub fn load(encoder: &Path, head: &Path, inference: Inference) -> Result<Self> {
        let (mut localizer, weights) = Self::open(encoder, head, inference)?;
        let solver = &mut localizer.solver;
        (solver.confidence, solver.covariance) = stored_fits(&weights)?;
        Ok(localizer)
    }

    /// Reads encoder and head without the confidence model in the head's file, to fit a new one: one of an earlier version has other
    /// features.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn load_without_confidence(
        encoder: &Path,
        head: &Path,
        inference: Inference,
    ) -> Result<Self> {
        Ok(Self::open(encoder, head, inference)?.0)
    }

    fn open(encoder: &Path, head: &Path, inference: Inference) -> Result<(Self, Weights)> {
        let Inference { device, precision } = inference;
        if SurfelMap::is_in(head) {
            return Err(FileError::new(head, "a surfel map, needed is a head").into());
        }
        let (mut network, encoder_sha256) = CellEncoder::load(encoder, device)?;
        let weights = Weights::load(head)?.with_precision(precision);
        weights.check_kind(SceneHead::KIND)?;
        let config: SceneHeadConfig = weights.config()?;
        // Before the layers are built: a wrong encoder is named as such, not by a shape.
        config.check_encoder(head, encoder, &encoder_sha256)?;
        let mut scene_head = weights.network(SceneHead::KIND, device, |path, config| {
            SceneHead::new(path, &config)
        })?;
        // The head's file has the scales of both networks.
        if let Some(scales) = weights.activation_scales()? {
            let quantised = network
                .quantise(&scales)
                .and_then(|()| scene_head.quantise(&scales));
            quantised.map_err(|error| weights.quantise_error(error))?;
        }
        let localizer = Self {
            encoder: network,
            head: scene_head,
            solver: PoseSolver::default(),
            most_parts: MOST_PARTS,
            encoder_sha256,
            driven_area: fitted(&weights, DRIVEN_AREA_KEY, DrivenArea::check)?,
        };
        Ok((localizer, weights))
    }

    /// Adds the activations of a sweep to a search for their scales, unless it has too few cells to be localized: theirs are no
    /// evidence for those of others.
    ///
    /// # Errors
    /// [`LocalizerError::Tensor`](super::LocalizerError::Tensor) when the tensor library fails.
    pub fn observe(&self, cloud: &PointCloud, search: &mut ScaleSearch) -> Result<()> {
        let Some(encoded) = self.encode(LocalizerInput::of(cloud), &mut stopwatch())? else {
            return Ok(());
        };
        let (sweep, features) = (&encoded.sweep, &encoded.features);
        if sweep.cells().len() < MIN_CELLS {
            return Ok(());
        }
        self.encoder.observe(sweep, search)?;
        let chosen = choose_evenly(sweep.cells(), self.head.config().max_cells.min(CELLS));
        let cells = SweepCells::pick(sweep.cells(), features, &chosen)?.features;
        no_grad(|| {
            let logits = self.head.classify(&features.sweeps, false)?;
            let logits = logits.f_expand([chosen.len() as i64, -1], false)?;
            let cells = self.head.normalise(&cells)?;
            self.head.observe(&cells, &logits, search)
        })?;
        Ok(())
    }

    /// First steps: voxels, features, scene coordinates.
    ///
    /// # Errors
    /// [`LocalizerError::Tensor`](super::LocalizerError::Tensor) when the tensor library fails.
    pub fn scene_coordinates(
        &self,
        sweep: LocalizerInput<'_>,
    ) -> Result<(SceneCoordinates, StageTimes)> {
        let mut times = stopwatch();
        let Some(encoded) = self.encode(sweep, &mut times)? else {
            return Ok((SceneCoordinates::default(), times));
        };
        let coordinates = self.regress(&encoded, CELLS, &self.classify(&encoded)?, &mut times)?;
        Ok((coordinates, times))
    }

    /// Features of a whole sweep, `[sweep_channels]`, to compare sweeps by; `None` for a sweep without cells.
    ///
    /// # Errors
    /// [`LocalizerError::Tensor`](super::LocalizerError::Tensor) when the tensor library fails.
    pub fn sweep_features(
        &self,
        cloud: &PointCloud,
        times: &mut StageTimes,
    ) -> Result<Option<Vec<f32>>> {
        let encoded = self.encode(LocalizerInput::of(cloud), times)?;
        let features = encoded.map(|encoded| values(&encoded.features.sweeps));
        Ok(features.transpose()?)
    }

    /// Cells and features; `None` for a sweep without cells.
    pub(super) fn encode(
        &self,
        input: LocalizerInput<'_>,
        times: &mut StageTimes,
    ) -> Result<Option<SweepFeatures>> {
        let sweep = self.encoder.format().prepare(&input.cloud.xyzi);
        times.lap(VOXELISE);
        let refined = choose_evenly(sweep.cells(), REFINEMENT_CELLS);
        if refined.is_empty() {
            return Ok(None);
        }
        let features = self.encoder.encode_one(&sweep, input.levels)?;
        let refinement_cells = SweepCells::pick(sweep.cells(), &features, &refined)?;
        times.lap(ENCODE);
        Ok(Some(SweepFeatures {
            sweep,
            features,
            refinement_cells,
        }))
    }

    /// Logits `[1, classes]` of the parts of the scene.
    pub(super) fn classify(&self, encoded: &SweepFeatures) -> tch::Result<Tensor> {
        no_grad(|| self.head.classify(&encoded.features.sweeps, false))
    }

    /// Scene coordinates of at most `count` cells in the part of the scene that the logits `[1, classes]` choose
    /// (Eq. 4).
    pub(super) fn regress(
        &self,
        encoded: &SweepFeatures,
        count: usize,
        logits: &Tensor,
        times: &mut StageTimes,
    ) -> Result<SceneCoordinates> {
        let sweep = &encoded.sweep;
        let chosen = choose_evenly(sweep.cells(), self.head.config().max_cells.min(count));
        let cells = SweepCells::pick(sweep.cells(), &encoded.features, &chosen)?;
        let regression = no_grad(|| {
            let logits = logits.f_expand([chosen.len() as i64, -1], false)?;
            let features = self.head.normalise(&cells.features)?;
            self.head.regress(&features, &logits, Kind::Float)
        })?;
        let world = values(&regression.coordinates_m)?;
        let epsilon_m = values(&regression.epsilon_m)?;
        times.lap(REGRESS);
        Ok(SceneCoordinates {
            sensor_m: cells.sensor_m,
            world_m: world.as_chunks().0.to_vec(),
            epsilon_m,
            origin_m: self.head.config().origin_m,
        })
    }
}

/// The confidence model in a head's file; the plain confidence if there is none.
///
/// # Errors
/// [`LocalizerError`](super::LocalizerError) names the file and the value that is wrong.
pub fn stored_confidence(weights: &Weights) -> Result<Confidence> {
    let model = fitted(weights, CONFIDENCE_KEY, ConfidenceModel::check)?;
    Ok(model.map_or(Confidence::Plain, Confidence::Calibrated))
}

/// Confidence and covariance scale in a head's file. The scale was fitted to a calibrated confidence: without one it is not
/// used, and a note names the file.
fn stored_fits(weights: &Weights) -> Result<(Confidence, Option<CovarianceScale>)> {
    let confidence = stored_confidence(weights)?;
    if confidence == Confidence::Plain {
        let head = weights.path().display();
        output::note(format_args!(
            "{head}: no {CONFIDENCE_KEY:?} in its metadata: wrong poses are not rejected (agent eval --fit-confidence)"
        ));
        return Ok((confidence, None));
    }
    let scale = fitted(weights, COVARIANCE_KEY, CovarianceScale::check)?;
    Ok((confidence, scale))
}

/// Fitted numbers in the metadata `key` of a head's file, checked; `None` if it has none.
fn fitted<T: DeserializeOwned>(
    weights: &Weights,
    key: &'static str,
    check: impl Fn(&T) -> Result<(), FieldError>,
) -> Result<Option<T>> {
    if weights.metadata(key).is_none() {
        return Ok(None);
    }
    let fitted = weights.metadata_json(key)?;
    check(&fitted)
        .map_err(|reason| FileError::new(weights.path(), format_args!("{key}: {reason}")))?;
    Ok(Some(fitted))
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use perception::weights::{self, Precision};
    use tch::Device;
    use tch::nn::VarStore;

    use super::*;
    use crate::pgc::{SceneEncoder, SceneEncoderConfig};

    /// The file of a head with this metadata.
    fn head(folder: &Path, metadata: &[(&str, String)]) -> Weights {
        let path = folder.join("head.safetensors");
        let metadata = metadata.iter().cloned();
        let metadata: BTreeMap<_, _> = metadata.map(|(key, text)| (key.into(), text)).collect();
        weights::save(
            &path,
            &VarStore::new(Device::Cpu),
            &metadata,
            Precision::Single,
        )
        .unwrap();
        Weights::load(&path).unwrap()
    }

    /// Confidence that is read from the file of a head with this model.
    fn stored(folder: &Path, model: &ConfidenceModel) -> Result<Confidence> {
        let text = serde_json::to_string(model).unwrap();
        stored_confidence(&head(folder, &[(CONFIDENCE_KEY, text)]))
    }

    #[test]
    fn without_a_confidence_the_covariance_scale_is_not_used() {
        let folder = tempfile::tempdir().unwrap();
        let factors = r#"{"planar":2.0,"height":2.0,"tilt":2.0,"yaw":2.0,"bound":4.0}"#;
        let covariance = (COVARIANCE_KEY, factors.to_owned());
        let plain = head(folder.path(), std::slice::from_ref(&covariance));
        assert_eq!(stored_fits(&plain).unwrap(), (Confidence::Plain, None));
        let model = serde_json::to_string(&ConfidenceModel::example()).unwrap();
        let calibrated = head(folder.path(), &[(CONFIDENCE_KEY, model), covariance]);
        let (_, scale) = stored_fits(&calibrated).unwrap();
        assert_eq!(scale.unwrap().bound, Some(4.0));
    }

    /// A small localizer with random parameters.
    fn small() -> Localizer {
        let config = SceneEncoderConfig {
            voxel_m: 1.0,
            range_m: 40.0,
            widths: vec![8, 12, 16],
            residual_widths: vec![16],
            ..SceneEncoderConfig::lean()
        };
        let head = SceneHeadConfig {
            scene_name: "test".into(),
            encoder_sha256: String::new(),
            cell_channels: config.cell_channels(),
            sweep_channels: config.sweep_channels(),
            classes: 2,
            centres: 3,
            width: 8,
            blocks: 1,
            origin_m: [0.0; 3],
            max_cells: 500,
            refiner: None,
            sweep_points: None,
        };
        let [of_encoder, of_head] = [(); 2].map(|()| VarStore::new(Device::Cpu));
        let encoder = SceneEncoder::new(&of_encoder.root(), &config).unwrap();
        Localizer {
            encoder: CellEncoder::sparse(encoder, Device::Cpu),
            head: SceneHead::new(&of_head.root(), &head).unwrap(),
            solver: PoseSolver::default(),
            most_parts: MOST_PARTS,
            encoder_sha256: String::new(),
            driven_area: None,
        }
    }

    #[test]
    fn sweeps_of_too_few_cells_are_no_evidence_for_scales() {
        let localizer = small();
        for (points, is_observed) in [(20, false), (4000, true)] {
            let xyzi = (0..points).map(|k| {
                let (x, y, z) = (k % 80, k / 80, k % 7);
                [x as f32 * 0.5 - 20.0, y as f32 - 25.0, z as f32 * 0.5, 0.1]
            });
            let cloud = PointCloud {
                xyzi: xyzi.collect(),
            };
            let mut search = ScaleSearch::default();
            localizer.observe(&cloud, &mut search).unwrap();
            let is_empty = search.scales().is_empty();
            assert_eq!(is_empty, !is_observed, "{points} points");
        }
    }

    #[test]
    fn a_confidence_that_would_fail_on_a_sweep_is_rejected_with_its_file() {
        let folder = tempfile::tempdir().unwrap();
        let model = ConfidenceModel::example();
        assert_eq!(
            stored(folder.path(), &model).unwrap(),
            Confidence::Calibrated(model.clone())
        );
        let absurd = ConfidenceModel {
            bias: -1e308,
            ..model
        };
        let message = stored(folder.path(), &absurd).unwrap_err().to_string();
        assert!(
            message.contains("head.safetensors") && message.contains("bias"),
            "{message}"
        );
    }
}
