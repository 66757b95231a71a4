//! Main loop of a replay.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use protocol::{CavId, Control, Limits, Role, Stream, Topic, Truth, Verb};

use super::ReplayClock;
use super::checkpoint::{Checkpoint, Place};
use super::read_ahead::{ReadAhead, TickFrames};
use super::report::StreamReport;
use super::schedule::{Planned, Schedule};
use super::sensor_link::{SensorLink, Sweep};
use super::sensor_publisher::{SensorPublisher, truth_of};
use bus::bounded_queue::Pop;
use bus::shutdown::Stop;
use bus::{
    Barrier, Bus, BusError, Event, Inbox, LivelinessToken, NotReady, Route, Subscription,
    process_id,
};
use dataset::{LoadOptions, Scenario};
use link::{LinkConfig, LinkError};
use support::file_error::FileError;

/// Ticks read ahead of the clock.
const READ_AHEAD: usize = 4;
/// Commands that may wait.
const COMMANDS: usize = 64;
/// Longest time that a restarted replay waits for the routes: other processes may be down, and the scene does not wait
/// for them.
const RESUME_TIMEOUT: Duration = Duration::from_secs(2);

/// Options of a replay.
#[derive(Debug, Clone)]
pub struct StreamOptions {
    /// Vehicles that take part; if empty, all of the scenario.
    pub agents: Vec<CavId>,
    /// Seconds of the scene per second; 0: as fast as the subscribers accept it, without drops.
    pub rate: f64,
    /// Start again after the last tick.
    pub repeats: bool,
    /// First tick, counted from 0.
    pub seek: usize,
    /// Ticks to play; `None`: to the end, or without end.
    pub frames: Option<usize>,
    /// Options of reading a frame.
    pub load: LoadOptions,
    /// True to wait for the vehicles' own agents: their `lidar` and `gnss` routes.
    pub await_agents: bool,
    /// Further routes that must be up before the clock starts.
    pub expect: Vec<Route>,
    /// Longest time to wait for the routes.
    pub ready_timeout: Duration,
    /// Egos whose detections of a tick are awaited before the next; empty: the clock does not wait.
    pub lockstep: Vec<CavId>,
    /// Longest time to wait for an ego's detections; then the tick counts as unanswered.
    pub answer_timeout: Duration,
    /// Link emulation between sensors and agents, and its seed; `None`: frames arrive at once.
    pub link: Option<(LinkConfig, u64)>,
    /// Checkpoint file, written after each tick; if it exists, the replay resumes from it instead of starting at
    /// `seek`. It is one of the same `seek`, `frames` and `repeats`, of a replay that has not ended.
    pub checkpoint: Option<PathBuf>,
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
            ready_timeout: Duration::from_secs(60),
            lockstep: Vec::new(),
            answer_timeout: Duration::from_secs(60),
            link: None,
            checkpoint: None,
        }
    }
}

impl StreamOptions {
    /// The options that give the order of ticks, as text.
    fn plan(&self) -> String {
        let (seek, repeats) = (self.seek, self.repeats);
        let frames = self.frames.map_or("all".into(), |count| count.to_string());
        format!("seek {seek}, frames {frames}, loop {repeats}")
    }

    /// True if the subscribers set the pace: nothing is published before they can accept it.
    fn is_paced(&self) -> bool {
        self.rate == 0.0 || !self.lockstep.is_empty()
    }
}

