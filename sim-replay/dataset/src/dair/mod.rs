//! DAIR-V2X-C and V2X-Seq (SPD): one vehicle and one roadside unit,
//! `{vehicle-side,infrastructure-side}/velodyne/<id>.pcd` with JSON files for calibration and labels, and
//! `cooperative/data_info.json`, which pairs the frames.
//!
//! Frames of the two sides have different ids. A tick is a pair of `cooperative/data_info.json` and is named by the id
//! of the vehicle; frames without partner are left out, as the data sets' own protocols do. The vehicle is the ego. The
//! two sweeps of a pair are up to some 50 ms apart; both are given the time of the vehicle's. Pairs more than 0.2 s apart
//! are left out.
//!
//! The cooperative labels are the ground truth of a pair ([`Frame::cooperative_objects`]). Labels of the two sides
//! ([`Frame::objects`]) are independent of each other: see [`labels::share_ids`].

mod calibration;
mod index;
mod labels;
#[cfg(test)]
mod tests;

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use nalgebra::Isometry3;
use protocol::{CavId, Handedness};

use self::index::{FramePair, Index, Kind};
use self::labels::{LabelList, LabelledObjects};
use super::layout::{LayoutReader, LayoutRow, opened};
use super::points::{SweepStorage, Sweeps};
use super::{
    Dataset, FrameSource, Layout, MissingFrame, OpenOptions, Problem, ReadError, Result, Scenario,
    Tick, files, roots,
};
use crate::frame::{Frame, Object};
use crate::pcd::PcdCloud;

/// DAIR-V2X-C: one vehicle and one roadside unit, JSON per frame.
pub(crate) static DAIR: LayoutRow = LayoutRow {
    key: "dair",
    name: "DAIR-V2X",
    data_sets: "DAIR-V2X-C",
    files: "cooperative/data_info.json with vehicle_pointcloud_path, vehicle-side/, infrastructure-side/",
    protocol: "dair",
    reader: Some(LayoutReader::DataSet(open)),
};

/// V2X-Seq (SPD): DAIR-V2X as sequences with track ids.
pub(crate) static V2XSEQ: LayoutRow = LayoutRow {
    key: "v2x_seq",
    name: "V2X-Seq",
    data_sets: "V2X-Seq-SPD",
    files: "cooperative/data_info.json with vehicle_frame, vehicle-side/, infrastructure-side/",
    protocol: "v2xseq",
    reader: None,
};

const VEHICLE_SIDE: &str = "vehicle-side";
const INFRASTRUCTURE_SIDE: &str = "infrastructure-side";
/// Names of the two agents.
const VEHICLE: &str = "vehicle";
const INFRASTRUCTURE: &str = "infrastructure";

/// Opens the data sets at or below `dir`; `None` where there are none.
pub(super) fn open(dir: &Path, options: &OpenOptions) -> Result<Option<Dataset>> {
    let root = files::above(dir).find(|above| is_root(above));
    let parts = [VEHICLE_SIDE, INFRASTRUCTURE_SIDE, "cooperative"];
    if let Some(root) = root.filter(|_| parts.iter().any(|part| dir.ends_with(part))) {
        let root = root.display();
        let reason = format!("this is a part of a DAIR-V2X data set: open {root}");
        return Err(ReadError::malformed(dir, reason));
    }
    let (mut scenarios, mut problems) = (Vec::new(), Vec::new());
    for root in &files::each_once(roots::find(dir, is_root), &mut problems) {
        match open_root(dir, root, options, &mut problems) {
            Ok(found) => scenarios.extend(found),
            Err(error) => problems.push(error),
        }
    }
    opened(dir, scenarios, problems)
}

fn is_root(dir: &Path) -> bool {
    let mut sides = [VEHICLE_SIDE, INFRASTRUCTURE_SIDE].iter();
    dir.join(index::COOPERATIVE).is_file() && sides.all(|side| dir.join(side).is_dir())
}

/// One scenario per batch or sequence.
fn open_root(
    opened: &Path,
    root: &Path,
    options: &OpenOptions,
    problems: &mut Vec<ReadError>,
) -> Result<Vec<Scenario>> {
    let Index { kind, groups } = Index::read(root, options.period_nanos, problems)?;
    let scenarios = groups.into_iter().map(|(group, pairs)| {
        let name = match root == opened {
            true => group,
            false => format!("{}/{group}", files::name_below(opened, root)),
        };
        let root = root.to_owned();
        scenario(name, Sides { root, kind }, pairs, options, problems)
    });
    Ok(scenarios.collect())
}

