//! `EXPERIMENT.yaml`: fixed settings, and what varies: the grid of a sweep, or the rows and columns of tables.

use std::path::{Path, PathBuf};

use agent::attack::AttackConfig;
use agent::config::SentBoxes;
use anyhow::{Result, bail};
use dataset::IntensityScale;
use dataset::evaluation_protocol::ProtocolConfig;
use ego_fuser::config::EgoSettings;
use ego_fuser_offline::evaluation::stepped::ComputeTimes;
use ego_fuser_offline::evaluation::{AgentPool, EmulatedLink, Setup};
use fusion::Method;
use link::LinkError;
use localization::pose_source::{NoiseMode, PoseSourceConfig};
use perception::int8::InferencePrecision;
use protocol::Dtype;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use training::feature_store::KeptMaps;

use super::evaluation::Trial;
use crate::scenario::weights_choice::weights_of;

/// An experiment: fixed settings, and either `grid` for `v2vloc sweep` or `tables` for `v2vloc eval --table`. Paths of
/// an experiment with a grid are relative to its file, except for those in `poses`; all others to the working directory.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Experiment {
    /// Name of the files of a sweep: letters, digits, `-` and `_`. Tables have their own names.
    #[serde(default)]
    pub name: String,
    /// One line on top of the report of a sweep.
    #[serde(default)]
    pub title: String,
    /// Data set, split or scenario; the first vehicle of each scenario is the ego.
    pub dataset: PathBuf,
    /// Settings of the generator for a `dataset` that does not exist.
    pub generate: Option<Generate>,
    /// Number of scenarios, evenly spread; absent: all.
    pub scenarios: Option<usize>,
    /// Largest number of frames of each scenario; absent: all.
    pub frames: Option<usize>,
    /// Participating vehicles, counted annotations and objects.
    #[serde(default)]
    pub protocol: ProtocolConfig,
    /// Weights, or a folder with a file `*-METHOD.safetensors` for each method; rows of tables may name their own.
    pub weights: Option<PathBuf>,
    /// Number format in which networks are computed.
    #[serde(default)]
    pub precision: InferencePrecision,
    /// Number format of transmitted feature values, unless the grid has encodings. The default of a scenario is `f32`.
    #[serde(default = "half")]
    pub dtype: Dtype,
    /// Pose source, unless the grid has pose noise, or a row or column of a table its own.
    #[serde(default)]
    pub poses: PoseSourceConfig,
    /// Correlation of the errors of successive frames of `grid.pose_noise`; refused without it.
    #[serde(default)]
    pub noise_mode: NoiseMode,
    /// Deadline, age and trust of the ego; `protocol.ego_kind` selects the vehicle. Without a link no time passes, and
    /// the deadline is refused; `inbox`, `pace` and `tracks` always.
    #[serde(default)]
    pub ego: EgoSettings,
    /// Compute times of the stages, over a link.
    #[serde(default)]
    pub compute: ComputeTimes,
    /// Link emulation in simulation time: a preset of `sim-replay link`, or a file. Absent: an ideal link for a grid,
    /// which varies it, and none for tables.
    pub link: Option<String>,
    /// Folder of cached feature maps of tables; absent: they are computed for every cell.
    pub feature_maps: Option<PathBuf>,
    /// Largest cache of feature maps per encoder, gigabytes.
    #[serde(default = "gigabytes")]
    pub feature_maps_limit_gb: f64,
    /// Axes that vary.
    #[serde(default)]
    pub grid: Grid,
    /// Tables of methods and conditions.
    #[serde(default)]
    pub tables: Vec<Table>,
}

/// A generated data set, see `sim-replay synth`.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Generate {
    /// Seed of routes and traffic; 1000 and above are for measuring.
    pub seed: u64,
    /// Number of scenarios.
    pub scenes: usize,
    /// Number of frames of each.
    pub frames: usize,
    /// Smallest and largest number of vehicles of a scenario.
    pub vehicles: [usize; 2],
}

/// Axes of the grid: every value of each field with every value of the others. An absent axis is as in the link.
#[derive(Debug, Clone, PartialEq, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Grid {
    /// Fusion methods.
    pub method: Vec<Method>,
    /// Encodings of feature maps; methods that exchange none have the first only.
    pub codec: Option<Vec<CodecSpec>>,
    /// Further methods, for comparison: with the first encoding only.
    #[serde(default)]
    pub reference: Vec<Method>,
    /// Mean delay after the last bit was sent, milliseconds; with jitter before negative delays become 0.
    pub latency_ms: Option<Vec<f64>>,
    /// Standard deviation of that normally distributed delay, milliseconds; negative delays become 0.
    pub jitter_ms: Option<Vec<f64>>,
    /// Rate of each link, Mbit/s; `.inf`: unlimited.
    pub bandwidth_mbps: Option<Vec<f64>>,
    /// Fraction of the messages that are lost, whatever the link's `loss_unit`.
    pub loss: Option<Vec<f64>>,
    /// Errors of the poses.
    pub pose_noise: Option<Vec<NoiseSpec>>,
    /// Number of participating vehicles, the ego included; absent: all.
    pub vehicles: Option<Vec<usize>>,
    /// Seeds of losses, delays and pose errors.
    pub seed: Option<Vec<u64>>,
}

