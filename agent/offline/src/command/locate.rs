//! `agent locate`: poses of single point clouds in the map of a scene head.

use std::path::{Path, PathBuf};

use dataset::IntensityScale;
use dataset::cloud_files::{CloudFile, clouds_at};
use dataset::findings::{self, SweepFindings};
use localization::pgc::head_files::{encoder_or_named, head_file};
use localization::pgc::pose_solver::FoundPose;
use localization::pgc::wrong_place::{
    lowest_m, other_lidar_hint, sweep_points, vehicle_frame_hint,
};
use localization::pgc::{Localization, Localize, LocalizerInput};
use localization::place_localizer::place_localizer;
use localization::pose_covariance::{pose_covariance, position_bound_m};
use perception::inference::Inference;
use perception::int8::InferencePrecision;
use protocol::PoseEstimate;
use protocol::config::within;
use serde::Serialize;
use support::cli::{BadInput, Outcome};
use support::output;
use tch::Device;

use super::scene_heads::surfel_map;

/// Find the pose of single point clouds: no other sensor, no earlier pose.
///
/// A cloud is one sweep in the frame of the LiDAR: metres, x forward, y left, z up, the LiDAR at the origin at its usual
/// height above the road, a metre or more. Intensities are not used. Points that are not finite, or exactly at the origin,
/// are left out. Readable are PCD, PLY, NumPy arrays (.npy, N x 3 or more), .bin of 32-bit floats (4 or 5 per point), and
/// the sweeps of data sets; of a folder all of these.
///
/// Positions are x, y, z of the LiDAR in the frame of the map, right-handed, metres: the frame of the poses that the head
/// was trained on, and where those were left-handed (OPV2V, CARLA), that frame with y negated. Angles are rotations about
/// x (roll), y (pitch) and z (yaw), in this order, degrees; yaw is counter-clockwise from x, seen from above.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Exit codes: 0 all found, 1 failed, 2 bad usage or a cloud that cannot be read, 3 a cloud without a \
                        pose."
)]
pub(crate) struct Args {
    /// Point clouds, or folders of them.
    #[arg(required = true, value_name = "CLOUD")]
    clouds: Vec<PathBuf>,
    /// Weights of the head of the place: a file, the folder that `agent map` wrote, or a released one (town1, town4); or a
    /// surfel map in its place, for localization without networks.
    #[arg(long, value_name = "FILE|NAME")]
    head: PathBuf,
    /// Weights of the encoder, or of a detector that has it [default: those that the head names, beside it or released].
    #[arg(long, value_name = "FILE")]
    encoder: Option<PathBuf>,
    /// Surfel map of the place, to which poses are registered, to the millimetre: a file, the folder that `agent map`
    /// wrote, or a released one (town1) [default: none].
    #[arg(long, value_name = "FILE|NAME")]
    surfel_map: Option<PathBuf>,
    /// Least confidence of a pose, 0 to 1: others are rejected, beside those that the head rejects.
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    min_confidence: f64,
    /// Direction of the y axis in files that belong to no data set: left, right (CARLA, OPV2V), or whichever gives a pose,
    /// left first.
    #[arg(long, value_enum, default_value_t = CloudYAxis::Auto)]
    y_axis: CloudYAxis,
    /// Number format in which networks are computed.
    #[arg(long, value_enum, default_value_t)]
    precision: InferencePrecision,
    /// Threads to compute with.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: u16,
    /// Print a JSON object per cloud, one a line.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum CloudYAxis {
    Auto,
    Left,
    Right,
}

/// Result of one cloud.
#[derive(Debug, Default, Serialize)]
struct Located {
    /// Path of the file.
    cloud: String,
    /// Name of the head's place.
    map: String,
    /// Pose of the LiDAR in the map.
    pose: Option<LocatedPose>,
    /// Reason for the missing pose.
    no_pose: Option<String>,
    /// The fault of a file that cannot be read.
    error: Option<String>,
    /// Number of cells that agree with the pose.
    inliers: u32,
    /// These as a share of all cells, 0..=1.
    inlier_ratio: f64,
    /// Number of points in the cloud.
    points: usize,
    /// Number of points left out: not finite, or exactly at the origin.
    points_left_out: usize,
    /// Height that 5 % of the points are below, metres.
    #[serde(skip)]
    lowest_m: Option<f32>,
    /// True if y of the file was negated.
    is_mirrored: bool,
}

/// A pose in the map frame, right-handed.
#[derive(Debug, Serialize)]
struct LocatedPose {
    /// x, y, z of the LiDAR, metres.
    position_m: [f64; 3],
    /// Roll, pitch, yaw, degrees.
    roll_pitch_yaw_deg: [f64; 3],
    /// The same rotation as a quaternion x, y, z, w.
    quaternion_xyzw: [f64; 4],
    /// Covariance of x, y, z (metres) and rotations about x, y, z (radians), row by row.
    covariance: [[f64; 6]; 6],
    /// Distance in the plane that one of 1,000 poses exceeds, metres; null where it was not fitted.
    bound_m: Option<f64>,
    /// Confidence, 0..=1.
    confidence: f64,
    /// True if it was registered to a surfel map: then it is accurate to millimetres, unless its confidence is low.
    registered: bool,
}

