//! Table of poses on disk, one row per sweep, found by scenario, vehicle and capture time.

use std::collections::{HashMap, HashSet};
use std::fs::{self, OpenOptions};
use std::io::Write as _;
use std::path::{Path, PathBuf};

use perception::inference::Inference;
use protocol::config::FieldError;
use protocol::{CavId, NoPoseReason, Pose, PoseEstimate};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use support::atomic_file;
use support::csv_file::{CsvFile, CsvRow, CsvText};
use support::file_error::{AtFile, FileError, Result};

use super::settings::{PoseBasis, PoseSettings, require_file};
use super::{NO_SOURCE, PoseInput, PoseSource, PoseSourceError};

/// The first line of a table.
const HEADER: &str =
    "scenario,cav,capture_nanos,x_m,y_m,z_m,qw,qx,qy,qz,confidence,no_pose,inliers";
/// First field of a row with the origin of a scenario's poses.
const ORIGIN: &str = "#";
/// Largest file that is read, bytes: two million sweeps.
const MAX_BYTES: u64 = 256 << 20;

/// A sweep within its scenario.
type SweepKey = (CavId, u64);

/// Poses of scenarios, sweep by sweep; a sweep without a pose has a reason.
///
/// The file is text: a header, then per sweep the last part of the scenario's name, vehicle, capture time, translation,
/// quaternion and confidence, or the reason for no pose and the number of inliers. A row that begins with `#` states what the
/// poses of a scenario were computed from.
#[derive(Debug, Clone, Default)]
pub struct PoseTable {
    path: PathBuf,
    scenarios: HashMap<String, HashMap<SweepKey, PoseEstimate>>,
    /// By scenario.
    origins: HashMap<String, String>,
}

/// One row to write.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseRow<'a> {
    /// Vehicle.
    pub cav: &'a CavId,
    /// Capture time, nanoseconds.
    pub capture_nanos: u64,
    /// Pose, or the reason why there is none.
    pub estimate: PoseEstimate,
}

impl PoseTable {
    /// Reads a table.
    ///
    /// # Errors
    /// [`FileError`] names the file and the line.
    pub fn read(path: &Path) -> Result<Self> {
        let mut table = Self {
            path: path.to_owned(),
            ..Self::default()
        };
        for row in CsvFile::read(path, HEADER, MAX_BYTES)?.rows() {
            if row.field(0) == ORIGIN {
                let [scenario, origin] = [1, 2].map(|column| row.field(column).to_owned());
                table.origins.insert(scenario, origin);
                continue;
            }
            let row = row.complete()?;
            let of_scenario = table.scenarios.entry(row.field(0).to_owned()).or_default();
            let cav = CavId::new(row.field(1))
                .map_err(|error| row.fault(format_args!("cav: {error}")))?;
            let capture_nanos = row.field(2).parse::<u64>();
            let capture_nanos = capture_nanos.map_err(|_| row.wrong(2, "integer nanoseconds"))?;
            let key = (cav, capture_nanos);
            let estimate = match row.field(11) {
                "" => pose(&row)?,
                _ => no_pose(&row)?,
            };
            let before = of_scenario.insert(key, estimate);
            // Two rows of one sweep, as in a table that was appended to twice: neither can be preferred.
            if before.is_some() {
                return Err(row.fault("duplicate row of the sweep"));
            }
        }
        Ok(table)
    }

    /// Origin of the poses of a scenario (its name, or the path that ends in it): digests of data and networks. Empty if the
    /// table has none, `None` if it has no poses of this scenario.
    pub fn origin(&self, scenario: &str) -> Option<&str> {
        let name = Self::key(scenario);
        self.scenarios.get(name)?;
        Some(self.origins.get(name).map_or("", String::as_str))
    }

    /// Refuses poses of a scenario that were computed from other data than these, whose digest `sha256` computes. A table
    /// without origin is not refused.
    ///
    /// # Errors
    /// [`FileError`] with both digests.
    pub fn check_data(&self, scenario: &str, sha256: impl FnOnce() -> String) -> Result<()> {
        let stated = self.origin(scenario).unwrap_or_default();
        let stated = { stated.strip_prefix("data ") }.and_then(|digests| digests.split(' ').next());
        match stated.map(|stated| (stated, sha256())) {
            Some((stated, found)) if stated != found => {
                let wrong = format!("poses of {scenario} are of data {stated}, not of {found}");
                Err(FileError::new(&self.path, wrong))
            }
            _ => Ok(()),
        }
    }