/// Reasons why a scene cannot be played.
#[derive(Debug, thiserror::Error)]
pub enum StreamError {
    /// The options do not fit each other or the scenario: a vehicle or tick that it does not have, an invalid rate, or a
    /// link in lockstep, where a lost frame is never answered; an invalid link or checkpoint. The message names what was
    /// asked and what there is.
    #[error("{0}")]
    Options(String),
    /// Not every route is up.
    #[error("the fleet is not ready: {0}")]
    NotReady(#[from] NotReady),
    /// The bus failed, or a thread could not be started.
    #[error(transparent)]
    Bus(#[from] BusError),
}

/// A replay of a scene.
pub struct Replay<'a> {
    bus: &'a Bus,
    options: StreamOptions,
    scenario: String,
    tick_count: usize,
    checkpoint: Option<Checkpoint>,
    is_resumed: bool,
    reading: ReadAhead,
    schedule: Schedule,
    /// Agents whose frames of the last tick were published.
    present: BTreeSet<CavId>,
    clock: ReplayClock,
    publisher: SensorPublisher,
    sensor_link: Option<SensorLink>,
    inbox: Arc<Inbox>,
    stop: Stop,
    report: StreamReport,
    _presence: LivelinessToken,
    _subscriptions: Vec<Subscription>,
}

impl<'a> Replay<'a> {
    /// Opens the publishers and subscriptions of the scene and starts reading; publishes nothing yet.
    ///
    /// # Errors
    /// [`StreamError`] if the scenario has no such agent or tick, or the bus fails.
    pub fn prepare(
        bus: &'a Bus,
        scenario: &Scenario,
        options: StreamOptions,
        stop: &Stop,
    ) -> Result<Self, StreamError> {
        use Verb::{Pause, Resume, Seek, Start, Step};
        let agents = agent_indices(scenario, &options.agents)?;
        check(scenario, &options)?;
        let cavs = agents.iter().map(|&index| scenario.agents[index].clone());
        let options = StreamOptions {
            agents: cavs.collect(),
            ..options
        };
        let scene = (scenario.name.as_str(), scenario.ticks.len());
        let read = |path: &PathBuf| Place::read(path, scene, &options.plan());
        let place = options.checkpoint.as_ref().map(read).transpose();
        let invalid = |error: FileError| StreamError::Options(format!("checkpoint: {error}"));
        let place = place.map_err(invalid)?.flatten();
        let (seek, frames) = (options.seek, options.frames);
        let mut schedule = Schedule::new(&scenario.ticks, seek, frames, options.repeats);
        if let Some(place) = &place {
            schedule = schedule.resumed(place.position);
        }
        let mut clock = ReplayClock::new(options.rate);
        if place.as_ref().is_some_and(|place| place.is_halted) {
            clock.pause();
        }
        let mut reading = ReadAhead::start(scenario.clone(), agents, options.load.clone())
            .map_err(BusError::thread("reading ahead"))?;
        reading.want(&schedule.ahead(READ_AHEAD));

        let inbox = bus.inbox(COMMANDS, 16);
        // A halted clock waits without a deadline: only the closed inbox lets it notice a stop.
        let closed = Arc::clone(&inbox);
        stop.on_request(move || closed.close());
        let verbs = [Start, Pause, Resume, Step, Seek].map(Topic::Control);
        let answers = options.lockstep.iter();
        let answers = answers.map(|ego| Topic::stream(ego, Stream::Detections));
        let topics = verbs.into_iter().chain(answers);
        let subscriptions = topics.map(|topic| bus.subscribe(topic, &inbox));
        let link = options.link.as_ref();
        let sensor_link = link.map(|(link, seed)| SensorLink::new(link, *seed));
        let invalid = |error: LinkError| StreamError::Options(error.to_string());
        let sensor_link = sensor_link.transpose().map_err(invalid)?;
        let checkpoint = options.checkpoint.clone().map(Checkpoint::open).transpose();
        Ok(Self {
            bus,
            scenario: scenario.name.clone(),
            tick_count: scenario.ticks.len(),
            checkpoint: checkpoint.map_err(BusError::thread("writing checkpoints"))?,
            is_resumed: place.is_some(),
            reading,
            schedule,
            present: BTreeSet::new(),
            clock,
            publisher: SensorPublisher::open(
                bus,
                &options.agents,
                &options.load,
                &scenario.cameras,
                options.is_paced(),
            )?,
            _subscriptions: subscriptions.collect::<Result<_, _>>()?,
            sensor_link,
            inbox,
            stop: stop.clone(),
            report: place.as_ref().map(Place::report).unwrap_or_default(),
            _presence: bus.announce(Role::Replay)?,
            options,
        })
    }

    /// Waits until every expected route has carried a probe. A resumed replay waits for a short time only.
    ///
    /// # Errors
    /// [`StreamError::NotReady`] with the routes that have not.
    pub fn wait_until_ready(&self) -> Result<(), StreamError> {
        let barrier = Barrier::new(self.expected_routes()).await_routes(self.bus)?;
        let timeout = self.options.ready_timeout;
        if !self.is_resumed {
            return Ok(barrier.wait_unless(timeout, || self.stop.requested())?);
        }
        let (tick, ticks) = (self.schedule.position.next_tick, self.tick_count);
        tracing::warn!(
            tick,
            ticks,
            "resuming from the checkpoint of the previous process instance"
        );
        let timeout = RESUME_TIMEOUT.min(timeout);
        if let Err(not_ready) = barrier.wait_unless(timeout, || self.stop.requested()) {
            tracing::warn!("the replay continues, although {not_ready}");
        }
        Ok(())
    }

