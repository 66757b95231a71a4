//! Input log: records what enters the loop of a process and what it publishes, for a replay of its decisions.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::{Context, bail, ensure};
use perception::detector::Detector;
use protocol::message::ModelHash;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use support::cli::{BadInput, Outcome};
use support::record_log::{RecordReader, RecordWriter};

/// A record of a process whose loop takes inputs `I`.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub enum Record<I, P> {
    /// Beginning of the run.
    Start(Start),
    /// Something that happened to the loop.
    Input {
        /// Time on the loop's clock, nanoseconds.
        now_nanos: u64,
        /// The input.
        input: I,
    },
    /// A message was published: what only its sending thread knows of it.
    Published(P),
}

/// Beginning of a run.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Start {
    /// Configuration of the process, as JSON.
    pub config: String,
    /// Hash of the detector's network; `None`: the process has no detector.
    pub model_hash: Option<ModelHash>,
    /// Version of the program.
    pub version: String,
}

/// File in which the inputs of a loop are recorded, and the configuration of its process as JSON.
pub type InputFile = (PathBuf, String);

/// Log of the inputs of one process. Clones write into the same file.
#[derive(Clone)]
pub struct InputLog<I, P>(Arc<Mutex<Writer<I, P>>>);

/// `None` after an error.
type Writer<I, P> = Option<RecordWriter<Record<I, P>>>;

