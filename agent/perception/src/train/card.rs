//! Model card: training, data and accuracy of a weights file.

use std::fmt::{Display, Write};
use std::path::Path;

use serde::Serialize;
use support::file_error::{AtFile, FileError};

use super::run_config::RunConfig;
use super::trainer::Trained;

/// A model card in Markdown: a title, a sentence, a table, and further paragraphs.
#[derive(Debug)]
pub struct ModelCard {
    text: String,
}

impl ModelCard {
    /// A card with an empty table.
    pub fn new(title: &str, about: &str) -> Self {
        let text = format!("# {title}\n\n{about}\n\n| | |\n| --- | --- |\n");
        Self { text }
    }

    /// Appends a row to the table.
    pub fn row(&mut self, name: &str, value: impl Display) {
        // Writing into a string cannot fail.
        let _ = writeln!(self.text, "| {name} | {value} |");
    }

    /// The rows that every card has; `data` describes the training data, `unit` the elements of a batch.
    pub fn trained(&mut self, run: &RunConfig, trained: &Trained, data: &str, unit: &str) {
        self.row("command", format_args!("`{}`", run.command));
        self.row("parameters", trained.parameters);
        self.row("weights", format_args!("SHA-256 `{}`", trained.sha256));
        let data = format!("{data}, contents SHA-256 `{}`", trained.data.sha256);
        self.row("data", data);
        if let Some(left_out) = trained.data.left_out() {
            self.row("left out", left_out);
        }
        self.row("seed", run.seed);
        let steps = format!("{} of {} {unit}", trained.steps, run.batch);
        self.row("steps", steps);
        self.row("numbers", format_args!("{:?}", run.precision));
        self.row("time", format_args!("{:.0} s", trained.seconds));
    }

    /// Appends a paragraph or a table.
    pub fn paragraph(&mut self, text: &str) {
        let _ = writeln!(self.text, "\n{text}");
    }

    /// Appends the configuration of the network.
    pub fn configuration(&mut self, config: &impl Serialize) {
        self.configuration_json(&serde_json::to_string_pretty(config).unwrap_or_default());
    }

    /// Appends the configuration, given as JSON text.
    pub fn configuration_json(&mut self, json: &str) {
        self.paragraph(&format!("Configuration:\n\n```json\n{json}\n```"));
    }

    /// Writes it into the folder of the weights.
    ///
    /// # Errors
    /// [`FileError`] when the file cannot be written.
    pub fn write(&self, out: &Path) -> Result<(), FileError> {
        let path = out.join("model-card.md");
        support::atomic_file::write(&path, &self.text).at(&path)
    }
}