    /// Scenarios are identified by the name of their folder, wherever that folder lies.
    pub fn key(scenario: &str) -> &str {
        scenario.rsplit('/').next().unwrap_or(scenario)
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.scenarios.values().map(HashMap::len).sum()
    }

    /// Estimate of a sweep.
    pub fn get(&self, scenario: &str, cav: &CavId, capture_nanos: u64) -> Option<&PoseEstimate> {
        (self.scenarios.get(Self::key(scenario))?).get(&(cav.clone(), capture_nanos))
    }

    /// Appends the rows of a scenario, computed from `origin`, to a file, which gets its header where it is new.
    ///
    /// # Errors
    /// [`FileError`] when the file cannot be written.
    pub fn append(path: &Path, scenario: &str, origin: &str, rows: &[PoseRow<'_>]) -> Result<()> {
        let is_begun = fs::metadata(path).is_ok_and(|file| file.len() > 0);
        let mut text = match is_begun {
            true => CsvText::headless(),
            false => CsvText::new(HEADER),
        };
        let scenario = Self::key(scenario);
        text.row([ORIGIN, scenario, origin]);
        rows.iter().for_each(|row| text.row(fields(scenario, row)));
        let file = OpenOptions::new().create(true).append(true).open(path);
        let written = file.and_then(|mut file| file.write_all(text.finish().as_bytes()));
        written.and_then(|()| atomic_file::sync(path)).at(path)
    }

    /// The poses of one scenario: the requested one, or the only one there is.
    ///
    /// # Errors
    /// [`FileError`] when there is none, or several and none is requested.
    fn of_scenario(mut self, scenario: Option<&str>) -> Result<HashMap<SweepKey, PoseEstimate>> {
        let wrong = match (scenario, self.scenarios.len()) {
            (Some(name), _) => match self.scenarios.remove(Self::key(name)) {
                Some(poses) => return Ok(poses),
                None => format!("there is no pose of scenario {name} in it"),
            },
            (None, 1) => return Ok(self.scenarios.into_values().next().unwrap_or_default()),
            (None, count) => {
                format!("it has poses of {count} scenarios, `scenario` must name one")
            }
        };
        Err(FileError::new(self.path, wrong))
    }
}

/// Table of poses and the scenario in it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(deny_unknown_fields)]
pub struct CachedPoseConfig {
    /// Table of poses, as `agent localize` writes it (pose source cached).
    #[arg(id = "poses", long = "poses", value_name = "FILE")]
    pub file: PathBuf,
    /// Scenario that is replayed; required if the table has several.
    #[arg(skip)]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scenario: Option<String>,
}

/// Looks up poses that were estimated before.
#[derive(Debug, Clone)]
pub(crate) struct CachedPose {
    file: PathBuf,
    poses: HashMap<SweepKey, PoseEstimate>,
    /// Vehicles that were named because the table has no row of a sweep of theirs.
    missed: HashSet<CavId>,
}

impl PoseSettings for CachedPoseConfig {
    fn basis(&self) -> PoseBasis {
        PoseBasis::Files
    }

    fn build(&self, _: Inference) -> Result<Box<dyn PoseSource>, PoseSourceError> {
        let poses = PoseTable::read(&self.file)?.of_scenario(self.scenario.as_deref())?;
        Ok(Box::new(CachedPose {
            file: self.file.clone(),
            poses,
            missed: HashSet::new(),
        }))
    }

    fn validate(&self) -> Result<(), FieldError> {
        require_file("cached.file", "--poses", &self.file)
    }

    fn files(&mut self) -> Vec<&mut PathBuf> {
        vec![&mut self.file]
    }

