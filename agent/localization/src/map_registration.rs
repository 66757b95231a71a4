//! Registration to a surfel map behind a localizer: the pose of a sweep to the millimetre, and evidence of its own.
//!
//! A pose that the localizer finds is registered to the planes of the place (ICP, point to plane). Points above the
//! ground decide: at a wrong pose the ground fits too. Where enough of them have a partner the registered pose takes the
//! place of the localizer's; where next to none has, the pose is rejected; between the two the localizer's pose stays,
//! as where the map has no planes. A sweep with a predicted pose is registered to it first, and the localizer is asked
//! only if that fails.

use std::path::Path;
use std::sync::Arc;

use nalgebra::{Isometry3, Matrix6};
use perception::weights::FileError;

use crate::pgc::pose_evidence::PoseEvidence;
use crate::pgc::pose_solver::FoundPose;
use crate::pgc::{Localization, Localize, LocalizerError, LocalizerInput, stopwatch};
use crate::registration::icp::surfel_map::SurfelMap;
use crate::registration::icp::{IcpConfig, IcpFit, IcpSource, register};

/// Stage of a localization.
pub(crate) const REGISTER: &str = "pose register";
/// Least share of the points above the ground with a partner, with which a registered pose is taken.
const CONFIRMED: f64 = 0.2;
/// Share below which a pose is rejected.
const CONTRADICTED: f64 = 0.1;
/// Largest distance of a registered pose from its start, metres: a step beyond is no refinement.
const MOST_MOVED_M: f64 = 1.5;
/// Factor on the standard deviations of a registration: distances of neighbouring points to the planes are correlated,
/// and the planes have errors of their own.
const STD_FACTOR: f64 = 4.0;
/// Smallest standard deviations: of a position per axis, metres, and of a rotation, radians.
const LEAST_STD: [f64; 2] = [0.002, 1e-4];

/// A localizer whose poses are registered to a surfel map.
#[derive(Debug)]
pub struct MapRegistration {
    localizer: Box<dyn Localize>,
    map: Arc<SurfelMap>,
    config: IcpConfig,
}

impl MapRegistration {
    /// Poses of a localizer, registered to the map in a file; without a file the localizer itself.
    ///
    /// # Errors
    /// [`FileError`] as [`SurfelMap::load`].
    pub fn of(localizer: Box<dyn Localize>, map: &Path) -> Result<Box<dyn Localize>, FileError> {
        if map.as_os_str().is_empty() {
            return Ok(localizer);
        }
        let map = Arc::new(SurfelMap::load(map)?);
        Ok(Box::new(Self::new(localizer, map)))
    }

    /// Poses of `localizer`, registered to `map`.
    #[must_use]
    pub fn new(localizer: Box<dyn Localize>, map: Arc<SurfelMap>) -> Self {
        Self {
            localizer,
            map,
            config: SurfelMap::registration(),
        }
    }

    /// The registration from `start`, if it constrains the pose and stays near.
    fn fit(&self, source: &IcpSource, start: &Isometry3<f64>) -> Option<IcpFit> {
        let fit = register(source, self.map.target(), start, &self.config).ok()?;
        let moved = fit.target_from_source.translation.vector - start.translation.vector;
        (moved.norm() <= MOST_MOVED_M).then_some(fit)
    }
}

impl Localize for MapRegistration {
    fn localize(&mut self, sweep: LocalizerInput<'_>) -> Result<Localization, LocalizerError> {
        let mut times = stopwatch();
        let source = IcpSource::of_sweep(&sweep.cloud.xyzi, &self.config);
        let near = sweep.predicted.and_then(|start| self.fit(&source, &start));
        let registering = times.lap(REGISTER);
        if let Some(fit) = near.filter(|fit| fit.overlap_above_ground >= CONFIRMED) {
            return Ok(Localization::of_found(registered(&fit), times));
        }
        let mut localization = self.localizer.localize(sweep)?;
        localization.times.add(REGISTER, registering);
        let published = localization.found.filter(|found| !found.is_rejected);
        if let Some(found) = published {
            if let Some(fit) = self.fit(&source, &found.world_from_sensor) {
                localization = judged(localization, &found, &fit);
            }
            localization.times.lap(REGISTER);
        }
        Ok(localization)
    }

    fn detector_encoder(&self) -> Option<&str> {
        self.localizer.detector_encoder()
    }
}

/// A localization whose pose was registered.
fn judged(localization: Localization, found: &FoundPose, fit: &IcpFit) -> Localization {
    let share = fit.overlap_above_ground;
    let judged = match share {
        CONFIRMED.. => FoundPose {
            evidence: found.evidence,
            ..registered(fit)
        },
        CONTRADICTED.. => return localization,
        _ => FoundPose {
            is_rejected: true,
            ..*found
        },
    };
    let (inlier_count, inlier_ratio) = (localization.inlier_count, localization.inlier_ratio);
    Localization {
        inlier_count,
        inlier_ratio,
        ..Localization::of_found(judged, localization.times)
    }
}

/// The pose of a registration. Its confidence is that of the expected squared error (Eq. 6).
fn registered(fit: &IcpFit) -> FoundPose {
    let [position, rotation] = LEAST_STD.map(|std: f64| std * std);
    let least = Matrix6::from_diagonal(
        &[position, position, position, rotation, rotation, rotation].into(),
    );
    let covariance = fit.covariance * (STD_FACTOR * STD_FACTOR) + least;
    FoundPose {
        world_from_sensor: fit.target_from_source,
        evidence: PoseEvidence::none(),
        cell_covariance: rows(&covariance),
        is_registered: true,
        sigma: 1.0 / (1.0 + covariance[(0, 0)] + covariance[(1, 1)]),
        is_rejected: false,
    }
}

fn rows(matrix: &Matrix6<f64>) -> [[f64; 6]; 6] {
    std::array::from_fn(|row| std::array::from_fn(|column| matrix[(row, column)]))
}
