//! Simulation time: compute times are given, the link determines arrivals, and the [ego's loop](EgoLoop), the same as
//! in the live process, decides at these times.
//!
//! No wall clock is read, so the same inputs and seed give the same result on a busy and on an idle machine.

mod compute;
mod delayed_delivery;
mod remote;

use std::collections::VecDeque;
use std::ops::ControlFlow;
use std::time::Duration;

use dataset::frame::Frame;
use dataset::ground_truth::GroundTruth;
use dataset::{LoadOptions, Scenario};
use link::Packet;
use protocol::{CavId, Detections, PoseEstimate, StageTiming, Stream, Tracks};

pub use compute::{ComputeTimes, EstimatedTimes};
pub use remote::{RemoteError, RemotePool};

use super::participant::{Participant, stamp};
use super::sent::Sent;
use super::sweeps::{AgentSweep, without_true_pose};
use super::{EvaluateError, EvaluatedFrame, Evaluator};
use delayed_delivery::{DelayedDelivery, Envelope};
use ego_fuser::capture_clock::SweepTime;
use ego_fuser::ego_loop::{EgoLoop, Input, Message, Output, Reception};
use fusion::method::Exchange;
use support::nanos;

/// Runs a scenario; `on_frame` may end it. Each frame's stamp has the time at which the ego published it.
pub(super) fn run(
    evaluator: &mut Evaluator,
    scenario: &Scenario,
    on_frame: &mut dyn FnMut(EvaluatedFrame) -> ControlFlow<()>,
) -> Result<ControlFlow<()>, EvaluateError> {
    let (places, observers) = evaluator.setup.pool.places(scenario);
    if places.is_empty() {
        return Ok(ControlFlow::Continue(()));
    }
    let mut run = SteppedRun::open(evaluator, scenario, places, observers)?;
    let mut flow = ControlFlow::Continue(());
    for tick in run.begin..run.end {
        let Some(frame) = run.decide(tick)? else {
            continue;
        };
        flow = on_frame(frame);
        if flow.is_break() {
            break;
        }
    }
    run.close()?;
    Ok(flow)
}

/// A tick whose sweeps are computed.
struct Computed {
    /// Reason why the ego's sweep cannot be computed.
    failure: Option<String>,
    /// Of all vehicles that take part, the ego first.
    frames: Vec<Frame>,
    poses: Vec<PoseEstimate>,
}

/// Result and tracks of a tick, or the reason of its failure.
type Fused = Result<(Detections, Option<Tracks>), String>;

struct SteppedRun<'a> {
    evaluator: &'a mut Evaluator,
    compute: ComputeTimes,
    scenario: &'a Scenario,
    /// Indices of the vehicles that take part, the ego first.
    places: Vec<usize>,
    /// One for each of them, unless they are in processes of their own.
    participants: Vec<Participant>,
    /// Indices of the agents that only contribute annotations.
    observers: Vec<usize>,
    /// The range of ticks, and the next one to compute.
    begin: usize,
    end: usize,
    next: usize,
    /// `None` for ticks at which the ego's sweep cannot be read.
    computed: VecDeque<Option<Computed>>,
    delivery: DelayedDelivery,
    /// Messages that arrive after the last decision, in order of time.
    arriving: VecDeque<Envelope>,
    /// The own agent's messages that arrive after the last decision.
    own: VecDeque<Message>,
    ego_loop: EgoLoop,
    /// Results that are not reported yet, each with the time of its decision, nanoseconds, or the reason of a failure.
    decided: VecDeque<(u64, Fused)>,
    /// Time at which the ego finishes its current fusion, nanoseconds.
    ego_free_nanos: u64,
}

