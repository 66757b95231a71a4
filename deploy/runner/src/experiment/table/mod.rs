//! Tables of methods: rows of methods and weights, columns of poses and delays, a cell for each, in Markdown and CSV.
//!
//! Cells are cached one by one by all their inputs, so that an interrupted run resumes and a changed row costs only
//! that row.

mod cell;
mod spec;
mod text;

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::Command;

use agent::rate::RateConfig;
use bus::config_file::ConfigError;
use dataset::{self, IntensityScale, ReadError};
use perception::boxes::postprocess::SCORE_THRESHOLD;

pub use cell::{Cell, CellKey};
pub use spec::{Column, Row, Table, TableSpec};
pub use text::{csv, markdown};

use crate::experiment::evaluation::{EvaluationError, EvaluationOptions, Part, evaluate};
use crate::scenario::weights_choice::WeightsChoiceError;
use ego_fuser::misbehaviour::MisbehaviourConfig;
use training::feature_store::KeptMaps;

/// Reason why a table failed.
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    /// Error of the operating system.
    #[error("{}: {source}", path.display())]
    Io {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// A file has invalid content.
    #[error("{}: {problem}", path.display())]
    Spec {
        /// Path of the file.
        path: PathBuf,
        /// Description of the error.
        problem: String,
    },
    /// The file of tables cannot be read.
    #[error(transparent)]
    File(#[from] ConfigError),
    /// Neither the row nor the file of tables names weights.
    #[error("row {0} has no weights, and there is no folder of weights")]
    NoWeights(String),
    /// The folder of weights has none for a method.
    #[error(transparent)]
    Weights(#[from] WeightsChoiceError),
    /// The data set cannot be read.
    #[error(transparent)]
    Dataset(#[from] ReadError),
    /// A cell cannot be evaluated.
    #[error(transparent)]
    Evaluation(#[from] Box<EvaluationError>),
}

/// The cells of a row: for each column one per training.
#[derive(Debug, Clone, PartialEq)]
pub struct FilledRow {
    /// First column of the row.
    pub label: String,
    /// Column by column, training by training.
    pub cells: Vec<Vec<Cell>>,
}

/// A table with all its values.
#[derive(Debug, Clone, PartialEq)]
pub struct FilledTable {
    /// Name of its files.
    pub name: String,
    /// Titles of its columns.
    pub columns: Vec<String>,
    /// Its rows.
    pub rows: Vec<FilledRow>,
}

/// Observer of the progress of tables.
pub trait TableObserver {
    /// A cell is next; `known` if it was computed before.
    fn cell(&mut self, table: &str, row: &str, column: &str, known: bool);
    /// A frame has been evaluated.
    fn frame(&mut self);
}

/// Computes the missing cells and writes every table into `out`: `NAME.md`, `NAME.csv`, and `cells/`.
///
/// # Errors
/// [`TableError`] at the first cell that cannot be computed; earlier cells are cached.
pub fn run(
    spec: &TableSpec,
    out: &Path,
    observer: &mut dyn TableObserver,
) -> Result<Vec<FilledTable>, TableError> {
    let cells = out.join("cells");
    fs::create_dir_all(&cells).map_err(|source| TableError::Io {
        path: cells.clone(),
        source,
    })?;
    let data_sha256 = dataset::content_sha256(&dataset::open(&spec.dataset)?.scenarios);
    let run = Run {
        spec,
        cells,
        data_sha256,
        commit: commit(),
    };
    let mut filled = Vec::with_capacity(spec.tables.len());
    for table in &spec.tables {
        let table = run.fill(table, observer)?;
        let write = |ending: &str, text: String| {
            let path = out.join(format!("{}.{ending}", table.name));
            fs::write(&path, text).map_err(|source| TableError::Io { path, source })
        };
        write("md", markdown(&table))?;
        write("csv", csv(&table))?;
        filled.push(table);
    }
    Ok(filled)
}

struct Run<'a> {
    spec: &'a TableSpec,
    cells: PathBuf,
    data_sha256: String,
    commit: String,
}

impl Run<'_> {
    fn fill(
        &self,
        table: &Table,
        observer: &mut dyn TableObserver,
    ) -> Result<FilledTable, TableError> {
        let mut rows = Vec::with_capacity(table.rows.len());
        for row in &table.rows {
            let weights = self.spec.weights_of(row)?;
            let mut cells = Vec::with_capacity(table.columns.len());
            for column in &table.columns {
                let of_training =
                    |weights: &PathBuf| self.cell(table, row, column, weights, observer);
                cells.push(weights.iter().map(of_training).collect::<Result<_, _>>()?);
            }
            rows.push(FilledRow {
                label: row.label(),
                cells,
            });
        }
        let columns = table
            .columns
            .iter()
            .map(|column| column.name.clone())
            .collect();
        Ok(FilledTable {
            name: table.name.clone(),
            columns,
            rows,
        })
    }

    fn cell(
        &self,
        table: &Table,
        row: &Row,
        column: &Column,
        weights: &Path,
        observer: &mut dyn TableObserver,
    ) -> Result<Cell, TableError> {
        let poses = row.poses.as_ref().unwrap_or(&column.poses).clone();
        let key = CellKey {
            method: row.method,
            weights_sha256: cell::sha256(weights)?,
            precision: self.spec.precision,
            data_sha256: self.data_sha256.clone(),
            poses_sha256: cell::pose_files(&poses)?,
            poses: poses.clone(),
            delay_ms: column.delay_ms,
            dtype: self.spec.dtype,
            frames: self.spec.frames,
            scenarios: table.scenarios,
            attack: column.attack,
            trust: column.trust.then(MisbehaviourConfig::default),
            protocol: self.spec.protocol.clone(),
            score_threshold: SCORE_THRESHOLD,
            version: env!("CARGO_PKG_VERSION").to_owned(),
        };
        let known = Cell::read(&key, &self.cells)?;
        observer.cell(&table.name, &row.label(), &column.name, known.is_some());
        if let Some(cell) = known {
            return Ok(cell);
        }
        let options = EvaluationOptions {
            dataset: self.spec.dataset.clone(),
            weights: weights.to_owned(),
            precision: self.spec.precision,
            pose_source: poses,
            codec: self.spec.codec(),
            rate: RateConfig::default(),
            delay_nanos: column.delay_ms.saturating_mul(1_000_000),
            attack: column.attack,
            trust: column.trust.then(MisbehaviourConfig::default),
            maps: self.spec.maps.as_ref().map(|folder| KeptMaps {
                folder: folder.clone(),
                dtype: self.spec.dtype,
                limit_bytes: (self.spec.maps_limit_gb.max(0.0) * 1e9) as u64,
                intensity_scale: IntensityScale::AUTO,
            }),
            frames: self.spec.frames,
            part: Part {
                scenarios: table.scenarios,
                ..Part::default()
            },
            protocol: self.spec.protocol.clone(),
            ..EvaluationOptions::default()
        };
        let metrics = evaluate(&options, row.method, &mut || observer.frame()).map_err(Box::new)?;
        let cell = Cell {
            key,
            weights: weights.to_owned(),
            commit: self.commit.clone(),
            metrics,
        };
        cell.write(&self.cells)?;
        Ok(cell)
    }
}

/// Commit of the checkout in the working directory, with `-dirty` if files differ from it.
fn commit() -> String {
    let output = Command::new("git")
        .args([
            "describe",
            "--always",
            "--dirty",
            "--abbrev=12",
            "--exclude=*",
        ])
        .output();
    let description = output.ok().filter(|output| output.status.success());
    description.map_or_else(
        || "unknown".to_owned(),
        |output| String::from_utf8_lossy(&output.stdout).trim().to_owned(),
    )
}
