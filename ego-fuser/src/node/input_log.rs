//! Input log: records what enters the ego's loop, for a replay of its decisions.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use support::record_log::RecordWriter;

use crate::ego_loop::recorded::{KIND, Record};

/// Log of the inputs of one process. Clones write into the same file.
#[derive(Clone)]
pub(super) struct InputLog(Arc<Mutex<Option<RecordWriter<Record>>>>);

impl InputLog {
    /// Creates the file; a process that was restarted gets one with the next number.
    pub(super) fn create(path: &Path, start: &Record) -> Option<Self> {
        let path = unused(path);
        let created = RecordWriter::create(&path, KIND).and_then(|mut writer| {
            writer.add(start)?;
            Ok(writer)
        });
        match created {
            Ok(writer) => Some(Self(Arc::new(Mutex::new(Some(writer))))),
            Err(error) => {
                tracing::error!("inputs are not recorded: {}: {error}", path.display());
                None
            }
        }
    }

    /// Appends a record. After an error nothing more is recorded: a log with a gap could not be replayed.
    pub(super) fn add(&self, record: &Record) {
        let mut writer = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(Err(error)) = writer.as_mut().map(|writer| writer.add(record)) {
            tracing::error!("inputs are no longer recorded: {error}");
            *writer = None;
        }
    }
}

/// The path, or the first `NAME.N.log` beside it that does not exist.
fn unused(path: &Path) -> PathBuf {
    let numbered = (2..).map(|number| path.with_extension(format!("{number}.log")));
    let mut paths = std::iter::once(path.to_owned()).chain(numbered);
    paths
        .find(|path| !path.exists())
        .unwrap_or_else(|| path.to_owned())
}
