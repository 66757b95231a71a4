//! Tables of methods: rows of methods and weights, columns of poses and delays, a cell for each, in Markdown and CSV.
//!
//! Cells are cached one by one by everything that they are made of, so that an interrupted run resumes and a changed row costs only
//! that row.

mod spec;
mod text;

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use dataset::IntensityScale;
use ego_fuser_offline::evaluation::EvaluateConfig;
use support::atomic_file;
use support::cli::NotWritten;

pub use spec::{Column, Row, Table, TableSpec};
pub use text::{csv, markdown};

use crate::experiment::cell::Cell;
use crate::experiment::evaluation::{EvaluationOptions, OpenedData, Part, compute};
use crate::experiment::slices::Slice;
use ego_fuser::misbehaviour::MisbehaviourConfig;
use training::feature_store::KeptMaps;

/// The cells of a row: for each column one per training.
#[derive(Debug, Clone, PartialEq)]
pub struct FilledRow {
    /// Method and first column of the row.
    pub row: Row,
    /// Column by column, training by training.
    pub cells: Vec<Vec<Cell>>,
}

/// A table with all its values.
#[derive(Debug, Clone, PartialEq)]
pub struct FilledTable {
    /// Name of its files.
    pub name: String,
    /// Conditions.
    pub columns: Vec<Column>,
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

/// Computes the missing cells and writes every table into `out`: `NAME.md`, `NAME.csv`, and `cells/`. Of a slice only
/// its cells are computed, and no table is written.
///
/// # Errors
/// An error at the first cell that cannot be computed; earlier cells are cached.
pub fn run(
    spec: &TableSpec,
    out: &Path,
    slice: Option<Slice>,
    observer: &mut dyn TableObserver,
) -> Result<Vec<FilledTable>> {
    let cells = out.join("cells");
    fs::create_dir_all(&cells).with_context(|| NotWritten(cells.clone()))?;
    let part = Part {
        frames: spec.frames,
        ..Part::default()
    };
    let data = part.open(&spec.dataset, &spec.protocol)?;
    let run = Run { spec, cells, data };
    let places = run.places()?;
    let part = slice.map_or(0..places.len(), |slice| slice.part(places.len()));
    let mut cells = Vec::with_capacity(part.len());
    for place in &places[part] {
        cells.push(run.cell(place, observer)?);
    }
    if slice.is_some() {
        return Ok(Vec::new());
    }
    let mut cells = cells.into_iter();
    let mut filled = Vec::with_capacity(spec.tables.len());
    for table in &spec.tables {
        let table = run.fill(table, &mut cells)?;
        for (ending, text) in [("md", markdown(&table)), ("csv", csv(&table))] {
            let path = out.join(format!("{}.{ending}", table.name));
            atomic_file::write(&path, text).with_context(|| path.display().to_string())?;
        }
        filled.push(table);
    }
    Ok(filled)
}

struct Run<'a> {
    spec: &'a TableSpec,
    cells: PathBuf,
    data: OpenedData,
}

/// Place of a cell in the tables.
struct Place<'a> {
    table: &'a Table,
    row: &'a Row,
    column: &'a Column,
    /// Weights of one training.
    weights: PathBuf,
}

impl Run<'_> {
    /// Every cell: by table, row, column and training.
    fn places(&self) -> Result<Vec<Place<'_>>> {
        let mut places = Vec::new();
        for table in &self.spec.tables {
            for row in &table.rows {
                for column in &table.columns {
                    places.extend(self.spec.weights_of(row)?.into_iter().map(|weights| Place {
                        table,
                        row,
                        column,
                        weights,
                    }));
                }
            }
        }
        Ok(places)
    }

    /// The table with the next of `cells`, which are in the order of [`Self::places`].
    fn fill(&self, table: &Table, cells: &mut impl Iterator<Item = Cell>) -> Result<FilledTable> {
        let mut rows = Vec::with_capacity(table.rows.len());
        for row in &table.rows {
            let trainings = self.spec.weights_of(row)?.len();
            rows.push(FilledRow {
                row: row.clone(),
                cells: (table.columns.iter())
                    .map(|_| cells.by_ref().take(trainings).collect())
                    .collect(),
            });
        }
        Ok(FilledTable {
            name: table.name.clone(),
            columns: table.columns.clone(),
            rows,
        })
    }

    fn cell(&self, place: &Place<'_>, observer: &mut dyn TableObserver) -> Result<Cell> {
        let Place {
            table, row, column, ..
        } = place;
        let options = self.options(place);
        let key = options.key(&self.data, row.method)?;
        let known = Cell::read(&key, &self.cells)?;
        observer.cell(&table.name, &row.label(), &column.name, known.is_some());
        if let Some(cell) = known {
            return Ok(cell);
        }
        let cell = compute(&options, &self.data, key, &mut || observer.frame())?;
        cell.write(&self.cells)?;
        Ok(cell)
    }

    fn options(&self, place: &Place<'_>) -> EvaluationOptions {
        let Place {
            table,
            row,
            column,
            weights,
        } = place;
        let settings = EvaluateConfig {
            weights: weights.clone(),
            precision: self.spec.precision,
            pose_source: row.poses.as_ref().unwrap_or(&column.poses).clone(),
            codec: self.spec.codec(),
            delay_nanos: column.delay_ms.saturating_mul(1_000_000),
            attack: column.attack,
            trust: column.trust.then(MisbehaviourConfig::default),
            ..EvaluateConfig::default()
        };
        EvaluationOptions {
            dataset: self.spec.dataset.clone(),
            settings,
            maps: self.spec.feature_maps.as_ref().map(|folder| KeptMaps {
                folder: folder.clone(),
                dtype: self.spec.dtype,
                limit_bytes: (self.spec.feature_maps_limit_gb.max(0.0) * 1e9) as u64,
                intensity_scale: IntensityScale::AUTO,
            }),
            part: Part {
                scenarios: table.scenarios,
                frames: self.spec.frames,
                ..Part::default()
            },
            protocol: self.spec.protocol.clone(),
            ..EvaluationOptions::default()
        }
    }
}