/// Localizes every cloud and prints a line for each.
pub(crate) fn run(args: &Args) -> anyhow::Result<Outcome> {
    tch::set_num_threads(i32::from(args.threads));
    let head = head_file(&args.head).map_err(BadInput::of)?;
    let encoder = encoder_or_named(args.encoder.as_deref(), &head).map_err(BadInput::of)?;
    let inference = Inference::new(Device::Cpu, args.precision);
    within("--min-confidence", args.min_confidence, 0.0, 1.0).map_err(BadInput::of)?;
    let files = [&encoder, &head, &surfel_map(args.surfel_map.as_deref())?];
    let files = files.map(PathBuf::as_path);
    let localizer = place_localizer(files, args.min_confidence, inference, |_| ());
    let mut localizer = localizer.map_err(BadInput::of)?;
    let place = localizer.place().unwrap_or_default().to_owned();
    let (mut found, mut lost, mut bad, mut remembered) = (0, 0, 0, 0);
    let (mut points, mut sweeps, mut lowest) = (Vec::new(), Vec::new(), Vec::new());
    for file in clouds_at(&args.clouds) {
        let located = args.locate(&mut *localizer, &place, file, &mut sweeps)?;
        match (&located.error, &located.pose) {
            (Some(_), _) => bad += 1,
            (None, Some(pose)) => {
                found += 1;
                remembered += usize::from(!pose.registered);
            }
            (None, None) => {
                lost += 1;
                lowest.extend(located.lowest_m);
            }
        }
        if located.error.is_none() {
            points.push(located.points);
        }
        match args.json {
            true => output::line(serde_json::to_string(&located)?)?,
            // Faults go to standard error, so that standard output has results alone.
            false if located.error.is_some() => output::note(located.text()),
            false => output::line(located.text())?,
        }
    }
    if found + lost + bad > 1 {
        output::note(format_args!(
            "{found} clouds found, {lost} without a pose, {bad} cannot be read"
        ));
    }
    if remembered > 0 {
        let hint = match args.surfel_map {
            None => "--surfel-map measures them",
            Some(_) => "the surfel map does not confirm these poses",
        };
        output::note(format_args!(
            "height, roll and pitch of {remembered} poses are those of the head's drives, not measured: {hint}"
        ));
    }
    if found == 0 && lost > 0 {
        output::note(lost_text(&head, &place));
    }
    if let Some(area) = localizer.driven_area().filter(|_| lost > 0) {
        let area = area.text();
        output::note(format_args!(
            "few poses are found where the head was trained on few sweeps: its training drives cover {area}"
        ));
    }
    let folder = args.clouds.first().map_or(Path::new(""), PathBuf::as_path);
    let sweeps: Vec<&SweepFindings> = sweeps.iter().collect();
    findings::note(&findings::of_clouds(folder, &sweeps, IntensityScale::AUTO));
    let other_lidar = other_lidar_hint(sweep_points(&head), &points);
    for hint in other_lidar.into_iter().chain(vehicle_frame_hint(&lowest)) {
        output::note(hint);
    }
    Ok(match bad > 0 {
        true => Outcome::BadInput,
        false => Outcome::of(lost > 0),
    })
}

impl Args {
    fn locate(
        &self,
        localizer: &mut dyn Localize,
        map: &str,
        file: Result<CloudFile, dataset::ReadError>,
        sweeps: &mut Vec<SweepFindings>,
    ) -> anyhow::Result<Located> {
        let map = map.to_owned();
        let (cloud, read) = match file {
            Ok(file) => (file.path.display().to_string(), file.read()),
            Err(error) => {
                let path = error.path().map(|path| path.display().to_string());
                (path.unwrap_or_default(), Err(error))
            }
        };
        let read = match read {
            Ok(read) => read,
            Err(error) => {
                return Ok(Located {
                    cloud,
                    map,
                    error: Some(error.to_string()),
                    ..Located::default()
                });
            }
        };
        let mut points = read.points;
        let count = points.len();
        sweeps.push(read.findings);
        // The reader of a data set has removed its handedness already.
        let y_axis = match read.is_of_data_set {
            true => CloudYAxis::Left,
            false => self.y_axis,
        };
        if y_axis == CloudYAxis::Right {
            points.mirror();
        }
        let mut localization = localizer.localize(LocalizerInput::of(&points))?;
        let mut is_mirrored = y_axis == CloudYAxis::Right;
        // A mirrored cloud looks like another place, so a pose tells which direction y has.
        if y_axis == CloudYAxis::Auto && published(&localization).is_none() {
            points.mirror();
            let other = localizer.localize(LocalizerInput::of(&points))?;
            if published(&other).is_some() {
                (localization, is_mirrored) = (other, true);
            }
        }
        Ok(Located {
            cloud,
            map,
            pose: published(&localization).map(LocatedPose::of),
            no_pose: match &localization.estimate {
                PoseEstimate::Pose { .. } => None,
                PoseEstimate::NoPose { reason, .. } => Some(<&str>::from(reason).replace('_', " ")),
            },
            error: None,
            inliers: localization.inlier_count,
            inlier_ratio: localization.inlier_ratio,
            points: count,
            points_left_out: read.left_out,
            lowest_m: lowest_m(&points),
            is_mirrored,
        })
    }
}

