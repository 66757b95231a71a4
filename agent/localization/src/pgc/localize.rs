//! Live localization pipeline: from a sweep to a pose with its confidence.

use std::path::Path;
use std::time::Instant;

use nalgebra::{Isometry3, Vector3};
use protocol::PointCloud;
use tch::nn::VarStore;
use tch::{Device, Kind, TchError, Tensor, no_grad};

use super::cell_encoder::{CellEncoder, PreparedSweep};
use super::confidence::{CONFIDENCE_KEY, Confidence, ConfidenceModel};
use super::error::LocalizerError;
use super::head_config::SceneHeadConfig;
use super::levelling;
use super::localization::{Localization, LocalizerTimes};
use super::pose_refinement::{self, SweepCells};
use super::pose_search::{Attempt, PoseSearch, SearchTimes};
use super::pose_solver::{self, FoundPose, PoseSolver};
use super::scene_encoder::SceneFeatures;
use super::scene_parts::{MOST_PARTS, logits_by_part};
use super::scene_regression::SceneHead;
use super::voxelise::Cell;
use crate::registration::Correspondence;
use perception::detector::BackboneLevel;
use perception::inference::Inference;
use perception::int8::ScaleSearch;
use perception::weights::Weights;

/// Largest number of regressed cells, where the head allows for more: more cells hardly improve poses, and they take
/// time.
pub(crate) const CELLS: usize = 256;
/// Largest number of cells of the pose refinement: each costs little, and their errors average out.
const REFINEMENT_CELLS: usize = 768;
/// Largest share of the regressed cells that may be flat ground, which looks the same everywhere.
const FLAT_SHARE: f64 = 0.25;

/// Predicted world coordinates of the cells of a sweep.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SceneCoordinates {
    /// `[N, 3]`: in the sensor frame, metres.
    pub sensor_m: Vec<[f32; 3]>,
    /// `[N, 3]`: in the world relative to the head's origin, metres.
    pub world_m: Vec<[f32; 3]>,
    /// `[N]`: predicted L1 error, metres.
    pub epsilon_m: Vec<f32>,
    /// The head's origin in the world, metres.
    pub origin_m: [f64; 3],
}

/// A sweep behind the encoder.
struct EncodedSweep {
    sweep: PreparedSweep,
    features: SceneFeatures,
    /// Cells of the pose refinement.
    refinement_cells: SweepCells,
}

/// Input of a localizer: one sweep.
#[derive(Debug, Clone, Copy)]
pub struct LocalizerInput<'a> {
    /// The sweep, in the LiDAR frame.
    pub cloud: &'a PointCloud,
    /// Levels of the backbone of the vehicle's detector for it, if they are computed already and are those of
    /// [`Localize::detector_encoder`].
    pub levels: Option<&'a [BackboneLevel]>,
}

impl<'a> LocalizerInput<'a> {
    /// A sweep of which nothing is computed yet.
    #[must_use]
    pub fn of(cloud: &'a PointCloud) -> Self {
        Self {
            cloud,
            levels: None,
        }
    }
}

