//! Tables as Markdown and as CSV.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use deploy::score::metrics::ByIou;
use support::csv_file::CsvText;

use super::{Cell, FilledRow, FilledTable};

/// Markdown table: AP@0.3/0.5/0.7 in per cent. A single column of conditions is expanded into both orderings and bytes;
/// several show the global ordering only. The provenance follows below.
#[must_use]
pub fn markdown(table: &FilledTable) -> String {
    let mut text = format!("# {}\n\n", table.name);
    let single = table.columns.len() == 1;
    let heads: Vec<String> = if single {
        let global = format!("{}: AP@0.3 / 0.5 / 0.7, global order", table.columns[0]);
        vec![
            global,
            "frame order".into(),
            "bytes per message".into(),
            "log2".into(),
        ]
    } else {
        table.columns.clone()
    };
    // Writing to a string cannot fail.
    let _ = writeln!(text, "| method | {} |", heads.join(" | "));
    let _ = writeln!(text, "| --- |{}", " --- |".repeat(heads.len()));
    for FilledRow { label, cells } in &table.rows {
        let values: Vec<String> = if single {
            let cells = &cells[0];
            let frame_order = precision(cells, |cell| cell.metrics.ap_frame_order);
            let bytes =
                |digits, value: &dyn Fn(&Cell) -> Option<f64>| number(&mean(cells, value), digits);
            vec![
                precision(cells, |cell| cell.metrics.ap_global),
                frame_order,
                bytes(0, &|cell| cell.metrics.comm.payload_bytes_mean),
                bytes(2, &|cell| cell.metrics.comm.log2_payload),
            ]
        } else {
            cells
                .iter()
                .map(|cells| precision(cells, |cell| cell.metrics.ap_global))
                .collect()
        };
        let _ = writeln!(text, "| {label} | {} |", values.join(" | "));
    }
    if !single {
        text += "\nAP@0.3 / 0.5 / 0.7 in the global order.\n";
    }
    text + &provenance(table)
}

/// Provenance of the values: frames, commits, data and weights.
fn provenance(table: &FilledTable) -> String {
    let cells = || table.rows.iter().flat_map(|row| row.cells.iter().flatten());
    let all = |value: &dyn Fn(&Cell) -> String| {
        let mut values: Vec<String> = cells().map(value).collect();
        values.sort();
        values.dedup();
        values.join(", ")
    };
    let mut text = format!(
        "\nFrames: {}. Commit: {}. Data: contents SHA-256 {}. Weights:\n\n",
        all(&|cell| cell.metrics.frames.to_string()),
        all(&|cell| cell.commit.clone()),
        all(&|cell| format!("`{}`", cell.key.data_sha256)),
    );
    let weights: BTreeMap<String, &Cell> = cells()
        .map(|cell| {
            (
                format!("{} {}", cell.weights.display(), cell.key.weights_sha256),
                cell,
            )
        })
        .collect();
    for cell in weights.values() {
        let _ = writeln!(
            text,
            "- `{}`, SHA-256 `{}`",
            cell.weights.display(),
            cell.key.weights_sha256
        );
    }
    text
}

/// CSV: a line per cell and training.
#[must_use]
pub fn csv(table: &FilledTable) -> String {
    let mut text = CsvText::new(
        "table,row,column,training,method,poses,delay_ms,frames,ap_global_30,ap_global_50,ap_global_70,ap_frame_30,\
         ap_frame_50,ap_frame_70,payload_bytes_mean,log2_payload,pose_mean_m,pose_p95_m,no_pose,commit,weights_sha256,\
         data_sha256",
    );
    for FilledRow { label, cells } in &table.rows {
        for (column, trainings) in table.columns.iter().zip(cells) {
            for (training, cell) in trainings.iter().enumerate() {
                let place = [
                    table.name.clone(),
                    label.clone(),
                    column.clone(),
                    training.to_string(),
                ];
                text.row(place.into_iter().chain(cell_fields(cell)));
            }
        }
    }
    text.finish()
}

