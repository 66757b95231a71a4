//! Columns of a sweep's table that vary, as its report and the terminal show them, and what is seen in them.

use dataset::evaluation_protocol::ApOrder;
use terminal::text_table::{GAP, Side, TextTable};

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
    /// First letters of the columns that are shown first, and in whose highest value a reader is interested.
    precisions: String,
}

impl VaryingTable {
    /// The varying settings, then the precisions in the order of the protocol, then the other varying results.
    pub(super) fn new(columns: &[&str], lines: &[Vec<String>], order: ApOrder) -> Self {
        let prefix = format!("ap_{}_", order.name());
        let is_precision = |place: usize| columns[place].starts_with(&prefix);
        let varies: Vec<bool> = (0..columns.len())
            .map(|place| column(lines, place).any(|it| Some(it) != column(lines, place).next()))
            .collect();
        let settings = columns.iter().position(|column| *column == LAST_SETTING);
        let settings = settings.map_or(0, |last| last + 1);
        let (precisions, others): (Vec<usize>, Vec<usize>) = (settings..columns.len())
            .filter(|&place| varies[place] || is_precision(place))
            .partition(|&place| is_precision(place));
        let varied: Vec<usize> = (0..settings).filter(|&place| varies[place]).collect();
        let kept: Vec<usize> = [&varied[..], &precisions, &others].concat();
        let names = kept.iter().map(|&place| columns[place].to_owned());
        let cells = lines
            .iter()
            .map(|line| kept.iter().map(|&place| line[place].clone()).collect());
        let others = (0..columns.len()).filter(|place| !kept.contains(place));
        let constants = others.filter_map(|place| {
            let value = column(lines, place)
                .next()
                .filter(|value| !value.is_empty())?;
            Some((columns[place].to_owned(), value.to_owned()))
        });
        Self {
            columns: names.collect(),
            lines: cells.collect(),
            constants: constants.collect(),
            settings: varied.len(),
            precisions: prefix,
        }
    }

    /// True if a field is the highest of a column of precisions, where they differ.
    pub(super) fn is_best(&self, line: usize, column: usize) -> bool {
        self.columns[column].starts_with(&self.precisions)
            && self
                .range(column)
                .is_some_and(|(low, high)| low < high && self.number(line, column) == Some(high))
    }

    /// One sentence: the runs with the highest and the lowest AP@0.5.
    pub(super) fn sentence(&self) -> Option<String> {
        let main = format!("{}50", self.precisions);
        let column = self.columns.iter().position(|column| *column == main)?;
        let (low, high) = self.range(column).filter(|(low, high)| low < high)?;
        // Both numbers were read from the same text, so they are equal bit by bit.
        let [worst, best] = [low, high].map(|value| {
            (0..self.lines.len()).find(|&line| self.number(line, column) == Some(value))
        });
        let [worst, best] = [worst?, best?].map(|run| self.settings_of(run));
        Some(format!(
            "{main} is between {low:.3} ({worst}) and {high:.3} ({best})."
        ))
    }

    /// The table for a terminal: settings, precisions, and of the other results those that fit; then the sentence.
    pub(super) fn text(&self) -> String {
        let mut shown: Vec<usize> = (0..self.columns.len())
            .filter(|&at| at < self.settings || self.columns[at].starts_with(&self.precisions))
            .collect();
        let mut used: usize = shown.iter().map(|&place| self.width(place)).sum();
        let results = self.settings..self.columns.len();
        for place in results.filter(|&place| KEY_RESULTS.contains(&self.columns[place].as_str())) {
            // Once a column has no room, those behind it are left out too.
            used += self.width(place);
            if used <= TERMINAL {
                shown.push(place);
            }
        }
        let heads = shown.iter().map(|&place| {
            let is_number = (0..self.lines.len()).all(|line| {
                self.lines[line][place].is_empty() || self.number(line, place).is_some()
            });
            let side = if is_number { Side::Right } else { Side::Left };
            (self.columns[place].as_str(), side)
        });
        let mut table = TextTable::new(heads);
        for line in &self.lines {
            table.row(shown.iter().map(|&place| match line[place].as_str() {
                "" => "-".to_owned(),
                value => value.to_owned(),
            }));
        }
        let sentence = self
            .sentence()
            .map_or(String::new(), |it| format!("{it}\n"));
        format!("{table}{sentence}")
    }

    /// Characters of a column and of the gap beside it.
    fn width(&self, column: usize) -> usize {
        let cells = self.lines.iter().map(|line| line[column].len());
        usize::from(GAP) + cells.chain([self.columns[column].len()]).max().unwrap_or(0)
    }

    fn settings_of(&self, line: usize) -> String {
        let pairs = self.columns.iter().zip(&self.lines[line]);
        let settings = pairs.take(self.settings);
        let given = settings.filter(|(_, value)| !value.is_empty());
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

/// Fields of a column, empty where a line is shorter.
fn column(lines: &[Vec<String>], place: usize) -> impl Iterator<Item = &str> {
    lines
        .iter()
        .map(move |line| line.get(place).map_or("", String::as_str))
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
        let lines = [
            ["max", "", "0", "1", "10", "0.9000", "31"],
            ["max", "", "0.1", "1", "10", "0.8000", "30"],
        ]
        .map(|fields| fields.map(str::to_owned).to_vec());
        let table = VaryingTable::new(&columns, &lines, ApOrder::Global);
        assert_eq!(table.columns, ["loss", "ap_global_50", "e2e_ms_p50"]);
        let constants = [("method", "max"), ("seed", "1"), ("frames", "10")];
        assert_eq!(
            table.constants,
            constants.map(|(name, value)| (name.to_owned(), value.to_owned()))
        );
        assert!(table.is_best(0, 1) && !table.is_best(1, 1) && !table.is_best(0, 2));
        assert_eq!(
            table.sentence().unwrap(),
            "ap_global_50 is between 0.800 (loss 0.1) and 0.900 (loss 0)."
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
        let one = VaryingTable::new(&columns, &lines[..1], ApOrder::Global);
        assert_eq!(one.sentence(), None);
    }

    #[test]
    fn the_order_of_the_protocol_is_the_one_that_is_shown() {
        let columns = ["loss", "seed", "ap_global_50", "ap_frame_50"];
        let lines = [
            ["0", "1", "0.9000", "0.6000"],
            ["0.1", "1", "0.9500", "0.5000"],
        ]
        .map(|fields| fields.map(str::to_owned).to_vec());
        let table = VaryingTable::new(&columns, &lines, ApOrder::Frame);
        assert_eq!(table.columns, ["loss", "ap_frame_50", "ap_global_50"]);
        assert!(table.is_best(0, 1) && !table.is_best(1, 2));
        assert!(
            table.text().starts_with("loss  ap_frame_50\n"),
            "{}",
            table.text()
        );
        assert_eq!(
            table.sentence().unwrap(),
            "ap_frame_50 is between 0.500 (loss 0.1) and 0.600 (loss 0)."
        );
    }
}