/// Encoding of feature maps.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CodecSpec {
    /// Number format of the values.
    pub dtype: Dtype,
    /// Fraction of the cells that are sent, those with the highest confidence; absent: all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub keep: Option<f64>,
    /// zstd level, 1 to 22. Absent: not compressed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub zstd_level: Option<i32>,
    /// Fraction of the link's rate that feature maps are adapted to, by coarser numbers and then fewer cells; absent:
    /// not adapted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fit: Option<f64>,
    /// Detections in place of feature maps, or beside them; the weights are `*-METHOD-boxes.safetensors` of a folder then.
    /// Absent: maps alone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub boxes: Option<SentBoxes>,
}

impl CodecSpec {
    /// Label in tables and charts: the number format and the fraction of the link's rate, or boxes.
    pub fn name(&self) -> String {
        let boxes = match self.boxes {
            Some(SentBoxes::Only) => return "boxes".to_owned(),
            Some(SentBoxes::Beside) => " and boxes",
            None => "",
        };
        let fitted = self
            .fit
            .map_or(String::new(), |share| format!(" fitted to {share}"));
        format!("{:?}{fitted}{boxes}", self.dtype).to_lowercase()
    }
}

/// Standard deviations of a pose's error.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct NoiseSpec {
    /// Of the position along each axis, metres.
    pub position_std_m: f64,
    /// Of the heading, degrees.
    pub heading_std_deg: f64,
}

/// One table: every row in every column.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Table {
    /// Name of its files.
    pub name: String,
    /// Largest number of scenarios to evaluate, evenly spread over the data set; absent: all.
    pub scenarios: Option<usize>,
    /// Its rows.
    pub rows: Vec<Row>,
    /// Its columns.
    pub columns: Vec<Column>,
}

/// A method with its weights.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Row {
    /// First column of the row; absent: the method. Different for each row, without `|` and line ends.
    pub name: Option<String>,
    /// Fusion method.
    pub method: Method,
    /// Its weights, several different files for a mean over trainings; absent: those of the folder.
    #[serde(default)]
    pub weights: Vec<PathBuf>,
    /// Pose source of this row, in place of that of the columns.
    pub poses: Option<PoseSourceConfig>,
    /// Number of participating vehicles, the ego included; absent: all. Annotations of the others count.
    pub vehicles: Option<usize>,
    /// Neighbours send their detections in place of feature maps, or beside them.
    pub boxes: Option<SentBoxes>,
    /// Weights of neighbours with a network of their own. Absent: that of the row.
    pub neighbour_weights: Option<PathBuf>,
    /// Box alignment of the ego.
    #[serde(default)]
    pub box_alignment: bool,
}

/// Conditions of a column.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Column {
    /// Title of the column: different for each, without `|` and line ends.
    pub name: String,
    /// Pose source; absent: that of the experiment.
    pub poses: Option<PoseSourceConfig>,
    /// Delay of the messages of neighbours without a link, milliseconds.
    #[serde(default)]
    pub delay_ms: u64,
    /// Attack by neighbours; absent: none. More attackers than any scenario has neighbours are refused; a row
    /// without neighbours has none.
    pub attack: Option<AttackConfig>,
    /// Misbehaviour detection of the ego.
    #[serde(default)]
    pub trust: bool,
}

fn half() -> Dtype {
    Dtype::F16
}

fn gigabytes() -> f64 {
    8.0
}

impl Experiment {
    /// The cell of the fixed settings; every cell of the experiment varies some of them.
    ///
    /// # Errors
    /// [`LinkError`] when the link cannot be read.
    pub fn trial(&self) -> Result<Trial, LinkError> {
        // A grid replaces this seed by that of each point.
        let link = self.link().map(|link| EmulatedLink::open(link, 0));
        let mut setup = Setup {
            ego: self.ego.clone(),
            link: link.transpose()?,
            compute: self.compute,
            frames: self.frames,
            ..Setup::default()
        };
        setup.models.precision = self.precision;
        setup.agents.pose = self.poses.clone();
        setup.agents.codec.dtype = self.dtype;
        Ok(Trial {
            dataset: self.dataset.clone(),
            scenarios: self.scenarios,
            protocol: self.protocol.clone(),
            setup,
            ..Trial::default()
        })
    }

