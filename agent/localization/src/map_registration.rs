//! Registration to a surfel map behind a localizer: the pose of a sweep to the millimetre, and evidence of its own.
//!
//! A pose that the localizer finds is registered to the planes of the place (ICP, point to plane). Points above the
//! ground and the sweep's own planes decide: at a wrong pose the ground fits too. Where enough of either have a partner the
//! registered pose takes the place of the localizer's. Where too few have, or the map has no planes, a pose of which the localizer is sure stays
//! and another one is rejected: fog leaves as few partners at a right pose as at a wrong one. A sweep with a predicted
//! pose is registered to it first, and the localizer is asked only if that fails.

use std::cell::OnceCell;
use std::path::Path;

use nalgebra::{Isometry3, Matrix6};
use perception::weights::FileError;
use protocol::PointCloud;
use support::stage_times::StageTimes;

use crate::covariance_scale::CovarianceScale;
use crate::pgc::driven_area::DrivenArea;
use crate::pgc::pose_evidence::PoseEvidence;
use crate::pgc::pose_solver::FoundPose;
use crate::pgc::{Localization, Localize, LocalizerError, LocalizerInput, stopwatch};
use crate::registration::icp::surfel_map::SurfelMap;
use crate::registration::icp::{IcpFit, IcpSource, MIN_POINTS, Plane, is_level, register};
use crate::tracker::{PoseMeasurement, unscaled_std};

/// Stage of a localization.
const REGISTER: &str = "pose register";
/// Least share of the points above the ground with a partner, with which a registered pose is taken.
const CONFIRMED: f64 = 0.2;
/// Least share of the sweep's planes that agree with the map, with which one is taken that is not confirmed so: in fog
/// scattered returns count among the points above the ground, and make no planes. Chosen on validation drives.
pub(crate) const AGREED: f64 = 0.55;
/// Radius around a sensor in which its ground is measured, metres.
const NEAR_M: f64 = 12.0;
/// Fewest level planes within it that tell of the ground.
const LEAST_LEVEL: usize = 10;
/// Confidence of the localizer with which a pose stays that the map does not confirm.
const SURE: f64 = 0.8;
/// Largest distance of a registered pose from its start, metres: a step beyond is no refinement.
const MOST_MOVED_M: f64 = 1.5;
/// Standard deviations of its start beyond which a registered pose is doubted: one sound pose in a hundred is.
const CONTRADICTED_STD: f64 = 4.0;
/// Factor on the standard deviations of a registration: distances of neighbouring points to the planes are correlated,
/// and the planes have errors of their own.
const STD_FACTOR: f64 = 4.0;
/// Smallest standard deviations: of a position per axis, metres, and of a rotation, radians.
const LEAST_STD: [f64; 2] = [0.002, 1e-4];
/// Largest root mean square of the distances of a rigid sweep to the planes, metres: on tuning drives, fog, snow and 5 cm of
/// noise included, at most 0.048, and 0.057 and more of sweeps that were taken at 5 to 9 m/s and not corrected for it.
const RIGID_RMS_M: f64 = 0.055;
/// Distance of the planes that a misfit turns a sweep about, metres.
const LEVER_M: f64 = 10.0;

/// A sweep that is registered to a map.
#[derive(Debug)]
pub(crate) struct SweepOnMap<'a> {
    cloud: &'a PointCloud,
    source: IcpSource,
    planes: OnceCell<Vec<Plane>>,
}

impl<'a> SweepOnMap<'a> {
    pub(crate) fn new(cloud: &'a PointCloud) -> Self {
        Self {
            cloud,
            source: IcpSource::of_sweep(&cloud.xyzi),
            planes: OnceCell::new(),
        }
    }

    /// The planes of the sweep, in the frame of its sensor.
    pub(crate) fn planes(&self) -> &[Plane] {
        self.planes
            .get_or_init(|| SurfelMap::planes_of_sweep(&self.cloud.xyzi))
    }

