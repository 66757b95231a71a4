//! `agent replay-inputs`: publishes again from the recorded inputs of a run.

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::{Context, ensure};
use bus::log_to_stderr;
use protocol::Stream;
use support::cli::Outcome;
use support::output;

use crate::agent_loop::recorded::{AgentRecord, KIND, Published};
use crate::agent_loop::{AgentLoop, LoopInput, LoopOutput, MessageEncoder, Unsent};
use crate::config::AgentConfig;
use crate::input_log::RecordedInputs;

/// Compute again from the recorded inputs of a run: prints stamp, size and SHA-256 of every published message.
///
/// `v2vloc up` records them with `record: {inputs: true}`. Every message is compared with that of the run. They differ
/// only if the program, the weights or the maps do (exit code 1).
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Recorded inputs: `inputs-agent-ID.log` of a run folder.
    file: PathBuf,
    /// Weights in place of those that the run names.
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
}

/// A run that is replayed.
struct InputReplay {
    agent_loop: AgentLoop,
    encoder: MessageEncoder,
    /// Messages that are not published, or not yet, by stream and number.
    unsent: BTreeMap<(Stream, u64), Box<Unsent>>,
}

impl Arguments {
    /// Replays the file and prints the messages.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        log_to_stderr();
        let (mut records, mut config) =
            RecordedInputs::<LoopInput, Published>::open::<AgentConfig>(&self.file, KIND)?;
        if let Some(weights) = self.weights {
            config.models.weights = weights;
        }
        let agent = super::run::agent(&config)?;
        records.check_model(agent.detector(), &config.models.weights)?;
        let options = config.options().of_loop;
        let mut replay = InputReplay {
            encoder: MessageEncoder::new(&options),
            agent_loop: AgentLoop::new(agent, options),
            unsent: BTreeMap::new(),
        };
        let (mut messages, mut differing) = (0, 0);
        for record in &mut records {
            match record {
                AgentRecord::Input { now_nanos, input } => replay.take_in(input, now_nanos),
                AgentRecord::Published(recorded) => {
                    let again = replay.publish(&recorded)?;
                    output::line(serde_json::to_string(&again)?)?;
                    messages += 1;
                    if again != recorded {
                        differing += 1;
                        tracing::error!("the run published {recorded:?}, the replay {again:?}");
                    }
                }
                // Not yielded: a second beginning ends the records.
                AgentRecord::Start(_) => {}
            }
        }
        ensure!(
            differing == 0,
            "{differing} of {messages} messages differ from those of the run"
        );
        Ok(records.outcome())
    }
}

impl InputReplay {
    fn take_in(&mut self, input: LoopInput, now_nanos: u64) {
        for output in self.agent_loop.handle(input, now_nanos) {
            if let LoopOutput::Publish(message) = output {
                self.unsent
                    .insert((message.stream, message.number), message);
            }
        }
    }

    /// Publishes a message as the run did, at the same turn and under the same stamp.
    fn publish(&mut self, recorded: &Published) -> anyhow::Result<Published> {
        let (stream, turn, stamp) = (recorded.stream, recorded.turn, &recorded.stamp);
        let message = self.unsent.remove(&(stream, turn.number));
        let message = message.with_context(|| {
            let number = turn.number;
            format!("the run published message {number} of {stream}, the replay does not")
        })?;
        // Earlier ones were superseded in the queue.
        self.unsent
            .retain(|&(of, number), _| of != stream || number > turn.number);
        let encoded = self.encoder.encode(message, stamp, Some(&turn));
        let bytes = encoded.as_ref().ok().map(|(encoded, _)| encoded);
        Ok(Published::new(stream, turn, stamp, bytes))
    }
}
