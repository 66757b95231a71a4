//! Simulation time: compute times are given, the link emulation determines arrivals, and the ego fuses at each tick
//! exactly the messages that have arrived when it decides. It decides as the live ego does: once the messages of all
//! awaited neighbours are there, at the latest when the deadline passes or its own next map arrives.
//!
//! No wall clock is read, so the same inputs and seed give the same result on a busy and on an idle machine. The
//! pipelines, the pairing and the link emulation are those of the live processes.

mod compute;
mod delayed_delivery;
mod remote;

use std::collections::{BTreeMap, VecDeque};
use std::ops::{ControlFlow, Range};
use std::path::PathBuf;

use agent::config::AgentSettings;
use dataset::frame::Frame;
use dataset::ground_truth::GroundTruth;
use dataset::{LoadOptions, Scenario};
use ego_fuser::config::EgoSettings;
use link::{LinkConfig, LinkEmulator};
use protocol::{
    CavId, Detections, DropReason, PoseEstimate, RateChoice, SkippedNeighbour, StageTiming, Stream,
};
use support::random::derive_seed;

pub use compute::ComputeTimes;
pub use remote::{RemoteError, RemotePool};

use super::participant::Participant;
use super::sent::{Sent, stamp, view};
use super::sweeps::Sweep;
use super::{EvaluateError, EvaluatedFrame, Evaluator};
use delayed_delivery::{Arrived, DelayedDelivery, Envelope};
use ego_fuser::capture_clock::{CaptureClocks, SweepTime};
use ego_fuser::ego::{EgoOutput, Skipped, View};
use ego_fuser::pairing::{Pairing, PairingConfig};
use ego_fuser::silence::Silence;
use fusion::method::Exchange;

/// Configuration of a fleet in simulation time.
#[derive(Debug, Clone)]
pub struct SteppedConfig {
    /// The link between the neighbours and the ego.
    pub link: LinkConfig,
    /// Base folder of the paths of traces in it.
    pub link_folder: PathBuf,
    /// Seed of losses and delays. Every scenario derives its own from it.
    pub seed: u64,
    /// Longest time that the ego waits for its neighbours after its own map has arrived, nanoseconds.
    pub deadline_nanos: u64,
    /// Pairing of messages with a frame.
    pub pairing: PairingConfig,
    /// Compute times of all processes.
    pub compute: ComputeTimes,
    /// Vehicles that take part.
    pub crew: AgentPool,
    /// Vehicles with settings of their own, as [`AgentSettings::in_fleet`] gives them.
    pub vehicles: BTreeMap<CavId, AgentSettings>,
    /// Ticks of a scenario; clipped to the available ones.
    pub ticks: Range<usize>,
    /// A variant of the sweeps, see [`Scenario::lidar_variants`].
    pub lidar_variant: Option<String>,
}

impl SteppedConfig {
    /// All vehicles and ticks over a link, given with the folder of its trace, and an ego with these limits.
    #[must_use]
    pub fn new(
        (link, link_folder): (LinkConfig, PathBuf),
        seed: u64,
        ego: &EgoSettings,
        compute: ComputeTimes,
    ) -> Self {
        Self {
            link,
            link_folder,
            seed,
            deadline_nanos: ego.deadline_ms.saturating_mul(1_000_000),
            pairing: ego.pairing(),
            compute,
            crew: AgentPool::First(usize::MAX),
            vehicles: BTreeMap::new(),
            ticks: 0..usize::MAX,
            lidar_variant: None,
        }
    }
}

/// Vehicles of a run in simulation time.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum AgentPool {
    /// The first so many vehicles of a scenario, or all where it has fewer; the first is the ego. Annotations of the
    /// others count all the same, so that the ground truth does not depend on the number of senders.
    First(usize),
    /// These, the ego first; the others are ignored completely.
    Named(Vec<CavId>),
}

