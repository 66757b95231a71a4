//! Tracker: the tracks of a vehicle from frame to frame.

use nalgebra::{Isometry3, Point3};
use protocol::{
    Detection, Detections, PerceivedObject, PlanarCovariance, Pose, PoseEstimate, Track, Tracks,
};

use crate::assignment;
use crate::kalman::Innovation;
use crate::measurement::Measurement;
use crate::track::TrackState;

/// Settings of a tracker.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackerConfig {
    /// Area of view: x, y of the lower, then of the upper corner in the ego's LiDAR frame, metres. Outside it a missing
    /// detection is no evidence against an object.
    pub area_m: [f64; 4],
    /// Standard deviation of a detected centre of score 1 in each direction, metres.
    pub sigma_certain_m: f64,
    /// The same for score 0; scores between are interpolated.
    pub sigma_uncertain_m: f64,
    /// Standard deviation of the acceleration of objects in each direction, metres per square second.
    pub acceleration_mps2: f64,
    /// Standard deviation of the velocity of a new object in each direction, metres per second.
    pub initial_sigma_mps: f64,
    /// Largest squared Mahalanobis distance of a detection from its track.
    pub gate: f64,
    /// Probability that an object in the area of view is detected in a frame.
    pub detection_probability: f64,
    /// New objects and false alarms per frame, per square metre.
    pub density_per_m2: f64,
    /// Lowest score of a detection that begins a track.
    pub birth_score: f64,
    /// Lowest probability of existence of a track that is reported.
    pub report_existence: f64,
    /// Probability of existence below which a track ends.
    pub death_existence: f64,
    /// Longest time without a detection, seconds.
    pub max_unseen_s: f64,
    /// Largest number of detections of a frame: those of the highest scores, in the order of the list where these are
    /// equal.
    pub max_detections: usize,
    /// Largest number of tracks: detections beyond it, those of the lowest scores, begin none.
    pub max_tracks: usize,
}

impl Default for TrackerConfig {
    fn default() -> Self {
        Self {
            area_m: [f64::MIN, f64::MIN, f64::MAX, f64::MAX],
            sigma_certain_m: 0.2,
            sigma_uncertain_m: 0.8,
            acceleration_mps2: 4.0,
            initial_sigma_mps: 10.0,
            // 99.9 % of the chi-square distribution with two degrees of freedom.
            gate: 13.816,
            detection_probability: 0.7,
            density_per_m2: 1e-3,
            birth_score: 0.1,
            report_existence: 0.3,
            death_existence: 0.05,
            max_unseen_s: 1.0,
            max_detections: 200,
            max_tracks: 400,
        }
    }
}

/// Tracks of one vehicle.
#[derive(Debug, Clone, Default)]
pub struct Tracker {
    config: TrackerConfig,
    tracks: Vec<TrackState>,
    begun: u64,
    last_nanos: Option<u64>,
    /// Detections so far that were left out: a number is not finite, a size negative, the score not within 0..=1, or
    /// there were more than [`TrackerConfig`] allows.
    left_out: u64,
}

impl Tracker {
    /// A tracker without tracks.
    pub fn new(config: TrackerConfig) -> Self {
        Self {
            config,
            ..Self::default()
        }
    }

    /// Takes the result of an ego and returns its tracks, none without a usable pose. A frame that is repeated, as a
    /// replay that is started again does, changes nothing; where time goes back the scene begins again: all tracks end.
    pub fn follow(&mut self, capture_nanos: u64, result: &Detections) -> Tracks {
        let before = self.left_out;
        let taken = match self.last_nanos == Some(capture_nanos) {
            true => usable(&result.pose).map(|pose| pose.isometry().inverse()),
            false => self.take_or_begin_again(capture_nanos, &result.pose, &result.detections),
        };
        let tracks = taken.map(|ego_from_world| self.reported(&ego_from_world));
        Tracks {
            ego: result.ego.clone(),
            agent_frame: result.agent_frame,
            pose: result.pose,
            tracks: tracks.unwrap_or_default(),
            left_out: u32::try_from(self.left_out - before).unwrap_or(u32::MAX),
        }
    }

    /// Takes a vehicle's detections in its own LiDAR frame in the same way and returns them with the track of each object
    /// that was detected before, as neighbours need them.
    pub fn objects(
        &mut self,
        capture_nanos: u64,
        pose: &PoseEstimate,
        detections: Vec<Detection>,
    ) -> Vec<PerceivedObject> {
        let taken = self.take_or_begin_again(capture_nanos, pose, &detections);
        let mut objects: Vec<PerceivedObject> = detections.into_iter().map(Into::into).collect();
        if let Some(cav_from_world) = taken {
            for track in &self.tracks {
                if let Some(index) = track.repeated_detection() {
                    objects[index].track = Some(track.in_message(&cav_from_world));
                }
            }
        }
        objects
    }

    /// Takes a frame and returns the tracks at its capture time in the ego's LiDAR frame, ordered by id.
    ///
    /// `world_from_ego` is the pose of the ego's LiDAR, `covariance` that of this pose in the plane of the world (`None`:
    /// taken as 0), and `detections` are in the ego's LiDAR frame. `None` when time does not advance, or the pose is none:
    /// nothing has changed then.
    pub fn update(
        &mut self,
        capture_nanos: u64,
        world_from_ego: &Pose,
        covariance: Option<&PlanarCovariance>,
        detections: &[Detection],
    ) -> Option<Vec<Track>> {
        let ego_from_world = self.take(capture_nanos, world_from_ego, covariance, detections)?;
        Some(self.reported(&ego_from_world))
    }

