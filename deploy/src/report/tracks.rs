//! Quality of the tracks of a run: `v2vloc report --tracks`.
//!
//! Needs `detections.jsonl` and `truth.jsonl`: the folder of a run, or of a method of an evaluation. Where the ego tracked,
//! its tracks are judged (`tracks.jsonl`), else those that its detections give: the tracker gets what a live one would
//! have, detections and the ego's own pose, no truth.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::io::{BufRead, BufReader, Read};
use std::path::Path;

use dataset::ground_truth::{GroundTruth, TrueBox};
use protocol::{
    Box3d, CavId, Detections, DetectionsReport, FrameReport, Track, Tracks, TracksReport,
    corners_within,
};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;
use support::bounded_file;
use support::file_error::{AtFile, FileError};
use terminal::text_table::{TextTable, number};
use tracking::metrics::{
    MATCH_DISTANCE_M, Sequence, TrackPoint, TrackQuality, TrackedFrame, TruePoint,
};
use tracking::{Tracker, TrackerConfig};

use super::comparison::{conditions, differences};
use super::read_json;
use crate::score::{ScenarioLine, TRACKS, TruthLine, metrics};

/// Longest line that is read, bytes: a result with the most boxes that a message may hold has less.
const MAX_LINE_BYTES: u64 = 16 << 20;

/// Quality of the tracks of a run.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct TrackReport {
    /// Name of the folder.
    pub run: String,
    /// Fusion method; `None` without a result.
    pub method: Option<String>,
    /// Ticks of the ground truth.
    pub ticks: usize,
    /// Ticks with detections. In the others there are no tracks.
    pub answered: usize,
    /// Answered ticks without tracks, because the ego had no pose.
    pub without_pose: usize,
    /// Results without a line in `truth.jsonl`, which are left out.
    pub without_truth: usize,
    /// Answered ticks without a line in `tracks.jsonl`, though the ego tracked: they are left out.
    pub without_tracks: usize,
    /// Detections that are left out, because a number is none or there are too many.
    pub rejected_detections: u64,
    /// True if the tracks are those of the ego, false if they are made from its detections.
    pub recorded: bool,
    /// The metrics.
    #[serde(flatten)]
    pub quality: TrackQuality,
    /// Conditions of the run, which are equal in runs that can be compared; `null` without `metrics.json`.
    #[serde(skip)]
    conditions: Value,
}

/// Scenario, ego, tick, and capture time, nanoseconds: ticks alone repeat with every lap of a loop.
type TickKey = (Option<String>, String, u64, u64);

/// Tracks of one ego in one scenario.
struct Followed {
    scenario: Option<String>,
    ego: String,
    /// Tick and capture time of the last line, nanoseconds.
    last: [u64; 2],
    tracker: Tracker,
    sequence: Sequence,
}

impl TrackReport {
    /// Tracks the detections in a folder.
    ///
    /// # Errors
    /// [`FileError`] names file and line.
    pub fn read(folder: &Path) -> Result<Self, FileError> {
        let file = folder.join("detections.jsonl");
        let (mut results, without_tick) = first_of_ticks(&file, |result: &Detections| &result.ego)?;
        let earliest = results.values().min_by_key(|line| line.capture_nanos);
        let method = earliest.map(|line| line.result.method.clone());
        let recorded = folder.join(TRACKS);
        // No tracks where the ego did not track.
        let mut tracks = match recorded.exists() {
            true => first_of_ticks(&recorded, |tracks: &Tracks| &tracks.ego)?.0,
            false => HashMap::new(),
        };
        let name = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
        let mut report = Self {
            run: name
                .file_name()
                .map_or(String::new(), |name| name.display().to_string()),
            method,
            recorded: !tracks.is_empty(),
            ..Self::default()
        };
        let (mut followed, mut judged) = (Vec::new(), HashSet::new());
        let truth = folder.join("truth.jsonl");
        for_each_line(&truth, |line: ScenarioLine<String, TruthLine>| {
            let ScenarioLine { scenario, line } = line;
            let ego = line.ego.to_string();
            let key = (scenario, ego, line.tick, line.capture_nanos);
            // A restarted replay plays its last tick once more.
            if !judged.insert(key.clone()) {
                return Ok(());
            }
            let found = (results.remove(&key), tracks.remove(&key));
            report.follow(&mut followed, key, &line, found)
        })?;
        // Results with a line of truth were taken out on the way.
        report.without_truth = without_tick + results.len();
        // Folders without metrics, or with those of an earlier version, are not compared.
        if let Ok(metrics) = read_json(folder.join(metrics::FILE)) {
            let egos: BTreeSet<&String> = followed.iter().map(|one| &one.ego).collect();
            report.conditions = conditions(&metrics, egos, report.ticks as u64);
        }
        let sequences: Vec<Sequence> = followed.into_iter().map(|one| one.sequence).collect();
        report.quality = TrackQuality::of(&sequences);
        Ok(report)
    }