/// Runs a scenario; `on_frame` may end it. Each frame's stamp has the time at which the ego published it.
pub(super) fn run(
    evaluator: &mut Evaluator,
    config: &SteppedConfig,
    scenario: &Scenario,
    on_frame: &mut dyn FnMut(EvaluatedFrame) -> ControlFlow<()>,
) -> Result<ControlFlow<()>, EvaluateError> {
    let mut run = Run::open(evaluator, config, scenario)?;
    let mut flow = ControlFlow::Continue(());
    for tick in run.next..run.end {
        let Some(frame) = run.decide(tick)? else {
            continue;
        };
        flow = on_frame(frame);
        if flow.is_break() {
            break;
        }
    }
    run.close();
    Ok(flow)
}

/// A vehicle that takes part.
struct Member {
    /// Its index among the scenario's agents.
    place: usize,
    cav: CavId,
    pipeline: Pipeline,
}

/// Location of a vehicle's pipeline.
enum Pipeline {
    Here(Box<Participant>),
    /// In a process of its own.
    Elsewhere,
}

/// A tick whose sweeps are computed.
struct Computed {
    /// The ego's view, or the reason why its sweep cannot be computed.
    own: Result<View, String>,
    /// Of all vehicles that take part, the ego first.
    frames: Vec<Frame>,
    poses: Vec<PoseEstimate>,
}

struct Run<'a> {
    evaluator: &'a mut Evaluator,
    config: &'a SteppedConfig,
    scenario: &'a Scenario,
    /// The ego first.
    crew: Vec<Member>,
    /// Indices of the agents that only contribute annotations.
    observers: Vec<usize>,
    /// The next tick to compute, and the end of the range.
    next: usize,
    end: usize,
    /// `None` for ticks at which the ego's sweep cannot be read.
    computed: VecDeque<Option<Computed>>,
    delivery: DelayedDelivery,
    /// Messages that arrive after the last decision, in order of time.
    arriving: VecDeque<Arrived>,
    pairing: Pairing<Envelope>,
    clocks: CaptureClocks,
    silence: Silence,
    /// Time at which the ego finishes its current fusion, nanoseconds.
    ego_free_nanos: u64,
}

impl<'a> Run<'a> {
    fn open(
        evaluator: &'a mut Evaluator,
        config: &'a SteppedConfig,
        scenario: &'a Scenario,
    ) -> Result<Self, EvaluateError> {
        config.compute.check(scenario)?;
        let places = places(scenario, &config.crew);
        let mut crew = Vec::with_capacity(places.len());
        for &place in &places {
            let cav = &scenario.agents[place];
            let pipeline = if evaluator.remote.is_some() {
                Pipeline::Elsewhere
            } else {
                let own = config.vehicles.get(cav).cloned();
                let settings = own.unwrap_or_else(|| evaluator.settings(scenario, crew.len()));
                let participant = evaluator.participant(scenario, cav, &settings)?;
                Pipeline::Here(Box::new(participant))
            };
            let cav = cav.clone();
            crew.push(Member {
                place,
                cav,
                pipeline,
            });
        }
        let is_witness =
            |place: &usize| matches!(config.crew, AgentPool::First(_)) && !places.contains(place);
        let observers = (0..scenario.agents.len()).filter(is_witness).collect();
        let ticks = config.ticks.start.min(scenario.ticks.len())
            ..config.ticks.end.min(scenario.ticks.len());
        let began_nanos = scenario
            .ticks
            .get(ticks.start)
            .map_or(0, |tick| tick.capture_nanos);
        let seed_words: Vec<u64> = scenario.name.bytes().map(u64::from).collect();
        let link = LinkEmulator::new(
            config.link.clone(),
            &config.link_folder,
            derive_seed(config.seed, &seed_words),
        )?;
        let ego = crew
            .first()
            .map_or_else(|| scenario.agents[0].clone(), |ego| ego.cav.clone());
        Ok(Self {
            delivery: DelayedDelivery::new(link, &ego, began_nanos),
            evaluator,
            config,
            scenario,
            crew,
            observers,
            next: ticks.start,
            end: ticks.end,
            computed: VecDeque::new(),
            arriving: VecDeque::new(),
            pairing: Pairing::new(config.pairing),
            clocks: CaptureClocks::exact(),
            silence: Silence::default(),
            ego_free_nanos: 0,
        })
    }

