//! The loop that plays a scene.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use protocol::{CavId, Control, Limits, Role, Stream, Topic, Truth, Verb};

use super::ReplayClock;
use super::checkpoint::{BookmarkError, Checkpoint, Place};
use super::read_ahead::{ReadAhead, TickFrames};
use super::report::StreamReport;
use super::schedule::{Planned, Schedule};
use super::sensor_link::{DelayedSweep, SensorAir};
use super::sensor_publisher::{SensorPublisher, truth_of};
use bus::bounded_queue::Pop;
use bus::shutdown::Stop;
use bus::{Barrier, Bus, BusError, Event, Inbox, LivelinessToken, NotReady, Route, Subscription, process_id};
use dataset::{LoadOptions, Scenario};
use link::{LinkConfig, LinkError};

/// Ticks read ahead of the clock.
const READ_AHEAD: usize = 4;
/// Commands that may wait.
const COMMANDS: usize = 64;
/// How long one that goes on where an earlier life was waits for the routes: the others have their own troubles, and the
/// world does not wait for them.
const RESUME_PATIENCE: Duration = Duration::from_secs(2);

/// How to play a scene.
#[derive(Debug, Clone)]
pub struct StreamOptions {
    /// Vehicles that take part; all of the scenario where empty.
    pub agents: Vec<CavId>,
    /// Seconds of the scene per second; 0: as fast as the bus takes it, dropping nothing.
    pub rate: f64,
    /// Start again after the last tick.
    pub repeats: bool,
    /// First tick, counted from 0.
    pub seek: usize,
    /// Ticks to play; `None`: to the end, or for ever.
    pub frames: Option<usize>,
    /// What to read of each frame.
    pub load: LoadOptions,
    /// Whether the vehicles' own agents are waited for: their `lidar` and `gnss` routes.
    pub await_agents: bool,
    /// Further routes that have to stand before the clock starts.
    pub expect: Vec<Route>,
    /// How long to wait for the routes.
    pub patience: Duration,
    /// Egos whose detections of a tick are waited for before the next; none: the clock does not wait.
    pub lockstep: Vec<CavId>,
    /// How long to wait for an ego's detections before the tick is counted as unanswered.
    pub answer_patience: Duration,
    /// A link that sensor frames cross on their way to the agents, and its seed; none: they arrive at once.
    pub link: Option<(LinkConfig, u64)>,
    /// Where to note after each tick how far the replay is, and to go on from where the file is there; the scene begins
    /// elsewhere then than `seek` says.
    pub bookmark: Option<PathBuf>,
}

impl Default for StreamOptions {
    fn default() -> Self {
        Self {
            agents: Vec::new(),
            rate: 1.0,
            repeats: false,
            seek: 0,
            frames: None,
            load: LoadOptions::default(),
            await_agents: true,
            expect: Vec::new(),
            patience: Duration::from_secs(60),
            lockstep: Vec::new(),
            answer_patience: Duration::from_secs(60),
            link: None,
            bookmark: None,
        }
    }
}

impl StreamOptions {
    /// Whether those who listen set the pace: nothing is published that they have no room for.
    fn is_paced(&self) -> bool {
        self.rate == 0.0 || !self.lockstep.is_empty()
    }
}