    /// True if a tick is left out because a line of it is missing: the metrics are those of the other ticks.
    pub fn has_left_out_ticks(&self) -> bool {
        self.without_truth + self.without_tracks > 0
    }

    /// A line for each count that is not zero.
    fn notes(&self) -> impl Iterator<Item = String> {
        let rejected = self.rejected_detections as usize;
        [
            (self.without_pose, "ticks without a pose: no tracks"),
            (self.without_truth, "results without ground truth: left out"),
            (
                self.without_tracks,
                "ticks without recorded tracks: left out",
            ),
            (rejected, "rejected detections: left out"),
        ]
        .into_iter()
        .filter(|(count, _)| *count > 0)
        .map(|(count, what)| format!("{}: {count} {what}\n", self.run))
    }

    /// Takes a tick of the ground truth, its result, and its recorded tracks. An answered tick whose recorded tracks are
    /// missing is left out; an unanswered one has no tracks.
    fn follow(
        &mut self,
        followed: &mut Vec<Followed>,
        (scenario, ego, tick, capture_nanos): TickKey,
        line: &TruthLine,
        (result, recorded): (Option<DetectionsReport>, Option<TracksReport>),
    ) -> Result<(), String> {
        let last = followed
            .iter()
            .rposition(|one| (&one.scenario, &one.ego) == (&scenario, &ego));
        let now = [tick, capture_nanos];
        // A scene that is played once more, and a lap of a loop, begins a new sequence.
        let goes_on = |last: &usize| followed[*last].last.iter().zip(&now).all(|(a, b)| a < b);
        let index = match last.filter(goes_on) {
            Some(last) => last,
            None => {
                let config = TrackerConfig {
                    area_m: line.truth.area_m,
                    ..TrackerConfig::default()
                };
                followed.push(Followed {
                    scenario,
                    ego,
                    last: now,
                    tracker: Tracker::new(config),
                    sequence: Sequence::default(),
                });
                followed.len() - 1
            }
        };
        let one = &mut followed[index];
        one.last = now;
        self.ticks += 1;
        self.answered += usize::from(result.is_some());
        if self.recorded && result.is_some() && recorded.is_none() {
            self.without_tracks += 1;
            return Ok(());
        }
        let pose = result.as_ref().map(|of| of.result.pose.world_from_cav());
        let is_unposed = pose.is_some_and(|pose| pose.is_none_or(|pose| pose.validate().is_err()));
        self.without_pose += usize::from(is_unposed);
        let tracks = result.and_then(|of| match self.recorded {
            true => recorded.map(|line| line.result),
            false => Some(one.tracker.follow(capture_nanos, &of.result)),
        });
        let (tracks, left_out) =
            tracks.map_or_else(Default::default, |of| (of.tracks, of.left_out));
        self.rejected_detections += u64::from(left_out);
        let frame = frame(&line.truth, tracks);
        one.sequence.add(frame).map_err(|error| error.to_string())
    }
}

/// A tick with the tracks that count, as for detections: all corners in range, and not on an object that does not count.
fn frame(truth: &GroundTruth, tracks: Vec<Track>) -> TrackedFrame {
    let objects = truth.objects.iter().map(|object| TruePoint {
        id: object.id,
        center_m: center_m(&object.box3d),
    });
    let counting = tracks.into_iter().filter(|Track { box3d, .. }| {
        // On an object that does not count only if none that counts is nearer.
        let to_ignored = nearest_m(&truth.ignored, box3d);
        let is_on_ignored =
            to_ignored < MATCH_DISTANCE_M && to_ignored < nearest_m(&truth.objects, box3d);
        corners_within(&box3d.corners(), truth.area_m) && !is_on_ignored
    });
    let tracks = counting.map(|track| TrackPoint {
        id: track.id,
        center_m: center_m(&track.box3d),
        score: track.score,
    });
    TrackedFrame {
        objects: objects.collect(),
        tracks: tracks.collect(),
    }
}

