//! Join of sweeps and poses of a bag by the stamps of their headers.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::Isometry3;
use protocol::Pose;

use super::contents::BagContents;
use super::pose_source::{LidarPoseSource, MAX_GAP_NANOS, PoseSources};
use super::scan::MessagePlace;
use super::sweeps::SweepTopic;
use crate::trajectory::Unposed;
use crate::{ReadError, Result};

/// Numbers of messages of two topics of clouds count as equal up to this share: a recorder begins between them.
const SAME_COUNT: f64 = 0.95;

/// The sweeps of a bag by the stamps of their headers; topics that were chosen, and those that were not.
type Joined = (BTreeMap<u64, JoinedSweep>, String);

/// Place and pose (`world_from_lidar`) of a sweep; no pose in a bag without poses.
pub(super) type JoinedSweep = (MessagePlace, Option<Pose>);

/// Sweeps of a topic, and the poses that a source gives them.
struct JoinAttempt {
    sweeps: SweepTopic,
    sources: PoseSources,
    /// Index of the source, and its pose at each sweep.
    chosen: Option<(usize, SweepPoses)>,
}

/// Pose of each sweep.
type SweepPoses = Vec<Result<Isometry3<f64>, Unposed>>;

/// Joins the sweeps of one topic and the poses of one source, both chosen by what the bag holds. Sweeps without a pose are
/// left out and counted; if no sweep has one, all are kept without.
///
/// # Errors
/// [`ReadError`] with the bag's topics if no sweep is in it.
pub(super) fn join(
    path: &Path,
    contents: &BagContents,
    problems: &mut Vec<ReadError>,
) -> Result<Joined> {
    let mut first = None;
    for sweeps in topics(path, contents) {
        let attempt = JoinAttempt::of(path, contents, sweeps);
        if attempt.chosen.is_some() {
            return Ok(attempt.finish(path, contents, problems));
        }
        first.get_or_insert(attempt);
    }
    // The first topic if none has poses.
    let attempt = first.ok_or_else(|| {
        let reason = format!(
            "no sweep in the bag: expected sensor_msgs/PointCloud2 with stamps, in the frame of a LiDAR; its topics: {}",
            contents.listing()
        );
        ReadError::malformed(path, reason)
    })?;
    Ok(attempt.finish(path, contents, problems))
}

/// Topics of sweeps, those with most messages first, of equally many those with most bytes. Clouds in the world's frame
/// are no sweeps.
fn topics(path: &Path, contents: &BagContents) -> Vec<SweepTopic> {
    let all = contents.clouds.iter();
    let mut topics: Vec<SweepTopic> = all
        .map(|(topic, clouds)| SweepTopic::new(path, topic, clouds))
        .filter(|topic| !contents.is_world(&topic.frame) && !topic.sweeps.is_empty())
        .collect();
    let counts = topics.iter().map(|topic| topic.sweeps.len());
    let most = counts.max().unwrap_or(0);
    topics.sort_by_key(|topic| {
        let count = topic.sweeps.len();
        let is_most = count as f64 >= SAME_COUNT * most as f64;
        Reverse((if is_most { most } else { count }, topic.bytes()))
    });
    topics
}

impl JoinAttempt {
    /// Chooses the source: of those that give poses to at least half as many sweeps as any other, the first by rank.
    fn of(path: &Path, contents: &BagContents, sweeps: SweepTopic) -> Self {
        let sources = PoseSources::of(path, contents, &sweeps);
        let all = sources.sources.iter().map(|source| {
            let sweeps = sweeps.sweeps.iter();
            let poses = sweeps.map(|sweep| source.at(&sources.transforms, sweep.nanos));
            poses.collect::<SweepPoses>()
        });
        let all: Vec<SweepPoses> = all.collect();
        let found = |poses: &SweepPoses| poses.iter().filter(|pose| pose.is_ok()).count();
        let counts: Vec<usize> = all.iter().map(found).collect();
        let most = counts.iter().copied().max().unwrap_or(0);
        let suited = sources.sources.iter().zip(&counts).enumerate();
        let best = suited
            .filter(|(_, (_, count))| **count > 0 && 2 * **count >= most)
            .max_by_key(|(_, (source, _))| source.rank());
        let chosen = best.and_then(|(index, _)| Some((index, all.get(index)?.clone())));
        Self {
            sweeps,
            sources,
            chosen,
        }
    }

