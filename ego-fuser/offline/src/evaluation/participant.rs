//! Participant of an evaluation: the [loop](AgentLoop) of a vehicle, the same as in the live process, at given times.

use std::time::Duration;

use agent::agent::Agent;
use agent::agent_loop::{AgentLoop, LoopInput, LoopOptions, LoopOutput, MessageEncoder, Sweep};
use agent::attack::CapturedMessages;
use dataset::frame::Frame;
use protocol::{CavId, Limits, StageTiming, Stamp, Stream, wire};
use tch::Tensor;

use super::EvaluateError;
use super::sent::{Replies, Sent};

pub(super) struct Participant {
    agent_loop: AgentLoop,
    encoder: MessageEncoder,
    /// Streams that it publishes, in the order of sending.
    streams: Vec<Stream>,
    /// True if its network is not that of the run.
    has_own_network: bool,
    /// Time of its last step, nanoseconds.
    now_nanos: u64,
    /// Durations of the stages of each step of the last sweep. The first of a step is the whole step.
    steps: Vec<Vec<StageTiming>>,
}

impl Participant {
    pub(super) fn new(agent: Agent, options: LoopOptions, has_own_network: bool) -> Self {
        Self {
            encoder: MessageEncoder::new(&options),
            streams: options.publish.clone(),
            agent_loop: AgentLoop::new(agent, options),
            has_own_network,
            now_nanos: 0,
            steps: Vec::new(),
        }
    }

    /// Messages of a sweep, from a map `[1, C, H, W]` of the run's encoder where there is one. A sweep that cannot be
    /// computed has a pose alone. `captured` is what another vehicle sent, for an attack.
    ///
    /// # Errors
    /// [`EvaluateError`] when no sweep can be computed, or a message cannot be encoded or decoded.
    pub(super) fn compute(
        &mut self,
        frame: &Frame,
        map: Option<&Tensor>,
        captured: impl FnOnce() -> CapturedMessages,
    ) -> Result<Sent, EvaluateError> {
        let capture_nanos = frame.capture_nanos;
        self.steps.clear();
        self.now_nanos = self.now_nanos.max(capture_nanos);
        let map = map.filter(|_| !self.has_own_network);
        self.agent_loop
            .set_known_map(map.map(Tensor::shallow_clone));
        self.agent_loop.capture(captured);
        let sweep = Sweep {
            capture_nanos,
            arrived_nanos: capture_nanos,
            cloud: frame.points.clone(),
        };
        let gnss = frame.gnss();
        let gnss = gnss.map(|gnss| LoopInput::Gnss(capture_nanos, gnss));
        let motion = LoopInput::Motion(capture_nanos, frame.motion());
        let mut answer = Replies::default();
        let mut is_over = false;
        for input in gnss.into_iter().chain([motion, LoopInput::Sweep(sweep)]) {
            is_over |= self.handle(input, &mut answer)?;
        }
        while !is_over || self.agent_loop.is_computing() {
            // A sweep without a recorded pose waits for one as long as in a live run.
            self.now_nanos = self.now_nanos.max(self.agent_loop.wakes_nanos());
            is_over |= self.handle(LoopInput::Wake, &mut answer)?;
        }
        Ok(answer.into_sent(frame, &self.streams))
    }

    /// Hands an input to the loop and carries out what that decides. True if the sweep is computed, or left out.
    fn handle(&mut self, input: LoopInput, answer: &mut Replies) -> Result<bool, EvaluateError> {
        let mut is_over = false;
        for output in self.agent_loop.handle(input, self.now_nanos) {
            match output {
                LoopOutput::Publish(message) if message.stream != Stream::Descriptor => {
                    let stamp = stamp(self.agent_loop.agent().cav(), message.capture_nanos);
                    let (encoded, _) = self.encoder.encode(message, &stamp, None)?;
                    let (_, message) = wire::decode_any(encoded.pieces(), &Limits::DEFAULT)?;
                    answer.note(message, encoded.wire_bytes() as u64)?;
                }
                LoopOutput::Timed(stages) => self.steps.push(stages),
                LoopOutput::Failed(error) if error.is_of_frame() => {
                    answer.failure = Some(error.to_string());
                }
                LoopOutput::Failed(error) => return Err(error.into()),
                LoopOutput::Computed { .. } | LoopOutput::Dropped(Stream::Lidar, _) => {
                    is_over = true
                }
                _ => {}
            }
        }
        Ok(is_over)
    }

    /// Durations of a step of the last sweep: the whole step, and its stages; of a step that was not made nothing.
    pub(super) fn step(&self, name: &str) -> (Duration, &[StageTiming]) {
        let mut steps = self.steps.iter().filter_map(|stages| stages.split_first());
        let step = steps.find(|(whole, _)| whole.stage == name);
        step.map_or((Duration::ZERO, &[]), |(whole, stages)| {
            (Duration::from_nanos(whole.nanos), stages)
        })
    }
}

/// Sender and capture time of a sweep's messages, stamped at the capture time.
pub(super) fn stamp(cav: &CavId, capture_nanos: u64) -> Stamp {
    Stamp {
        cav: cav.clone(),
        epoch: 0,
        sequence: 0,
        capture_nanos,
        publish_nanos: capture_nanos,
    }
}