/// Distance to the nearest of some true boxes.
fn nearest_m(others: &[TrueBox], box3d: &Box3d) -> f64 {
    let [x, y] = center_m(box3d);
    let centers = others.iter().map(|other| center_m(&other.box3d));
    let distances = centers.map(|[other_x, other_y]| (other_x - x).hypot(other_y - y));
    distances.fold(f64::INFINITY, f64::min)
}

fn center_m(box3d: &Box3d) -> [f64; 2] {
    let [x, y, _] = box3d.center_m;
    [x, y]
}

/// The results in a file, and the number of those whose tick is unknown. Of several results of a tick the first counts,
/// as in the scores of a run.
fn first_of_ticks<T: DeserializeOwned>(
    path: &Path,
    ego: fn(&T) -> &CavId,
) -> Result<(HashMap<TickKey, FrameReport<T>>, usize), FileError> {
    let (mut results, mut without_tick) = (HashMap::new(), 0);
    for_each_line(path, |line: ScenarioLine<String, FrameReport<T>>| {
        let ScenarioLine { scenario, line } = line;
        let ego = ego(&line.result).to_string();
        match line.tick {
            Some(tick) => {
                let key = (scenario, ego, tick, line.capture_nanos);
                results.entry(key).or_insert(line);
            }
            None => without_tick += 1,
        }
        Ok(())
    })?;
    Ok((results, without_tick))
}

/// Reads a file of JSON lines, one at a time.
fn for_each_line<T: DeserializeOwned>(
    path: &Path,
    mut take: impl FnMut(T) -> Result<(), String>,
) -> Result<(), FileError> {
    let mut reader = BufReader::new(bounded_file::open(path).at(path)?);
    let mut line = Vec::new();
    for index in 1.. {
        line.clear();
        // A longer line is cut here, and then refused as incomplete JSON.
        let mut bounded = reader.by_ref().take(MAX_LINE_BYTES);
        if bounded.read_until(b'\n', &mut line).at(path)? == 0 {
            break;
        }
        let parsed = serde_json::from_slice(&line).map_err(|error| error.to_string());
        parsed
            .and_then(&mut take)
            .map_err(|problem| FileError::new(path, format_args!("line {index}: {problem}")))?;
    }
    Ok(())
}

/// A table with a row for each run, and below it lines about what differs between the runs, and a line for each count of
/// what could not be used.
pub fn track_table(reports: &[TrackReport]) -> String {
    let numbers = [
        "answered", "AMOTA", "AMOTP, m", "MOTA", "MOTP, m", "recall", "IDS", "FRAG", "MT", "ML",
        "HOTA", "DetA", "AssA", "IDF1",
    ];
    let mut table = TextTable::of(&["run", "method"], &numbers);
    for report in reports {
        let quality = &report.quality;
        let [ids, frag] = [quality.ids, quality.frag].map(|count| Some(count?.to_string()));
        let [mt, ml] = [quality.mt, quality.ml]
            .map(|count| Some(format!("{}/{}", count?, quality.true_tracks?)));
        let [ids, frag, mt, ml] = [ids, frag, mt, ml].map(|text| text.unwrap_or("-".into()));
        table.row([
            report.run.clone(),
            report.method.clone().unwrap_or_else(|| "-".into()),
            format!("{}/{}", report.answered, report.ticks),
            number(quality.amota, 3),
            number(quality.amotp_m, 2),
            number(quality.mota, 3),
            number(quality.motp_m, 2),
            number(quality.recall, 3),
            ids,
            frag,
            mt,
            ml,
            number(quality.hota, 3),
            number(quality.det_a, 3),
            number(quality.ass_a, 3),
            number(quality.idf1, 3),
        ]);
    }
    let notes: String = reports.iter().flat_map(TrackReport::notes).collect();
    let runs = reports.iter().map(|of| (of.run.as_str(), &of.conditions));
    // Of a run that was interrupted nothing is known.
    let known = runs.filter(|(_, conditions)| !conditions.is_null());
    let differences = differences(&Vec::from_iter(known));
    format!("{table}{differences}{notes}")
}

#[cfg(test)]
mod tests {
    use dataset::evaluation_protocol::EvaluationProtocol;
    use protocol::{Detection, Pose, PoseEstimate, Stamp};

    use super::*;
    use crate::report::distinguish;
    use crate::score::metrics::Metrics;

    const EGO: &str = "12";