impl<'a> SteppedRun<'a> {
    /// A run of the agents at `places`, the ego first.
    fn open(
        evaluator: &'a mut Evaluator,
        scenario: &'a Scenario,
        places: Vec<usize>,
        observers: Vec<usize>,
    ) -> Result<Self, EvaluateError> {
        let setup = &evaluator.setup;
        setup.compute.check(scenario)?;
        let mut participants = Vec::with_capacity(places.len());
        for &place in places.iter().filter(|_| evaluator.remote.is_none()) {
            let index = places.iter().filter(|other| **other < place).count();
            let own = setup.vehicles.get(&scenario.agents[place]);
            let (settings, is_ego) = (own.unwrap_or(&setup.agents), place == places[0]);
            // Without an exchange, neighbours send their pose only.
            let method = evaluator.ego.method();
            let needed = match method.exchange() {
                Exchange::Nothing if !is_ego => None,
                _ => Some(method.own_content().stream()),
            };
            let at = (place, index);
            let participant = evaluator.participant(settings, scenario, at, (is_ego, needed))?;
            participants.push(participant);
        }
        let begin = setup.seek.min(scenario.ticks.len());
        let end = begin.saturating_add(setup.frames.unwrap_or(usize::MAX));
        let first = scenario.ticks.get(begin);
        let began_nanos = first.map_or(0, |tick| tick.capture_nanos);
        let ego = &scenario.agents[places[0]];
        let mut ego_loop = EgoLoop::new(ego, &evaluator.ego, setup.loop_options(scenario));
        let delivery = DelayedDelivery::new(setup.emulator(scenario)?, ego, began_nanos);
        // An ego-only method needs no messages of others.
        if evaluator.ego.method().exchange() != Exchange::Nothing {
            for &place in &places[1..] {
                let cav = &scenario.agents[place];
                let joined = Input::Joined(cav.clone());
                ego_loop.handle(&mut evaluator.ego, joined, began_nanos);
                // As in a live run, before its first sweep is computed.
                let settings = evaluator.setup.vehicles.get(cav);
                let settings = settings.unwrap_or(&evaluator.setup.agents);
                let descriptor = evaluator.descriptor_of(settings, ego_loop.stream())?;
                let described = Input::Model(cav.clone(), descriptor);
                ego_loop.handle(&mut evaluator.ego, described, began_nanos);
            }
        }
        Ok(Self {
            delivery,
            compute: evaluator.setup.compute,
            evaluator,
            scenario,
            places,
            participants,
            observers,
            begin,
            end: end.min(scenario.ticks.len()),
            next: begin,
            computed: VecDeque::new(),
            arriving: VecDeque::new(),
            own: VecDeque::new(),
            ego_loop,
            decided: VecDeque::new(),
            ego_free_nanos: 0,
        })
    }

    /// Computes the sweeps of the next tick and hands the neighbours' messages to the link.
    fn compute(&mut self) -> Result<(), EvaluateError> {
        let tick = self.next;
        self.next += 1;
        let mut load = LoadOptions {
            points: self.evaluator.needs_points(),
            lidar_variant: self.evaluator.setup.lidar_variant.clone(),
            ..LoadOptions::default()
        };
        let places = &self.places;
        let ego_place = places.first().copied();
        let is_exchanged = self.evaluator.ego.method().exchange() != Exchange::Nothing;
        let is_here = self.evaluator.remote.is_none();
        let sweeps = self
            .evaluator
            .sweeps(self.scenario, tick, places, &load, |place| {
                // Without an exchange, neighbours have nothing to encode; their poses are still needed.
                is_here && (is_exchanged || Some(place) == ego_place)
            })?;
        if sweeps.first().map(|ego| ego.place) != ego_place {
            self.computed.push_back(None);
            return Ok(());
        }
        let all = self.perceive(&sweeps)?;
        let mut frames: Vec<Frame> = sweeps.into_iter().map(|sweep| sweep.frame).collect();
        let (mut poses, mut failure) = (Vec::with_capacity(all.len()), None);
        for (place, sent) in all.into_iter().enumerate() {
            poses.push(sent.pose);
            if let Some(reason) = &sent.failure {
                self.evaluator
                    .count_failure(self.scenario, tick, &sent.cav, reason);
            }
            if place == 0 {
                failure = self.send_own(tick, sent)?;
            } else if !sent.messages.is_empty() && is_exchanged {
                let distance_m = distance_m(&frames[0], &frames[place]);
                self.delivery.enqueue(sent, &self.compute, distance_m);
            }
        }
        load.points = false;
        let observers = self.observers.iter().copied();
        let observers = self.scenario.load_tick(tick, observers, &load);
        self.evaluator.left_out.add_tick(&observers);
        frames.extend(observers.frames.into_iter().map(|(_, frame)| frame));
        self.computed.push_back(Some(Computed {
            failure,
            frames,
            poses,
        }));
        Ok(())
    }

    /// Queues the own agent's message; returns the reason where there is none.
    fn send_own(&mut self, tick: usize, sent: Sent) -> Result<Option<String>, EvaluateError> {
        let capture_nanos = self.scenario.ticks[tick].capture_nanos;
        let sweep = SweepTime {
            capture_nanos,
            arrived_nanos: capture_nanos,
        };
        self.handle(Input::Sweeps(sent.cav.clone(), vec![sweep]), capture_nanos)?;
        let failure = sent.failure.clone();
        let Some(view) = sent.into_views().pop() else {
            return Ok(Some(failure.unwrap_or_default()));
        };
        self.own.push_back(Message {
            reception: exact_reception(&view.cav, self.ready_nanos(tick)),
            view,
            sequence: (tick - self.begin) as u64,
            payload_bytes: 0,
            wire_bytes: 0,
        });
        Ok(None)
    }