    /// The level planes near the sensor: those below it and those above it, in its frame.
    pub(crate) fn level_planes(&self) -> (Vec<Plane>, Vec<Plane>) {
        let planes = self.planes().iter().copied();
        let level = planes.filter(|plane| is_level(&plane.normal));
        let near = level.filter(|plane| plane.centre_m.xy().norm() < NEAR_M);
        near.partition(|plane| plane.centre_m.z < 0.0)
    }

    /// The registration from `start`, if it constrains the pose and stays near.
    pub(crate) fn fit(&self, map: &SurfelMap, start: &Isometry3<f64>) -> Option<IcpFit> {
        let config = SurfelMap::registration();
        let fit = register(&self.source, map.target(), start, &config).ok()?;
        let moved = fit.target_from_source.translation.vector - start.translation.vector;
        (moved.norm() <= MOST_MOVED_M).then_some(fit)
    }

    /// Share of the planes that agree with the map, of how many; a share of 0 of too few, which agree by chance.
    pub(crate) fn agreement(&self, map: &SurfelMap, fit: &IcpFit) -> (f64, usize) {
        let planes = self.planes();
        match map
            .target()
            .agreement(planes, &fit.target_from_source, false)
        {
            [_, count @ ..MIN_POINTS] => (0.0, count),
            [agreed, count] => (agreed as f64 / count as f64, count),
        }
    }

    /// The pose of that registration, if the map confirms it.
    fn registered(&self, map: &SurfelMap, start: &Isometry3<f64>) -> Option<FoundPose> {
        let fit = self.fit(map, start)?;
        self.confirms(map, &fit)
            .then(|| found_pose(&fit, map.covariance_scale))
    }

    /// The localization near a predicted pose, if there is one and the map confirms it.
    pub(crate) fn near_prediction(
        &self,
        map: &SurfelMap,
        predicted: Option<Isometry3<f64>>,
        times: &mut StageTimes,
    ) -> Option<Localization> {
        let found = predicted.and_then(|start| self.registered(map, &start));
        times.lap(REGISTER);
        found.map(|found| Localization::new(&Ok(found), times.clone()))
    }

    /// True unless the ground below the sensor is not that of the map, or is above it: walls fit an upside-down sweep too.
    /// Not asked near a prediction, which follows from a pose that was: the planes take as long as the registration.
    pub(crate) fn stands_on(&self, map: &SurfelMap, world_from_sensor: &Isometry3<f64>) -> bool {
        let (below, above) = self.level_planes();
        let is_upright = below.len() >= LEAST_LEVEL || above.len() < LEAST_LEVEL;
        let [agreed, count] = map.target().agreement(&below, world_from_sensor, true);
        is_upright && (count < LEAST_LEVEL || 2 * agreed >= count)
    }

    /// True if enough of the sweep lies on the map.
    pub(crate) fn confirms(&self, map: &SurfelMap, fit: &IcpFit) -> bool {
        fit.overlap_above_ground >= CONFIRMED || self.agreement(map, fit).0 >= AGREED
    }
}

/// A localizer whose poses are registered to a surfel map.
#[derive(Debug)]
pub struct MapRegistration {
    localizer: Box<dyn Localize>,
    map: SurfelMap,
    /// Confidence below which a pose that the registration contradicts is rejected.
    min_confidence: f64,
}

impl MapRegistration {
    /// Poses of a localizer, registered to the map in a file; without a file the localizer itself. A pose that the
    /// registration contradicts is rejected below `min_confidence`, as the localizer rejects its own.
    ///
    /// # Errors
    /// [`FileError`] as [`SurfelMap::load`], and of a map of another place than the localizer's.
    pub fn of(
        localizer: Box<dyn Localize>,
        map: &Path,
        min_confidence: f64,
    ) -> Result<Box<dyn Localize>, FileError> {
        if map.as_os_str().is_empty() {
            return Ok(localizer);
        }
        let mut surfels = SurfelMap::load(map)?;
        // Its bound was fitted to poses that began where a fitted confidence gave their deviation.
        if !localizer.is_calibrated() {
            surfels.covariance_scale = None;
        }
        match (localizer.place(), surfels.place.as_str()) {
            (Some(head), place) if !place.is_empty() && place != head => {
                let problem = format_args!("a surfel map of {place:?}, the head is of {head:?}");
                Err(FileError::new(map, problem))
            }
            _ => Ok(Box::new(Self {
                localizer,
                map: surfels,
                min_confidence,
            })),
        }
    }
}