    fn car(x: f64, y: f64) -> Box3d {
        Box3d {
            center_m: [x, y, 0.0],
            size_m: [4.0, 2.0, 1.5],
            heading_rad: 0.0,
        }
    }

    fn true_boxes(boxes: &[(i64, Box3d)]) -> Vec<TrueBox> {
        boxes
            .iter()
            .map(|&(id, box3d)| TrueBox {
                id,
                class: dataset::frame::ObjectClass::Car,
                box3d,
            })
            .collect()
    }

    fn truth(tick: u64, objects: &[(i64, Box3d)], ignored: &[(i64, Box3d)]) -> String {
        let line = TruthLine {
            tick,
            capture_nanos: (tick + 1) * 100_000_000,
            publish_nanos: 0,
            ego: CavId::new(EGO).unwrap(),
            world_from_ego: Some(Pose::IDENTITY),
            truth: GroundTruth {
                objects: true_boxes(objects),
                ignored: true_boxes(ignored),
                area_m: [-50.0, -50.0, 50.0, 50.0],
            },
        };
        serde_json::to_string(&line).unwrap()
    }

    fn result(tick: u64, pose: PoseEstimate, boxes: &[Box3d]) -> String {
        let cav = CavId::new(EGO).unwrap();
        let stamp = Stamp {
            cav: cav.clone(),
            epoch: u64::MAX,
            sequence: tick,
            capture_nanos: (tick + 1) * 100_000_000,
            publish_nanos: 0,
        };
        let detections = boxes.iter().map(|&box3d| Detection {
            box3d,
            score: 0.9,
            source: None,
        });
        let result = Detections {
            ego: cav,
            agent_frame: tick,
            method: "pastat".into(),
            pose,
            detections: detections.collect(),
            fused: vec![],
            skipped: vec![],
            neighbours: vec![],
            stages: vec![],
        };
        DetectionsReport::new(&stamp, Some(tick), result).to_json()
    }

    fn posed(x: f64) -> PoseEstimate {
        PoseEstimate::new(Pose::from_xyz_yaw([x, 0.0, 0.0], 0.0), 1.0)
    }

    fn read(truth: &[String], detections: &[String]) -> Result<TrackReport, FileError> {
        read_all(truth, detections, &[])
    }

    fn read_all(
        truth: &[String],
        detections: &[String],
        tracks: &[String],
    ) -> Result<TrackReport, FileError> {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path().join("run");
        std::fs::create_dir(&run).unwrap();
        let files = [
            ("truth.jsonl", truth),
            ("detections.jsonl", detections),
            (TRACKS, tracks),
        ];
        for (name, lines) in files {
            let text: String = lines.iter().map(|line| format!("{line}\n")).collect();
            std::fs::write(run.join(name), text).unwrap();
        }
        TrackReport::read(&run)
    }

    /// The ego drives 1 m a tick beside a vehicle, and passes a standing one.
    fn boxes(tick: u64) -> [Box3d; 2] {
        [car(5.0, 3.5), car(30.0 - tick as f64, -4.0)]
    }

    /// The ground truth of 20 ticks of it.
    fn street() -> Vec<String> {
        (0..20)
            .map(|tick| truth(tick, &[(7, boxes(tick)[0]), (9, boxes(tick)[1])], &[]))
            .collect()
    }

    /// The numbers of the quality without the last digits, in which numbers of JSON are rounded.
    fn rounded_numbers(report: &TrackReport) -> Vec<Option<f64>> {
        let quality = serde_json::to_value(&report.quality).unwrap();
        let numbers = quality.as_object().unwrap().values();
        numbers
            .map(|number| Some((number.as_f64()? * 1e9).round()))
            .collect()
    }

    #[test]
    fn right_detections_of_a_driving_ego_give_right_tracks() {
        let truths = street();
        let results: Vec<String> = (0..20)
            .map(|tick| result(tick, posed(tick as f64), &boxes(tick)))
            .collect();
        let report = read(&truths, &results).unwrap();
        assert_eq!((report.ticks, report.answered), (20, 20));
        assert_eq!(report.method.as_deref(), Some("pastat"));
        let quality = &report.quality;
        assert_eq!((quality.amota, quality.idf1), (Some(1.0), Some(1.0)));
        assert_eq!((quality.ids, quality.mt), (Some(0), Some(2)));
        assert!(quality.hota > Some(0.99), "{quality:?}");
        let text = track_table(&[report]);
        assert!(text.contains("pastat") && text.contains("20/20"), "{text}");
        assert_eq!(text.lines().count(), 2, "nothing was left out: {text}");
    }

