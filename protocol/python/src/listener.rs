//! Listener: follows a live run as a passive subscriber and hands over its frames, or its messages.

use std::path::PathBuf;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use bus::bounded_queue::Pop;
use bus::{Bus, BusOptions, Credentials, Endpoint, Identity, PassiveSubscriber, RawMessage};
use dataset::evaluation_protocol::EvaluationProtocol;
use protocol::{CavId, Principal, Role, RunId, Topic, Verb};
use pyo3::types::{IntoPyDict, PyDict};
use pyo3::{Bound, Py, PyAny, PyRef, PyRefMut, PyResult, Python, pyclass, pyfunction, pymethods};

use crate::decode::{DecodedMessage, PyMessage};
use crate::error::error;
use crate::frame::FleetFrame;
use crate::frame_parts::is_part_of_frames;
use crate::live_frames::LiveFrames;
use crate::subscriptions;

/// Interval between two checks for Ctrl-C.
const POLL: Duration = Duration::from_millis(50);
/// Longest time for reaching the router.
const CONNECT_LIMIT: Duration = Duration::from_secs(10);
/// Longest time for closing the connection.
const CLOSE_LIMIT: Duration = Duration::from_secs(2);
/// Queued messages of each topic.
const PLACES: usize = 64;
/// Messages that cannot be decoded and are named; all are counted.
const MOST_NAMED: usize = 100;

/// Frames of a live run as they arrive.
#[pyclass(module = "v2vloc")]
pub(crate) struct Listener {
    connection: Option<(Bus, PassiveSubscriber)>,
    endpoint: Endpoint,
    timeout: Option<Duration>,
    frames: LiveFrames,
    last_message: Instant,
    /// The same without status messages.
    last_data: Instant,
    messages: u64,
    undecodable: u64,
    /// Counts of messages that a closed connection had lost.
    lost: [u64; 2],
    #[pyo3(get)]
    problems: Vec<String>,
    /// The replay has published its end.
    is_over: bool,
}

impl Listener {
    /// The next message, waiting for one so long: without Python's lock, and such that Ctrl-C interrupts. Closed if no
    /// message will follow.
    fn step(&mut self, py: Python<'_>, wait: Duration) -> PyResult<Pop<Topic, RawMessage>> {
        py.check_signals()?;
        let Some((bus, subscriber)) = &self.connection else {
            return Ok(Pop::Closed);
        };
        let has_ended = self.is_over && self.last_data.elapsed() >= self.frames.settle;
        // After the end only what is queued is still handed out.
        let wait = if has_ended { Duration::ZERO } else { wait };
        match py.detach(|| subscriber.take(Some(Instant::now() + wait))) {
            // Its own status is no sign that the run is there.
            Pop::Item(Topic::Stats(process), _) if process == *bus.stats().process() => {
                self.silence()
            }
            Pop::Item(topic, message) => {
                self.last_message = Instant::now();
                self.is_over |= topic == Topic::Control(Verb::End);
                self.messages += u64::from(!matches!(topic, Topic::Control(_)));
                // Processes that outlive the replay go on with their status.
                if !matches!(topic, Topic::Stats(_)) {
                    self.last_data = Instant::now();
                }
                Ok(Pop::Item(topic, message))
            }
            Pop::Closed => Ok(Pop::Closed),
            Pop::TimedOut if has_ended => Ok(Pop::Closed),
            Pop::TimedOut => self.silence(),
        }
    }

    /// Nothing has arrived: the end, or a run that is not there.
    fn silence(&self) -> PyResult<Pop<Topic, RawMessage>> {
        let silent = self.last_message.elapsed();
        match self.timeout {
            Some(timeout) if silent >= timeout && self.messages == 0 => Err(error(format!(
                "no message of run {:?} at {} within {:.1} s: `v2vloc status` lists runs",
                self.frames.run,
                self.endpoint,
                timeout.as_secs_f64()
            ))),
            Some(timeout) if silent >= timeout => Ok(Pop::Closed),
            _ => Ok(Pop::TimedOut),
        }
    }

    /// Counts a message that cannot be decoded, and names it.
    fn reject(&mut self, key: &protocol::Key, cause: &protocol::WireError) {
        self.undecodable += 1;
        if self.problems.len() < MOST_NAMED {
            self.problems.push(format!("{key}: {cause}"));
        }
    }

    fn disconnect(&mut self) {
        if let Some((bus, subscriber)) = self.connection.take() {
            self.lost = lost(&subscriber);
            // Subscriptions have to end before the bus is left.
            drop(subscriber);
            // A connection that does not close in time closes with the process.
            let _ = bus.leave(CLOSE_LIMIT);
        }
    }
}

impl Drop for Listener {
    fn drop(&mut self) {
        self.disconnect();
    }
}