impl Localize for MapRegistration {
    fn localize(&mut self, sweep: LocalizerInput<'_>) -> Result<Localization, LocalizerError> {
        let mut times = stopwatch();
        let on_map = SweepOnMap::new(sweep.cloud);
        // Where the map confirms the prediction, the networks are not needed.
        if let Some(near) = on_map.near_prediction(&self.map, sweep.predicted, &mut times) {
            return Ok(near);
        }
        let registering = times.total();
        let mut localization = self.localizer.localize(sweep)?;
        // The localizer has a stopwatch of its own, which began after the failed registration.
        localization.times.add(REGISTER, registering);
        let published = localization.found.filter(|found| !found.is_rejected);
        if let Some(found) = published {
            let start = &found.world_from_sensor;
            let registered = on_map.registered(&self.map, start);
            let registered =
                registered.filter(|found| on_map.stands_on(&self.map, &found.world_from_sensor));
            let registered = registered.map(|pose| doubted(&found, pose, self.min_confidence));
            localization = judged(localization, &found, registered);
            localization.times.lap(REGISTER);
        }
        Ok(localization)
    }

    fn detector_encoder(&self) -> Option<&str> {
        self.localizer.detector_encoder()
    }

    fn place(&self) -> Option<&str> {
        self.localizer.place()
    }

    fn driven_area(&self) -> Option<&DrivenArea> {
        self.localizer.driven_area()
    }
}

/// A localization of a pose that was registered if the map confirms it.
fn judged(
    localization: Localization,
    found: &FoundPose,
    registered: Option<FoundPose>,
) -> Localization {
    let judged = match registered {
        Some(registered) => registered,
        None if found.sigma >= SURE => return localization,
        None => FoundPose {
            is_rejected: true,
            ..*found
        },
    };
    Localization::new(&Ok(judged), localization.times)
}

/// A registered pose that knows where it began: far from a sure start it is doubted. A sweep that is not rigid, taken while
/// driving without correction or by two LiDARs, fits its map beside its place, and closely.
fn doubted(start: &FoundPose, registered: FoundPose, min_confidence: f64) -> FoundPose {
    let [from, to] = [start, &registered].map(|found| found.world_from_sensor.translation.vector);
    let off_m = (to - from).xy().norm();
    let [std_m, _] = unscaled_std(start);
    let mut judged = FoundPose {
        evidence: start.evidence,
        start_std_m: std_m,
        ..registered
    };
    if off_m > CONTRADICTED_STD * PoseMeasurement::new(0, start).position_std_m {
        judged.start_std_m = std_m.hypot(off_m);
        let scale = registered.covariance_scale.unwrap_or(CovarianceScale::NONE);
        for axis in 0..2 {
            // The fitted factor is on it, too.
            judged.cell_covariance[axis][axis] += (off_m / scale.planar).powi(2);
        }
        judged.sigma = 1.0 / (1.0 / registered.sigma + 2.0 * off_m * off_m);
        judged.is_rejected = judged.sigma < min_confidence;
    }
    judged
}