/// Why a scene cannot be played.
#[derive(Debug, thiserror::Error)]
pub enum StreamError {
    /// A vehicle that the scenario does not have.
    #[error("scenario {scenario} has no agent {asked}; it has {available}")]
    NoAgent {
        /// The scenario.
        scenario: String,
        /// Who was asked for.
        asked: CavId,
        /// Who is there.
        available: String,
    },
    /// A tick that the scenario does not have.
    #[error("scenario {scenario} has {ticks} ticks, counted from 0; there is no tick {asked}")]
    NoTick {
        /// The scenario.
        scenario: String,
        /// Which was asked for.
        asked: usize,
        /// How many there are.
        ticks: usize,
    },
    /// A rate that is none.
    #[error("rate is {0}, not a number from 0 to 1000")]
    Rate(f64),
    /// The link makes no sense.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// A frame that is lost is never answered.
    #[error("a link and lockstep exclude each other: a tick whose frames are late or lost is not answered")]
    LinkInLockstep,
    /// The place to go on from makes no sense.
    #[error("bookmark: {0}")]
    Checkpoint(#[from] BookmarkError),
    /// Not every route came up.
    #[error("the fleet is not ready: {0}")]
    NotReady(#[from] NotReady),
    /// The bus failed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// A thread could not be started.
    #[error("no thread for reading ahead or noting the place: {0}")]
    Thread(std::io::Error),
}

/// A scene that is being played.
pub struct Replay<'a> {
    bus: &'a Bus,
    options: StreamOptions,
    scenario: String,
    tick_count: usize,
    bookmark: Option<Checkpoint>,
    is_resumed: bool,
    reading: ReadAhead,
    schedule: Schedule,
    /// Agents whose frames of the last tick were published.
    present: BTreeSet<CavId>,
    clock: ReplayClock,
    outlet: SensorPublisher,
    air: Option<SensorAir>,
    inbox: Arc<Inbox>,
    stop: Stop,
    report: StreamReport,
    _presence: LivelinessToken,
    _subscriptions: Vec<Subscription>,
}

impl<'a> Replay<'a> {
    /// Opens everything that the scene needs on the bus and begins to read; publishes nothing yet.
    ///
    /// # Errors
    /// [`StreamError`] when the scenario has no such agent or tick, or the bus refuses.
    pub fn prepare(
        bus: &'a Bus,
        scenario: &Scenario,
        options: StreamOptions,
        stop: &Stop,
    ) -> Result<Self, StreamError> {
        let agents = agent_indices(scenario, &options.agents)?;
        check(scenario, &options)?;
        let cavs: Vec<CavId> = agents.iter().map(|&index| scenario.agents[index].clone()).collect();
        let options = StreamOptions { agents: cavs, ..options };
        let read = |path: &PathBuf| Place::read(path, &scenario.name, scenario.ticks.len());
        let place = options.bookmark.as_ref().map(read).transpose()?.flatten();
        let schedule = Schedule::new(&scenario.ticks, options.seek, options.frames, options.repeats);
        let mut clock = ReplayClock::new(options.rate);
        let schedule = match &place {
            Some(place) => schedule.resumed(place.position),
            None => schedule,
        };
        if place.as_ref().is_some_and(|place| place.is_halted) {
            clock.pause();
        }
        let reading = ReadAhead::start(scenario.clone(), agents, options.load.clone()).map_err(StreamError::Thread)?;
        reading.want(&schedule.ahead(READ_AHEAD));

        let inbox = bus.inbox(COMMANDS, 16);
        stop.on_request({
            let inbox = Arc::clone(&inbox);
            move || inbox.close()
        });
        let verbs = [Verb::Start, Verb::Pause, Verb::Resume, Verb::Step, Verb::Seek].map(Topic::Control);
        let answers = options.lockstep.iter().map(|ego| Topic::Stream { cav: ego.clone(), stream: Stream::Detections });
        let subscriptions = verbs.into_iter().chain(answers).map(|topic| bus.subscribe(topic, &inbox));
        let air = options.link.as_ref().map(|(link, seed)| SensorAir::new(link, *seed)).transpose()?;
        Ok(Self {
            bus,
            scenario: scenario.name.clone(),
            tick_count: scenario.ticks.len(),
            bookmark: options.bookmark.clone().map(Checkpoint::open).transpose().map_err(StreamError::Thread)?,
            is_resumed: place.is_some(),
            reading,
            schedule,
            present: BTreeSet::new(),
            clock,
            outlet: SensorPublisher::open(bus, &options.agents, options.load.radar, options.is_paced())?,
            _subscriptions: subscriptions.collect::<Result<_, _>>()?,
            air,
            inbox,
            stop: stop.clone(),
            report: place.as_ref().map(Place::report).unwrap_or_default(),
            _presence: bus.announce(Role::Replay)?,
            options,
        })
    }

    /// Waits until every expected route has carried a probe. One that goes on where an earlier life was waits for a moment
    /// only.
    ///
    /// # Errors
    /// [`StreamError::NotReady`] names the routes that have not.
    pub fn wait_until_ready(&self) -> Result<(), StreamError> {
        let barrier = Barrier::new(self.expected_routes()).await_routes(self.bus)?;
        let stop = self.stop.clone();
        let wait = |patience| barrier.wait_unless(patience, || stop.requested());
        if !self.is_resumed {
            return Ok(wait(self.options.patience)?);
        }
        let (tick, ticks) = (self.schedule.position().next_tick, self.tick_count);
        tracing::warn!(tick, ticks, "going on where an earlier life was");
        if let Err(not_ready) = wait(RESUME_PATIENCE.min(self.options.patience)) {
            tracing::warn!("the world goes on, though {not_ready}");
        }
        Ok(())
    }

