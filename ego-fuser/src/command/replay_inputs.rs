//! `ego-fuser replay-inputs`: decides again from the recorded inputs of a run.

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::{Context, bail, ensure};
use bus::log_to_stderr;
use protocol::Limits;
use protocol::message::{Detections, DetectionsReport};
use serde::Deserialize;
use support::cli::{BadInput, Outcome};
use support::record_log::RecordReader;
use support::{bounded_file, output};

use crate::config::EgoConfig;
use crate::ego::Ego;
use crate::ego_loop::recorded::{KIND, Record};
use crate::ego_loop::{EgoLoop, Output};
use crate::node::NodeOptions;

/// Largest file of ground truth, bytes.
const MAX_TRUTH_BYTES: u64 = 1 << 30;

/// Decide again from the recorded inputs of a run: prints its detections.jsonl, byte for byte.
///
/// `v2vloc up` records them with `record: {inputs: true}`. Results differ only if the program or the weights do.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Recorded inputs: `inputs-ego-ID.log` of a run folder.
    file: PathBuf,
    /// Weights in place of those that the run names.
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    /// File with the tick of each capture time. Default: truth.jsonl of the run folder, if there is one.
    #[arg(long, value_name = "FILE")]
    truth: Option<PathBuf>,
}

/// A line of `truth.jsonl`, as far as it is needed.
#[derive(Deserialize)]
struct Tick {
    tick: u64,
    capture_nanos: u64,
}

impl Arguments {
    /// Replays the file and prints the results.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        log_to_stderr();
        let ticks = self.ticks()?;
        let mut records = RecordReader::<Record>::open(&self.file, KIND).map_err(BadInput::of)?;
        let (mut ego, mut ego_loop) = self.beginning(records.next())?;
        let mut results: BTreeMap<u64, Detections> = BTreeMap::new();
        let mut is_whole = true;
        for record in records {
            let (now_nanos, input) = match record {
                Ok(Record::Input { now_nanos, input }) => (now_nanos, input),
                Ok(Record::Published { stamp, stages }) => {
                    let capture_nanos = stamp.capture_nanos;
                    let result = results.remove(&capture_nanos).with_context(|| {
                        format!("no result of the frame captured at {capture_nanos} ns")
                    })?;
                    let tick = ticks.get(&capture_nanos).copied();
                    let result = Detections { stages, ..result };
                    output::line(DetectionsReport::new(&stamp, tick, result).to_json())?;
                    continue;
                }
                Ok(Record::Start { .. }) => bail!("{}: a second beginning", self.file.display()),
                Err(error) => {
                    tracing::warn!("the rest is left out: {error}");
                    is_whole = false;
                    break;
                }
            };
            let decoded =
                input.try_map(|message| message.decode(&ego_loop, &Limits::DEFAULT).map(Box::new));
            let Ok(input) = decoded else {
                bail!(
                    "{}: a recorded message cannot be decoded",
                    self.file.display()
                );
            };
            for output in ego_loop.handle(&mut ego, input, now_nanos) {
                if let Output::Publish {
                    capture_nanos,
                    result,
                } = output
                {
                    results.insert(capture_nanos, *result);
                }
            }
        }
        Ok(Outcome::of(!is_whole))
    }

    /// Ego and loop at the beginning of the run.
    fn beginning(
        &self,
        first: Option<Result<Record, support::file_error::FileError>>,
    ) -> anyhow::Result<(Ego, EgoLoop)> {
        let file = self.file.display();
        let Some(Record::Start {
            config,
            model_hash,
            version,
        }) = first.transpose().map_err(BadInput::of)?
        else {
            bail!(BadInput::new(format!("{file}: the beginning is missing")));
        };
        let mut config: EgoConfig = serde_json::from_str(&config)
            .with_context(|| format!("{file}: configuration of version {version}"))?;
        if let Some(weights) = &self.weights {
            config.models.weights.clone_from(weights);
        }
        let (cav, mut ego) = super::run::build(&config)?;
        let found = ego.detector().model_hash();
        ensure!(
            found == model_hash,
            "weights: {} has model_hash {found}, the run had {model_hash}",
            config.models.weights.display()
        );
        let ours = env!("CARGO_PKG_VERSION");
        if version != ours {
            tracing::warn!("recorded by version {version}, replayed by {ours}");
        }
        ego.warm_up(&cav)?;
        let ego_loop = EgoLoop::new(&cav, &ego, NodeOptions::from(&config).of_loop);
        Ok((ego, ego_loop))
    }

    /// Tick by capture time, nanoseconds.
    fn ticks(&self) -> anyhow::Result<BTreeMap<u64, u64>> {
        let of_run = Some(self.file.with_file_name("truth.jsonl"));
        let Some(path) = self.truth.clone().or(of_run.filter(|path| path.exists())) else {
            return Ok(BTreeMap::new());
        };
        let text = bounded_file::read_text(&path, MAX_TRUTH_BYTES);
        let text = text.with_context(|| path.display().to_string())?;
        let mut ticks = BTreeMap::new();
        for line in text.lines() {
            let Tick {
                tick,
                capture_nanos,
            } = serde_json::from_str(line).with_context(|| path.display().to_string())?;
            ticks.insert(capture_nanos, tick);
        }
        Ok(ticks)
    }
}