    #[test]
    fn recorded_tracks_are_judged_as_those_made_from_the_detections() {
        let truths = street();
        let results: Vec<String> = (0..20)
            .map(|tick| {
                result(
                    tick,
                    posed(tick as f64),
                    &boxes(tick)[usize::from(tick % 3 == 1)..],
                )
            })
            .collect();
        let made = read(&truths, &results).unwrap();
        let mut tracker = Tracker::new(TrackerConfig {
            area_m: [-50.0, -50.0, 50.0, 50.0],
            ..TrackerConfig::default()
        });
        let recorded = results.iter().map(|line| {
            let DetectionsReport {
                tick,
                epoch,
                sequence,
                capture_nanos,
                publish_nanos,
                result,
            } = serde_json::from_str(line).unwrap();
            let result = tracker.follow(capture_nanos, &result);
            TracksReport {
                tick,
                epoch,
                sequence,
                capture_nanos,
                publish_nanos,
                result,
            }
        });
        let lines: Vec<String> = recorded.map(|report| report.to_json()).collect();
        let read = read_all(&truths, &results, &lines).unwrap();
        assert!(read.recorded && !made.recorded);
        assert_eq!(rounded_numbers(&read), rounded_numbers(&made));
        // What the ego has tracked counts, whatever its detections are.
        let empty: Vec<String> = (0..20)
            .map(|tick| result(tick, posed(tick as f64), &[]))
            .collect();
        let read = read_all(&truths, &empty, &lines).unwrap();
        assert_eq!(rounded_numbers(&read), rounded_numbers(&made));
        // A file without a line is that of an ego that did not track.
        assert_eq!(read_all(&truths, &results, &[]).unwrap(), made);
        // Without lines of tracks the metrics are those of the other ticks, and the others are counted.
        let cut = read_all(&truths, &results, &lines[..10]).unwrap();
        let whole = read_all(&truths[..10], &results[..10], &lines[..10]).unwrap();
        assert_eq!(cut.quality, whole.quality);
        assert_eq!((cut.ticks, cut.answered, cut.without_tracks), (20, 20, 10));
        assert!(cut.has_left_out_ticks() && !whole.has_left_out_ticks());
        let text = track_table(&[whole, cut]);
        assert!(
            text.ends_with("\nrun: 10 ticks without recorded tracks: left out\n"),
            "{text}"
        );
        // A tick without a result has no tracks, whatever the file of tracks says.
        let cut = read_all(&truths, &results[..10], &lines).unwrap();
        let unanswered = read_all(&truths, &results[..10], &[]).unwrap();
        assert_eq!(rounded_numbers(&cut), rounded_numbers(&unanswered));
        assert!(!cut.has_left_out_ticks());
        let cut = read_all(&truths[..10], &results, &lines).unwrap();
        assert!(cut.without_truth == 10 && cut.has_left_out_ticks());
    }

    #[test]
    fn unanswered_ticks_and_ticks_without_pose_have_no_tracks() {
        let no_pose = PoseEstimate::NoPose {
            reason: protocol::NoPoseReason::TooFewInliers,
            inlier_count: 0,
        };
        let car = car(10.0, 0.0);
        let truths: Vec<String> = (0..10).map(|tick| truth(tick, &[(7, car)], &[])).collect();
        let results: Vec<String> = (0..9)
            .map(|tick| result(tick, if tick == 4 { no_pose } else { posed(0.0) }, &[car]))
            .chain([result(99, posed(0.0), &[car])])
            .collect();
        let report = read(&truths, &results).unwrap();
        let TrackReport {
            ticks,
            answered,
            without_pose,
            without_truth,
            quality,
            ..
        } = report;
        assert_eq!(
            (ticks, answered, without_pose, without_truth),
            (10, 9, 1, 1)
        );
        assert_eq!(
            (quality.recall, quality.frag, quality.ids),
            (Some(0.8), Some(1), Some(0))
        );
    }