/// Estimates the pose of a sweep.
pub trait Localize: std::fmt::Debug + Send {
    /// Localizes one sweep.
    ///
    /// # Errors
    /// [`LocalizerError::Tensor`] when the tensor library fails. A sweep that cannot be localized is no error but a
    /// result: [`protocol::PoseEstimate::NoPose`].
    fn localize_sweep(&mut self, sweep: LocalizerInput<'_>)
    -> Result<Localization, LocalizerError>;

    /// Localizes one sweep of which nothing is computed yet.
    ///
    /// # Errors
    /// As [`Self::localize_sweep`].
    fn localize(&mut self, cloud: &PointCloud) -> Result<Localization, LocalizerError> {
        self.localize_sweep(LocalizerInput::of(cloud))
    }

    /// SHA-256 of the encoder of the detector whose levels it takes; `None` if it has an encoder of its own.
    fn detector_encoder(&self) -> Option<&str> {
        None
    }

    /// Localizes one sweep near a predicted pose `world_from_sensor`, which saves time if the sweep confirms it. By
    /// default the prediction is not used.
    ///
    /// # Errors
    /// As [`Self::localize_sweep`].
    fn localize_near(
        &mut self,
        sweep: LocalizerInput<'_>,
        world_from_sensor: &Isometry3<f64>,
    ) -> Result<Localization, LocalizerError> {
        let _ = world_from_sensor;
        self.localize_sweep(sweep)
    }
}

/// Encoder, scene-specific head and solver.
#[derive(Debug)]
pub struct Localizer {
    encoder: CellEncoder,
    head: SceneHead,
    solver: PoseSolver,
    most_parts: usize,
    device: Device,
    sha256: [String; 2],
}

impl Localizer {
    /// Reads encoder and head.
    ///
    /// # Errors
    /// [`LocalizerError`] when a file is missing, truncated or of another kind, when its confidence model is not valid,
    /// or when the head was trained on the features of another encoder.
    pub fn load(encoder: &Path, head: &Path, inference: Inference) -> Result<Self, LocalizerError> {
        let (mut localizer, weights) = Self::open(encoder, head, inference)?;
        localizer.solver.confidence = stored_confidence(&weights)?;
        Ok(localizer)
    }

    /// The same without the confidence model in the head's file, to fit a new one: one of an earlier version has other
    /// features.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn load_without_confidence(
        encoder: &Path,
        head: &Path,
        inference: Inference,
    ) -> Result<Self, LocalizerError> {
        Ok(Self::open(encoder, head, inference)?.0)
    }

    fn open(
        encoder: &Path,
        head: &Path,
        inference: Inference,
    ) -> Result<(Self, Weights), LocalizerError> {
        let Inference { device, precision } = inference;
        let (mut network, encoder_sha256) = CellEncoder::load(encoder, device)?;
        let weights = Weights::load(head)?.with_precision(precision);
        weights.check_kind(SceneHead::KIND)?;
        let config: SceneHeadConfig = weights.config()?;
        if config.encoder_sha256 != encoder_sha256 {
            return Err(LocalizerError::OtherEncoder {
                head: head.display().to_string(),
                expected: config.encoder_sha256,
                encoder: encoder.display().to_string(),
                found: encoder_sha256,
            });
        }
        let mut variables = VarStore::new(device);
        let mut scene_head = SceneHead::new(&variables.root(), &config)?;
        weights.copy_into(&variables)?;
        variables.freeze();
        if let Some(scales) = weights.activation_scales()? {
            let quantised = network
                .quantise(&scales)
                .and_then(|()| scene_head.quantise(&scales));
            quantised.map_err(|error| weights.quantise_error(error))?;
        }
        let sha256 = [encoder_sha256, weights.sha256().to_owned()];
        let solver = PoseSolver::default();
        Ok((
            Self {
                encoder: network,
                head: scene_head,
                solver,
                most_parts: MOST_PARTS,
                device,
                sha256,
            },
            weights,
        ))
    }

    /// Adds the activations of a sweep to a search for their scales; a sweep without cells has none.
    ///
    /// # Errors
    /// [`LocalizerError::Tensor`] when the tensor library fails.
    pub fn observe(
        &self,
        cloud: &PointCloud,
        search: &mut ScaleSearch,
    ) -> Result<(), LocalizerError> {
        let mut times = LocalizerTimes::default();
        let Some(EncodedSweep {
            sweep, features, ..
        }) = self.encode(LocalizerInput::of(cloud), &mut times)?
        else {
            return Ok(());
        };
        self.encoder.observe(&sweep, search)?;
        let chosen = choose_evenly(sweep.cells(), self.head.config().max_cells.min(CELLS));
        let cells = self.pick(&sweep, &features, &chosen)?.features;
        no_grad(|| {
            let logits = self
                .head
                .classify(&features.sweeps, false)?
                .f_expand([chosen.len() as i64, -1], false)?;
            self.head
                .observe(&self.head.normalise(&cells)?, &logits, search)
        })?;
        Ok(())
    }

    /// SHA-256 of encoder and head.
    #[must_use]
    pub fn sha256(&self) -> &[String; 2] {
        &self.sha256
    }

