//! Tables of methods: rows of methods and weights, columns of poses and delays, a cell for each, in Markdown and CSV.
//!
//! Cells are cached one by one by everything that they are made of, so that an interrupted run resumes and a changed row costs only
//! that row.

mod text;

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use support::atomic_file;
use support::cli::NotWritten;

pub use text::{csv, markdown};

use super::cell::Cell;
use super::evaluation::{OpenedData, Trial, compute};
use super::slices::Slice;
use super::spec::{Column, Experiment, Row, Table};
use super::sweep::generate;

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
    experiment: &Experiment,
    out: &Path,
    slice: Option<Slice>,
    observer: &mut dyn TableObserver,
) -> Result<Vec<FilledTable>> {
    let cells = out.join("cells");
    atomic_file::create_folder(&cells).with_context(|| NotWritten(cells.clone()))?;
    generate(experiment)?;
    let data = OpenedData::open(&experiment.trial()?)?;
    let run = TableRun {
        experiment,
        cells,
        data,
    };
    let places = run.places()?;
    run.check_participants(&places)?;
    let part = slice.map_or(0..places.len(), |slice| slice.part(places.len()));
    let cells = places[part].iter().map(|place| run.cell(place, observer));
    let cells = cells.collect::<Result<Vec<_>>>()?;
    // Cells of other slices may still be missing, so no table can be filled.
    if slice.is_some() {
        return Ok(Vec::new());
    }
    let mut cells = cells.into_iter();
    let mut filled = Vec::with_capacity(experiment.tables.len());
    for table in &experiment.tables {
        let table = run.fill(table, &mut cells)?;
        for (ending, text) in [("md", markdown(&table)), ("csv", csv(&table))] {
            let path = out.join(format!("{}.{ending}", table.name));
            atomic_file::write(&path, text).with_context(|| path.display().to_string())?;
        }
        filled.push(table);
    }
    Ok(filled)
}

struct TableRun<'a> {
    experiment: &'a Experiment,
    cells: PathBuf,
    data: OpenedData,
}

/// Place of a cell in the tables.
struct CellPlace<'a> {
    table: &'a Table,
    row: &'a Row,
    column: &'a Column,
    /// Weights of one training.
    weights: PathBuf,
}

impl TableRun<'_> {
    /// Every cell: by table, row, column and training.
    fn places(&self) -> Result<Vec<CellPlace<'_>>> {
        let mut places = Vec::new();
        for table in &self.experiment.tables {
            for row in &table.rows {
                for column in &table.columns {
                    let trainings = self.experiment.trainings_of(row)?.into_iter();
                    places.extend(trainings.map(|weights| CellPlace {
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

    /// Refuses vehicles and attackers that the data do not have, before the first cell is computed.
    fn check_participants(&self, places: &[CellPlace<'_>]) -> Result<()> {
        for place in places {
            let mut trial = self.trial(place)?;
            // The ego alone is a reference beside rows that are attacked.
            let is_alone = place.row.vehicles == Some(1);
            trial.setup.attack = trial.setup.attack.filter(|_| !is_alone);
            let checked = trial.check_participants(&self.data);
            checked.with_context(|| format!("table {:?}", place.table.name))?;
        }
        Ok(())
    }

    /// The table with the next of `cells`, which are in the order of [`Self::places`].
    fn fill(&self, table: &Table, cells: &mut impl Iterator<Item = Cell>) -> Result<FilledTable> {
        let mut rows = Vec::with_capacity(table.rows.len());
        for row in &table.rows {
            let trainings = self.experiment.trainings_of(row)?.len();
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

    fn cell(&self, place: &CellPlace<'_>, observer: &mut dyn TableObserver) -> Result<Cell> {
        let trial = self.trial(place)?;
        let key = trial.key(&self.data, place.row.method)?;
        let known = Cell::read(&key, &self.cells)?;
        let (table, column) = (&place.table.name, &place.column.name);
        observer.cell(table, &place.row.label(), column, known.is_some());
        if let Some(cell) = known {
            return Ok(cell);
        }
        let cell = compute(&trial, &self.data, key, &mut || observer.frame())?;
        cell.write(&self.cells)?;
        Ok(cell)
    }

    fn trial(&self, place: &CellPlace<'_>) -> Result<Trial> {
        let (row, column) = (place.row, place.column);
        let mut trial = self.experiment.trial()?;
        trial.scenarios = place.table.scenarios.or(trial.scenarios);
        let setup = &mut trial.setup;
        setup.models.weights.clone_from(&place.weights);
        if let Some(poses) = row.poses.as_ref().or(column.poses.as_ref()) {
            setup.agents.pose.clone_from(poses);
        }
        row.apply(setup);
        column.apply(setup);
        let folder = self.experiment.feature_maps.as_ref();
        trial.maps = folder.map(|folder| self.experiment.kept_maps(folder));
        Ok(trial)
    }
}