/// The pose of a registration. Its confidence is that of the expected squared error (Eq. 6).
pub(crate) fn found_pose(fit: &IcpFit, covariance_scale: Option<CovarianceScale>) -> FoundPose {
    let [position, rotation] = LEAST_STD.map(|std: f64| std * std);
    let least = [position, position, position, rotation, rotation, rotation];
    let least = Matrix6::from_diagonal(&least.into());
    // Added, not the larger entry of each: the sum of two covariances is a covariance.
    let covariance = fit.covariance * (STD_FACTOR * STD_FACTOR) + least;
    let misfit_m2 = (fit.rms_m.powi(2) - RIGID_RMS_M.powi(2)).max(0.0);
    let scale = covariance_scale.unwrap_or(CovarianceScale::NONE);
    let widened = covariance + misfit(misfit_m2.sqrt(), &scale);
    FoundPose {
        world_from_sensor: fit.target_from_source,
        evidence: PoseEvidence::none(),
        cell_covariance: widened.transpose().data.0,
        is_registered: true,
        covariance_scale,
        sigma: 1.0 / (1.0 + covariance[(0, 0)] + covariance[(1, 1)] + 2.0 * misfit_m2),
        ..FoundPose::default()
    }
}

/// Covariance of a misfit, metres, without the factors of a scale. It is of the whole sweep: more planes do not make it
/// smaller, as they do noise.
fn misfit(misfit_m: f64, scale: &CovarianceScale) -> Matrix6<f64> {
    let turn = misfit_m / LEVER_M;
    let (planar, height) = (misfit_m / scale.planar, misfit_m / scale.height);
    let (tilt, yaw) = (turn / scale.tilt, turn / scale.yaw);
    let deviations = [planar, planar, height, tilt, tilt, yaw];
    Matrix6::from_diagonal(&deviations.map(|deviation| deviation * deviation).into())
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use perception::weights::annotate;
    use protocol::{NoPoseReason, PointCloud, PoseEstimate};

    use super::*;
    use crate::covariance_scale::COVARIANCE_KEY;
    use crate::pose_covariance::pose_covariance;
    use crate::registration::icp::IcpTarget;
    use crate::registration::icp::surfel_map::tests::{stored, yard};

    #[test]
    fn a_misfit_of_the_sweep_widens_the_covariance_and_a_rigid_sweep_keeps_its_own() {
        let found = |rms_m, scale| {
            let fit = IcpFit {
                target_from_source: Isometry3::identity(),
                overlap: 0.9,
                overlap_above_ground: 0.6,
                rms_m,
                covariance: Matrix6::identity() * 1e-7,
                steps: 4,
            };
            found_pose(&fit, scale)
        };
        assert_eq!(found(0.02, None), found(RIGID_RMS_M, None));
        assert!(found(0.02, None).sigma > 0.9999);
        // Fitted to rigid sweeps: the misfit is as large with their factors as without.
        let scale = CovarianceScale {
            planar: 0.2,
            yaw: 0.1,
            ..CovarianceScale::NONE
        };
        for scale in [None, Some(scale)] {
            let skewed = found(0.08, scale);
            let covariance = pose_covariance(&skewed);
            let [position_std_m, yaw_std_rad] =
                [0, 5].map(|axis: usize| covariance[axis][axis].sqrt());
            assert!((0.055..0.065).contains(&position_std_m), "{position_std_m}");
            assert!((0.0055..0.0065).contains(&yaw_std_rad), "{yaw_std_rad}");
            assert!((0.99..0.995).contains(&skewed.sigma), "{}", skewed.sigma);
        }
    }

    /// A localizer of a place that always finds one pose.
    #[derive(Debug)]
    struct Fixed {
        found: FoundPose,
        place: &'static str,
    }

    impl Localize for Fixed {
        fn localize(&mut self, _: LocalizerInput<'_>) -> Result<Localization, LocalizerError> {
            Ok(Localization::new(&Ok(self.found), stopwatch()))
        }

        fn place(&self) -> Option<&str> {
            Some(self.place)
        }
    }

    /// A sweep of the yard, with a number of points on walls that are not on its map.
    fn sweep(unmapped: u32) -> PointCloud {
        let mut xyzi = yard();
        xyzi.extend((0..unmapped).map(|k| {
            let (along, up, wall) = (k % 100, k / 100 % 20, k / 2000);
            let [along, up] = [along as f32 * 0.35 - 17.5, up as f32 * 0.3 + 6.0];
            [along, 4.0 * wall as f32 - 16.0, up, 0.1]
        }));
        PointCloud { xyzi }
    }

    /// The localizer that finds `start`, behind the map of the yard.
    fn registration(start: Isometry3<f64>, sigma: f64) -> (Box<dyn Localize>, FoundPose) {
        let (_folder, file, _) = stored();
        let found = FoundPose {
            world_from_sensor: start,
            evidence: PoseEvidence::none(),
            cell_covariance: Matrix6::identity().data.0,
            is_registered: false,
            start_std_m: 0.0,
            covariance_scale: None,
            sigma,
            is_rejected: false,
        };
        let place = "yard";
        let registration = MapRegistration::of(Box::new(Fixed { found, place }), &file, 0.0);
        (registration.unwrap(), found)
    }

    /// A sweep with unmapped walls, localized behind the localizer that finds `start`, and the pose of that localizer.
    fn localized(start: Isometry3<f64>, sigma: f64, unmapped: u32) -> (Localization, FoundPose) {
        let (mut registration, found) = registration(start, sigma);
        let cloud = sweep(unmapped);
        let localized = registration.localize(LocalizerInput::of(&cloud));
        (localized.unwrap(), found)
    }

    /// The pose that is found in a sweep with a predicted one.
    fn found_near(registration: &mut dyn Localize, predicted: Isometry3<f64>) -> FoundPose {
        let cloud = sweep(0);
        let input = LocalizerInput {
            predicted: Some(predicted),
            ..LocalizerInput::of(&cloud)
        };
        registration.localize(input).unwrap().found.unwrap()
    }

    /// Distance between a pose and the true one, metres.
    fn off_m(found: &FoundPose, truth: &Isometry3<f64>) -> f64 {
        let off = truth.inv_mul(&found.world_from_sensor);
        off.translation.vector.norm()
    }

    #[test]
    fn points_above_the_ground_decide_whether_a_pose_is_taken_kept_or_rejected() {
        let (_folder, _, truth) = stored();
        let start = truth * Isometry3::new(Vector3::new(0.3, -0.2, 0.0), Vector3::z() * 0.01);
        let (taken, _) = localized(start, 0.5, 0);
        let pose = taken.found.unwrap();
        assert!(pose.is_registered && !pose.is_rejected && off_m(&pose, &truth) < 5e-3);
        assert!(pose.sigma > 0.999 && taken.estimate.world_from_cav().is_some());
        // Its bound remembers how unsure the pose was at which the registration began.
        assert!(pose.start_std_m > 0.3, "{}", pose.start_std_m);
        // A sure pose that it moves far contradicts it: both may be wrong.
        let (doubted, _) = localized(start, 0.999, 0);
        let doubted = doubted.found.unwrap();
        assert!(doubted.is_registered && doubted.sigma < 0.9 && doubted.start_std_m > 0.3);
        assert!(doubted.cell_covariance[0][0].sqrt() > 0.3);
        // Of too few points with a partner a sure pose stays as it was.
        let (kept, found) = localized(start, SURE, 19_000);
        assert_eq!(kept.found, Some(found));
        assert_eq!(kept.estimate, PoseEstimate::new(start.into(), SURE as f32));
        let (rejected, _) = localized(start, SURE - 0.01, 19_000);
        assert!(rejected.found.unwrap().is_rejected);
        let PoseEstimate::NoPose { reason, .. } = rejected.estimate else {
            panic!("{:?}", rejected.estimate);
        };
        assert_eq!(reason, NoPoseReason::LowConfidence);
    }

    /// A yard with its ground at a height above the sensor, metres, and a steep roof, which holds the height without ground.
    fn yard_with_roof(ground_m: f32) -> Vec<[f32; 4]> {
        let (ground, walls) = (yard().into_iter().take(6400), yard().into_iter().skip(6400));
        let roof = (0..6400).map(|k| {
            let up = (k / 80) as f32 * 0.1;
            [(k % 80) as f32 * 0.3 - 12.0, up - 10.0, up + 4.0, 0.1]
        });
        let ground = ground.map(|[x, y, _, intensity]| [x, y, ground_m, intensity]);
        ground.chain(walls).chain(roof).collect()
    }

    #[test]
    fn a_pose_beside_the_ground_of_the_map_or_below_it_is_not_taken() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("surfels.safetensors");
        let mut target = IcpTarget::new(&SurfelMap::building(0.5));
        target.add(&yard_with_roof(-2.0), &Isometry3::identity());
        target.fit();
        SurfelMap::write(&file, "yard", &target).unwrap();
        let map = SurfelMap::load(&file).unwrap();
        for (ground_m, is_taken) in [(-2.0, true), (-0.5, false), (2.0, false)] {
            let xyzi = yard_with_roof(ground_m);
            let cloud = PointCloud { xyzi };
            let sweep = SweepOnMap::new(&cloud);
            let found = sweep.registered(&map, &Isometry3::identity()).unwrap();
            let off_m = found.world_from_sensor.translation.vector.norm();
            assert!(
                off_m < 0.05,
                "{ground_m}: the walls and the roof fit, {off_m} m"
            );
            let stands = sweep.stands_on(&map, &found.world_from_sensor);
            assert_eq!(stands, is_taken, "ground at {ground_m} m");
        }
    }

    #[test]
    fn a_predicted_pose_that_the_map_confirms_needs_no_localizer() {
        let (_folder, _, truth) = stored();
        let elsewhere = Isometry3::translation(90.0, 0.0, 0.0) * truth;
        let (mut registration, found) = registration(elsewhere, SURE);
        let near = truth * Isometry3::translation(0.2, 0.1, 0.0);
        assert!(off_m(&found_near(registration.as_mut(), near), &truth) < 5e-3);
        // A prediction without planes falls back on the localizer, whose pose has no planes either.
        assert_eq!(found_near(registration.as_mut(), elsewhere), found);
    }

    /// The same localizer without a fitted confidence.
    #[derive(Debug)]
    struct Uncalibrated(Fixed);

    impl Localize for Uncalibrated {
        fn localize(&mut self, sweep: LocalizerInput<'_>) -> Result<Localization, LocalizerError> {
            self.0.localize(sweep)
        }

        fn is_calibrated(&self) -> bool {
            false
        }
    }

    #[test]
    fn behind_a_confidence_that_is_not_fitted_the_scale_of_the_map_is_not_used() {
        let (_folder, file, truth) = stored();
        let factors = r#"{"planar":2.0,"height":2.0,"tilt":2.0,"yaw":2.0,"bound":4.0}"#;
        annotate(&file, COVARIANCE_KEY, factors).unwrap();
        let (_, found) = registration(truth, 0.9);
        let fixed = || Fixed {
            found,
            place: "yard",
        };
        let localizers: [Box<dyn Localize>; 2] =
            [Box::new(fixed()), Box::new(Uncalibrated(fixed()))];
        let scaled = localizers.map(|localizer| {
            let mut registration = MapRegistration::of(localizer, &file, 0.0).unwrap();
            let found = found_near(registration.as_mut(), truth);
            found.covariance_scale.is_some()
        });
        assert_eq!(scaled, [true, false]);
    }

    #[test]
    fn a_map_of_another_place_is_refused_with_both_names() {
        let (_folder, file, truth) = stored();
        let (_, found) = registration(truth, 0.9);
        let place = "town1";
        let refused =
            MapRegistration::of(Box::new(Fixed { found, place }), &file, 0.0).unwrap_err();
        let message = refused.to_string();
        assert!(
            message.contains("\"yard\"") && message.contains("\"town1\""),
            "{message}"
        );
    }
}