    /// Plays the scene to its end, or until a stop is requested. Sends the end markers, and returns when all messages
    /// have left the process.
    pub fn play(mut self) -> StreamReport {
        let began = Instant::now();
        let mut last = began;
        // Paced by its subscribers, it may wait for the slowest agent for any time.
        let working = (!self.options.is_paced()).then(|| self.bus.works_from(&self.inbox));
        while let Some((planned, due)) = self.wait_for_next() {
            // A late replay takes nothing from its inbox.
            if let Some(working) = &working {
                working.beat();
            }
            self.publish(planned, due);
            last = Instant::now();
            self.wait_for_answers(&planned);
            // Noted last: a process that dies before this plays the tick once more.
            self.note_place();
        }
        // After the last tick: waits for the frames in flight, unless a stop is requested.
        while let Some(next) = self.next_arrival().filter(|_| !self.stop.requested()) {
            if matches!(self.inbox.take(Some(next)), Pop::Closed) {
                break;
            }
            self.deliver();
        }
        // The loop has ended: otherwise the process would count as stalled while it sends its queues.
        drop(working);
        let mut report = self.report;
        report.sensor_link = self.sensor_link.map(|link| link.report);
        report.seconds = last.duration_since(began).as_secs_f64();
        report.lateness.sum_up();
        report.sent = self.publisher.finish();
        report.count_unsent(&self.bus.stats().ledger());
        let (ticks, sent) = (report.ticks, report.sent.clone());
        self.bus.publish_control(Control::End { ticks, sent }, 0);
        report
    }

    fn expected_routes(&self) -> Vec<Route> {
        let answers = self.options.lockstep.iter().map(|ego| Route {
            topic: Topic::stream(ego, Stream::Detections),
            receiver: self.bus.identity().process.clone(),
        });
        let options = &self.options;
        let agents = options.agents.iter().filter(|_| options.await_agents);
        agents
            .flat_map(|cav| {
                [Stream::Lidar, Stream::Gnss, Stream::Imu].map(|stream| {
                    Route::new(Topic::stream(cav, stream), process_id(Role::Agent, cav))
                })
            })
            .chain(answers)
            .chain(self.options.expect.iter().cloned())
            .collect()
    }

    /// The next tick with its due time, at that time. `None`: the scene has ended, or a stop was requested.
    fn wait_for_next(&mut self) -> Option<(Planned, Instant)> {
        loop {
            // A command may change the next tick, so the plan is renewed each time.
            let planned = self.schedule.clone().next()?;
            let due_nanos = planned.capture_nanos.saturating_sub(planned.gap_nanos);
            let due = self.clock.due(due_nanos, Instant::now());
            self.deliver();
            if let Some(due) = due.filter(|due| *due <= Instant::now() && !self.stop.requested()) {
                self.schedule.next();
                return Some((planned, due));
            }
            // While halted nothing is due: then only an arrival, a command or a stop wakes the loop.
            let until = due.into_iter().chain(self.next_arrival()).min();
            match self.inbox.take(until) {
                Pop::Item(_, Event::Message(arrival)) => {
                    if let Ok(command) = arrival.decode(&Limits::DEFAULT) {
                        self.apply(command);
                        // A pause or a seek must survive a restart, even if no further tick is played.
                        self.note_place();
                    }
                }
                Pop::Item(_, Event::End { .. }) | Pop::TimedOut => {}
                Pop::Closed => return None,
            }
        }
    }

    /// Time at which the next frame in flight can arrive.
    fn next_arrival(&self) -> Option<Instant> {
        self.sensor_link.as_ref().and_then(SensorLink::next)
    }

    /// Publishes the frames that have passed the emulated link.
    fn deliver(&mut self) {
        let link = self.sensor_link.as_mut();
        let arrived = link.map(|link| link.arrived(Instant::now()));
        for sweep in arrived.unwrap_or_default() {
            self.publisher.submit(sweep);
        }
    }

