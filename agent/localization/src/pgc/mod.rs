//! PGC, Pose Generation with Confidence: scene-coordinate regression from one sweep, after LightLoc.
//!
//! One module per step, in the order of the paper: cells and their features (`cell_encoder`), part of the scene and
//! world coordinates of each cell with their error (`scene_regression`, Eq. 4, 5), pose of most inliers
//! (`pose_solver`, Eq. 6) and its refinement (`pose_refinement`), confidence (`confidence`). Steps that are not in the
//! paper are in `extensions`.

mod cell_choice;
pub mod cell_encoder;
pub mod confidence;
pub(crate) mod dense;
pub mod driven_area;
mod encoder_config;
pub(crate) mod error;
pub mod extensions;
pub(crate) mod feature_norm;
pub(crate) mod head_config;
pub mod head_files;
mod int8_block;
mod int8_levels;
pub(crate) mod localization;
mod localize;
mod localizer;
pub(crate) mod pose_evidence;
pub mod pose_refinement;
pub mod pose_search;
pub mod pose_solver;
mod pose_std;
mod refinement_network;
mod residual_group;
mod scene_coordinates;
pub(crate) mod scene_encoder;
pub(crate) mod scene_regression;
pub mod test_scene;
pub(crate) mod voxel_batch;
pub(crate) mod voxelise;
pub mod wrong_place;

use nalgebra::{Isometry3, Translation3};
use support::stage_times::StageTimes;
use tch::{Kind, Tensor};

pub(crate) use cell_choice::choose_evenly;
pub use cell_encoder::{CellEncoder, EncodedCells, PreparedSweep, SweepFormat};
pub use dense::of_unit_length;
pub use encoder_config::{SceneEncoderConfig, VoxelInput};
pub use error::LocalizerError;
pub(crate) use error::Result;
pub use head_config::{RefinerConfig, SceneHeadConfig};
pub use localization::{Localization, stopwatch};
pub use localize::{Localize, LocalizerInput};
pub use localizer::{Localizer, stored_confidence};
pub use pose_evidence::{PoseEvidence, RefinementEvidence};
pub use refinement_network::Refiner;
pub use scene_coordinates::{Regression, SceneCoordinates, sigma};
pub use scene_encoder::{LocalFeatures, SceneEncoder, SceneFeatures};
pub use scene_regression::SceneHead;
pub use voxel_batch::VoxelBatch;
pub use voxelise::{SweepCell, SweepVoxels};

use confidence::Confidence;
use driven_area::DrivenArea;
use extensions::{along_street, levelling, other_parts, wider_search};
use localization::REFINE;
use localizer::{CELLS, SweepFeatures};
use pose_search::{Attempt, PoseSearch};
use pose_solver::FoundPose;

impl Localize for Localizer {
    fn localize(&mut self, sweep: LocalizerInput<'_>) -> Result<Localization, LocalizerError> {
        let mut times = stopwatch();
        let Some(encoded) = self.encode(sweep, &mut times)? else {
            let solved = self.solver.solve(&SceneCoordinates::default());
            return Ok(Localization::new(&solved, times));
        };
        // A prediction that the sweep does not confirm is dropped: the search is as without one.
        if let Some(predicted) = &sweep.predicted
            && let Some(found) = self.refine_near(&encoded, predicted, &mut times)?
        {
            return Ok(Localization::new(&Ok(found), times));
        }
        // Scene coordinates in the part of the scene that the classifier chooses.
        let logits = self.classify(&encoded)?;
        let coordinates = self.regress(&encoded, CELLS, &logits, &mut times)?;
        let best = wider_search::search(&self.search(&encoded), &coordinates, &mut times)?;
        let best = self.search_elsewhere(best, coordinates, &encoded, &logits, &mut times)?;
        Ok(Localization::new(&best.solved, times))
    }

    fn detector_encoder(&self) -> Option<&str> {
        matches!(self.encoder.format(), SweepFormat::Bev(_)).then_some(&self.encoder_sha256)
    }

    fn place(&self) -> Option<&str> {
        Some(&self.head.config().scene_name)
    }

    fn is_calibrated(&self) -> bool {
        self.solver.confidence != Confidence::Plain
    }

    fn driven_area(&self) -> Option<&DrivenArea> {
        self.driven_area.as_ref()
    }
}

impl Localizer {
    fn search<'a>(&'a self, encoded: &'a SweepFeatures) -> PoseSearch<'a> {
        PoseSearch {
            head: &self.head,
            solver: &self.solver,
            refinement_cells: &encoded.refinement_cells,
            kind: Kind::Float,
        }
    }

    /// Extension: while few cells are inliers of `best`, searches in other likely parts of the scene, and at last along
    /// the street.
    fn search_elsewhere(
        &self,
        mut best: Attempt,
        mut coordinates: SceneCoordinates,
        encoded: &SweepFeatures,
        logits: &Tensor,
        times: &mut StageTimes,
    ) -> Result<Attempt, LocalizerError> {
        if best.is_sufficient() {
            return Ok(best);
        }
        let search = self.search(encoded);
        // The first part is the one that was searched, now with its logit raised above all others.
        for part in other_parts::logits_by_part(logits, self.most_parts)? {
            let there = self.regress(encoded, CELLS, &part, times)?;
            let next = search.attempt(&there, other_parts::WIDENING, times)?;
            if next.is_better_than(&best) {
                (best, coordinates) = (next, there);
            }
            if best.is_sufficient() {
                break;
            }
        }
        Ok(along_street::search(&search, best, &coordinates, times)?)
    }

    /// Extension: the pose near a predicted one, from the pose refinement alone; `None` if the sweep does not confirm
    /// it.
    fn refine_near(
        &self,
        encoded: &SweepFeatures,
        world_from_sensor: &Isometry3<f64>,
        times: &mut StageTimes,
    ) -> Result<Option<FoundPose>, LocalizerError> {
        let origin_m = self.head.config().origin_m;
        // Subtracted in double precision before positions become single.
        let origin_from_sensor = Translation3::from(origin_m).inverse() * world_from_sensor;
        // The refinement hardly corrects height and tilt: a few scene coordinates do it first.
        let few = self.regress(encoded, levelling::CELLS, &self.classify(encoded)?, times)?;
        let start = levelling::level(&few, &origin_from_sensor);
        let cells = &encoded.refinement_cells;
        let refined = pose_refinement::refine(&self.head, cells, &start, false, Kind::Float)?;
        times.lap(REFINE);
        Ok(refined.and_then(|refined| pose_solver::confirm(&refined, &start, origin_m)))
    }
}
