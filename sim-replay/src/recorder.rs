//! Recorder: writes the messages of a live run to a file.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use protocol::{Key, KeyExpr, RunId, Stream, Topic, Verb};
use serde::{Deserialize, Serialize};

use crate::config::RecorderConfig;
use bus::bounded_queue::Pop;
use bus::shutdown::Stop;
use bus::{Bus, BusError, PassiveSubscriber, RawMessage};
use recording::{RecordingError, RecordingWriter};

/// Messages of one key that may wait for the disk.
const PLACES: usize = 64;
/// A chunk is closed after this time even if it is small: the largest loss of a crash.
const FLUSH_PERIOD: Duration = Duration::from_secs(1);
/// Time after the end of the replay during which messages of the run may still arrive.
const LAST_WORDS: Duration = Duration::from_secs(3);

/// Silence that ends a recording that is asked to stop: messages published before that may still be under way.
const SILENCE: Duration = Duration::from_millis(200);

/// Report of a recording.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct RecordReport {
    /// The file.
    pub file: PathBuf,
    /// Messages of the run in the file.
    pub messages: u64,
    /// Size of the file.
    pub bytes: u64,
    /// Time from the first to the last message in the file, seconds.
    pub seconds: f64,
    /// Messages lost because they arrived faster than they could be written.
    pub overwritten: u64,
    /// Messages that the router did not hand on, as the recorder took earlier ones too slowly.
    #[serde(default)]
    pub undelivered: u64,
    /// Time for which the recorder had no connection to the router, seconds.
    #[serde(default)]
    pub router_gone_s: f64,
    /// Messages that arrived after writing had failed, or were in the chunk that failed.
    pub not_written: u64,
    /// Reason of the failure.
    pub failure: Option<String>,
}

impl RecordReport {
    /// True if all received messages are in the file.
    pub fn is_complete(&self) -> bool {
        self.loss_in_words().is_none()
    }

    /// Description of the missing messages; `None` if there are none.
    pub fn loss_in_words(&self) -> Option<String> {
        let missing = self.overwritten + self.undelivered + self.not_written;
        let (gone_s, seconds) = (self.router_gone_s, self.seconds);
        match &self.failure {
            None if missing == 0 => None,
            None if self.undelivered == missing && gone_s > 0.0 => Some(format!(
                "recording with gaps: router gone for {gone_s:.1} s, {missing} messages missing"
            )),
            None if self.undelivered == missing => Some(format!(
                "recording with gaps: the recorder was too slow for the router, {missing} messages missing"
            )),
            None => Some(format!(
                "recording with gaps: the disk is too slow, {missing} messages missing"
            )),
            Some(why) if self.messages == 0 => Some(format!(
                "nothing is recorded: {why}, {missing} messages missing"
            )),
            Some(why) => Some(format!(
                "recording cut at {seconds:.1} s: {why}, {missing} messages missing; sim-replay recover {} --out {}",
                self.file.display(),
                self.file.with_extension("whole.mcap").display()
            )),
        }
    }
}

/// Reasons why a recording could not begin.
#[derive(Debug, thiserror::Error)]
pub enum RecorderError {
    /// The file cannot be written.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The bus failed.
    #[error(transparent)]
    Bus(#[from] BusError),
}

/// Records the run of `bus` until it ends, or `stop` is requested and no message has come for a moment.
///
/// If writing fails (full disk, for example), `on_failure` is called once, the run continues, and the messages not
/// recorded are counted.
///
/// # Errors
/// [`RecorderError`] if the recording cannot begin.
pub fn record(
    bus: &Bus,
    config: &RecorderConfig,
    stop: &Stop,
    on_failure: &mut dyn FnMut(&RecordReport),
) -> Result<RecordReport, RecorderError> {
    let keeps_running = config.keep_running || config.bus.supervised;
    let (writer, failure) = match RecordingWriter::create(&config.out, config.record.options()) {
        Ok(writer) => (Some(writer), None),
        // A run that waits for its recorder must not wait forever.
        Err(error) if keeps_running => {
            tracing::error!("nothing is recorded, the run continues: {error}");
            (None, Some(in_words(&error)))
        }
        Err(error) => return Err(error.into()),
    };
    let subscriber = bus.tap(&[KeyExpr::run(&bus.identity().run)], PLACES)?;
    let presence = bus.announce(protocol::Role::Recorder)?;
    let mut recorder = Recorder {
        writer,
        without: &config.record.without,
        run: &bus.identity().run,
        over: None,
        taken: 0,
        span: None,
        on_failure,
        report: RecordReport {
            file: config.out.clone(),
            failure,
            ..RecordReport::default()
        },
    };
    if recorder.report.failure.is_some() {
        (recorder.on_failure)(&recorder.report);
    }
    recorder.listen(&subscriber, keeps_running, stop);
    recorder.report.router_gone_s = bus.router_lost().as_secs_f64();
    let report = recorder.finish(subscriber.overwritten(), subscriber.undelivered());
    presence.withdraw()?;
    Ok(report)
}

struct Recorder<'a> {
    /// `None` once writing has failed.
    writer: Option<RecordingWriter<std::fs::File>>,
    without: &'a [Stream],
    run: &'a RunId,
    /// Time at which the replay reported its end.
    over: Option<Instant>,
    /// Messages received for writing.
    taken: u64,
    /// Times of arrival of the first and the last of them, nanoseconds.
    span: Option<(u64, u64)>,
    on_failure: &'a mut dyn FnMut(&RecordReport),
    report: RecordReport,
}

