//! Tables of methods: rows of methods and weights, columns of poses and delays, a cell for each, in Markdown and CSV.
//!
//! Cells are cached one by one by everything that they are made of, so that an interrupted run resumes and a changed row costs only
//! that row.

mod text;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use perception::model_config::DetectorConfig;
use perception::weights::Weights;
use protocol::Dtype;
use support::atomic_file;
use support::cli::NotWritten;
use support::file_digests::FileDigests;
use support::output;
use support::sampling::{distinct, repeated};

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
    /// Number format of transmitted feature values.
    pub dtype: Dtype,
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
    let lacking = experiment.tables.iter().flat_map(|table| {
        data.lacking(table.scenarios.or(experiment.scenarios), experiment.frames)
    });
    distinct(lacking).into_iter().for_each(output::note);
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
        let result = |cell: &Cell| [cell.metrics.ap_global, cell.metrics.ap_frame_order];
        let rows = table.rows.iter();
        let same = rows.filter_map(|(row, columns)| same_results(row, columns, result));
        same.for_each(|same| output::note(format_args!("table {:?}, {same}", table.name)));
        filled.push(table);
    }
    Ok(filled)
}

/// Refuses trainings of a row that are one, by another path or as a copy: their standard deviation would be 0; and
/// trainings of different networks, of which there is no mean.
fn check_trainings(row: &Row, digests: &FileDigests) -> Result<()> {
    let mut known = BTreeMap::new();
    let mut first: Option<(DetectorConfig, &PathBuf)> = None;
    for weights in &row.weights {
        let file = weights_of(weights, row.method, row.boxes.is_some())?;
        // A file that cannot be read is refused where it is used.
        if let Ok(config) = Weights::load(&file).and_then(|file| file.detector_config()) {
            let (network, same) = first.get_or_insert((config.clone(), weights));
            // Names are for reports only.
            network.name.clone_from(&config.name);
            if *network != config {
                let (row, [same, other]) = (row.label(), [*same, weights].map(|it| it.display()));
                bail!("row {row}: weights {same} and {other} are of different networks");
            }
        }
        if let Some(same) = known.insert(digests.of(&file)?, weights) {
            let (row, [same, other]) = (row.label(), [same, weights].map(|file| file.display()));
            bail!("row {row}: weights {same} and {other} have the same contents");
        }
    }
    Ok(())
}

/// Sentence about two trainings of a row with the same results in all columns: they differ in what the row does not use,
/// and are no two samples for a standard deviation.
fn same_results<C, R: PartialEq>(
    row: &Row,
    columns: &[Vec<C>],
    result: impl Fn(&C) -> R,
) -> Option<String> {
    let of = |training: usize| -> Vec<Option<R>> {
        let cells = columns.iter().map(|cells| cells.get(training));
        cells.map(|cell| cell.map(&result)).collect()
    };
    let trainings: Vec<_> = (0..row.weights.len()).map(of).collect();
    let twice = repeated(&trainings)?;
    let results = row.weights.iter().zip(&trainings);
    let mut same = results.filter(|(_, one)| *one == twice);
    let [(first, _), (second, _)] = [same.next()?, same.next()?];
    let (first, second, row) = (first.display(), second.display(), row.label());
    Some(format!(
        "row {row}: weights {first} and {second} have the same average precision in every column"
    ))
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
            dtype: self.experiment.dtype,
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
    fn trainings_with_the_same_results_are_named() {
        let row = Row {
            weights: ["a", "b", "c"].map(PathBuf::from).to_vec(),
            ..serde_saphyr::from_str("method: max").unwrap()
        };
        let same = "row max: weights a and c have the same average precision in every column";
        let named = |second: [f64; 3]| {
            let columns = [vec![0.5, 0.6, 0.5], second.to_vec()];
            same_results(&row, &columns, |one| *one)
        };
        assert_eq!(named([0.7, 0.7, 0.7]).as_deref(), Some(same));
        assert_eq!(named([0.7, 0.7, 0.8]), None);
    }

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
        let released = |name| format!("{}/../weights/{name}", env!("CARGO_MANIFEST_DIR"));
        let others = ["lean-max.safetensors", "half.safetensors"].map(released);
        let networks = problem(&[&others[0], &others[1]]);
        assert!(
            networks.ends_with("half.safetensors are of different networks"),
            "{networks}"
        );
        let same = ["lean-max.safetensors", "lean-max-boxes.safetensors"].map(released);
        assert_eq!(problem(&[&same[0], &same[1]]), "");
        for other in ["./a", "copy"] {
            let problem = problem(&["a", "b", other]);
            assert!(problem.contains("row max: weights ") && problem.contains("same contents"));
            assert!(problem.contains(&format!("/{other} have")), "{problem}");
        }
    }
}