/// A side is absent at a tick if a file is missing without which it has no frame; labels may be missing.
fn scenario(
    name: String,
    sides: Sides,
    pairs: Vec<(Tick, FramePair)>,
    options: &OpenOptions,
    problems: &mut Vec<ReadError>,
) -> Scenario {
    let agents =
        [VEHICLE, INFRASTRUCTURE].map(|name| CavId::new(name).expect("a word is an identifier"));
    let (mut moments, mut missing, mut kept) = (Vec::<Tick>::new(), Vec::new(), HashMap::new());
    for (tick, pair) in pairs {
        let last = moments.last().map(|last| last.capture_nanos);
        if last == Some(tick.capture_nanos) {
            let stem = tick.stem;
            let reason =
                format!("vehicle frame {stem} has the time stamp of the one before: left out");
            let path = sides.root.join(index::COOPERATIVE);
            problems.push(ReadError::malformed(&path, reason));
            continue;
        }
        for agent in &agents {
            if let Some(path) = sides.missing_file(&pair, PairSide::of(agent)) {
                let reason = format!("does not exist: {agent} is absent at {}", tick.stem);
                problems.push(ReadError::malformed(&path, reason));
                missing.push(MissingFrame::new(agent, &tick.stem));
            }
        }
        kept.insert(tick.stem.clone(), pair);
        moments.push(tick);
    }
    let mut sweeps = Sweeps::new(SweepStorage::ByName, options);
    for agent in &agents {
        let files = (moments.iter())
            .filter_map(|tick| Some(sides.points(kept.get(&tick.stem)?, PairSide::of(agent))));
        sweeps = sweeps.with_agent(agent.clone(), files);
    }
    let layout = match sides.kind {
        Kind::Dair => Layout::DAIR,
        Kind::V2xSeq => Layout::V2XSEQ,
    };
    let source = Arc::new(DairSource {
        sides,
        pairs: kept,
        sweeps,
    });
    Scenario {
        roadside_units: vec![agents[1].clone()],
        ..Scenario::new(name, layout, agents.to_vec(), Vec::new(), source)
    }
    .among(moments, missing)
}

/// Side of a pair: vehicle or roadside unit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum PairSide {
    Vehicle,
    Infrastructure,
}

impl PairSide {
    fn of(agent: &CavId) -> Self {
        match agent.as_str() {
            VEHICLE => Self::Vehicle,
            _ => Self::Infrastructure,
        }
    }
}

/// Folders of a data set.
#[derive(Debug)]
struct Sides {
    root: PathBuf,
    kind: Kind,
}

impl Sides {
    fn points(&self, pair: &FramePair, side: PairSide) -> PathBuf {
        let (folder, id) = match side {
            PairSide::Vehicle => (VEHICLE_SIDE, &pair.vehicle),
            PairSide::Infrastructure => (INFRASTRUCTURE_SIDE, &pair.infrastructure),
        };
        let folder = self.root.join(folder).join("velodyne");
        folder.join(format!("{id}.pcd"))
    }

    /// Labels of a side's own sweep.
    fn labels(&self, pair: &FramePair, side: PairSide) -> PathBuf {
        let (folder, id) = match side {
            PairSide::Vehicle => ("vehicle-side/label/lidar", &pair.vehicle),
            PairSide::Infrastructure => (
                "infrastructure-side/label/virtuallidar",
                &pair.infrastructure,
            ),
        };
        self.json(folder, id)
    }

    fn cooperative_labels(&self, pair: &FramePair) -> PathBuf {
        let folder = match self.kind {
            Kind::Dair => "cooperative/label_world",
            Kind::V2xSeq => "cooperative/label",
        };
        self.json(folder, &pair.vehicle)
    }

    fn json(&self, folder: &str, id: &str) -> PathBuf {
        self.root.join(folder).join(format!("{id}.json"))
    }

    fn calibrations(&self, pair: &FramePair, side: PairSide) -> Vec<PathBuf> {
        let (folders, id): (&[&str], _) = match side {
            PairSide::Vehicle => (&calibration::VEHICLE, &pair.vehicle),
            PairSide::Infrastructure => (&[calibration::INFRASTRUCTURE], &pair.infrastructure),
        };
        folders.iter().map(|folder| self.json(folder, id)).collect()
    }

    /// The first required file of a side that does not exist.
    fn missing_file(&self, pair: &FramePair, side: PairSide) -> Option<PathBuf> {
        let mut files = self.calibrations(pair, side);
        files.insert(0, self.points(pair, side));
        files.into_iter().find(|path| !path.is_file())
    }
}

/// A batch or sequence.
#[derive(Debug)]
struct DairSource {
    sides: Sides,
    /// By the stem of the tick.
    pairs: HashMap<String, FramePair>,
    sweeps: Sweeps,
}

