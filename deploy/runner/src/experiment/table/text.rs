//! Tables as Markdown and as CSV.

use std::collections::BTreeSet;
use std::fmt::Write as _;

use dataset::evaluation_protocol::ApOrder;
use deploy::operate::run_folder::fixed;
use support::csv_file::CsvText;
use support::statistics;

use super::FilledTable;
use crate::experiment::cell::{Cell, sources};

/// Markdown table: AP@0.3/0.5/0.7 in per cent. A single column of conditions is expanded into both orderings and bytes;
/// several show the ordering of the protocol only. The provenance follows below.
pub fn markdown(table: &FilledTable) -> String {
    let order = cells_of(table).next().map(|cell| cell.metrics.ap_order());
    let mut orders = [ApOrder::Global, ApOrder::Frame];
    // That of the protocol first.
    orders.sort_by_key(|it| Some(*it) != order);
    let [first, other] = orders.map(ApOrder::name);
    let mut text = format!("# {}\n\n", table.name);
    let heads: Vec<String> = match &table.columns[..] {
        [only] => {
            let headline = format!("{}: AP@0.3 / 0.5 / 0.7, {first} order", only.name);
            let other = format!("{other} order");
            vec![headline, other, "bytes per message".into(), "log2".into()]
        }
        several => several.iter().map(|column| column.name.clone()).collect(),
    };
    // Writing to a string cannot fail.
    let _ = writeln!(text, "| method | {} |", heads.join(" | "));
    let _ = writeln!(text, "| --- |{}", " --- |".repeat(heads.len()));
    for (row, cells) in &table.rows {
        let headlines = cells.iter().map(|cells| precision(cells, orders[0]));
        let mut values: Vec<String> = headlines.collect();
        if let [cells] = &cells[..] {
            let payload = mean(cells, 0, &|cell| cell.metrics.comm.payload_bytes_mean);
            let log2 = mean(cells, 2, &|cell| cell.metrics.comm.log2_payload);
            values.extend([precision(cells, orders[1]), payload, log2]);
        }
        let _ = writeln!(text, "| {} | {} |", row.label(), values.join(" | "));
    }
    if table.columns.len() != 1 {
        let _ = writeln!(text, "\nAP@0.3 / 0.5 / 0.7 in the {first} order.");
    }
    text + &provenance(table)
}

fn cells_of(table: &FilledTable) -> impl Iterator<Item = &Cell> {
    let rows = table.rows.iter();
    rows.flat_map(|(_, cells)| cells.iter().flatten())
}

/// Provenance of the values: frames, number format, programs, data, and every other file.
fn provenance(table: &FilledTable) -> String {
    let frames = cells_of(table).map(|cell| cell.metrics.frames.to_string());
    let frames: BTreeSet<String> = frames.collect();
    let dtype = format!("{:?}", table.dtype).to_lowercase();
    let mut text = format!(
        "\nFrames: {}. Feature values are sent as {dtype}. Made of:\n\n",
        Vec::from_iter(frames).join(", ")
    );
    for line in sources(cells_of(table)) {
        let _ = writeln!(text, "- {line}");
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
    for (row, cells) in &table.rows {
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

/// Mean over trainings, and their standard deviation where there are several, as text.
fn mean(cells: &[Cell], digits: usize, value: &dyn Fn(&Cell) -> Option<f64>) -> String {
    // One training without a value makes the mean unknown: that of the others would mislead.
    let values: Option<Vec<f64>> = cells.iter().map(value).collect();
    let values = values.unwrap_or_default();
    let Some(mean) = statistics::mean(&values) else {
        return "-".into();
    };
    if values.len() == 1 {
        return format!("{mean:.digits$}");
    }
    let square: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    // Sample standard deviation, divided by the number of trainings less one.
    let deviation = (square / (values.len() - 1) as f64).sqrt();
    format!("{mean:.digits$} ± {deviation:.digits$}")
}

/// Three precisions in per cent.
fn precision(cells: &[Cell], order: ApOrder) -> String {
    let precisions = [0, 1, 2].map(|index: usize| {
        mean(cells, 2, &|cell| {
            Some(100.0 * cell.metrics.ap_in(order).values()[index]?)
        })
    });
    precisions.join(" / ")
}

#[cfg(test)]
mod tests {
    use fusion::Method;

    use super::*;
    use crate::experiment::cell::CellKey;
    use crate::experiment::spec::{Column, Row};
    use dataset::evaluation_protocol::EvaluationProtocol;
    use deploy::score::metrics::{ByIou, Communication, Metrics};
    use protocol::Dtype;
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
                program_sha256: "p".into(),
                version: "1".into(),
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

    fn filled_row(method: Method, trainings: &[f64], columns: usize) -> (Row, Vec<Vec<Cell>>) {
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
        (row, vec![cells; columns])
    }

    fn table(columns: &[&str]) -> FilledTable {
        FilledTable {
            name: "main".into(),
            dtype: Dtype::F16,
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
    fn the_order_of_the_protocol_is_the_one_of_the_headings() {
        let by_frame = |columns: &[&str]| {
            let mut table = table(columns);
            for cell in table
                .rows
                .iter_mut()
                .flat_map(|(_, cells)| cells.iter_mut().flatten())
            {
                cell.metrics.protocol = EvaluationProtocol::preset("v2v4real");
                cell.metrics.ap_frame_order.at_50 = Some(0.125);
            }
            markdown(&table)
        };
        let one = by_frame(&["true poses"]);
        let head = "true poses: AP@0.3 / 0.5 / 0.7, frame order | global order | bytes";
        assert!(
            one.contains(head) && one.contains("| 90.00 / 12.50 / - | 90.00 / 50.00 / - |"),
            "{one}"
        );
        let several = by_frame(&["0 m", "1 m"]);
        assert!(several.contains("0.7 in the frame order.\n"), "{several}");
        assert!(
            several.contains("| 90.00 / 12.50 / - | 90.00 / 12.50 / - |"),
            "{several}"
        );
    }

    #[test]
    fn several_conditions_are_columns_and_lines_of_the_csv() {
        let table = table(&["0 m", "1 m"]);
        insta::assert_snapshot!(markdown(&table));
        insta::assert_snapshot!(csv(&table));
    }
}
