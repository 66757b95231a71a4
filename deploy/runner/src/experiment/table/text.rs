//! Tables as Markdown and as CSV.

use std::collections::BTreeSet;
use std::fmt::Write as _;

use deploy::operate::run_folder::fixed;
use deploy::score::metrics::ByIou;
use support::csv_file::CsvText;

use super::{FilledRow, FilledTable};
use crate::experiment::cell::Cell;

/// Markdown table: AP@0.3/0.5/0.7 in per cent. A single column of conditions is expanded into both orderings and bytes;
/// several show the global ordering only. The provenance follows below.
pub fn markdown(table: &FilledTable) -> String {
    let mut text = format!("# {}\n\n", table.name);
    let heads: Vec<String> = match &table.columns[..] {
        [only] => {
            let global = format!("{}: AP@0.3 / 0.5 / 0.7, global order", only.name);
            let others = ["frame order", "bytes per message", "log2"].map(str::to_owned);
            [global].into_iter().chain(others).collect()
        }
        several => several.iter().map(|column| column.name.clone()).collect(),
    };
    // Writing to a string cannot fail.
    let _ = writeln!(text, "| method | {} |", heads.join(" | "));
    let _ = writeln!(text, "| --- |{}", " --- |".repeat(heads.len()));
    for FilledRow { row, cells } in &table.rows {
        let global = cells.iter();
        let global = global.map(|of| precision(of, |cell| cell.metrics.ap_global));
        let mut values: Vec<String> = global.collect();
        if let [cells] = &cells[..] {
            let payload = mean(cells, &|cell| cell.metrics.comm.payload_bytes_mean);
            let log2 = mean(cells, &|cell| cell.metrics.comm.log2_payload);
            values.extend([
                precision(cells, |cell| cell.metrics.ap_frame_order),
                number(&payload, 0),
                number(&log2, 2),
            ]);
        }
        let _ = writeln!(text, "| {} | {} |", row.label(), values.join(" | "));
    }
    if table.columns.len() != 1 {
        text += "\nAP@0.3 / 0.5 / 0.7 in the global order.\n";
    }
    text + &provenance(table)
}

/// Provenance of the values: frames, programs, data, and every other file.
fn provenance(table: &FilledTable) -> String {
    let (mut frames, mut programs, mut data) = (BTreeSet::new(), BTreeSet::new(), BTreeSet::new());
    let mut files = BTreeSet::new();
    for cell in table.rows.iter().flat_map(|row| row.cells.iter().flatten()) {
        let of = &cell.key.provenance;
        let (version, commit, sha256) = (&of.version, &of.commit, &of.program_sha256);
        frames.insert(cell.metrics.frames.to_string());
        programs.insert(format!("{version}, commit {commit}, SHA-256 `{sha256}`"));
        data.insert(format!("`{}`", of.data_sha256));
        files.extend(&of.files_sha256);
    }
    let [frames, programs, data] =
        [frames, programs, data].map(|values| Vec::from_iter(values).join(", "));
    let mut text = format!(
        "\nFrames: {frames}. Program: {programs}. Data: contents SHA-256 {data}. Weights and other files:\n\n"
    );
    for (file, sha256) in files {
        let _ = writeln!(text, "- `{}`, SHA-256 `{sha256}`", file.display());
    }
    text
}

/// CSV: a line per cell and training.
pub fn csv(table: &FilledTable) -> String {
    let mut text = CsvText::new(
        "table,row,column,training,method,poses,delay_ms,frames,ap_global_30,ap_global_50,ap_global_70,ap_frame_30,\
         ap_frame_50,ap_frame_70,payload_bytes_mean,log2_payload,pose_mean_m,pose_p95_m,no_pose,commit,program_sha256,\
         data_sha256,files_sha256",
    );
    for FilledRow { row, cells } in &table.rows {
        for (column, trainings) in table.columns.iter().zip(cells) {
            for (training, cell) in trainings.iter().enumerate() {
                let place = [
                    table.name.clone(),
                    row.label(),
                    column.name.clone(),
                    training.to_string(),
                    row.method.to_string(),
                    cell.metrics.pose_source.clone(),
                    column.delay_ms.to_string(),
                ];
                text.row(place.into_iter().chain(cell_fields(cell)));
            }
        }
    }
    text.finish()
}