    /// The head's configuration: scene, origin.
    #[must_use]
    pub fn head_config(&self) -> &SceneHeadConfig {
        self.head.config()
    }

    /// First steps: voxels, features, scene coordinates.
    ///
    /// # Errors
    /// [`LocalizerError::Tensor`] when the tensor library fails.
    pub fn scene_coordinates(
        &self,
        sweep: LocalizerInput<'_>,
    ) -> Result<(SceneCoordinates, LocalizerTimes), LocalizerError> {
        let mut times = LocalizerTimes::default();
        let coordinates = match self.encode(sweep, &mut times)? {
            Some(encoded) => {
                self.regress(&encoded, CELLS, &self.classify(&encoded)?, &mut times)?
            }
            None => SceneCoordinates::default(),
        };
        Ok((coordinates, times))
    }

    /// Features of a whole sweep, `[sweep_channels]`, to compare sweeps by; `None` for a sweep without cells.
    ///
    /// # Errors
    /// [`LocalizerError::Tensor`] when the tensor library fails.
    pub fn sweep_features(
        &self,
        cloud: &PointCloud,
        times: &mut LocalizerTimes,
    ) -> Result<Option<Vec<f32>>, LocalizerError> {
        let Some(encoded) = self.encode(LocalizerInput::of(cloud), times)? else {
            return Ok(None);
        };
        Ok(Some(Vec::try_from(
            &encoded
                .features
                .sweeps
                .f_reshape([-1])?
                .f_to_device(Device::Cpu)?,
        )?))
    }

    /// Cells and features; `None` for a sweep without cells.
    fn encode(
        &self,
        input: LocalizerInput<'_>,
        times: &mut LocalizerTimes,
    ) -> Result<Option<EncodedSweep>, LocalizerError> {
        let start = Instant::now();
        let sweep = self.encoder.format().prepare(&input.cloud.xyzi);
        times.voxelise = start.elapsed();
        let refined = choose_evenly(sweep.cells(), REFINEMENT_CELLS);
        if refined.is_empty() {
            return Ok(None);
        }
        let start = Instant::now();
        let features = self.encoder.encode_one(&sweep, input.levels)?;
        let refinement_cells = self.pick(&sweep, &features, &refined)?;
        times.encode = start.elapsed();
        Ok(Some(EncodedSweep {
            sweep,
            features,
            refinement_cells,
        }))
    }

    /// Logits `[1, classes]` of the parts of the scene.
    fn classify(&self, encoded: &EncodedSweep) -> Result<Tensor, TchError> {
        no_grad(|| self.head.classify(&encoded.features.sweeps, false))
    }

    /// Scene coordinates of at most `count` cells in the part of the scene that the logits `[1, classes]` choose
    /// (Eq. 4).
    fn regress(
        &self,
        encoded: &EncodedSweep,
        count: usize,
        logits: &Tensor,
        times: &mut LocalizerTimes,
    ) -> Result<SceneCoordinates, LocalizerError> {
        let EncodedSweep {
            sweep, features, ..
        } = encoded;
        let start = Instant::now();
        let chosen = choose_evenly(sweep.cells(), self.head.config().max_cells.min(count));
        let SweepCells {
            features: cells,
            sensor_m,
        } = self.pick(sweep, features, &chosen)?;
        let (world, epsilon_m) = no_grad(|| -> Result<(Vec<f32>, Vec<f32>), TchError> {
            let logits = logits.f_expand([chosen.len() as i64, -1], false)?;
            let regression =
                self.head
                    .regress(&self.head.normalise(&cells)?, &logits, Kind::Float)?;
            let world = Vec::try_from(
                &regression
                    .coordinates_m
                    .f_reshape([-1])?
                    .f_to_device(Device::Cpu)?,
            )?;
            Ok((
                world,
                Vec::try_from(&regression.epsilon_m.f_to_device(Device::Cpu)?)?,
            ))
        })?;
        times.regress += start.elapsed();
        let origin_m = self.head.config().origin_m;
        Ok(SceneCoordinates {
            sensor_m,
            world_m: world.as_chunks().0.to_vec(),
            epsilon_m,
            origin_m,
        })
    }