    /// After a tick was submitted completely: a restarted replay resumes with the next one.
    fn note_place(&self) {
        if let Some(checkpoint) = &self.checkpoint {
            checkpoint.note(Place {
                scenario: self.scenario.clone(),
                plan: self.options.plan(),
                has_ended: false,
                position: self.schedule.position,
                is_halted: self.clock.is_halted(),
                ticks: self.report.ticks,
                unanswered: self.report.unanswered,
                unreadable_frames: self.report.unreadable_frames,
            });
        }
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
                    self.schedule.position.next_tick = index;
                    // A jump ahead is a jump in capture time too, which would otherwise be waited out.
                    self.clock.rebase();
                    self.reading.want(&self.schedule.ahead(READ_AHEAD));
                }
                _ => tracing::warn!(tick, ticks = self.tick_count, "no such tick to seek"),
            },
            Control::End { .. } | Control::Ready { .. } | Control::Probe | Control::Done { .. } => {
            }
        }
    }

    fn publish(&mut self, planned: Planned, due: Instant) {
        let capture_nanos = planned.capture_nanos;
        let frames: TickFrames = self.reading.take(planned.tick_index);
        self.reading.want(&self.schedule.ahead(READ_AHEAD));
        // Taken before the frames are handed over. The truth takes no link: it is sent even if they are lost.
        let read: Vec<_> = frames.iter().flatten().collect();
        let agents = truth_of(&read);
        self.present = read.iter().map(|frame| frame.cav.clone()).collect();
        if !self.options.is_paced() {
            self.report.lateness.add(due.elapsed());
        }
        for (agent, frame) in frames.into_iter().enumerate() {
            match frame {
                Ok(frame) => {
                    self.report.parts_left_out(&frame);
                    let sweep = Sweep {
                        agent,
                        capture_nanos,
                        frame,
                    };
                    match &mut self.sensor_link {
                        None => self.publisher.submit(sweep),
                        Some(link) => link.submit(sweep, Instant::now()),
                    }
                }
                Err(error) if error.is_absent() => self.report.absent_frames += 1,
                Err(error) => self.report.unreadable(capture_nanos, &error),
            }
        }
        let tick = planned.tick_index as u64;
        let truth = Truth { tick, agents };
        self.publisher.submit_truth(capture_nanos, truth);
        self.deliver();
        self.report.ticks += 1;
        self.clock.published(capture_nanos, due);
    }

    /// In lockstep, waits until every ego that has a frame at the tick has answered.
    fn wait_for_answers(&mut self, planned: &Planned) {
        let capture_nanos = planned.capture_nanos;
        let egos = self.options.lockstep.iter();
        let egos = egos.filter(|ego| self.present.contains(*ego));
        let mut missing: BTreeSet<CavId> = egos.cloned().collect();
        if missing.is_empty() {
            // The next tick is at its time: the agents have that of a tick to compute.
            return;
        }
        let deadline = end_of(self.options.answer_timeout);
        while !missing.is_empty() {
            match self.inbox.take(deadline) {
                Pop::Item(Topic::Stream { cav, .. }, Event::Message(arrival)) => {
                    self.bus.stats().received(&arrival.topic);
                    // Late answers to earlier ticks do not count.
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
                    tracing::error!(
                        capture_nanos,
                        ?missing,
                        "no detections within {:?}",
                        self.options.answer_timeout
                    );
                    self.report.unanswered += 1;
                    break;
                }
                Pop::Closed => break,
            }
        }
        // The subscribers set the pace: the next tick is not late because this one took long.
        self.clock.rebase();
    }
}

/// End of a timeout that begins now; `None` if it is beyond the range of the clock: no end.
fn end_of(timeout: Duration) -> Option<Instant> {
    Instant::now().checked_add(timeout)
}

fn check(scenario: &Scenario, options: &StreamOptions) -> Result<(), StreamError> {
    let (name, ticks) = (&scenario.name, scenario.ticks.len());
    let StreamOptions { rate, seek, .. } = options;
    // NaN lies in no range, so it is refused too.
    let problem = if !(0.0..=1e3).contains(rate) {
        format!("rate is {rate}, not a number from 0 to 1000")
    } else if options.link.is_some() && !options.lockstep.is_empty() {
        "a link and lockstep exclude each other: a tick whose frames are late or lost is not answered".into()
    } else if *seek >= ticks {
        format!("scenario {name} has {ticks} ticks, counted from 0; there is no tick {seek}")
    } else {
        return Ok(());
    };
    Err(StreamError::Options(problem))
}

fn agent_indices(scenario: &Scenario, asked: &[CavId]) -> Result<Vec<usize>, StreamError> {
    if asked.is_empty() {
        return Ok((0..scenario.agents.len()).collect());
    }
    let agents = &scenario.agents;
    let indices = asked.iter().map(|cav| {
        let found = agents.iter().position(|agent| agent == cav);
        found.ok_or_else(|| {
            let available: Vec<&str> = agents.iter().map(CavId::as_str).collect();
            let (name, available) = (&scenario.name, available.join(", "));
            let reason = format!("scenario {name} has no agent {cav}; it has {available}");
            StreamError::Options(reason)
        })
    });
    indices.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_options_that_give_the_order_of_ticks_are_in_the_plan() {
        let whole = StreamOptions::default();
        let part = StreamOptions {
            seek: 5,
            frames: Some(40),
            repeats: true,
            ..whole.clone()
        };
        assert_eq!(
            [whole.plan(), part.plan()],
            [
                "seek 0, frames all, loop false",
                "seek 5, frames 40, loop true"
            ]
        );
    }

    #[test]
    fn unlimited_timeout_waits_for_the_subscribers() {
        assert_eq!(end_of(Duration::MAX), None);
        assert!(end_of(Duration::from_secs(60)).unwrap() > Instant::now());
    }
}