    /// Computes the sweeps of the next tick and hands the neighbours' messages to the link.
    fn compute(&mut self) -> Result<(), EvaluateError> {
        let tick = self.next;
        self.next += 1;
        let method = self.evaluator.ego.method();
        let load = self.load_options();
        let places: Vec<usize> = self.crew.iter().map(|member| member.place).collect();
        let ego_place = places.first().copied();
        // Without an exchange, neighbours have nothing to encode; their poses are still needed.
        let is_needed =
            |place: usize| Some(place) == ego_place || method.exchange() != Exchange::Nothing;
        let is_here = self.evaluator.remote.is_none();
        let with_maps = |place| is_here && is_needed(place);
        let sweeps = self
            .evaluator
            .sweeps(self.scenario, tick, &places, &load, with_maps)?;
        if sweeps.first().map(|ego| ego.place) != ego_place {
            self.computed.push_back(None);
            return Ok(());
        }
        let all = self.perceive(&sweeps)?;
        let mut frames: Vec<Frame> = sweeps.into_iter().map(|sweep| sweep.frame).collect();
        let (mut poses, mut own) = (Vec::with_capacity(all.len()), Err(String::new()));
        for (place, sent) in all.into_iter().enumerate() {
            poses.push(sent.pose);
            if let Some(reason) = &sent.failure {
                self.evaluator
                    .count_failure(self.scenario, tick, &sent.cav, reason);
            }
            if place == 0 {
                own = sent.view().ok_or(sent.failure.unwrap_or_default());
            } else if sent.content.is_some() && method.exchange() != Exchange::Nothing {
                let distance_m = distance_m(&frames[0], &frames[place]);
                enqueue(
                    &mut self.delivery,
                    &self.config.compute,
                    tick,
                    sent,
                    distance_m,
                );
            }
        }
        let blind = LoadOptions {
            points: false,
            ..load
        };
        let observers = self
            .scenario
            .load_tick(tick, self.observers.iter().copied(), &blind);
        self.evaluator.left_out.add_tick(&observers);
        frames.extend(observers.frames.into_iter().map(|(_, frame)| frame));
        self.computed
            .push_back(Some(Computed { own, frames, poses }));
        Ok(())
    }

    /// Messages of all vehicles for the sweeps of a tick.
    fn perceive(&mut self, sweeps: &[Sweep]) -> Result<Vec<Sent>, EvaluateError> {
        if let Some(remote) = &self.evaluator.remote {
            let frames: Vec<&Frame> = sweeps.iter().map(|sweep| &sweep.frame).collect();
            return Ok(remote.request(&frames).map_err(Box::new)?);
        }
        let method = self.evaluator.ego.method();
        let mut all: Vec<Sent> = Vec::with_capacity(sweeps.len());
        for Sweep { place, frame, map } in sweeps {
            let is_needed = all.is_empty() || method.exchange() != Exchange::Nothing;
            let exchange = is_needed.then(|| method.own_content());
            let Some(member) = self.crew.iter_mut().find(|member| member.place == *place) else {
                continue;
            };
            if let Pipeline::Here(participant) = &mut member.pipeline {
                participant.capture(all.last());
                all.push(view(participant, frame, map.as_ref(), exchange)?);
            }
        }
        Ok(all)
    }

    fn load_options(&self) -> LoadOptions {
        let own = self
            .config
            .vehicles
            .values()
            .any(|own| own.pose.looks_at_sweeps());
        let points = own || self.evaluator.remote.is_some() || self.evaluator.needs_points();
        LoadOptions {
            points,
            lidar_variant: self.config.lidar_variant.clone(),
            ..LoadOptions::default()
        }
    }

