//! `--table FILE`: tables of methods and conditions.

use std::path::{Path, PathBuf};

use agent::attack::AttackConfig;
use bus::config_file;
use dataset::evaluation_protocol::ProtocolConfig;
use fusion::Method;
use localization::pose_source::PoseSourceConfig;
use perception::int8::InferencePrecision;
use protocol::{CodecConfig, Dtype};
use schemars::JsonSchema;
use serde::Deserialize;

use anyhow::{Result, bail};
use support::file_error::FileError;

use crate::experiment::sweep::check_name;
use crate::scenario::weights_choice::weights_of;

/// A file of tables: common settings, and each table.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TableSpec {
    /// Data set, split or scenario; the first vehicle of each scenario is the ego.
    pub dataset: PathBuf,
    /// Participating vehicles, counted annotations and objects.
    #[serde(default)]
    pub protocol: ProtocolConfig,
    /// Folder with a file `*-METHOD.safetensors` for each method, for rows that name no weights.
    #[serde(default)]
    pub weights: Option<PathBuf>,
    /// Number format in which networks are computed.
    #[serde(default)]
    pub precision: InferencePrecision,
    /// Number format of transmitted feature values.
    #[serde(default = "half")]
    pub dtype: Dtype,
    /// Largest number of frames of each scenario.
    #[serde(default)]
    pub frames: Option<usize>,
    /// Folder of cached feature maps; absent: they are computed for every cell.
    #[serde(default)]
    pub feature_maps: Option<PathBuf>,
    /// Largest cache of feature maps per encoder, gigabytes.
    #[serde(default = "gigabytes")]
    pub feature_maps_limit_gb: f64,
    /// The tables.
    pub tables: Vec<Table>,
}

/// One table: every row in every column.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Table {
    /// Name of its files.
    pub name: String,
    /// Largest number of scenarios to evaluate, evenly spread over the data set; absent: all.
    #[serde(default)]
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
    /// First column of the row; absent: the method.
    #[serde(default)]
    pub name: Option<String>,
    /// Fusion method.
    pub method: Method,
    /// Its weights, several for a mean over trainings; absent: those of the folder.
    #[serde(default)]
    pub weights: Vec<PathBuf>,
    /// Pose source of this row, in place of that of the columns.
    #[serde(default)]
    pub poses: Option<PoseSourceConfig>,
}

/// Conditions of a column.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Column {
    /// Title of the column.
    pub name: String,
    /// Pose source.
    #[serde(default)]
    pub poses: PoseSourceConfig,
    /// Delay of the messages of neighbours, milliseconds.
    #[serde(default)]
    pub delay_ms: u64,
    /// Attack by neighbours; absent: none.
    #[serde(default)]
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

impl TableSpec {
    /// Reads a file of tables.
    ///
    /// # Errors
    /// [`FileError`] names the file and the error.
    pub fn read(path: &Path) -> Result<Self, FileError> {
        let mut spec: Self = config_file::read(path)?;
        let checked = spec.check().and_then(|()| spec.find_networks());
        checked.map_err(|problem| FileError::new(path, problem))?;
        Ok(spec)
    }

    fn find_networks(&mut self) -> Result<(), String> {
        for Table { rows, columns, .. } in &mut self.tables {
            let of_rows = rows.iter_mut().filter_map(|row| row.poses.as_mut());
            let of_columns = columns.iter_mut().map(|column| &mut column.poses);
            for poses in of_rows.chain(of_columns) {
                let found = std::mem::take(poses).with_networks();
                *poses = found.map_err(|error| format!("poses: {error}"))?;
            }
        }
        Ok(())
    }

    fn check(&self) -> Result<(), String> {
        for (index, table) in self.tables.iter().enumerate() {
            check_name("table name", &table.name)?;
            let mut before = self.tables[..index].iter();
            if before.any(|other| other.name == table.name) {
                return Err(format!("two tables are called {:?}", table.name));
            }
            if table.rows.is_empty() || table.columns.is_empty() {
                return Err(format!("table {:?} has no rows or no columns", table.name));
            }
        }
        Ok(())
    }

    /// The weights of a row, one file per training.
    ///
    /// # Errors
    /// An error when neither the row nor the folder has any.
    pub(crate) fn weights_of(&self, row: &Row) -> Result<Vec<PathBuf>> {
        match (&row.weights[..], &self.weights) {
            ([], Some(folder)) => Ok(vec![weights_of(folder, row.method)?]),
            ([], None) => bail!(
                "row {} has no weights, and there is no folder of weights",
                row.label()
            ),
            (files, _) => Ok(files.to_vec()),
        }
    }

    /// Encoding of feature maps.
    #[must_use]
    pub fn codec(&self) -> CodecConfig {
        CodecConfig {
            dtype: self.dtype,
            ..CodecConfig::default()
        }
    }
}

impl Row {
    /// First column of the row.
    #[must_use]
    pub fn label(&self) -> String {
        self.name
            .clone()
            .unwrap_or_else(|| self.method.name().to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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

    fn read(text: &str) -> Result<TableSpec, FileError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tables.yaml");
        std::fs::write(&path, text).unwrap();
        TableSpec::read(&path)
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
        assert_eq!(
            (table.columns[0].poses.name(), table.columns[1].poses.name()),
            ("recorded", "noisy")
        );
        assert_eq!(
            (
                table.columns[0].delay_ms,
                table.columns[1].delay_ms,
                spec.dtype
            ),
            (0, 100, Dtype::F16)
        );
        assert_eq!(spec.weights_of(&table.rows[1]).unwrap().len(), 2);
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
            .weights_of(&spec.tables[0].rows[0])
            .unwrap_err()
            .to_string();
        assert!(message.contains("none"), "{message}");
    }
}