impl DairSource {
    fn vehicle_frame(&self, agent: &CavId, tick: &Tick, pair: &FramePair) -> Result<Frame> {
        let poses = calibration::vehicle(&self.sides, pair)?;
        let world_from_lidar = poses.world_from_lidar;
        let mut frame = Frame::empty(agent.clone(), tick.capture_nanos, Handedness::Right);
        frame.world_from_lidar = Some(world_from_lidar.into());
        frame.world_from_vehicle = Some(poses.world_from_novatel.into());
        let path = self.sides.labels(pair, PairSide::Vehicle);
        let own = labels::in_frame(&path, &world_from_lidar, LabelList::Vehicle);
        frame.objects = usable(own, &mut frame.problems).unwrap_or_default();
        let path = self.sides.cooperative_labels(pair);
        // DAIR-V2X has these labels in the world, V2X-Seq in the frame of the vehicle's LiDAR.
        let cooperative = match self.sides.kind {
            Kind::Dair => labels::in_world(&path),
            Kind::V2xSeq => labels::in_frame(&path, &world_from_lidar, LabelList::Cooperative),
        };
        // Without a usable list the annotations of the two sides are merged instead.
        frame.cooperative_objects = usable(cooperative, &mut frame.problems);
        let listed = frame.cooperative_objects.as_ref();
        let is_empty = listed.is_some_and(Vec::is_empty);
        if is_empty && (!frame.objects.is_empty() || self.unit_lists_objects(pair)) {
            let reason = "no object, but the two sides list some: their lists are merged instead";
            let problem = ReadError::malformed(&path, reason);
            frame.problems.push(Problem::from(&problem));
            frame.cooperative_objects = None;
        }
        Ok(frame)
    }

    fn unit_lists_objects(&self, pair: &FramePair) -> bool {
        let path = self.sides.labels(pair, PairSide::Infrastructure);
        // In whatever frame.
        let list = labels::in_frame(&path, &Isometry3::identity(), LabelList::Infrastructure);
        list.is_ok_and(|(objects, _)| !objects.is_empty())
    }

    fn infrastructure_frame(&self, agent: &CavId, tick: &Tick, pair: &FramePair) -> Result<Frame> {
        let world_from_lidar = calibration::infrastructure(&self.sides, pair)?;
        let mut frame = Frame::empty(agent.clone(), tick.capture_nanos, Handedness::Right);
        frame.world_from_lidar = Some(world_from_lidar.into());
        let path = self.sides.labels(pair, PairSide::Infrastructure);
        let own = labels::in_frame(&path, &world_from_lidar, LabelList::Infrastructure);
        frame.objects = usable(own, &mut frame.problems).unwrap_or_default();
        // Faults of the vehicle's labels are problems of its frame.
        let vehicle = calibration::vehicle(&self.sides, pair).and_then(|poses| {
            let path = self.sides.labels(pair, PairSide::Vehicle);
            labels::in_frame(&path, &poses.world_from_lidar, LabelList::Vehicle)
        });
        if let Ok((others, _)) = vehicle {
            labels::share_ids(&mut frame.objects, &others, &world_from_lidar.inverse());
        }
        Ok(frame)
    }
}

/// The objects of a list; its faults are added to the frame's problems.
fn usable(labels: Result<LabelledObjects>, problems: &mut Vec<Problem>) -> Option<Vec<Object>> {
    let read = labels.map_err(|error| problems.push(Problem::from(&error)));
    let (objects, wrong) = read.ok()?;
    problems.extend(wrong);
    Some(objects)
}

impl FrameSource for DairSource {
    fn frame(&self, agent: &CavId, tick: &Tick) -> Result<Frame> {
        let pair = self.pairs.get(&tick.stem).ok_or_else(|| {
            let reason = format!("no pair of vehicle frame {}", tick.stem);
            ReadError::malformed(&self.sides.root, reason)
        })?;
        match PairSide::of(agent) {
            PairSide::Vehicle => self.vehicle_frame(agent, tick, pair),
            PairSide::Infrastructure => self.infrastructure_frame(agent, tick, pair),
        }
    }

    fn points(&self, agent: &CavId, tick: &Tick, variant: Option<&str>) -> Result<PcdCloud> {
        self.sweeps
            .read(agent, &self.points_path(agent, tick, variant))
    }

    fn shared_files(&self, agent: &CavId) -> Vec<PathBuf> {
        let index = index::FILES.map(|file| self.sides.root.join(file));
        self.sweeps.samples(agent, index)
    }

    /// Of both sides: the frame of one needs the pose and the ids of the other.
    fn frame_files(&self, _agent: &CavId, tick: &Tick) -> Vec<PathBuf> {
        let Some(pair) = self.pairs.get(&tick.stem) else {
            return Vec::new();
        };
        let mut files = vec![self.sides.cooperative_labels(pair)];
        for side in [PairSide::Vehicle, PairSide::Infrastructure] {
            files.extend(self.sides.calibrations(pair, side));
            files.push(self.sides.labels(pair, side));
        }
        files
    }

    fn points_path(&self, agent: &CavId, tick: &Tick, _variant: Option<&str>) -> PathBuf {
        let points = |pair| self.sides.points(pair, PairSide::of(agent));
        // A tick of another scenario has no file here.
        self.pairs.get(&tick.stem).map(points).unwrap_or_default()
    }
}