impl Recorder<'_> {
    fn listen(&mut self, subscriber: &PassiveSubscriber, keeps_running: bool, stop: &Stop) {
        let mut flush_at = Instant::now() + FLUSH_PERIOD;
        let (mut stopping, mut last_message) = (None, Instant::now());
        loop {
            // Wakes without messages too, to notice the silence after a stop.
            match subscriber.take(Some(flush_at.min(Instant::now() + SILENCE))) {
                Pop::Item(topic, raw) => {
                    last_message = Instant::now();
                    if topic == Topic::Control(Verb::End) {
                        self.over = Some(Instant::now());
                    }
                    self.take(&raw);
                }
                Pop::TimedOut => {}
                Pop::Closed => return,
            }
            let now = Instant::now();
            if stop.requested() {
                let since = *stopping.get_or_insert(now);
                // Where messages never cease, LAST_WORDS ends the recording.
                if now - last_message.max(since) >= SILENCE || now - since >= LAST_WORDS {
                    return;
                }
            }
            if now >= flush_at {
                flush_at = now + FLUSH_PERIOD;
                self.attempt(RecordingWriter::flush);
                if !keeps_running && self.over.is_some_and(|over| over.elapsed() > LAST_WORDS) {
                    return;
                }
            }
        }
    }

    fn take(&mut self, raw: &RawMessage) {
        let Key { run, topic } = &raw.key;
        let stream = match topic {
            Topic::Stream { stream, .. } | Topic::Received { stream, .. } => Some(stream),
            _ => None,
        };
        if run != self.run || stream.is_some_and(|stream| self.without.contains(stream)) {
            return;
        }
        self.taken += 1;
        let first_nanos = self.span.map_or(raw.arrived_nanos, |(first, _)| first);
        self.span = Some((first_nanos, raw.arrived_nanos));
        self.attempt(|writer| writer.write(&raw.key, raw.arrived_nanos, &raw.bytes()));
    }

    fn attempt(
        &mut self,
        write: impl FnOnce(&mut RecordingWriter<std::fs::File>) -> Result<(), RecordingError>,
    ) {
        let Some(writer) = &mut self.writer else {
            return;
        };
        let written = write(writer);
        // Messages of an open chunk do not count yet: a crash loses them.
        if writer.whole_messages() > self.report.messages {
            self.report.messages = writer.whole_messages();
            self.report.seconds = self.span.map_or(0.0, |(first, last)| {
                last.saturating_sub(first) as f64 * 1e-9
            });
        }
        if let Err(error) = written {
            tracing::error!("the recording ends here, the run continues: {error}");
            self.report.failure = Some(in_words(&error));
            // The messages of the open chunk are lost with it.
            self.report.not_written = self.taken - self.report.messages;
            self.writer = None;
            (self.on_failure)(&self.report);
        }
    }

    fn finish(mut self, overwritten: u64, undelivered: u64) -> RecordReport {
        // Asked first: `attempt` drops the writer if finishing fails.
        let has_file = self.writer.is_some() || self.report.messages > 0;
        self.attempt(RecordingWriter::finish);
        self.report.overwritten = overwritten;
        self.report.undelivered = undelivered;
        // Messages that arrived after a failure count too.
        self.report.not_written = self.taken - self.report.messages;
        if has_file && let Ok(file) = std::fs::metadata(&self.report.file) {
            self.report.bytes = file.len();
        }
        if self.report.overwritten > 0 {
            tracing::error!(
                messages = self.report.overwritten,
                "the disk was too slow for the run"
            );
        }
        self.report
    }
}

/// Reason of the failure, without the file, which is in the report.
fn in_words(error: &RecordingError) -> String {
    match error {
        RecordingError::Io { source, .. } if source.kind() == std::io::ErrorKind::StorageFull => {
            "disk full".into()
        }
        RecordingError::Io { source, .. } => source.to_string(),
        other => other.to_string(),
    }
}