fn cell_fields(cell: &Cell) -> Vec<String> {
    let Cell { key, metrics, .. } = cell;
    let mut fields = vec![metrics.frames.to_string()];
    for ap in [metrics.ap_global, metrics.ap_frame_order] {
        fields.extend(ap.values().map(|value| fixed(value, 6)));
    }
    let (comm, pose, of) = (&metrics.comm, &metrics.pose, &key.provenance);
    let numbers = [
        comm.payload_bytes_mean,
        comm.log2_payload,
        pose.mean_m,
        pose.p95_m,
    ];
    fields.extend(numbers.map(|value| fixed(value, 6)));
    let files: Vec<&str> = of.files_sha256.values().map(String::as_str).collect();
    fields.extend([
        pose.no_pose.to_string(),
        of.commit.clone(),
        of.program_sha256.clone(),
        of.data_sha256.clone(),
        files.join(" "),
    ]);
    fields
}

/// Mean over trainings, and their standard deviation where there are several.
fn mean(cells: &[Cell], value: &dyn Fn(&Cell) -> Option<f64>) -> Option<(f64, Option<f64>)> {
    // One training without a value makes the mean unknown: that of the others would mislead.
    let values: Option<Vec<f64>> = cells.iter().map(value).collect();
    let values = values.filter(|values| !values.is_empty())?;
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let square: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    // Sample standard deviation, divided by the number of trainings less one.
    let deviation = (values.len() > 1).then(|| (square / (count - 1.0)).sqrt());
    Some((mean, deviation))
}

fn number(value: &Option<(f64, Option<f64>)>, digits: usize) -> String {
    match value {
        None => "-".into(),
        Some((mean, None)) => format!("{mean:.digits$}"),
        Some((mean, Some(deviation))) => format!("{mean:.digits$} ± {deviation:.digits$}"),
    }
}

/// Three precisions in per cent.
fn precision(cells: &[Cell], of: impl Fn(&Cell) -> ByIou) -> String {
    let precisions = [0, 1, 2].map(|index: usize| {
        let percent = mean(cells, &|cell| Some(100.0 * of(cell).values()[index]?));
        number(&percent, 2)
    });
    precisions.join(" / ")
}

#[cfg(test)]
mod tests {
    use fusion::Method;

    use super::*;
    use crate::experiment::cell::CellKey;
    use crate::experiment::spec::{Column, Row};
    use deploy::score::metrics::{Communication, Metrics};
    use support::provenance::Provenance;

    fn cell(method: Method, at_50: f64) -> Cell {
        let ap = ByIou {
            at_30: Some(0.9),
            at_50: Some(at_50),
            at_70: None,
        };
        let metrics = Metrics {
            clock: "offline".into(),
            ap_global: ap,
            ap_frame_order: ap,
            comm: Communication {
                payload_bytes_mean: Some(1024.0),
                log2_payload: Some(10.0),
                ..Communication::default()
            },
            frames: 60,
            method: method.name().into(),
            pose_source: "recorded".into(),
            ..Metrics::default()
        };
        let weights = ("w.safetensors".into(), format!("{at_50}"));
        let key = CellKey {
            method,
            sha256: "c".into(),
            provenance: Provenance {
                commit: "abc".into(),
                data_sha256: "d".into(),
                files_sha256: [weights].into(),
                ..Provenance::default()
            },
        };
        Cell {
            key,
            metrics,
            used: 0,
            messages: Default::default(),
            wall_seconds: 0.0,
        }
    }

    fn column(name: &str) -> Column {
        Column {
            name: name.into(),
            poses: None,
            delay_ms: 0,
            attack: None,
            trust: false,
        }
    }

    fn filled_row(method: Method, trainings: &[f64], columns: usize) -> FilledRow {
        let row = Row {
            name: Some(format!("{method}, here")),
            method,
            weights: vec![],
            poses: None,
            vehicles: None,
            neighbour_weights: None,
            boxes: None,
            box_alignment: false,
        };
        let cells: Vec<Cell> = trainings.iter().map(|&at_50| cell(method, at_50)).collect();
        FilledRow {
            row,
            cells: vec![cells; columns],
        }
    }

    fn table(columns: &[&str]) -> FilledTable {
        FilledTable {
            name: "main".into(),
            columns: columns.iter().map(|name| column(name)).collect(),
            rows: vec![
                filled_row(Method::NONE, &[0.5], columns.len()),
                filled_row(Method::PASTAT, &[0.6, 0.8], columns.len()),
            ],
        }
    }

    #[test]
    fn one_condition_shows_both_orderings_and_bytes() {
        insta::assert_snapshot!(markdown(&table(&["true poses"])));
    }

    #[test]
    fn several_conditions_are_columns_and_lines_of_the_csv() {
        let table = table(&["0 m", "1 m"]);
        insta::assert_snapshot!(markdown(&table));
        insta::assert_snapshot!(csv(&table));
    }
}