#[pymethods]
impl Listener {
    fn __iter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
        slf
    }

    fn __next__(&mut self, py: Python<'_>) -> PyResult<Option<FleetFrame>> {
        loop {
            if let Some(parts) = self.frames.ready.pop_front() {
                return FleetFrame::new(py, parts).map(Some);
            }
            // A loop that is slow finds messages in the queue that belong to frames which look complete.
            let is_settled = self.frames.is_settled();
            match self.step(py, if is_settled { Duration::ZERO } else { POLL })? {
                Pop::Item(topic, message) if is_part_of_frames(&topic) => {
                    let frames = &mut self.frames;
                    if let Err(cause) = py.detach(|| frames.add(&message)) {
                        self.reject(&message.key, &cause);
                    }
                }
                Pop::TimedOut if is_settled => self.frames.hand_over_oldest(),
                Pop::Item(..) | Pop::TimedOut => {}
                Pop::Closed => {
                    self.frames.finish();
                    let last = self.frames.ready.pop_front();
                    return last.map(|parts| FleetFrame::new(py, parts)).transpose();
                }
            }
        }
    }

    /// Single messages instead of frames.
    fn messages(slf: Py<Self>) -> MessageIterator {
        MessageIterator { listener: slf }
    }

    /// Leaves the run.
    fn close(&mut self, py: Python<'_>) {
        py.detach(|| self.disconnect());
    }

    fn __enter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
        slf
    }

    #[pyo3(signature = (*_cause))]
    fn __exit__(&mut self, py: Python<'_>, _cause: &Bound<'_, PyAny>) {
        self.close(py);
    }

    #[getter]
    fn run(&self) -> &str {
        &self.frames.run
    }

    #[getter]
    fn counts<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let connection = self.connection.as_ref();
        let [overwritten, undelivered] =
            connection.map_or(self.lost, |(_, subscriber)| lost(subscriber));
        let counts = [
            ("messages", self.messages),
            ("undecodable", self.undecodable),
            ("late", self.frames.late),
            ("overwritten", overwritten),
            ("undelivered", undelivered),
        ];
        counts.into_py_dict(py)
    }

    fn __repr__(&self) -> String {
        let state = self.connection.as_ref().map_or(", closed", |_| "");
        format!(
            "Listener(run={:?}, {} messages{state})",
            self.frames.run, self.messages
        )
    }
}

/// Messages of a live run as they arrive.
#[pyclass(module = "v2vloc")]
pub(crate) struct MessageIterator {
    listener: Py<Listener>,
}

#[pymethods]
impl MessageIterator {
    fn __iter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
        slf
    }

    fn __next__(&self, py: Python<'_>) -> PyResult<Option<PyMessage>> {
        // An iterator on another thread may be inside: then this is an error of Python, not a deadlock.
        let mut listener: PyRefMut<'_, Listener> = self.listener.try_borrow_mut(py)?;
        loop {
            let message = match listener.step(py, POLL)? {
                Pop::Item(topic, message) if !topic.is_json() => message,
                Pop::Item(..) | Pop::TimedOut => continue,
                Pop::Closed => return Ok(None),
            };
            match py.detach(|| DecodedMessage::of_key(&message.key, &message.bytes())) {
                Ok(decoded) => {
                    return PyMessage::new(py, Some(message.key.to_string()), decoded).map(Some);
                }
                Err(cause) => listener.reject(&message.key, &cause),
            }
        }
    }
}

/// Follows a live run.
#[pyfunction]
#[pyo3(signature = (endpoint="tcp/127.0.0.1:7447", run=None, *, timeout_s=Some(10.0), credentials=None, streams=None, settle_s=1.0))]
pub(crate) fn listen(
    py: Python<'_>,
    endpoint: &str,
    run: Option<&str>,
    timeout_s: Option<f64>,
    credentials: Option<PathBuf>,
    streams: Option<Vec<String>>,
    settle_s: f64,
) -> PyResult<Listener> {
    let run = run.ok_or_else(|| {
        error("run: give the name of the run; `v2vloc up` prints it, `v2vloc status` lists runs")
    })?;
    let run = RunId::new(run).map_err(error)?;
    let endpoint = endpoint.parse::<Endpoint>().map_err(error)?;
    let timeout = timeout_s
        .map(|seconds| seconds_of("timeout_s", seconds))
        .transpose()?;
    let settle = seconds_of("settle_s", settle_s)?;
    let mut options = BusOptions::client(endpoint.clone());
    options.connect_timeout = timeout.unwrap_or(CONNECT_LIMIT).min(CONNECT_LIMIT);
    let (mut principal, mut access) = (anonymous()?, None);
    if let Some(folder) = credentials {
        let credentials = Credentials::read(&folder).map_err(error)?;
        principal = credentials.name().parse().map_err(error)?;
        access = subscriptions::access_of(&principal, &run);
        options = options.with_credentials(credentials);
    }
    let selectors = subscriptions::selectors(&run, streams, &access)?;
    let identity = Identity::new(run.clone(), principal.name(), principal.cav);
    let connection: Result<_, bus::BusError> = py.detach(|| {
        let bus = Bus::join(&options, identity)?;
        let subscriber = bus.tap(&selectors, PLACES)?;
        Ok((bus, subscriber))
    });
    let connection = connection.map_err(error)?;
    let protocol = EvaluationProtocol::preset("opv2v").ok_or_else(|| error("no protocol opv2v"))?;
    Ok(Listener {
        connection: Some(connection),
        frames: LiveFrames::new(run.as_str(), settle, protocol),
        endpoint,
        timeout,
        last_message: Instant::now(),
        last_data: Instant::now(),
        messages: 0,
        undecodable: 0,
        lost: [0; 2],
        problems: Vec::new(),
        is_over: false,
    })
}

/// Messages that were overwritten in the queue, and that the router did not deliver.
fn lost(subscriber: &PassiveSubscriber) -> [u64; 2] {
    [subscriber.overwritten(), subscriber.undelivered()]
}

fn seconds_of(name: &str, seconds: f64) -> PyResult<Duration> {
    Duration::try_from_secs_f64(seconds)
        .map_err(|cause| error(format!("{name}: {seconds}: {cause}")))
}

/// A viewer of a name of its own: several listeners of a process, or of several, may follow one run.
fn anonymous() -> PyResult<Principal> {
    static LISTENERS: AtomicU32 = AtomicU32::new(0);
    let number = LISTENERS.fetch_add(1, Ordering::Relaxed);
    let cav = CavId::new(&format!("python-{}-{number}", std::process::id())).map_err(error)?;
    Ok(Principal::new(Role::Viewer, &cav))
}