    /// Pose from the sweep alone.
    fn search(
        &self,
        encoded: &EncodedSweep,
        mut times: LocalizerTimes,
    ) -> Result<Localization, LocalizerError> {
        let mut spent = SearchTimes::default();
        let best = self.best_pose(encoded, &mut times, &mut spent)?;
        times.solve = spent.solve;
        times.refine += spent.refine;
        Ok(Localization::new(&best.into_solved(), times))
    }

    /// Pose in the part of the scene that the classifier chooses; while few cells are inliers, in other likely parts,
    /// and at last along the street.
    fn best_pose(
        &self,
        encoded: &EncodedSweep,
        times: &mut LocalizerTimes,
        spent: &mut SearchTimes,
    ) -> Result<Attempt, LocalizerError> {
        let search = PoseSearch {
            head: &self.head,
            solver: &self.solver,
            kind: Kind::Float,
        };
        let cells = &encoded.refinement_cells;
        let logits = self.classify(encoded)?;
        let mut coordinates = self.regress(encoded, CELLS, &logits, times)?;
        let mut best = search.run(&coordinates, cells, spent)?;
        if best.is_sufficient() {
            return Ok(best);
        }
        for part in logits_by_part(&logits, self.most_parts)? {
            let there = self.regress(encoded, CELLS, &part, times)?;
            let next = search.run_in_part(&there, cells, spent)?;
            if next.is_better_than(&best) {
                (best, coordinates) = (next, there);
            }
            if best.is_sufficient() {
                break;
            }
        }
        Ok(search.run_along(best, &coordinates, cells, spent)?)
    }

    /// Pose near a predicted one, from the pose refinement alone; `None` if the sweep does not confirm it.
    fn refine(
        &self,
        encoded: &EncodedSweep,
        world_from_sensor: &Isometry3<f64>,
        times: &mut LocalizerTimes,
    ) -> Result<Option<FoundPose>, LocalizerError> {
        let origin_m = Vector3::from(self.head.config().origin_m);
        let mut origin_from_sensor = *world_from_sensor;
        origin_from_sensor.translation.vector -= origin_m;
        let few = self.regress(encoded, levelling::CELLS, &self.classify(encoded)?, times)?;
        let start = Instant::now();
        let origin_from_sensor = levelling::level(&few, &origin_from_sensor);
        let refined = pose_refinement::refine(
            &self.head,
            &encoded.refinement_cells,
            &origin_from_sensor,
            false,
            Kind::Float,
        )?;
        times.refine = start.elapsed();
        Ok(refined
            .and_then(|refined| pose_solver::confirm(&refined, &origin_from_sensor, &origin_m)))
    }

    fn pick(
        &self,
        sweep: &PreparedSweep,
        features: &SceneFeatures,
        chosen: &[usize],
    ) -> Result<SweepCells, TchError> {
        let rows: Vec<i64> = chosen.iter().map(|&cell| cell as i64).collect();
        let rows = Tensor::f_from_slice(&rows)?.f_to_device(self.device)?;
        let features = no_grad(|| features.cells.f_index_select(0, &rows))?;
        Ok(SweepCells {
            features,
            sensor_m: chosen
                .iter()
                .map(|&cell| sweep.cells()[cell].centroid_m)
                .collect(),
        })
    }

    /// Search and confidence.
    #[must_use]
    pub fn solver(&self) -> &PoseSolver {
        &self.solver
    }

    /// Sets the largest number of parts of the scene in which a sweep is sought whose pose few cells confirm.
    pub fn set_most_parts(&mut self, most: usize) {
        self.most_parts = most;
    }

    /// Sets another search or confidence.
    pub fn set_solver(&mut self, solver: PoseSolver) {
        self.solver = solver;
    }

    /// All steps.
    ///
    /// # Errors
    /// [`LocalizerError::Tensor`] when the tensor library fails. A sweep that cannot be localized is no error but a
    /// result: [`protocol::PoseEstimate::NoPose`].
    pub fn localize(&self, cloud: &PointCloud) -> Result<Localization, LocalizerError> {
        self.localize_globally(LocalizerInput::of(cloud))
    }