    fn set_scenario(&mut self, name: &str) {
        self.scenario = Some(name.to_owned());
    }
}

impl PoseSource for CachedPose {
    /// Ignores sweep and measured pose; a sweep that is not in the table has no source.
    fn estimate(&mut self, input: &PoseInput<'_>) -> PoseEstimate {
        let (cav, capture_nanos) = (input.cav, input.capture_nanos);
        let pose = self.poses.get(&(cav.clone(), capture_nanos));
        if pose.is_none() && self.missed.insert(cav.clone()) {
            let file = self.file.display();
            tracing::warn!(%cav, capture_nanos, "no pose: {file} has no row of this vehicle and capture time");
        }
        pose.copied().unwrap_or(NO_SOURCE)
    }
}

fn fields(scenario: &str, row: &PoseRow<'_>) -> [String; 13] {
    let mut fields: [String; 13] = Default::default();
    fields[0] = scenario.to_owned();
    fields[1] = row.cav.to_string();
    fields[2] = row.capture_nanos.to_string();
    match &row.estimate {
        PoseEstimate::Pose {
            world_from_cav: pose,
            confidence,
            ..
        } => {
            // To a hundredth of a millimetre. The covariance is not stored: a cached pose has none.
            fields[3..6].clone_from_slice(&pose.translation_m.map(|metres| format!("{metres:.5}")));
            fields[6..10].clone_from_slice(&pose.rotation_wxyz.map(|part| format!("{part:.9}")));
            fields[10] = format!("{confidence:.6}");
        }
        PoseEstimate::NoPose {
            reason,
            inlier_count,
        } => {
            fields[11] = <&str>::from(reason).to_owned();
            fields[12] = inlier_count.to_string();
        }
    }
    fields
}

fn pose(row: &CsvRow<'_>) -> Result<PoseEstimate> {
    let mut numbers = [0.0; 7];
    for (column, number) in (3..).zip(&mut numbers) {
        *number = row.number(column, f64::MIN..=f64::MAX, "a finite number")?;
    }
    let [x, y, z, rotation_wxyz @ ..] = numbers;
    let pose = Pose {
        translation_m: [x, y, z],
        rotation_wxyz,
    };
    pose.validate().map_err(|error| row.fault(error))?;
    let confidence = row.number(10, 0.0..=1.0, "0 to 1")?;
    Ok(PoseEstimate::new(pose, confidence as f32))
}

fn no_pose(row: &CsvRow<'_>) -> Result<PoseEstimate> {
    let reason = serde_json::from_value::<NoPoseReason>(row.field(11).into());
    let reason = reason.map_err(|_| row.wrong(11, "a reason for no pose"))?;
    let inliers = row
        .field(12)
        .parse::<u32>()
        .map_err(|_| row.wrong(12, "a count"))?;
    Ok(PoseEstimate::no_pose(reason, inliers))
}

#[cfg(test)]
mod tests {
    use protocol::PointCloud;

    use super::super::{PoseInput, PoseSourceConfig};
    use perception::inference::Inference;

    use super::*;

    fn cav(name: &str) -> CavId {
        CavId::new(name).unwrap()
    }

    fn found() -> PoseEstimate {
        PoseEstimate::new(Pose::from_xyz_yaw([101.25, -7.5, 1.9], 0.7), 0.875)
    }

    const LOST: PoseEstimate = PoseEstimate::NoPose {
        reason: NoPoseReason::LowConfidence,
        inlier_count: 12,
    };

    fn row(cav: &CavId, capture_nanos: u64, estimate: PoseEstimate) -> PoseRow<'_> {
        PoseRow {
            cav,
            capture_nanos,
            estimate,
        }
    }

    fn config(file: &Path, scenario: Option<&str>) -> PoseSourceConfig {
        PoseSourceConfig::Cached(CachedPoseConfig {
            file: file.to_owned(),
            scenario: scenario.map(str::to_owned),
        })
    }

    #[test]
    fn rows_come_back_by_scenario_vehicle_and_time() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("poses.csv");
        let (a, b) = (cav("a"), cav("b"));
        PoseTable::append(
            &file,
            "towns/one",
            "head 1, data 2",
            &[row(&a, 100, found()), row(&b, 100, LOST)],
        )
        .unwrap();
        PoseTable::append(&file, "two", "", &[row(&a, 100, LOST)]).unwrap();
        let table = PoseTable::read(&file).unwrap();
        let origins = ["elsewhere/one", "two", "three"].map(|name| table.origin(name));
        assert_eq!(origins, [Some("head 1, data 2"), Some(""), None]);
        let PoseEstimate::Pose {
            world_from_cav,
            confidence,
            ..
        } = table.get("one", &a, 100).unwrap()
        else {
            panic!()
        };
        let apart = found()
            .world_from_cav()
            .unwrap()
            .from_world(world_from_cav)
            .isometry();
        assert!(
            apart.translation.vector.norm() < 1e-4
                && apart.rotation.angle() < 1e-6
                && *confidence == 0.875
        );
        assert_eq!(table.get("one", &b, 100), Some(&LOST));
        assert_eq!(table.get("one", &b, 200), None);