    /// Fuses a tick; `None` where the ego's sweep cannot be read.
    fn decide(&mut self, tick: usize) -> Result<Option<EvaluatedFrame>, EvaluateError> {
        let capture_nanos = self.scenario.ticks[tick].capture_nanos;
        let compute = self.config.compute;
        while self.next <= tick {
            self.compute()?;
        }
        self.clocks.note_own(SweepTime {
            capture_nanos,
            arrived_nanos: capture_nanos,
        });
        let Some(Computed { own, frames, poses }) = self.computed.pop_front().flatten() else {
            return Ok(None);
        };
        // Arrival of the own map.
        let ready_nanos = capture_nanos.saturating_add(compute.agent_nanos());
        let (decided_nanos, fused) = match own {
            Ok(own) => {
                let decided_nanos = self.wait(capture_nanos, ready_nanos)?;
                self.ego_free_nanos = decided_nanos.saturating_add(compute.fuse_nanos());
                (decided_nanos, self.fuse(tick, &own)?)
            }
            // The ego gets no map to begin with.
            Err(reason) => (ready_nanos, Err(reason)),
        };
        Ok(Some(self.evaluated(
            tick,
            decided_nanos,
            (frames, poses),
            fused,
        )))
    }

    /// The frame of a tick that was decided at that time.
    fn evaluated(
        &self,
        tick: usize,
        decided_nanos: u64,
        (frames, poses): (Vec<Frame>, Vec<PoseEstimate>),
        fused: Result<Detections, String>,
    ) -> EvaluatedFrame {
        let compute = self.config.compute;
        let capture_nanos = self.scenario.ticks[tick].capture_nanos;
        let ready_nanos = capture_nanos.saturating_add(compute.agent_nanos());
        let done_nanos = decided_nanos.saturating_add(compute.fuse_nanos());
        let (ego, pose) = (&frames[0].cav, poses[0]);
        let (mut result, failure) = match fused {
            Ok(result) => (result, None),
            Err(reason) => {
                let number = tick - self.config.ticks.start;
                let own = (ego, pose, capture_nanos);
                let empty = EgoOutput::default();
                let empty = self.evaluator.report(number, own, &[], &[], empty);
                (empty, Some(reason))
            }
        };
        // Measured times would differ in every run.
        let stage = |name: &str, nanos| StageTiming {
            stage: name.into(),
            nanos,
        };
        result.stages = vec![
            stage("pose", compute.pose_nanos()),
            stage("map", compute.map_nanos()),
            stage("wait", decided_nanos - ready_nanos),
            stage("fuse", done_nanos - decided_nanos),
        ];
        let views: Vec<&Frame> = frames.iter().collect();
        EvaluatedFrame {
            tick,
            stamp: protocol::Stamp {
                publish_nanos: done_nanos,
                ..stamp(ego, capture_nanos)
            },
            result,
            failure,
            truth: GroundTruth::of_tick(&views, 0, &self.evaluator.rule),
            frames,
            poses,
        }
    }

