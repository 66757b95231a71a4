use deploy::score::metrics::{ByIou, Communication, Messages, Metrics};
use support::provenance::Provenance;

use super::*;
use crate::experiment::cell::{Cell, CellKey};
use crate::experiment::sweep::points;

/// An experiment with a grid, and its runs of 1024 bytes a message; each has a higher AP than the one before.
pub(in crate::experiment::sweep) fn runs(grid: &str) -> (Experiment, Vec<Run>) {
    let text = format!("name: e\ndataset: d\nweights: w\ngrid: {grid}\n");
    let experiment: Experiment = serde_saphyr::from_str(&text).unwrap();
    let runs = points(&experiment).into_iter().zip(1..);
    let runs = runs.map(|(point, place)| {
        let precision = Some(0.1 * f64::from(place));
        let ap_global = ByIou {
            at_30: precision,
            at_50: precision,
            at_70: precision,
        };
        let key = CellKey {
            method: point.method,
            sha256: String::new(),
            provenance: Provenance::default(),
        };
        let metrics = Metrics {
            ap_global,
            comm: Communication::of(&[(1024, 1100)], 1),
            ..Metrics::default()
        };
        let cell = Cell {
            key,
            metrics,
            used: 1,
            messages: Messages::default(),
            wall_seconds: 0.0,
        };
        Run { point, cell }
    });
    let runs = runs.collect();
    (experiment, runs)
}

#[test]
fn a_seed_that_the_grid_does_not_have_is_empty() {
    let place = COLUMNS.split(',').position(|name| name == "seed").unwrap();
    for (grid, seed) in [("{method: [max]}", ""), ("{method: [max], seed: [7]}", "7")] {
        let (experiment, runs) = runs(grid);
        assert_eq!(line(&experiment, &runs[0])[place], seed, "{grid}");
    }
}

#[test]
fn the_values_of_a_map_are_counted_only_where_the_bytes_give_their_number() {
    let codecs = "[{dtype: f16}, {dtype: f16, keep: 1}, {dtype: f16, keep: 0.5}, {dtype: f16, boxes: only}, \
                  {dtype: f16, boxes: beside}, {dtype: f16, zstd_level: 3}]";
    let grid = format!("{{method: [max], reference: [where2comm, late], codec: {codecs}}}");
    let (experiment, runs) = runs(&grid);
    let place = COLUMNS.split(',').position(|name| name == "log2_fp32");
    let lines = runs.iter().map(|run| line(&experiment, run));
    let values: Vec<String> = lines.map(|line| line[place.unwrap()].clone()).collect();
    assert_eq!(values, ["11.0000", "11.0000", "", "", "", "", "", ""]);
}