        let mut source = config(&file, Some("one"))
            .build(Inference::default())
            .unwrap();
        let cloud = PointCloud::default();
        for (capture_nanos, expected) in [(100, LOST), (300, NO_SOURCE)] {
            let estimate = source.estimate(&PoseInput {
                cav: &b,
                capture_nanos,
                cloud: &cloud,
                levels: None,
                measured: Some(&Pose::IDENTITY),
                motion: protocol::EgoMotion::default(),
            });
            assert_eq!(estimate, expected);
        }
        for (scenario, named) in [(None, "2 scenarios"), (Some("three"), "three")] {
            let built = config(&file, scenario).build(Inference::default());
            let message = built.unwrap_err().to_string();
            assert!(message.contains(named), "{message}");
        }
        assert_eq!(
            config(&file, None).for_scenario("two"),
            config(&file, Some("two"))
        );
    }

    #[test]
    fn poses_of_other_data_are_refused_with_both_digests() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("poses.csv");
        let a = cav("a");
        for (scenario, origin) in [("one", "data d1 head h"), ("two", "")] {
            PoseTable::append(&file, scenario, origin, &[row(&a, 100, LOST)]).unwrap();
        }
        let table = PoseTable::read(&file).unwrap();
        for scenario in ["elsewhere/one", "two", "three"] {
            table.check_data(scenario, || "d1".to_owned()).unwrap();
        }
        let refused = table.check_data("one", || "d2".to_owned());
        let message = refused.unwrap_err().to_string();
        let parts = ["poses.csv: poses of one", "data d1", "d2"];
        assert!(parts.iter().all(|part| message.contains(part)), "{message}");
    }

    #[test]
    fn a_vehicle_with_a_sweep_that_has_no_row_is_named_and_has_no_pose_then() {
        let [a, b, c] = ["a", "b", "c"].map(cav);
        let rows = [&a, &c].map(|cav| ((cav.clone(), 100), found()));
        let mut source = CachedPose {
            file: "poses.csv".into(),
            poses: HashMap::from(rows),
            missed: HashSet::new(),
        };
        for (cav, capture_nanos, expected) in [
            (&a, 100, found()),
            (&b, 100, NO_SOURCE),
            (&b, 200, NO_SOURCE),
            (&c, 100, found()),
            (&c, 200, NO_SOURCE),
        ] {
            let estimate = source.estimate(&PoseInput {
                cav,
                capture_nanos,
                cloud: &PointCloud::default(),
                levels: None,
                measured: None,
                motion: protocol::EgoMotion::default(),
            });
            assert_eq!(estimate, expected);
        }
        assert_eq!(source.missed, HashSet::from([b, c]));
    }

    #[test]
    fn errors_name_file_and_line() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("poses.csv");
        let good = "s,a,1,0,0,0,1,0,0,0,0.5,,";
        for (text, part) in [
            ("a,b\n".to_owned(), "poses.csv:1"),
            (
                format!("{HEADER}\n{good}\n{good}\n"),
                "poses.csv:3: duplicate row of the sweep",
            ),
            (format!("{HEADER}\ns,a,1,0\n"), "4 columns"),
            (
                format!("{HEADER}\ns,a,1,0,0,0,1,0,0,0,1.5,,\n"),
                "confidence is \"1.5\", must be 0 to 1",
            ),
            (
                format!("{HEADER}\ns,a,1,0,0,NaN,1,0,0,0,0.5,,\n"),
                "poses.csv:2",
            ),
            (
                format!("{HEADER}\ns,a,1,0,0,0,9,0,0,0,0.5,,\n"),
                "poses.csv:2",
            ),
            (format!("{HEADER}\ns,a,1,,,,,,,,,tired,0\n"), "tired"),
            (format!("{HEADER}\ns,A/b,1,0,0,0,1,0,0,0,0.5,,\n"), "cav"),
        ] {
            std::fs::write(&file, text).unwrap();
            let message = PoseTable::read(&file).unwrap_err().to_string();
            assert!(message.contains(part), "{message}");
        }
    }
}