    /// Takes in messages until the ego decides on the frame; returns the time at which it does.
    fn wait(&mut self, capture_nanos: u64, ready_nanos: u64) -> Result<u64, EvaluateError> {
        let deadline_nanos = ready_nanos.saturating_add(self.config.deadline_nanos);
        // It may still fuse the frame before.
        let begins_nanos = ready_nanos.max(self.ego_free_nanos);
        let mut closes_nanos = begins_nanos.max(deadline_nanos);
        loop {
            // A frame that is followed by a newer one waits no longer.
            let computed = self.computed.iter().flatten();
            if let Some(next) = { computed }.find_map(|next| next.own.as_ref().ok()) {
                let arrives_nanos = next
                    .capture_nanos
                    .saturating_add(self.config.compute.agent_nanos());
                closes_nanos = closes_nanos.min(begins_nanos.max(arrives_nanos));
            }
            let next = self
                .scenario
                .ticks
                .get(self.next)
                .filter(|_| self.next < self.end);
            if next.is_none_or(|next| next.capture_nanos > closes_nanos) {
                break;
            }
            self.compute()?;
        }
        self.arriving.extend(self.delivery.until(closes_nanos));
        while let Some(arrived) = self.next_arrival(begins_nanos) {
            self.take_in(arrived);
        }
        let mut decided_nanos = begins_nanos;
        while !self.is_complete(capture_nanos) {
            let Some(arrived) = self.next_arrival(closes_nanos) else {
                return Ok(closes_nanos);
            };
            decided_nanos = arrived.nanos;
            self.take_in(arrived);
        }
        Ok(decided_nanos)
    }

    /// The next message that arrives by a time.
    fn next_arrival(&mut self, by_nanos: u64) -> Option<Arrived> {
        let is_due = self.arriving.front()?.nanos <= by_nanos;
        if is_due {
            self.arriving.pop_front()
        } else {
            None
        }
    }

    /// Queues an arrived message for its tick.
    fn take_in(&mut self, arrived: Arrived) {
        let mut envelope = arrived.envelope;
        let cav = envelope.view.cav.clone();
        self.clocks.note(&cav, envelope.sweep);
        for cav in self.clocks.update() {
            for _ in 0..self.pairing.forget(&cav) {
                self.delivery.dropped(&cav, DropReason::Clock);
            }
        }
        self.silence.reset(&cav);
        let stated_nanos = envelope.view.capture_nanos;
        let Some(capture_nanos) = self.clocks.corrected(&cav, stated_nanos) else {
            return self.delivery.dropped(&cav, DropReason::Clock);
        };
        envelope.view.capture_nanos = capture_nanos;
        if let Some(lost) = self.pairing.insert(&cav, capture_nanos, envelope) {
            self.delivery.dropped(&lost.cav, lost.reason);
        }
    }

    /// True if a frame waits for nothing more.
    fn is_complete(&self, capture_nanos: u64) -> bool {
        self.neighbours().all(|cav| {
            !self.silence.is_awaited(cav) || self.pairing.has_reached(cav, capture_nanos)
        })
    }

    /// Vehicles whose messages the ego can use.
    fn neighbours(&self) -> impl Iterator<Item = &CavId> {
        let exchanges = self.evaluator.ego.method().exchange() != Exchange::Nothing;
        let neighbours = self.crew.iter().skip(1).filter(move |_| exchanges);
        neighbours.map(|member| &member.cav)
    }

    /// The result of a tick, or the reason why it cannot be computed.
    fn fuse(
        &mut self,
        tick: usize,
        own: &View,
    ) -> Result<Result<Detections, String>, EvaluateError> {
        let (paired, dropped) = self.pairing.pair(own.capture_nanos);
        let (mut views, mut bytes, mut first_uses) = (Vec::new(), Vec::new(), Vec::new());
        for pair in paired {
            views.push(pair.message.view.clone());
            bytes.push((pair.message.payload_bytes, pair.message.wire_bytes));
            first_uses.push(pair.is_first_use);
        }
        let output = self.evaluator.detect(self.scenario, tick, own, &views)?;
        for lost in &dropped {
            self.delivery.dropped(&lost.cav, lost.reason);
        }
        let new = views
            .iter()
            .enumerate()
            .filter(|(index, _)| first_uses[*index]);
        for (index, view) in new {
            // The messages of a frame that failed are valid.
            let skipped = output.as_ref().map_or(&[][..], |output| &output.skipped);
            let left_out = skipped.iter().find(|(skipped, _)| *skipped == index);
            match left_out {
                Some((_, Skipped::Unusable(reason))) => self.delivery.dropped(&view.cav, *reason),
                Some((_, Skipped::NotNeeded)) | None => self.delivery.received(&view.cav),
            }
        }
        let silent: Vec<CavId> = self
            .neighbours()
            .filter(|cav| views.iter().all(|view| view.cav != **cav))
            .cloned()
            .collect();
        let mut skipped = Vec::with_capacity(silent.len());
        for cav in silent {
            self.silence.missed(&cav);
            let lost = dropped.iter().rev().find(|lost| lost.cav == cav);
            let reason = lost.map(|lost| lost.reason);
            skipped.push(SkippedNeighbour { cav, reason });
        }
        let number = tick - self.config.ticks.start;
        let own = (&own.cav, own.pose, own.capture_nanos);
        Ok(output.map(|output| {
            let mut result = self.evaluator.report(number, own, &views, &bytes, output);
            result.skipped.extend(skipped);
            self.clocks.describe(&mut result.neighbours);
            result
        }))
    }