    /// Plays the scene to its end, or until someone asks to stop. Sends the end markers, and returns when the network
    /// has taken everything.
    #[must_use]
    pub fn play(mut self) -> StreamReport {
        let began = Instant::now();
        let mut last = began;
        // Without a pace of its own it may wait for its slowest agent for any time.
        let working = (!self.options.is_paced()).then(|| self.bus.works_from(&self.inbox));
        while let Some((planned, due)) = self.wait_for_next() {
            // One that is late takes nothing from its inbox.
            if let Some(working) = &working {
                working.beat();
            }
            self.publish(planned, due);
            last = Instant::now();
            self.wait_for_answers(&planned);
            self.note_place();
        }
        self.await_the_last();
        drop(working);
        let Self { bus, outlet, air, mut report, .. } = self;
        report.air = air.map(|air| air.report().clone());
        report.seconds = last.duration_since(began).as_secs_f64();
        report.lateness.sum_up();
        report.sent = outlet.finish();
        report.count_unsent(&bus.books().ledger());
        bus.say(Control::End { ticks: report.ticks, sent: report.sent.clone() }, 0);
        report
    }

    fn expected_routes(&self) -> Vec<Route> {
        let sensors = |cav: &CavId| {
            [Stream::Lidar, Stream::Gnss].map(|stream| Route {
                topic: Topic::Stream { cav: cav.clone(), stream },
                receiver: process_id(Role::Agent, cav),
            })
        };
        let answers = self.options.lockstep.iter().map(|ego| Route {
            topic: Topic::Stream { cav: ego.clone(), stream: Stream::Detections },
            receiver: self.bus.identity().process.clone(),
        });
        let agents = self.options.agents.iter().filter(|_| self.options.await_agents);
        agents.flat_map(sensors).chain(answers).chain(self.options.expect.iter().cloned()).collect()
    }

    /// The next tick and when it is due, at that moment. `None`: the scene is over, or someone asked to stop.
    fn wait_for_next(&mut self) -> Option<(Planned, Instant)> {
        loop {
            // A command may change what comes next, so the plan is made anew each time.
            let planned = self.schedule.clone().next()?;
            let due = self.clock.due(planned.capture_nanos, Instant::now());
            self.deliver();
            match due {
                Some(due) if due <= Instant::now() && !self.stop.requested() => {
                    self.schedule.next();
                    return Some((planned, due));
                }
                _ => {}
            }
            match self.inbox.take(due.into_iter().chain(self.next_arrival()).min()) {
                Pop::Item(_, Event::Message(arrival)) => {
                    if let Ok(command) = arrival.decode(&Limits::DEFAULT) {
                        self.apply(command);
                        self.note_place();
                    }
                }
                Pop::Item(_, Event::End { .. }) | Pop::TimedOut => {}
                Pop::Closed => return None,
            }
        }
    }

    /// When the next frame that is on its way can arrive.
    fn next_arrival(&self) -> Option<Instant> {
        self.air.as_ref().and_then(SensorAir::next)
    }

    /// Publishes the frames that have crossed the air.
    fn deliver(&mut self) {
        let Some(air) = &mut self.air else { return };
        for DelayedSweep { agent, capture_nanos, frame } in air.arrived(Instant::now()) {
            self.outlet.offer(agent, capture_nanos, frame);
        }
    }

    /// After the last tick: waits for the frames that are on their way, unless someone asks to stop.
    fn await_the_last(&mut self) {
        while let Some(next) = self.next_arrival().filter(|_| !self.stop.requested()) {
            if matches!(self.inbox.take(Some(next)), Pop::Closed) {
                return;
            }
            self.deliver();
        }
    }

    /// After everything of a tick was handed over: what comes next is for the next life.
    fn note_place(&self) {
        let Some(bookmark) = &self.bookmark else { return };
        let StreamReport { ticks, unanswered, unreadable_frames, .. } = self.report;
        bookmark.note(Place {
            scenario: self.scenario.clone(),
            position: self.schedule.position(),
            is_halted: self.clock.is_halted(),
            ticks,
            unanswered,
            unreadable_frames,
        });
    }

    fn apply(&mut self, command: Control) {
        tracing::info!(?command, "asked to");
        match command {
            Control::Start { rate } => self.clock.resume(Some(rate)),
            Control::Resume => self.clock.resume(None),
            Control::Pause => self.clock.pause(),
            Control::Step { ticks } => self.clock.step(ticks),
            Control::Seek { tick } => match usize::try_from(tick) {
                Ok(index) if index < self.tick_count => {
                    self.schedule.seek(index);
                    self.clock.rebase();
                    self.reading.want(&self.schedule.ahead(READ_AHEAD));
                }
                _ => tracing::warn!(tick, ticks = self.tick_count, "no such tick to seek"),
            },
            Control::End { .. } | Control::Ready { .. } | Control::Probe | Control::Done { .. } => {}
        }
    }

