//! Columns of a sweep's table that vary, as its report and the terminal show them, and what is seen in them.

use terminal::text_table::{GAP, Side, TextTable};

/// Columns that are shown first, and in whose highest value a reader is interested.
const PRECISIONS: [&str; 3] = ["ap_global_30", "ap_global_50", "ap_global_70"];
/// The one that the sentence is about.
const MAIN: &str = "ap_global_50";
/// Characters of a line of a terminal.
const TERMINAL: usize = 120;
/// Further results, shown as far as a line has room for them.
const KEY_RESULTS: [&str; 4] = ["log2_wire", "e2e_ms_p50", "e2e_ms_p95", "frames_used"];
/// Last column that an experiment sets; those after it are results.
const LAST_SETTING: &str = "seed";

/// A table without the columns that are the same in every run.
#[derive(Debug, PartialEq)]
pub(super) struct VaryingTable {
    pub(super) columns: Vec<String>,
    pub(super) lines: Vec<Vec<String>>,
    /// Name and value of the other columns that have one.
    pub(super) constants: Vec<(String, String)>,
    /// Number of the columns that the experiment sets.
    settings: usize,
}

impl VaryingTable {
    /// The varying settings, then precisions, then the other varying results.
    pub(super) fn new(columns: &[&str], lines: &[Vec<String>]) -> Self {
        let values = |place: usize| {
            lines
                .iter()
                .map(move |line| line.get(place).map_or("", String::as_str))
        };
        let varies = |place: usize| values(place).any(|value| Some(value) != values(place).next());
        let settings = columns
            .iter()
            .position(|column| *column == LAST_SETTING)
            .map_or(0, |last| last + 1);
        let is_shown = |place: &usize| varies(*place) || PRECISIONS.contains(&columns[*place]);
        let (precisions, others): (Vec<usize>, Vec<usize>) = (settings..columns.len())
            .filter(is_shown)
            .partition(|&place| PRECISIONS.contains(&columns[place]));
        let varied: Vec<usize> = (0..settings).filter(|&place| varies(place)).collect();
        let kept: Vec<usize> = [&varied[..], &precisions, &others].concat();
        let constant = |place: usize| {
            let value = values(place).next().filter(|value| !value.is_empty())?;
            Some((columns[place].to_owned(), value.to_owned()))
        };
        let names = kept.iter().map(|&place| columns[place].to_owned());
        let cells = |line: &Vec<String>| kept.iter().map(|&place| line[place].clone()).collect();
        let others = (0..columns.len()).filter(|place| !kept.contains(place));
        Self {
            columns: names.collect(),
            lines: lines.iter().map(cells).collect(),
            constants: others.filter_map(constant).collect(),
            settings: varied.len(),
        }
    }

    /// True if a field is the highest of a column of precisions, where they differ.
    pub(super) fn is_best(&self, line: usize, column: usize) -> bool {
        PRECISIONS.contains(&self.columns[column].as_str())
            && self
                .range(column)
                .is_some_and(|(low, high)| low < high && self.number(line, column) == Some(high))
    }

    /// One sentence: the runs with the highest and the lowest AP@0.5.
    pub(super) fn sentence(&self) -> Option<String> {
        let column = self.columns.iter().position(|column| column == MAIN)?;
        let (low, high) = self.range(column).filter(|(low, high)| low < high)?;
        let run_with = |value: f64| {
            // Both numbers were read from the same text, so they are equal bit by bit.
            (0..self.lines.len()).find(|&line| self.number(line, column) == Some(value))
        };
        let [worst, best] = [run_with(low)?, run_with(high)?].map(|run| self.settings_of(run));
        Some(format!(
            "AP@0.5 is between {low:.3} ({worst}) and {high:.3} ({best})."
        ))
    }

    /// The table for a terminal: settings, precisions, and of the other results those that fit; then the sentence.
    pub(super) fn text(&self) -> String {
        let name = |place: usize| self.columns[place].as_str();
        let width = |place: usize| {
            let cells = self.lines.iter().map(|line| line[place].len());
            usize::from(GAP) + cells.chain([name(place).len()]).max().unwrap_or(0)
        };
        let mut shown: Vec<usize> = (0..self.columns.len())
            .filter(|&place| place < self.settings || PRECISIONS.contains(&name(place)))
            .collect();
        let mut used: usize = shown.iter().map(|&place| width(place)).sum();
        for place in
            (self.settings..self.columns.len()).filter(|&place| KEY_RESULTS.contains(&name(place)))
        {
            // Once a column has no room, those behind it are left out too.
            used += width(place);
            if used <= TERMINAL {
                shown.push(place);
            }
        }
        let side = |place: usize| {
            let is_number = (0..self.lines.len()).all(|line| {
                self.lines[line][place].is_empty() || self.number(line, place).is_some()
            });
            if is_number { Side::Right } else { Side::Left }
        };
        let heads = shown.iter().map(|&place| (name(place), side(place)));
        let mut table = TextTable::new(heads);
        for line in &self.lines {
            table.row(shown.iter().map(|&place| match line[place].as_str() {
                "" => "-".to_owned(),
                value => value.to_owned(),
            }));
        }
        let sentence = self
            .sentence()
            .map_or(String::new(), |sentence| format!("{sentence}\n"));
        format!("{table}{sentence}")
    }

    fn settings_of(&self, line: usize) -> String {
        let pairs = self
            .columns
            .iter()
            .zip(&self.lines[line])
            .take(self.settings);
        let given = pairs.filter(|(_, value)| !value.is_empty());
        let texts = given.map(|(name, value)| format!("{name} {value}"));
        texts.collect::<Vec<_>>().join(", ")
    }

    fn number(&self, line: usize, column: usize) -> Option<f64> {
        self.lines[line][column].parse().ok()
    }

    fn range(&self, column: usize) -> Option<(f64, f64)> {
        let numbers = (0..self.lines.len()).filter_map(|line| self.number(line, column));
        numbers
            .map(|number| (number, number))
            .reduce(|(low, high), (number, _)| (low.min(number), high.max(number)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn common_settings_are_printed_once_and_the_best_run_is_named() {
        let columns = [
            "method",
            "zstd",
            "loss",
            "seed",
            "frames",
            "ap_global_50",
            "e2e_ms_p50",
        ];
        let line = |fields: [&str; 7]| fields.map(str::to_owned).to_vec();
        let lines = [
            line(["max", "", "0", "1", "10", "0.9000", "31"]),
            line(["max", "", "0.1", "1", "10", "0.8000", "30"]),
        ];
        let table = VaryingTable::new(&columns, &lines);
        assert_eq!(table.columns, ["loss", "ap_global_50", "e2e_ms_p50"]);
        let constants = [("method", "max"), ("seed", "1"), ("frames", "10")];
        assert_eq!(
            table.constants,
            constants.map(|(name, value)| (name.to_owned(), value.to_owned()))
        );
        assert!(table.is_best(0, 1) && !table.is_best(1, 1) && !table.is_best(0, 2));
        assert_eq!(
            table.sentence().unwrap(),
            "AP@0.5 is between 0.800 (loss 0.1) and 0.900 (loss 0)."
        );
        let text = table.text();
        assert_eq!(
            text.lines().next().unwrap(),
            "loss  ap_global_50  e2e_ms_p50"
        );
        assert!(
            text.ends_with("0.900 (loss 0).\n") && text.lines().count() == 4,
            "{text}"
        );
        assert_eq!(VaryingTable::new(&columns, &lines[..1]).sentence(), None);
    }
}