    #[test]
    fn tracks_beyond_the_range_or_on_ignored_objects_do_not_count() {
        let (counted, ignored) = (car(10.0, 0.0), car(20.0, 0.0));
        let seen = [counted, ignored, car(48.5, 0.0), car(-20.0, 0.0)];
        let truths: Vec<String> = (0..10)
            .map(|tick| truth(tick, &[(7, counted)], &[(8, ignored)]))
            .collect();
        let results: Vec<String> = (0..10)
            .map(|tick| result(tick, posed(0.0), &seen))
            .collect();
        let report = read(&truths, &results).unwrap();
        assert_eq!(
            report.quality.fp,
            Some(10),
            "only the box without an object"
        );
    }

    #[test]
    fn runs_under_other_conditions_are_named_by_their_folders() {
        let folder = tempfile::tempdir().unwrap();
        let folders = ["a", "b"].map(|name| folder.path().join(name).join("max"));
        let mut reports = Vec::new();
        for (run, max_agents) in folders.iter().zip([4, 7]) {
            std::fs::create_dir_all(run).unwrap();
            std::fs::write(run.join("detections.jsonl"), "").unwrap();
            let line = truth(0, &[], &[]) + "\n";
            std::fs::write(run.join("truth.jsonl"), line).unwrap();
            let protocol = EvaluationProtocol {
                max_agents,
                ..EvaluationProtocol::preset("opv2v").unwrap()
            };
            let metrics = Metrics {
                protocol: Some(protocol),
                ..Metrics::default()
            };
            let text = serde_json::to_string(&metrics).unwrap();
            std::fs::write(run.join(metrics::FILE), text).unwrap();
            reports.push(TrackReport::read(run).unwrap());
        }
        let names = reports.iter_mut().map(|report| &mut report.run);
        distinguish(&mut Vec::from_iter(names), &folders);
        let text = track_table(&reports);
        let [a, b] = folders.each_ref().map(|folder| folder.display());
        let line = format!("\nRuns differ in protocol max_agents: {a} 4, {b} 7\n");
        assert!(text.contains(&line), "{text}");
        assert_eq!(text.matches("differ").count(), 1, "{text}");
    }

    /// A line of truth or of a result, of another tick and capture time.
    fn at(line: &str, tick: u64, capture_nanos: u64) -> String {
        let mut line: serde_json::Value = serde_json::from_str(line).unwrap();
        (line["tick"], line["capture_nanos"]) = (tick.into(), capture_nanos.into());
        line.to_string()
    }

    /// Report of a car that is detected at ticks with these numbers and capture times.
    fn read_at(ticks: &[(u64, u64)]) -> TrackReport {
        let car = car(10.0, 0.0);
        let lines = [truth(0, &[(7, car)], &[]), result(0, posed(0.0), &[car])];
        let [truths, results] = lines.map(|line| {
            let ticks = ticks.iter();
            ticks
                .map(|&(tick, nanos)| at(&line, tick, nanos))
                .collect::<Vec<_>>()
        });
        read(&truths, &results).unwrap()
    }

    /// Ten ticks: number and capture time.
    fn ticks(tick: fn(u64) -> (u64, u64)) -> Vec<(u64, u64)> {
        (0..10).map(tick).collect()
    }

    #[test]
    fn a_scene_that_is_played_again_begins_a_new_sequence() {
        let again = ticks(|index| (index, (index % 5 + 1) * 100_000_000));
        // A loop repeats its ticks, and its capture times go on.
        let laps = ticks(|index| (index % 5, (index + 1) * 100_000_000));
        for ticks in [again, laps] {
            let report = read_at(&ticks);
            assert_eq!((report.answered, report.without_truth), (10, 0));
            let quality = report.quality;
            assert_eq!((quality.true_tracks, quality.ids), (Some(2), Some(0)));
        }
    }

    #[test]
    fn a_tick_that_a_restarted_replay_plays_again_counts_once() {
        let once = ticks(|index| (index, (index + 1) * 100_000_000));
        let again = [&once[..5], &once[4..]].concat();
        assert_eq!(again.len(), 11);
        assert_eq!(read_at(&again), read_at(&once));
    }

    #[test]
    fn a_broken_line_is_named() {
        let line = truth(0, &[], &[]);
        let error = read(&[line.clone(), "{".into()], &[])
            .unwrap_err()
            .to_string();
        assert!(error.contains("truth.jsonl: line 2: "), "{error}");
        let twice = truth(1, &[(7, car(0.0, 0.0)), (7, car(5.0, 0.0))], &[]);
        let error = read(&[line, twice], &[]).unwrap_err().to_string();
        assert!(
            error.contains("line 2: two points of a frame have the id 7"),
            "{error}"
        );
    }
}
