//! `report.html`: figures, table and provenance, in one self-contained file.

use std::fmt::Write as _;

use super::Run;
use super::table::NOTES;
use super::varying::VaryingTable;
use crate::experiment::cell::sources;
use crate::experiment::spec::Experiment;

const STYLE: &str = "body{font:16px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:72rem;padding:0 1rem;\
    color:#282c34;overflow-wrap:anywhere}h1{font-size:1.5rem}h2{font-size:1.15rem;margin-top:2rem}svg{flex:1 1 20rem;min-width:0;height:auto}figure{margin:1rem 0;display:flex;flex-wrap:wrap}\
    .wide{overflow-x:auto}table{border-collapse:collapse;font-size:.8rem;white-space:nowrap}\
    th,td{padding:.2rem .6rem;text-align:right;border-bottom:1px solid #e2e5ea}th{position:sticky;top:0;background:#fff}\
    pre{background:#f5f6f8;padding:1rem;overflow-x:auto;font-size:.85rem}dt{font-weight:600}dd{margin:0 0 .4rem 1rem}";

/// Page of an experiment with the file content `spec`, the SVG of the charts of each figure, and the table of the runs.
// Writing to a string cannot fail.
pub(super) fn page(
    experiment: &Experiment,
    spec: &str,
    runs: &[Run],
    figures: &[Vec<String>],
    table: &VaryingTable,
) -> String {
    let title = match experiment.title.as_str() {
        "" => &experiment.name,
        title => title,
    };
    let mut page = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\n\
         <title>{0}</title><style>{STYLE}</style></head><body>\n<h1>{0}</h1>\n",
        escaped(title)
    );
    let frames = runs.first().map_or(0, |run| run.cell.metrics.frames);
    let _ = writeln!(
        page,
        "<p>{} runs of {frames} frames in simulation time; means over seeds in the figures. The table is \
         <code>{}.csv</code>.</p>",
        runs.len(),
        escaped(&experiment.name)
    );
    if let Some(sentence) = table.sentence() {
        let _ = writeln!(page, "<p>{}</p>", escaped(&sentence));
    }
    for figure in figures {
        let _ = writeln!(page, "<figure>{}</figure>", figure.concat());
    }
    page += &runs_table(table);
    page += "<h2>Columns</h2>\n<dl>\n";
    for (column, note) in NOTES.lines().filter_map(|line| line.split_once(": ")) {
        let _ = writeln!(page, "<dt>{column}</dt><dd>{}</dd>", escaped(note));
    }
    page += "</dl>\n<h2>What it was made of</h2>\n<ul>\n";
    for line in sources(runs.iter().map(|run| &run.cell)) {
        let _ = writeln!(page, "<li>{}</li>", escaped(&line));
    }
    let _ = writeln!(
        page,
        "</ul>\n<h2>Experiment</h2>\n<pre>{}</pre>\n</body></html>",
        escaped(spec)
    );
    page
}

/// The runs: what varies in a table, the best precisions in bold, and the rest in a line.
fn runs_table(table: &VaryingTable) -> String {
    let mut text = "<h2>Runs</h2>\n<div class=\"wide\"><table><thead><tr>".to_owned();
    for column in &table.columns {
        text += &format!("<th>{}</th>", escaped(column));
    }
    text += "</tr></thead><tbody>\n";
    for (line, fields) in table.lines.iter().enumerate() {
        text += "<tr>";
        for (column, field) in fields.iter().enumerate() {
            let field = escaped(field);
            text += &match table.is_best(line, column) {
                true => format!("<td><b>{field}</b></td>"),
                false => format!("<td>{field}</td>"),
            };
        }
        text += "</tr>\n";
    }
    text += "</tbody></table></div>\n";
    let constants = table
        .constants
        .iter()
        .map(|(name, value)| format!("{name} {value}"));
    if !table.constants.is_empty() {
        let constants = escaped(&constants.collect::<Vec<_>>().join(", "));
        text += &format!("<p>The same in all runs: {constants}.</p>\n");
    }
    text
}

/// Text with the special characters of markup escaped.
fn escaped(text: &str) -> String {
    // The ampersand first, or those of the other entities would be escaped once more.
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}