    /// Closes the accounting: messages still on the link or queued for a tick that will not come are in flight.
    fn close(&mut self) {
        while let Some(arrived) = self.arriving.pop_front() {
            self.take_in(arrived);
        }
        for member in self.crew.iter().skip(1) {
            let cav = &member.cav;
            let waiting = self.pairing.forget(cav) as u64;
            self.delivery.close(cav, waiting);
        }
        self.evaluator.ledger.merge(self.delivery.ledger());
        self.evaluator.sent_bytes += self.delivery.sent_bytes();
    }
}

/// Hands over a neighbour's messages for a tick: its pose as soon as it is known, the rest when it is computed.
fn enqueue(
    delivery: &mut DelayedDelivery,
    compute: &ComputeTimes,
    tick: usize,
    sent: Sent,
    distance_m: f64,
) {
    let sequence = tick as u64;
    let pose_nanos = sent.capture_nanos.saturating_add(compute.pose_nanos());
    let (cav, pose_bytes) = (sent.cav.clone(), sent.pose_bytes);
    delivery.enqueue_pose(&cav, sequence, pose_bytes, pose_nanos, distance_m);
    let (payload_bytes, wire_bytes) = (sent.payload_bytes, sent.wire_bytes);
    let sent_nanos = sent.capture_nanos.saturating_add(compute.agent_nanos());
    let stream = match sent.content.as_ref().map(ego_fuser::ego::Content::exchange) {
        Some(Exchange::Boxes) => Stream::Boxes,
        Some(Exchange::Points) => Stream::Points,
        _ => Stream::Bev,
    };
    if let Some(RateChoice { reason, .. }) = sent.rate {
        delivery.adapted(&cav, stream, reason);
    }
    if let Some(view) = sent.into_view() {
        let envelope = Envelope {
            sweep: SweepTime {
                capture_nanos: view.capture_nanos,
                arrived_nanos: view.capture_nanos,
            },
            view,
            payload_bytes,
            wire_bytes,
        };
        let bytes = wire_bytes - pose_bytes;
        delivery.enqueue(stream, sequence, bytes, sent_nanos, distance_m, envelope);
    }
}

/// Indices of the participants, the ego first.
fn places(scenario: &Scenario, crew: &AgentPool) -> Vec<usize> {
    match crew {
        AgentPool::First(count) => (0..scenario.agents.len()).take(*count).collect(),
        AgentPool::Named(names) => names
            .iter()
            .filter_map(|name| scenario.agents.iter().position(|agent| agent == name))
            .collect(),
    }
}

/// Distance between two vehicles, metres; 0 where the recording has no poses.
fn distance_m(one: &Frame, other: &Frame) -> f64 {
    let place = |frame: &Frame| frame.world_from_lidar.map(|pose| pose.translation_m);
    match (place(one), place(other)) {
        (Some(one), Some(other)) => (one[0] - other[0]).hypot(one[1] - other[1]),
        _ => 0.0,
    }
}