/// The question that remains where no cloud found itself; a surfel map may have no name.
fn lost_text(head: &Path, place: &str) -> String {
    let head = head.display();
    let map = match place {
        "" => String::new(),
        _ => format!(" Its map is {place}"),
    };
    format!(
        "no cloud found itself: is {head} the head of this place and this LiDAR, and were these roads driven for it?{map}"
    )
}

/// The pose, unless it is rejected.
fn published(localization: &Localization) -> Option<FoundPose> {
    localization.found.filter(|found| !found.is_rejected)
}

impl LocatedPose {
    fn of(found: FoundPose) -> Self {
        let pose = found.world_from_sensor;
        let (roll, pitch, yaw) = pose.rotation.euler_angles();
        Self {
            position_m: pose.translation.vector.into(),
            roll_pitch_yaw_deg: [roll, pitch, yaw].map(f64::to_degrees),
            quaternion_xyzw: pose.rotation.coords.into(),
            covariance: pose_covariance(&found),
            bound_m: position_bound_m(&found),
            confidence: found.sigma,
            registered: found.is_registered,
        }
    }
}

impl Located {
    /// One line for a person.
    fn text(&self) -> String {
        let (cloud, inliers, points) = (&self.cloud, self.inliers, self.points);
        if let Some(error) = &self.error {
            return format!("error: {error}");
        }
        let mirrored = match self.is_mirrored {
            true => ", y of the file negated",
            false => "",
        };
        let Some(pose) = &self.pose else {
            let reason = self.no_pose.as_deref().unwrap_or("failed");
            return format!("{cloud}: no pose, {reason} ({inliers} inliers, {points} points)");
        };
        let ([x, y, z], [roll, pitch, yaw]) = (pose.position_m, pose.roll_pitch_yaw_deg);
        // Root mean square of the standard deviations along x and y.
        let std_m = f64::midpoint(pose.covariance[0][0], pose.covariance[1][1]).sqrt();
        let confidence = pose.confidence;
        format!(
            "{cloud}: x {x:.2} y {y:.2} z {z:.2} m (std {std_m:.2}), roll {roll:.2} pitch {pitch:.2} yaw {yaw:.2} degrees, \
             confidence {confidence:.3}, {inliers} inliers{mirrored}"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn located(pose: Option<LocatedPose>, error: Option<&str>) -> Located {
        Located {
            cloud: "a.pcd".into(),
            map: "town".into(),
            no_pose: pose.is_none().then(|| "too few inliers".to_owned()),
            pose,
            error: error.map(str::to_owned),
            inliers: 12,
            inlier_ratio: 0.1,
            points: 900,
            points_left_out: 0,
            lowest_m: None,
            is_mirrored: false,
        }
    }

    #[test]
    fn a_map_without_a_name_is_not_named() {
        let text = |place| lost_text(Path::new("surfels.safetensors"), place);
        assert!(text("").ends_with("driven for it?"), "{}", text(""));
        assert!(text("town").ends_with("for it? Its map is town"));
    }

    #[test]
    fn a_line_states_the_pose_the_reason_or_the_fault() {
        let mut covariance = [[0.0; 6]; 6];
        (covariance[0][0], covariance[1][1]) = (0.0025, 0.0025);
        let pose = LocatedPose {
            position_m: [1.0, -2.0, 0.5],
            roll_pitch_yaw_deg: [0.0, 0.1, 90.0],
            quaternion_xyzw: [0.0, 0.0, 0.7, 0.7],
            covariance,
            bound_m: None,
            confidence: 0.9876,
            registered: false,
        };
        assert_eq!(
            located(Some(pose), None).text(),
            "a.pcd: x 1.00 y -2.00 z 0.50 m (std 0.05), roll 0.00 pitch 0.10 yaw 90.00 degrees, confidence 0.988, 12 inliers"
        );
        assert_eq!(
            located(None, None).text(),
            "a.pcd: no pose, too few inliers (12 inliers, 900 points)"
        );
        assert_eq!(
            located(None, Some("a.pcd: cut off")).text(),
            "error: a.pcd: cut off"
        );
    }
}