    fn publish(&mut self, planned: Planned, due: Instant) {
        let Planned { tick_index, capture_nanos } = planned;
        let frames: TickFrames = self.reading.take(tick_index);
        self.reading.want(&self.schedule.ahead(READ_AHEAD));
        let agents = truth_of(&frames.iter().flatten().collect::<Vec<_>>());
        self.present = frames.iter().flatten().map(|frame| frame.cav.clone()).collect();
        if self.options.lockstep.is_empty() && self.options.rate > 0.0 {
            self.report.lateness.add(due.elapsed());
        }
        for (agent, frame) in frames.into_iter().enumerate() {
            match frame {
                Ok(frame) => {
                    self.report.parts_left_out(&frame);
                    match &mut self.air {
                        None => self.outlet.offer(agent, capture_nanos, frame),
                        Some(air) => {
                            let cav = frame.cav.clone();
                            air.offer(&cav, DelayedSweep { agent, capture_nanos, frame }, Instant::now());
                        }
                    }
                }
                Err(error) if error.is_absence() => self.report.absent_frames += 1,
                Err(error) => self.report.unreadable(capture_nanos, &error),
            }
        }
        self.outlet.offer_truth(capture_nanos, Truth { tick: tick_index as u64, agents });
        self.deliver();
        self.report.ticks += 1;
        self.clock.published(capture_nanos, due);
    }

    /// Under lockstep, waits until every ego that has a frame at the tick has answered.
    fn wait_for_answers(&mut self, planned: &Planned) {
        if self.options.lockstep.is_empty() {
            return;
        }
        let capture_nanos = planned.capture_nanos;
        let is_asked = |ego: &&CavId| self.present.contains(ego);
        let mut missing: BTreeSet<CavId> = self.options.lockstep.iter().filter(is_asked).cloned().collect();
        let deadline = end_of(self.options.answer_patience);
        while !missing.is_empty() {
            match self.inbox.take(deadline) {
                Pop::Item(Topic::Stream { cav, .. }, Event::Message(arrival)) => {
                    self.bus.books().received(&arrival.topic);
                    if arrival.header.stamp.capture_nanos >= capture_nanos {
                        missing.remove(&cav);
                    }
                }
                Pop::Item(_, Event::Message(arrival)) => {
                    if let Ok(command) = arrival.decode(&Limits::DEFAULT) {
                        self.apply(command);
                    }
                }
                Pop::Item(_, Event::End { .. }) => {}
                Pop::TimedOut => {
                    tracing::error!(capture_nanos, ?missing, "no detections within {:?}", self.options.answer_patience);
                    self.report.unanswered += 1;
                    break;
                }
                Pop::Closed => break,
            }
        }
        // The fleet sets the pace: the next tick is not late because this one took long.
        self.clock.rebase();
    }
}

/// When a patience that begins now is over; `None`: never, where no clock reaches that far.
fn end_of(patience: Duration) -> Option<Instant> {
    Instant::now().checked_add(patience)
}

fn check(scenario: &Scenario, options: &StreamOptions) -> Result<(), StreamError> {
    if !(0.0..=1e3).contains(&options.rate) {
        return Err(StreamError::Rate(options.rate));
    }
    if options.link.is_some() && !options.lockstep.is_empty() {
        return Err(StreamError::LinkInLockstep);
    }
    if options.seek >= scenario.ticks.len() {
        let (scenario, ticks) = (scenario.name.clone(), scenario.ticks.len());
        return Err(StreamError::NoTick { scenario, asked: options.seek, ticks });
    }
    Ok(())
}

fn agent_indices(scenario: &Scenario, asked: &[CavId]) -> Result<Vec<usize>, StreamError> {
    if asked.is_empty() {
        return Ok((0..scenario.agents.len()).collect());
    }
    let find = |cav: &CavId| {
        scenario.agents.iter().position(|agent| agent == cav).ok_or_else(|| StreamError::NoAgent {
            scenario: scenario.name.clone(),
            asked: cav.clone(),
            available: scenario.agents.iter().map(CavId::as_str).collect::<Vec<_>>().join(", "),
        })
    };
    asked.iter().map(find).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_patience_may_have_no_end() {
        assert_eq!(end_of(Duration::MAX), None);
        assert!(end_of(Duration::from_secs(60)).unwrap() > Instant::now());
    }
}
