//! Track: an object with identity, motion and a probability of existence.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use nalgebra::{Isometry3, Matrix4, Rotation2, Vector2, Vector3};
use protocol::{Box3d, ObjectTrack, Track};

use crate::TrackerConfig;
use crate::kalman::{ConstantVelocity, Innovation};
use crate::measurement::Measurement;

/// Share of a new measurement in size, height and heading.
const SMOOTHING: f64 = 0.3;
/// Largest probability of existence: any object may vanish between two frames.
const MAX_EXISTENCE: f64 = 0.99;
/// Speed from which the direction of motion tells front from rear, metres per second.
const CLEAR_MOTION_MPS: f64 = 3.0;

/// State of a track between frames.
#[derive(Debug, Clone)]
pub(crate) struct TrackState {
    id: u64,
    filter: ConstantVelocity,
    z_m: f64,
    size_m: [f64; 3],
    heading_rad: f64,
    existence: f64,
    score_sum: f64,
    hits: u32,
    age_s: f64,
    unseen_s: f64,
    /// Index of its detection in the list of this frame.
    detection: Option<usize>,
}

impl TrackState {
    /// The track of a first detection.
    pub(crate) fn new(id: u64, measured: &Measurement, config: &TrackerConfig) -> Self {
        let position = measured.position_m();
        Self {
            id,
            filter: ConstantVelocity::at(position, &measured.noise_m2, config.initial_sigma_mps),
            z_m: measured.box3d.center_m[2],
            size_m: measured.box3d.size_m,
            heading_rad: measured.box3d.heading_rad,
            existence: measured.score.min(MAX_EXISTENCE),
            score_sum: measured.score,
            hits: 1,
            age_s: 0.0,
            unseen_s: 0.0,
            detection: Some(measured.detection),
        }
    }

    pub(crate) fn predict(&mut self, elapsed_s: f64, config: &TrackerConfig) {
        self.filter.predict(elapsed_s, config.acceleration_mps2);
        self.age_s += elapsed_s;
        self.unseen_s += elapsed_s;
        self.detection = None;
    }

    pub(crate) fn innovation(&self, measured: &Measurement) -> Option<Innovation> {
        self.filter
            .innovation(measured.position_m(), &measured.noise_m2)
    }

    /// Takes a detection in.
    pub(crate) fn hit(&mut self, innovation: &Innovation, measured: &Measurement) {
        self.filter.correct(innovation, &measured.noise_m2);
        smooth(&mut self.z_m, measured.box3d.center_m[2]);
        for (old, new) in self.size_m.iter_mut().zip(measured.box3d.size_m) {
            smooth(old, new);
        }
        self.turn(measured.box3d.heading_rad);
        // Independent evidence: it does not exist only if both are wrong.
        let both_wrong = (1.0 - self.existence) * (1.0 - measured.score);
        self.existence = (1.0 - both_wrong).min(MAX_EXISTENCE);
        self.score_sum += measured.score;
        self.hits = self.hits.saturating_add(1);
        self.unseen_s = 0.0;
        self.detection = Some(measured.detection);
    }

    /// Moves the heading towards a measured one. Detectors confuse front and rear: the nearer of the two counts, and the
    /// direction of a clear motion.
    fn turn(&mut self, measured_rad: f64) {
        let mut difference = wrapped(measured_rad - self.heading_rad);
        if difference.abs() > FRAC_PI_2 {
            difference = wrapped(difference + PI);
        }
        self.heading_rad = wrapped(self.heading_rad + SMOOTHING * difference);
        let (velocity, (sin, cos)) = (self.filter.velocity_mps(), self.heading_rad.sin_cos());
        if velocity.norm() > CLEAR_MOTION_MPS && velocity.dot(&Vector2::new(cos, sin)) < 0.0 {
            self.heading_rad = wrapped(self.heading_rad + PI);
        }
    }

    /// No detection in a frame whose area of view holds the object.
    pub(crate) fn miss(&mut self, config: &TrackerConfig) {
        // Bayes' rule: exists and was missed, over was missed at all.
        let missed = 1.0 - config.detection_probability;
        self.existence *= missed / (1.0 - self.existence * config.detection_probability);
    }

    pub(crate) fn is_alive(&self, config: &TrackerConfig) -> bool {
        self.existence >= config.death_existence && self.unseen_s <= config.max_unseen_s
    }

    /// Index of its detection in the list of this frame, if it was detected in a frame before, too.
    pub(crate) fn repeated_detection(&self) -> Option<usize> {
        self.detection.filter(|_| self.hits > 1)
    }

    pub(crate) fn is_reported(&self, config: &TrackerConfig) -> bool {
        self.existence >= config.report_existence
    }

    pub(crate) fn box3d(&self) -> Box3d {
        let position = self.filter.position_m();
        Box3d {
            center_m: [position.x, position.y, self.z_m],
            size_m: self.size_m,
            heading_rad: self.heading_rad,
        }
    }

    /// The track in the LiDAR frame of the ego.
    pub(crate) fn report(&self, ego_from_world: &Isometry3<f64>) -> Track {
        // The yaw alone: velocity and covariance are in the ground plane.
        let axis = ego_from_world * Vector3::x();
        let turn = Rotation2::new(axis.y.atan2(axis.x));
        let mut both = Matrix4::zeros();
        for first in [0, 2] {
            both.fixed_view_mut::<2, 2>(first, first)
                .copy_from(turn.matrix());
        }
        let covariance = both * self.filter.covariance * both.transpose();
        Track {
            id: self.id,
            box3d: self.box3d().transformed(ego_from_world),
            velocity_mps: (turn * self.filter.velocity_mps()).into(),
            covariance: covariance.transpose().map(|value| value as f32).into(),
            score: self.existence * self.score_sum / f64::from(self.hits),
            hits: self.hits,
            age_s: self.age_s,
            unseen_s: self.unseen_s,
        }
    }
    /// The same for a message of its vehicle.
    pub(crate) fn in_message(&self, cav_from_world: &Isometry3<f64>) -> ObjectTrack {
        let track = self.report(cav_from_world);
        let [x, y, u, v] = track.covariance;
        ObjectTrack {
            id: track.id,
            velocity_mps: track.velocity_mps.map(|speed| speed as f32),
            position_covariance: [x[0], x[1], y[1]],
            velocity_covariance: [u[2], u[3], v[3]],
        }
    }
}

fn smooth(old: &mut f64, new: f64) {
    *old += SMOOTHING * (new - *old);
}

/// The angle within half a turn of 0, radians.
fn wrapped(angle_rad: f64) -> f64 {
    let turned = angle_rad.rem_euclid(TAU);
    if turned > PI { turned - TAU } else { turned }
}