    fn finish(self, path: &Path, contents: &BagContents, problems: &mut Vec<ReadError>) -> Joined {
        let (sweeps, sources, chosen) = (self.sweeps, self.sources, self.chosen);
        let source = chosen
            .as_ref()
            .and_then(|(index, _)| sources.sources.get(*index));
        let text = text(contents, &sweeps, &sources, source);
        problems.extend(sweeps.problems);
        problems.extend(sources.problems);
        let poses: Vec<Option<Pose>> = match (&chosen, source) {
            (Some((_, poses)), Some(source)) => {
                let reasons = without_pose(poses, source, &sweeps.topic);
                problems.extend(reasons.map(|reason| ReadError::malformed(path, reason)));
                poses.iter().map(|pose| pose.ok().map(Pose::from)).collect()
            }
            _ => {
                let reason = format!("{text}: the sequence is read without poses");
                problems.push(ReadError::malformed(path, reason));
                vec![None; sweeps.sweeps.len()]
            }
        };
        let joined = sweeps.sweeps.iter().zip(poses);
        let joined = joined.filter(|(_, pose)| pose.is_some() || chosen.is_none());
        let joined = joined.map(|(sweep, pose)| (sweep.nanos, (sweep.place, pose)));
        (joined.collect(), text)
    }
}

/// Numbers of sweeps that are joined and left out.
fn text(
    contents: &BagContents,
    sweeps: &SweepTopic,
    sources: &PoseSources,
    chosen: Option<&LidarPoseSource>,
) -> String {
    let of_sweeps = format!("{} ({})", sweeps.topic, sweeps.frame);
    let others = sources
        .sources
        .iter()
        .filter(|source| chosen.is_none_or(|chosen| chosen.name != source.name))
        .map(|source| {
            let span = span_text(source.span);
            format!("{}, {} poses {span}", source.name, source.poses)
        });
    let unused = others.chain(sources.unusable.iter().cloned());
    let clouds = (contents.clouds.iter())
        .filter(|(topic, _)| **topic != sweeps.topic)
        .map(|(topic, clouds)| format!("{topic}, {} clouds", clouds.len()));
    let clouds = clouds.filter(|_| chosen.is_some());
    let unused: Vec<String> = unused.chain(clouds).collect();
    let unused = unused.join("; ");
    match chosen {
        Some(chosen) => {
            let unused = match unused.is_empty() {
                true => String::new(),
                false => format!("; not used: {unused}"),
            };
            format!(
                "sweeps of {of_sweeps} and poses of {} by the stamps of their headers, interpolated over at most {} \
                 s{unused}",
                chosen.name,
                seconds(MAX_GAP_NANOS)
            )
        }
        None if unused.is_empty() => format!(
            "no poses in the bag: expected nav_msgs/Odometry, geometry_msgs/PoseStamped or PoseWithCovarianceStamped, or \
             tf2_msgs/TFMessage; its topics: {}",
            contents.listing()
        ),
        None => {
            let (first, last) = (sweeps.sweeps.first(), sweeps.sweeps.last());
            let of_stamps = first
                .zip(last)
                .map(|(first, last)| (first.nanos, last.nanos));
            format!(
                "no pose for any of {} sweeps of {of_sweeps} {}: {unused}",
                sweeps.sweeps.len(),
                span_text(of_stamps)
            )
        }
    }
}

fn span_text(span: Option<(u64, u64)>) -> String {
    match span {
        Some((first, last)) => format!("from {:.3} s to {:.3} s", seconds(first), seconds(last)),
        None => "none".to_owned(),
    }
}

/// Sweeps that the chosen source gives no pose, by reason.
fn without_pose<'a>(
    poses: &'a SweepPoses,
    source: &'a LidarPoseSource,
    topic: &'a str,
) -> impl Iterator<Item = String> + 'a {
    [Unposed::Outside, Unposed::Gap]
        .into_iter()
        .filter_map(move |reason| {
            let count = poses.iter().filter(|pose| **pose == Err(reason)).count();
            let place = match (reason, source.span) {
                (Unposed::Outside, Some((first, last))) => format!(
                    "are not within the poses of {}, {:.3} s to {:.3} s",
                    source.name,
                    seconds(first),
                    seconds(last)
                ),
                (Unposed::Outside, None) => format!("are not within the poses of {}", source.name),
                (Unposed::Gap, _) => format!(
                    "are in gaps of more than {} s between the poses of {}",
                    seconds(MAX_GAP_NANOS),
                    source.name
                ),
            };
            let all = poses.len();
            (count > 0).then(|| format!("{topic}: {count} of {all} sweeps {place}: left out"))
        })
}

fn seconds(nanos: u64) -> f64 {
    nanos as f64 * 1e-9
}