impl<I: Serialize, P: Serialize> InputLog<I, P> {
    /// Creates a log of that kind; a process that was restarted gets a file with the next number, which is logged. `None`
    /// if it cannot be written, which is logged too.
    pub fn create(file: &InputFile, kind: &str, detector: Option<&Detector>) -> Option<Self> {
        let (wanted, config) = file;
        // The path, or the first `NAME.N.log` beside it that does not exist.
        let numbered = (2..).map(|number| wanted.with_extension(format!("{number}.log")));
        let mut paths = std::iter::once(wanted.to_owned()).chain(numbered);
        let free = paths.find(|path| !path.exists());
        let path = free.unwrap_or_else(|| wanted.to_owned());
        if path != *wanted {
            let [wanted, used] = [wanted, &path].map(|path| path.display());
            tracing::warn!("inputs are recorded in {used}, as {wanted} exists");
        }
        let start = Record::Start(Start {
            config: config.clone(),
            model_hash: detector.map(Detector::model_hash),
            version: env!("CARGO_PKG_VERSION").to_owned(),
        });
        // The beginning is written at once: a log without it cannot be replayed.
        let created = RecordWriter::create(&path, kind).and_then(|mut writer| {
            writer.add(&start)?;
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
    pub fn add(&self, record: &Record<I, P>) {
        let mut writer = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(Err(error)) = writer.as_mut().map(|writer| writer.add(record)) {
            tracing::error!("inputs are no longer recorded: {error}");
            *writer = None;
        }
    }
}

/// Recorded inputs of a process: its records after the first, up to the damage if the file is damaged.
#[derive(Debug)]
pub struct RecordedInputs<I, P> {
    path: PathBuf,
    start: Start,
    records: RecordReader<Record<I, P>>,
    is_whole: bool,
}

impl<I: DeserializeOwned, P: DeserializeOwned> RecordedInputs<I, P> {
    /// Opens a log of that kind; returns the configuration of its process too.
    ///
    /// # Errors
    /// [`BadInput`] for a file that is no such log; a configuration that this version does not read.
    pub fn open<C: DeserializeOwned>(path: &Path, kind: &str) -> anyhow::Result<(Self, C)> {
        let file = path.display();
        let mut records = RecordReader::open(path, kind).map_err(BadInput::of)?;
        let Some(Record::Start(start)) = records.next().transpose().map_err(BadInput::of)? else {
            bail!(BadInput::new(format!("{file}: the beginning is missing")));
        };
        let (version, ours) = (&start.version, env!("CARGO_PKG_VERSION"));
        let config = serde_json::from_str(&start.config)
            .with_context(|| format!("{file}: configuration of version {version}"))?;
        if version != ours {
            tracing::warn!("recorded by version {version}, replayed by {ours}");
        }
        let recorded = Self {
            path: path.to_owned(),
            start,
            records,
            is_whole: true,
        };
        Ok((recorded, config))
    }

    /// Compares the network of a detector with the recorded one.
    ///
    /// # Errors
    /// They are different: names both, and the file of the weights.
    pub fn check_model(&self, detector: Option<&Detector>, weights: &Path) -> anyhow::Result<()> {
        let found = detector.map(Detector::model_hash);
        ensure!(
            found == self.start.model_hash,
            "weights: {} has model_hash {}, the run had {}",
            weights.display(),
            name(found),
            name(self.start.model_hash)
        );
        Ok(())
    }

    /// [`Outcome::DataLost`] if the file was damaged.
    pub fn outcome(&self) -> Outcome {
        Outcome::of(!self.is_whole)
    }
}

fn name(hash: Option<ModelHash>) -> String {
    hash.map_or("none".into(), |hash| hash.to_string())
}

impl<I: DeserializeOwned, P: DeserializeOwned> Iterator for RecordedInputs<I, P> {
    type Item = Record<I, P>;

    fn next(&mut self) -> Option<Self::Item> {
        match self.records.next()? {
            Ok(Record::Start(_)) => {
                tracing::warn!("{}: a second beginning ends it", self.path.display());
            }
            Ok(record) => return Some(record),
            Err(error) => tracing::warn!("the rest is left out: {error}"),
        }
        self.is_whole = false;
        None
    }
}

#[cfg(test)]
mod tests {
    use tracing::span;

    use super::*;

    /// Texts of the events that are logged.
    #[derive(Clone, Default)]
    struct Texts(Arc<Mutex<Vec<String>>>);

    impl tracing::Subscriber for Texts {
        fn enabled(&self, _: &tracing::Metadata<'_>) -> bool {
            true
        }

        fn new_span(&self, _: &span::Attributes<'_>) -> span::Id {
            span::Id::from_u64(1)
        }

        fn record(&self, _: &span::Id, _: &span::Record<'_>) {}

        fn record_follows_from(&self, _: &span::Id, _: &span::Id) {}

        fn event(&self, event: &tracing::Event<'_>) {
            event.record(
                &mut |_: &tracing::field::Field, value: &dyn std::fmt::Debug| {
                    self.0.lock().unwrap().push(format!("{value:?}"));
                },
            );
        }

        fn enter(&self, _: &span::Id) {}

        fn exit(&self, _: &span::Id) {}
    }

    #[test]
    fn a_restarted_process_has_a_log_of_its_own_and_damage_is_reported() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("inputs-agent-1.log");
        let file = (path.clone(), "[5]".to_owned());
        let first = InputLog::<u8, String>::create(&file, "words", None).unwrap();
        let texts = Texts::default();
        let second = tracing::subscriber::with_default(texts.clone(), || {
            InputLog::create(&file, "words", None).unwrap()
        });
        let next = folder.path().join("inputs-agent-1.2.log");
        let [wanted, used] = [&path, &next].map(|path| path.display());
        let notice = format!("inputs are recorded in {used}, as {wanted} exists");
        assert_eq!(*texts.0.lock().unwrap(), [notice]);
        for log in [&first, &second] {
            log.add(&Record::Input {
                now_nanos: 9,
                input: 3,
            });
            log.add(&Record::Published("three".to_owned()));
        }
        let bytes = std::fs::read(&next).unwrap();
        std::fs::write(&next, &bytes[..bytes.len() - 1]).unwrap();
        for (path, whole) in [(&path, true), (&next, false)] {
            let (mut recorded, config) =
                RecordedInputs::<u8, String>::open::<Vec<i32>>(path, "words").unwrap();
            assert_eq!(config, [5]);
            recorded.check_model(None, Path::new("weights")).unwrap();
            let first = recorded.next().unwrap();
            assert!(matches!(
                first,
                Record::Input {
                    now_nanos: 9,
                    input: 3
                }
            ));
            assert_eq!(recorded.by_ref().count(), usize::from(whole));
            assert_eq!(recorded.outcome(), Outcome::of(!whole));
        }
        assert!(RecordedInputs::<u8, String>::open::<Vec<i32>>(&path, "numbers").is_err());
    }
}