    fn localize_globally(&self, sweep: LocalizerInput<'_>) -> Result<Localization, LocalizerError> {
        let mut times = LocalizerTimes::default();
        match self.encode(sweep, &mut times)? {
            Some(encoded) => self.search(&encoded, times),
            None => Ok(Localization::new(
                &self.solver.solve(&SceneCoordinates::default()),
                times,
            )),
        }
    }
}

impl Localize for Localizer {
    fn localize_sweep(
        &mut self,
        sweep: LocalizerInput<'_>,
    ) -> Result<Localization, LocalizerError> {
        self.localize_globally(sweep)
    }

    fn detector_encoder(&self) -> Option<&str> {
        self.encoder
            .takes_levels()
            .then_some(self.sha256[0].as_str())
    }

    fn localize_near(
        &mut self,
        sweep: LocalizerInput<'_>,
        world_from_sensor: &Isometry3<f64>,
    ) -> Result<Localization, LocalizerError> {
        let mut times = LocalizerTimes::default();
        let Some(encoded) = self.encode(sweep, &mut times)? else {
            return Ok(Localization::new(
                &self.solver.solve(&SceneCoordinates::default()),
                times,
            ));
        };
        match self.refine(&encoded, world_from_sensor, &mut times)? {
            Some(found) => Ok(Localization::new(&Ok(found), times)),
            None => self.search(&encoded, times),
        }
    }
}

impl SceneCoordinates {
    /// Correspondences for the solver, weighted by Eq. 6.
    #[must_use]
    pub fn correspondences(&self) -> Vec<Correspondence> {
        let places = self.sensor_m.iter().zip(&self.world_m).zip(&self.epsilon_m);
        places
            .map(|((&source_m, &target_m), &epsilon_m)| Correspondence {
                source_m,
                target_m,
                weight: sigma(epsilon_m),
            })
            .collect()
    }
}

/// The confidence model in a head's file; the plain confidence if there is none.
fn stored_confidence(weights: &Weights) -> Result<Confidence, LocalizerError> {
    if weights.metadata(CONFIDENCE_KEY).is_none() {
        return Ok(Confidence::Plain);
    }
    let model: ConfidenceModel = weights.metadata_json(CONFIDENCE_KEY)?;
    let head = weights.path().display().to_string();
    model
        .check()
        .map_err(|reason| LocalizerError::Confidence { head, reason })?;
    Ok(Confidence::Calibrated(model))
}

/// Confidence of a cell (Eq. 6): 0.5 at an expected error of 1 m.
#[must_use]
pub fn sigma(epsilon_m: f32) -> f32 {
    1.0 / (1.0 + epsilon_m * epsilon_m)
}

/// Up to `count` cells, evenly over the sweep, flat ground no more than its share.
pub(crate) fn choose_evenly(cells: &[Cell], count: usize) -> Vec<usize> {
    let (flat, high): (Vec<usize>, Vec<usize>) =
        (0..cells.len()).partition(|&cell| cells[cell].is_flat());
    let mut chosen = every_nth(&high, (count as f64 * (1.0 - FLAT_SHARE)) as usize);
    // A share of the chosen cells: a sweep with little but ground must not be localized by its ground.
    let flat_count = chosen.len() as f64 * FLAT_SHARE / (1.0 - FLAT_SHARE);
    chosen.extend(every_nth(&flat, flat_count as usize));
    chosen
}

