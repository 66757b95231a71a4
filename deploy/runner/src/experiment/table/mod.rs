//! Tables of methods: rows of methods and weights, columns of poses and delays, a cell for each, in Markdown and CSV.
//!
//! Cells are cached one by one by everything that they are made of, so that an interrupted run resumes and a changed row costs only
//! that row.

mod text;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use support::atomic_file;
use support::cli::NotWritten;
use support::file_digests::FileDigests;
use support::output;

pub use text::{csv, markdown};

use super::cell::Cell;
use super::evaluation::{OpenedData, Trial, compute};
use super::slices::Slice;
use super::spec::{Column, Experiment, Row, Table};
use super::sweep::generate;
use crate::scenario::weights_choice::weights_of;

/// A table with all its values.
#[derive(Debug, Clone, PartialEq)]
pub struct FilledTable {
    /// Name of its files.
    pub name: String,
    /// Conditions.
    pub columns: Vec<Column>,
    /// Its rows, each with its cells: column by column, training by training.
    pub rows: Vec<(Row, Vec<Vec<Cell>>)>,
}

/// Computes the missing cells and writes every table into `out`: `NAME.md`, `NAME.csv`, and `cells/`. Of a slice only
/// its cells are computed, and no table is written. `on_cell` is called before every cell, with its place as text and true
/// if it was computed before; `on_frame` after every frame.
///
/// # Errors
/// An error at the first cell that cannot be computed; earlier cells are cached.
pub fn run(
    experiment: &Experiment,
    out: &Path,
    slice: Option<Slice>,
    on_cell: &mut dyn FnMut(&str, bool),
    on_frame: &mut dyn FnMut(),
) -> Result<Vec<FilledTable>> {
    let cells = out.join("cells");
    atomic_file::create_folder(&cells).with_context(|| NotWritten(cells.clone()))?;
    generate(experiment)?;
    let data = OpenedData::open(&experiment.trial()?)?;
    let lacking = data.lacking(experiment.scenarios, experiment.frames);
    lacking.into_iter().for_each(output::note);
    let run = TableRun {
        experiment,
        cells,
        data,
    };
    let places = run.places()?;
    run.check_participants(&places)?;
    let part = slice.map_or(0..places.len(), |slice| slice.part(places.len()));
    let cells = places[part].iter();
    let cells = cells.map(|place| run.cell(place, on_cell, on_frame));
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

/// Refuses trainings of a row that are one, by another path or as a copy: their standard deviation would be 0.
fn check_trainings(row: &Row, digests: &FileDigests) -> Result<()> {
    let mut known = BTreeMap::new();
    for weights in &row.weights {
        let file = weights_of(weights, row.method, row.boxes.is_some())?;
        if let Some(same) = known.insert(digests.of(&file)?, weights) {
            let (row, [same, other]) = (row.label(), [same, weights].map(|file| file.display()));
            bail!("row {row}: weights {same} and {other} have the same contents");
        }
    }
    Ok(())
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
                let checked = check_trainings(row, &self.data.digests);
                checked.map_err(|problem| anyhow!("table {:?}, {problem}", table.name))?;
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
            let columns = table.columns.iter();
            let of_row = columns.map(|_| cells.by_ref().take(trainings).collect());
            rows.push((row.clone(), of_row.collect()));
        }
        Ok(FilledTable {
            name: table.name.clone(),
            columns: table.columns.clone(),
            rows,
        })
    }

    fn cell(
        &self,
        place: &CellPlace<'_>,
        on_cell: &mut dyn FnMut(&str, bool),
        on_frame: &mut dyn FnMut(),
    ) -> Result<Cell> {
        let trial = self.trial(place)?;
        let key = trial.key(&self.data, place.row.method)?;
        let known = Cell::read(&key, &self.cells)?;
        let (table, row, column) = (&place.table.name, place.row.label(), &place.column.name);
        on_cell(&format!("{table}: {row}, {column}"), known.is_some());
        if let Some(cell) = known {
            return Ok(cell);
        }
        let cell = compute(&trial, &self.data, key, on_frame)?;
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

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_training_that_is_named_twice_is_refused_by_whatever_path() {
        let folder = tempfile::tempdir().unwrap();
        for (name, contents) in [("a", "first"), ("b", "second"), ("copy", "first")] {
            fs::write(folder.path().join(name), contents).unwrap();
        }
        let problem = |names: &[&str]| {
            let row = Row {
                weights: names.iter().map(|name| folder.path().join(name)).collect(),
                ..serde_saphyr::from_str("method: max").unwrap()
            };
            let checked = check_trainings(&row, &FileDigests::default()).err();
            checked.map_or(String::new(), |problem| problem.to_string())
        };
        assert_eq!(problem(&["a", "b"]), "");
        for other in ["./a", "copy"] {
            let problem = problem(&["a", "b", other]);
            assert!(problem.contains("row max: weights ") && problem.contains("same contents"));
            assert!(problem.contains(&format!("/{other} have")), "{problem}");
        }
    }
}