fn cell_fields(cell: &Cell) -> Vec<String> {
    let Cell {
        key,
        metrics,
        commit,
        ..
    } = cell;
    let mut fields = vec![
        key.method.to_string(),
        key.poses.name().to_owned(),
        key.delay_ms.to_string(),
    ];
    fields.push(metrics.frames.to_string());
    for ByIou {
        at_30,
        at_50,
        at_70,
    } in [metrics.ap_global, metrics.ap_frame_order]
    {
        fields.extend([at_30, at_50, at_70].map(plain));
    }
    let (comm, pose) = (&metrics.comm, &metrics.pose);
    fields.extend(
        [
            comm.payload_bytes_mean,
            comm.log2_payload,
            pose.mean_m,
            pose.p95_m,
        ]
        .map(plain),
    );
    fields.extend([
        pose.no_pose.to_string(),
        commit.clone(),
        key.weights_sha256.clone(),
        key.data_sha256.clone(),
    ]);
    fields
}

/// Mean over trainings, and their standard deviation where there are several.
fn mean(cells: &[Cell], value: &dyn Fn(&Cell) -> Option<f64>) -> Option<(f64, Option<f64>)> {
    let values: Option<Vec<f64>> = cells.iter().map(value).collect();
    let values = values.filter(|values| !values.is_empty())?;
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let square: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    Some((
        mean,
        (values.len() > 1).then(|| (square / (count - 1.0)).sqrt()),
    ))
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
    let at = |pick: fn(ByIou) -> Option<f64>| {
        number(
            &mean(cells, &|cell| pick(of(cell)).map(|value| 100.0 * value)),
            2,
        )
    };
    [at(|ap| ap.at_30), at(|ap| ap.at_50), at(|ap| ap.at_70)].join(" / ")
}

fn plain(value: Option<f64>) -> String {
    value.map_or(String::new(), |value| format!("{value:.6}"))
}

#[cfg(test)]
mod tests {
    use fusion::Method;
    use localization::pose_source::PoseSourceConfig;

    use dataset::evaluation_protocol::ProtocolConfig;

    use super::super::CellKey;
    use super::*;
    use deploy::score::metrics::{Communication, Metrics};

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
            ..Metrics::default()
        };
        let key = CellKey {
            method,
            weights_sha256: format!("{at_50}"),
            precision: Default::default(),
            data_sha256: "d".into(),
            poses: PoseSourceConfig::Recorded,
            poses_sha256: vec![],
            delay_ms: 0,
            dtype: protocol::Dtype::F16,
            frames: None,
            scenarios: None,
            attack: None,
            trust: None,
            protocol: ProtocolConfig::default(),
            score_threshold: 0.1,
            version: "1".into(),
        };
        Cell {
            key,
            weights: "w.safetensors".into(),
            commit: "abc".into(),
            metrics,
        }
    }

    fn table(columns: &[&str]) -> FilledTable {
        let row = |method: Method, trainings: &[f64]| FilledRow {
            label: format!("{method}, here"),
            cells: columns
                .iter()
                .map(|_| trainings.iter().map(|&at_50| cell(method, at_50)).collect())
                .collect(),
        };
        FilledTable {
            name: "main".into(),
            columns: columns.iter().map(ToString::to_string).collect(),
            rows: vec![row(Method::NONE, &[0.5]), row(Method::PASTAT, &[0.6, 0.8])],
        }
    }

    #[test]
    fn one_condition_shows_both_orderings_and_bytes() {
        let text = markdown(&table(&["true poses"]));
        assert!(
            text.contains("| none, here | 90.00 / 50.00 / - | 90.00 / 50.00 / - | 1024 | 10.00 |"),
            "{text}"
        );
        assert!(text.contains("70.00 ± 14.14"), "{text}");
        assert!(
            text.contains("Commit: abc.") && text.contains("SHA-256 `0.6`") && text.contains("`d`"),
            "{text}"
        );
    }

    #[test]
    fn several_conditions_are_columns_and_lines_of_the_csv() {
        let table = table(&["0 m", "1 m"]);
        let text = markdown(&table);
        assert!(text.contains("| method | 0 m | 1 m |"), "{text}");
        let text = csv(&table);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.len(), 1 + 2 + 4);
        assert!(
            lines[1]
                .starts_with("main,\"none, here\",0 m,0,none,recorded,0,60,0.900000,0.500000,,"),
            "{text}"
        );
        let columns = lines[0].split(',').count();
        assert!(
            lines[1..]
                .iter()
                .all(|line| line.split(',').count() == columns + 1),
            "{text}"
        );
    }
}
