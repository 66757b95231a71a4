//! `ego-fuser replay-inputs`: decides again from the recorded inputs of a run.

use std::collections::BTreeMap;
use std::path::PathBuf;

use agent::input_log::RecordedInputs;
use anyhow::Context;
use bus::log_to_stderr;
use protocol::message::{Detections, FrameReport};
use protocol::{Limits, Stream, Tracks};
use serde::Deserialize;
use support::cli::Outcome;
use support::{bounded_file, output};

use crate::config::EgoConfig;
use crate::ego_loop::recorded::{EgoRecord, KIND};
use crate::ego_loop::{EgoLoop, Output};
use crate::node::NodeOptions;

/// Largest file of ground truth, bytes.
const MAX_TRUTH_BYTES: u64 = 1 << 30;

/// Decide again from the recorded inputs of a run: prints its detections.jsonl or tracks.jsonl, byte for byte.
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
    /// Print the tracks in place of the detections.
    #[arg(long)]
    tracks: bool,
}

/// A line of `truth.jsonl`, as far as it is needed.
#[derive(Deserialize)]
struct TruthTick {
    tick: u64,
    capture_nanos: u64,
}

impl Arguments {
    /// Replays the file and prints the results.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        log_to_stderr();
        let ticks = self.ticks()?;
        let (mut records, mut config) = RecordedInputs::open::<EgoConfig>(&self.file, KIND)?;
        if let Some(weights) = &self.weights {
            config.models.weights.clone_from(weights);
        }
        let (cav, mut ego) = super::run::build(&config)?;
        records.check_model(Some(ego.detector()), &config.models.weights)?;
        ego.warm_up(&cav)?;
        let mut ego_loop = EgoLoop::new(&cav, &ego, NodeOptions::from(&config).of_loop);
        // Results wait for the record of their publication, since only the run knows its stamp and durations.
        let mut results: BTreeMap<u64, (Detections, Option<Tracks>)> = BTreeMap::new();
        for record in &mut records {
            let (now_nanos, input) = match record {
                EgoRecord::Input { now_nanos, input } => (now_nanos, input),
                EgoRecord::Published(published) => {
                    if (published.stream == Stream::Tracks) != self.tracks {
                        continue;
                    }
                    let stamp = &published.stamp;
                    let capture_nanos = stamp.capture_nanos;
                    let missing =
                        || format!("no result of the frame captured at {capture_nanos} ns");
                    let (result, tracks) = results.remove(&capture_nanos).with_context(missing)?;
                    let tick = ticks.get(&capture_nanos).copied();
                    output::line(if self.tracks {
                        let tracks = tracks.with_context(missing)?;
                        FrameReport::new(stamp, tick, tracks).to_json()
                    } else {
                        // Durations as measured in the run, not those of the replay.
                        let stages = published.stages;
                        FrameReport::new(stamp, tick, Detections { stages, ..result }).to_json()
                    })?;
                    continue;
                }
                EgoRecord::Start(_) => continue,
            };
            let decoded =
                input.try_map(|message| message.decode(&ego_loop, &Limits::DEFAULT).map(Box::new));
            let input = decoded.with_context(|| {
                let file = self.file.display();
                format!("{file}: a recorded message cannot be decoded")
            })?;
            for output in ego_loop.handle(&mut ego, input, now_nanos) {
                if let Output::Publish {
                    capture_nanos,
                    result,
                    tracks,
                } = output
                {
                    results.insert(capture_nanos, (*result, tracks));
                }
            }
        }
        Ok(records.outcome())
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
            let line = serde_json::from_str(line);
            let line: TruthTick = line.with_context(|| path.display().to_string())?;
            ticks.insert(line.capture_nanos, line.tick);
        }
        Ok(ticks)
    }
}