    /// Takes a frame; where time does not advance all tracks end first. `None` without a usable pose.
    fn take_or_begin_again(
        &mut self,
        capture_nanos: u64,
        pose: &PoseEstimate,
        detections: &[Detection],
    ) -> Option<Isometry3<f64>> {
        if self.last_nanos.is_some_and(|last| capture_nanos <= last) {
            (self.tracks, self.last_nanos) = (Vec::new(), None);
        }
        let world_from_cav = pose.world_from_cav()?;
        self.take(capture_nanos, world_from_cav, pose.covariance(), detections)
    }

    /// Takes a frame and returns `ego_from_world`; `None` as of [`Self::update`].
    fn take(
        &mut self,
        capture_nanos: u64,
        world_from_ego: &Pose,
        covariance: Option<&PlanarCovariance>,
        detections: &[Detection],
    ) -> Option<Isometry3<f64>> {
        // Before time advances: a frame that is not taken changes nothing.
        world_from_ego.validate().ok()?;
        let elapsed_s = self.advance(capture_nanos)?;
        let world_from_ego = world_from_ego.isometry();
        let measure =
            |detection| Measurement::new(detection, &world_from_ego, covariance, &self.config);
        let mut measurements: Vec<_> = detections.iter().enumerate().filter_map(measure).collect();
        keep_best(&mut measurements, self.config.max_detections);
        self.left_out += (detections.len() - measurements.len()) as u64;
        for track in &mut self.tracks {
            track.predict(elapsed_s, &self.config);
        }
        let owners = self.assign(&measurements);
        let ego_from_world = world_from_ego.inverse();
        self.count_misses(&owners, &ego_from_world);
        // After `count_misses`: owners are indices into the list of tracks.
        self.tracks.retain(|track| track.is_alive(&self.config));
        self.begin(&measurements, &owners);
        Some(ego_from_world)
    }

    fn reported(&self, ego_from_world: &Isometry3<f64>) -> Vec<Track> {
        let tracks = self.tracks.iter();
        let reported = tracks.filter(|track| track.is_reported(&self.config));
        reported.map(|track| track.report(ego_from_world)).collect()
    }

    /// Time since the frame before, seconds; 0 for the first, `None` where it does not advance.
    fn advance(&mut self, given_nanos: u64) -> Option<f64> {
        if self.last_nanos.is_some_and(|last| given_nanos <= last) {
            return None;
        }
        let last_nanos = self.last_nanos.replace(given_nanos).unwrap_or(given_nanos);
        Some((given_nanos - last_nanos) as f64 / 1e9)
    }

    /// Gives detections to tracks; returns the index of the track of each detection.
    ///
    /// The set of pairs has the highest likelihood (Blackman and Popoli 1999, Section 6.4): a pair costs its squared
    /// distance and the logarithm of its covariance, a track without detection and a detection without track what these
    /// are worth together.
    fn assign(&mut self, measurements: &[Measurement]) -> Vec<Option<usize>> {
        let innovations = self.tracks.iter().map(|track| {
            let all = measurements.iter();
            all.map(|measured| track.innovation(measured)).collect()
        });
        let innovations: Vec<Vec<Option<Innovation>>> = innovations.collect();
        let found = self.config.detection_probability;
        // Below this cost a pair is likelier than a miss and a new object or false alarm together.
        let unpaired = 2.0
            * (found / (1.0 - found) / (std::f64::consts::TAU * self.config.density_per_m2)).ln();
        // A column for each track that stays without a detection.
        let columns = measurements.len() + self.tracks.len();
        let pairs = assignment::of_allowed(self.tracks.len(), columns, |track, column| {
            if column >= measurements.len() {
                return Some(unpaired);
            }
            let innovation = innovations[track][column].as_ref()?;
            let distance = innovation.mahalanobis_squared();
            (distance <= self.config.gate).then_some(distance + innovation.log_determinant)
        });
        let mut owners = vec![None; measurements.len()];
        for (track, column) in pairs {
            if let Some(Some(innovation)) = innovations[track].get(column) {
                self.tracks[track].hit(innovation, &measurements[column]);
                owners[column] = Some(track);
            }
        }
        owners
    }

    fn count_misses(&mut self, owners: &[Option<usize>], ego_from_world: &Isometry3<f64>) {
        let [x_low, y_low, x_high, y_high] = self.config.area_m;
        for (index, track) in self.tracks.iter_mut().enumerate() {
            let center = ego_from_world * Point3::from(track.box3d().center_m);
            let is_in_view =
                (x_low..=x_high).contains(&center.x) && (y_low..=y_high).contains(&center.y);
            if is_in_view && !owners.contains(&Some(index)) {
                track.miss(&self.config);
            }
        }
    }

    fn begin(&mut self, measurements: &[Measurement], owners: &[Option<usize>]) {
        let owned = measurements.iter().zip(owners);
        let free = owned.filter(|(_, owner)| owner.is_none());
        let mut new: Vec<Measurement> = free.map(|(measured, _)| *measured).collect();
        new.retain(|measured| measured.score >= self.config.birth_score);
        let found = new.len();
        let room = self.config.max_tracks.saturating_sub(self.tracks.len());
        keep_best(&mut new, room);
        self.left_out += (found - new.len()) as u64;
        for measured in &new {
            self.begun += 1;
            let track = TrackState::new(self.begun, measured, &self.config);
            self.tracks.push(track);
        }
    }
}

/// The pose of a vehicle, if it is one.
fn usable(pose: &PoseEstimate) -> Option<&Pose> {
    let pose = pose.world_from_cav()?;
    pose.validate().is_ok().then_some(pose)
}

/// Keeps as many measurements, those of the highest scores.
fn keep_best(measurements: &mut Vec<Measurement>, most: usize) {
    if measurements.len() > most {
        measurements.sort_by(|a, b| b.score.total_cmp(&a.score));
        measurements.truncate(most);
    }
}

#[cfg(test)]
mod tests;