    /// The link whose emulation the cells share.
    pub(super) fn link(&self) -> Option<&str> {
        let of_grid = self.tables.is_empty().then_some("ideal");
        self.link.as_deref().or(of_grid)
    }

    /// A cache of feature maps in this folder. Kept in 32 bits whatever is sent, so that it changes no result and serves
    /// all encodings.
    pub(super) fn kept_maps(&self, folder: &Path) -> KeptMaps {
        KeptMaps {
            folder: folder.to_owned(),
            dtype: Dtype::F32,
            limit_bytes: (self.feature_maps_limit_gb * 1e9) as u64,
            intensity_scale: IntensityScale::AUTO,
        }
    }

    /// The weights of a method, with a box input where neighbours send boxes.
    ///
    /// # Errors
    /// An error when none are named, or there are not exactly one.
    pub(super) fn weights_of(&self, method: Method, boxes: Option<SentBoxes>) -> Result<PathBuf> {
        match &self.weights {
            Some(weights) => Ok(weights_of(weights, method, boxes.is_some())?),
            None => bail!("method {method} has no weights: name a file or a folder"),
        }
    }

    /// The weights of a row, one file per training.
    ///
    /// # Errors
    /// An error when neither the row nor the experiment has any.
    pub(super) fn trainings_of(&self, row: &Row) -> Result<Vec<PathBuf>> {
        match &row.weights[..] {
            [] => Ok(vec![self.weights_of(row.method, row.boxes)?]),
            files => Ok(files.to_vec()),
        }
    }
}

impl Column {
    /// Sets what the column states beside poses; what the experiment has switched on stays on.
    pub(super) fn apply(&self, setup: &mut Setup) {
        setup.delay_ms = self.delay_ms;
        setup.attack = self.attack;
        setup.ego.trust |= self.trust;
    }
}

impl Row {
    /// The same for the row.
    pub(super) fn apply(&self, setup: &mut Setup) {
        setup.pool = self.vehicles.map_or(AgentPool::All, AgentPool::First);
        setup.agents.boxes = self.boxes;
        setup.agents.weights.clone_from(&self.neighbour_weights);
        setup.ego.box_alignment |= self.box_alignment;
    }

    /// First column of the row.
    pub fn label(&self) -> String {
        let name = self.name.as_deref();
        name.unwrap_or(self.method.name()).to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use support::file_error::FileError;

    const SPEC: &str = "\
dataset: scenes/test
weights: deploy/weights
tables:
- name: main
  rows:
  - method: none
  - {name: PASTAT, method: pastat, weights: [a.safetensors, b.safetensors], poses: {cached: {file: poses.csv}}}
  columns:
  - name: true poses
  - {name: 1 m, poses: {noisy: {mode: independent, position_std_m: 1}}, delay_ms: 100}
";

    fn read(text: &str) -> Result<Experiment, FileError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tables.yaml");
        std::fs::write(&path, text).unwrap();
        Experiment::read(&path)
    }

    #[test]
    fn rows_and_columns_are_read_with_their_defaults() {
        let spec = read(SPEC).unwrap();
        let table = &spec.tables[0];
        assert_eq!(
            (table.rows[0].label(), table.rows[1].label()),
            ("none".to_owned(), "PASTAT".to_owned())
        );
        assert_eq!(table.rows[1].poses.as_ref().unwrap().name(), "cached");
        assert_eq!(table.columns[0].poses, None);
        assert_eq!(table.columns[1].poses.as_ref().unwrap().name(), "noisy");
        assert_eq!(
            (
                table.columns[0].delay_ms,
                table.columns[1].delay_ms,
                spec.dtype
            ),
            (0, 100, Dtype::F16)
        );
        assert_eq!(spec.trainings_of(&table.rows[1]).unwrap().len(), 2);
    }

    #[test]
    fn what_is_wrong_is_named_with_the_file() {
        for (text, part) in [
            (SPEC.replace("method: none", "method: nine"), "tables.yaml"),
            (SPEC.replace("name: main", "name: ../main"), "../main"),
            (SPEC.replace("delay_ms", "delay_s"), "delay_s"),
            (
                SPEC.replace("  columns:", "  columns: []\n  more:"),
                "tables.yaml",
            ),
        ] {
            let message = read(&text).unwrap_err().to_string();
            assert!(
                message.contains("tables.yaml") && message.contains(part),
                "{message}"
            );
        }
        let spec = read(&SPEC.replace("weights: deploy/weights\n", "")).unwrap();
        let message = spec
            .trainings_of(&spec.tables[0].rows[0])
            .unwrap_err()
            .to_string();
        assert!(message.contains("none"), "{message}");
    }
}