    /// Messages of all vehicles for the sweeps of a tick.
    fn perceive(&mut self, sweeps: &[AgentSweep]) -> Result<Vec<Sent>, EvaluateError> {
        if let Some(remote) = &self.evaluator.remote {
            let frames: Vec<&Frame> = sweeps.iter().map(|sweep| &sweep.frame).collect();
            return Ok(remote.request(&frames).map_err(Box::new)?);
        }
        let mut all: Vec<Sent> = Vec::with_capacity(sweeps.len());
        for AgentSweep { place, frame, map } in sweeps {
            let index = self.places.iter().position(|it| it == place);
            if let Some(participant) = index.and_then(|index| self.participants.get_mut(index)) {
                // A replaying attacker repeats the message of the vehicle before it.
                let sent = participant.compute(frame, map.as_ref(), || {
                    all.last().map(Sent::captured).unwrap_or_default()
                });
                all.push(sent?);
            }
        }
        Ok(all)
    }

    /// Fuses a tick; `None` where the ego's sweep cannot be read.
    fn decide(&mut self, tick: usize) -> Result<Option<EvaluatedFrame>, EvaluateError> {
        while self.next <= tick {
            self.compute()?;
        }
        let Some(Some(computed)) = self.computed.pop_front() else {
            return Ok(None);
        };
        let ready_nanos = self.ready_nanos(tick);
        let (decided_nanos, fused) = match &computed.failure {
            // The ego gets no map to begin with.
            Some(reason) => (ready_nanos, Err(reason.clone())),
            None => loop {
                if let Some(decided) = self.decided.pop_front() {
                    break decided;
                }
                self.advance()?;
            },
        };
        if let (Err(reason), None) = (&fused, &computed.failure) {
            let ego = &computed.frames[0].cav;
            self.evaluator
                .count_failure(self.scenario, tick, ego, reason);
        }
        let frame = self.evaluated(tick, decided_nanos, computed, fused);
        // The vehicle has driven on, but its result cannot be compared with anything.
        if frame.true_pose().is_none() {
            let problem = without_true_pose(self.scenario, tick, &frame.stamp.cav);
            self.evaluator.left_out.add_unreadable(0, problem);
        }
        Ok(Some(frame))
    }

    /// Time at which the ego's own map of a tick arrives, nanoseconds.
    fn ready_nanos(&self, tick: usize) -> u64 {
        let capture_nanos = self.scenario.ticks[tick].capture_nanos;
        capture_nanos.saturating_add(self.compute.agent_nanos())
    }

    /// Goes on to the next moment at which the ego can act: a message arrives, or a frame has waited long enough. Sweeps
    /// that are captured until then are computed first.
    fn advance(&mut self) -> Result<(), EvaluateError> {
        loop {
            let own = self.own.front();
            let moments = [
                own.map(|message| message.reception.arrived_nanos),
                self.arriving.front().map(Envelope::arrived_nanos),
                self.ego_loop.wakes_nanos(),
            ];
            let next = moments.into_iter().flatten().min().unwrap_or(u64::MAX);
            // While it fuses, the ego takes nothing in.
            let now_nanos = next.max(self.ego_free_nanos);
            let next_tick = self.scenario.ticks.get(self.next);
            let captured = next_tick.filter(|_| self.next < self.end);
            // A sweep that is captured before the next event may cause an earlier one.
            if captured.is_some_and(|tick| tick.capture_nanos <= now_nanos) {
                self.compute()?;
                continue;
            }
            // What arrives by then may arrive earlier than anything that was known.
            let arrived = self.delivery.until(now_nanos);
            let is_known = arrived.is_empty();
            self.arriving.extend(arrived);
            if is_known {
                return self.act(now_nanos);
            }
        }
    }

    /// Takes everything in that has arrived, and wakes the ego.
    fn act(&mut self, now_nanos: u64) -> Result<(), EvaluateError> {
        loop {
            // Of two at the same time the own agent's comes first.
            let other_nanos = self.arriving.front().map(Envelope::arrived_nanos);
            let until_nanos = other_nanos.map_or(now_nanos, |other| other.min(now_nanos));
            let (own, arriving) = (&mut self.own, &mut self.arriving);
            if let Some(message) = own.pop_front_if(|it| it.reception.arrived_nanos <= until_nanos)
            {
                self.handle(Input::Message(Box::new(message)), now_nanos)?;
            } else if let Some(arrived) =
                arriving.pop_front_if(|it| it.arrived_nanos() <= now_nanos)
            {
                self.take_in(arrived, now_nanos)?;
            } else {
                return self.handle(Input::Wake, now_nanos);
            }
        }
    }

    /// Hands a neighbour's message to the ego, and before it the arrival of its sweep.
    fn take_in(&mut self, arrived: Envelope, now_nanos: u64) -> Result<(), EvaluateError> {
        let Envelope { message, sweep } = arrived;
        let cav = message.view.cav.clone();
        self.handle(Input::Sweeps(cav, vec![sweep]), now_nanos)?;
        self.handle(Input::Message(Box::new(message)), now_nanos)
    }