fn every_nth(rows: &[usize], count: usize) -> Vec<usize> {
    let kept = count.min(rows.len());
    (0..kept)
        .map(|place| rows[place * rows.len() / kept])
        .collect()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use dataset::LoadOptions;
    use nalgebra::Translation3;
    use perception::weights::{self, Precision};
    use simulator::generate::{Subset, SynthOptions, generate};

    use super::*;

    /// A sweep of town 1 and its pose.
    fn town1_sweep() -> (PointCloud, Isometry3<f64>) {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("scene");
        generate(
            &SynthOptions {
                frames: 1,
                ..SynthOptions::new(Subset::Town1loc, 450, out.clone())
            },
            &|_| (),
        )
        .unwrap();
        let frame = dataset::open(&out).unwrap().scenarios[0]
            .load(0, 0, &LoadOptions::default())
            .unwrap();
        (frame.points, frame.world_from_lidar.unwrap().isometry())
    }

    fn released(name: &str) -> std::path::PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../deploy/weights")
            .join(name)
    }

    #[test]
    fn a_pose_further_along_the_street_is_mended() {
        tch::set_num_threads(1);
        let files = ["pgc-encoder.safetensors", "pgc-town1.safetensors"].map(released);
        let localizer = Localizer::load(&files[0], &files[1], Inference::default()).unwrap();
        let (cloud, truth) = town1_sweep();
        let mut times = LocalizerTimes::default();
        let encoded = localizer
            .encode(LocalizerInput::of(&cloud), &mut times)
            .unwrap()
            .unwrap();
        let logits = localizer.classify(&encoded).unwrap();
        let coordinates = localizer
            .regress(&encoded, CELLS, &logits, &mut times)
            .unwrap();
        let (head, solver) = (&localizer.head, &localizer.solver);
        let search = PoseSearch {
            head,
            solver,
            kind: Kind::Float,
        };
        let mut origin_from_sensor = truth;
        origin_from_sensor.translation.vector -= Vector3::from(coordinates.origin_m);
        let mut times = SearchTimes::default();
        for (ahead_m, is_mended) in [(-8.0, true), (9.0, true), (40.0, false)] {
            let wrong = solver.registration_at(
                &coordinates,
                origin_from_sensor * Translation3::new(ahead_m, 0.0, 0.0),
            );
            let inlier_ratio = wrong.inlier_ratio;
            let solved = Ok(solver.judge(&coordinates, &wrong, None));
            let wrong = Attempt {
                solved,
                inlier_ratio,
            };
            let found = search
                .run_along(wrong, &coordinates, &encoded.refinement_cells, &mut times)
                .unwrap();
            assert_eq!(
                found.is_sufficient(),
                is_mended,
                "{ahead_m} m ahead: {}",
                found.inlier_ratio
            );
            let pose = found.into_solved().unwrap().world_from_sensor;
            let off_m = (pose.translation.vector - truth.translation.vector).norm();
            assert_eq!(off_m < 0.3, is_mended, "{ahead_m} m ahead: {off_m} m");
        }
    }

    #[test]
    fn a_confidence_that_would_fail_on_a_sweep_is_rejected_with_its_file() {
        let folder = tempfile::tempdir().unwrap();
        let stored = |model: &ConfidenceModel| {
            let path = folder.path().join("head.safetensors");
            let metadata: BTreeMap<_, _> = [(
                CONFIDENCE_KEY.to_owned(),
                serde_json::to_string(model).unwrap(),
            )]
            .into();
            weights::save(
                &path,
                &VarStore::new(Device::Cpu),
                &metadata,
                Precision::Single,
            )
            .unwrap();
            stored_confidence(&Weights::load(&path).unwrap())
        };
        let model = ConfidenceModel::example();
        assert_eq!(
            stored(&model).unwrap(),
            Confidence::Calibrated(model.clone())
        );
        let message = stored(&ConfidenceModel {
            bias: -1e308,
            ..model
        })
        .unwrap_err()
        .to_string();
        assert!(
            message.contains("head.safetensors") && message.contains("bias"),
            "{message}"
        );
    }

    #[test]
    fn ground_is_never_more_than_its_share() {
        let cells = |high: usize, flat: usize| -> Vec<Cell> {
            let cell = |extent_m| Cell {
                extent_m,
                ..Cell::default()
            };
            std::iter::repeat_n(cell(2.0), high)
                .chain(std::iter::repeat_n(cell(0.1), flat))
                .collect()
        };
        for (high, flat, expected) in [
            (1000, 1000, 256),
            (60, 1000, 80),
            (1000, 10, 202),
            (0, 500, 0),
        ] {
            let cells = cells(high, flat);
            let chosen = choose_evenly(&cells, 256);
            let ground = chosen.iter().filter(|&&cell| cells[cell].is_flat()).count();
            assert_eq!(chosen.len(), expected);
            assert!(
                ground as f64 <= FLAT_SHARE * chosen.len() as f64,
                "{ground} of {expected}"
            );
        }
    }
}