    /// Hands an input to the ego's loop and carries out what it decides.
    fn handle(&mut self, input: Input, now_nanos: u64) -> Result<(), EvaluateError> {
        let ego = &mut self.evaluator.ego;
        for output in self.ego_loop.handle(ego, input, now_nanos) {
            let fused = match output {
                Output::Publish { result, tracks, .. } => Ok((*result, tracks)),
                Output::Failed { error, .. } if error.is_of_frame() => Err(error.to_string()),
                Output::Failed { error, .. } => return Err(error.into()),
                Output::Counted(source, reason) => {
                    self.delivery.count(&source, reason);
                    continue;
                }
                // The sweeps of simulation time are all computed.
                Output::Pace(_) => continue,
            };
            self.ego_free_nanos = now_nanos.saturating_add(nanos::of_ms(self.compute.fuse_ms));
            self.decided.push_back((now_nanos, fused));
        }
        Ok(())
    }

    /// The frame of a tick that was decided at that time.
    fn evaluated(
        &self,
        tick: usize,
        decided_nanos: u64,
        computed: Computed,
        fused: Fused,
    ) -> EvaluatedFrame {
        let Computed { frames, poses, .. } = computed;
        let compute = self.compute;
        let capture_nanos = self.scenario.ticks[tick].capture_nanos;
        let ready_nanos = self.ready_nanos(tick);
        let done_nanos = decided_nanos.saturating_add(nanos::of_ms(compute.fuse_ms));
        let ego = &frames[0].cav;
        let (mut result, tracks, failure) = match fused {
            Ok((result, tracks)) => (result, tracks, None),
            Err(reason) => (self.empty(tick, ego, poses[0]), None, Some(reason)),
        };
        if self.evaluator.setup.link.is_some() {
            // Measured times would differ in every run.
            result.stages = [
                ("pose", nanos::of_ms(compute.pose_ms)),
                ("map", nanos::of_ms(compute.map_ms)),
                ("wait", decided_nanos - ready_nanos),
                ("fuse", done_nanos - decided_nanos),
            ]
            .map(|(stage, nanos)| StageTiming::new(stage, Duration::from_nanos(nanos)))
            .into();
        } else {
            // Nothing is waited for, so nothing that did not come is missing.
            result.stages.retain(|timing| timing.stage != "wait");
            result.skipped.retain(|skipped| skipped.reason.is_some());
        }
        let views: Vec<&Frame> = frames.iter().collect();
        EvaluatedFrame {
            tick,
            stamp: protocol::Stamp {
                publish_nanos: done_nanos,
                ..stamp(ego, capture_nanos)
            },
            result,
            tracks,
            failure,
            truth: GroundTruth::of_tick(&views, 0, &self.evaluator.rule),
            frames,
            poses,
        }
    }

    /// The result of a tick that has failed.
    fn empty(&self, tick: usize, ego: &CavId, pose: PoseEstimate) -> Detections {
        Detections {
            ego: ego.clone(),
            agent_frame: (tick - self.begin) as u64,
            method: self.evaluator.ego.method().name().to_owned(),
            pose,
            detections: Vec::new(),
            fused: Vec::new(),
            skipped: Vec::new(),
            neighbours: Vec::new(),
            stages: Vec::new(),
        }
    }

    /// Closes the accounting: messages still on the link or queued for a tick that will not come are in flight.
    fn close(&mut self) -> Result<(), EvaluateError> {
        if self.evaluator.setup.link.is_none() {
            return Ok(());
        }
        while let Some(arrived) = self.arriving.pop_front() {
            let nanos = arrived.arrived_nanos().max(self.ego_free_nanos);
            self.take_in(arrived, nanos)?;
        }
        for &place in &self.places[1..] {
            let cav = &self.scenario.agents[place];
            self.delivery.close(&(cav.clone(), Stream::Pose), 0);
            for stream in self.ego_loop.neighbour_streams() {
                let source = (cav.clone(), stream);
                let waiting = self.ego_loop.unused(&source) as u64;
                self.delivery.close(&source, waiting);
            }
        }
        self.evaluator.ledger.merge(&self.delivery.ledger);
        self.evaluator.sent_bytes += self.delivery.sent_bytes;
        Ok(())
    }
}

/// Arrival of a message whose sender has the clock of the ego.
fn exact_reception(cav: &CavId, arrived_nanos: u64) -> Reception {
    Reception {
        cav: cav.clone(),
        arrived_nanos,
        transport: None,
        clock_offset_s: None,
    }
}

/// Distance between two vehicles, metres.
fn distance_m(one: &Frame, other: &Frame) -> f64 {
    let positions_m = [one, other].map(|frame| Some(frame.world_from_lidar?.translation_m));
    Packet::distance_m(positions_m)
}
