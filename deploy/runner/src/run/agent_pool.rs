//! Agents of a run in simulation time, one process each.

use std::path::Path;
use std::sync::mpsc::channel;
use std::thread;
use std::time::Duration;

use bus::shutdown::Stop;
use bus::{Bus, Identity};
use deploy::operate::run_folder::RunFolder;
use deploy::operate::security::RunKeys;
use deploy::operate::supervise::{ProcessEventKind, Supervisor};
use ego_fuser_offline::evaluation::EvaluateError;
use ego_fuser_offline::evaluation::stepped::RemotePool;
use protocol::{CavId, ProcessId, RunId};

use crate::fleet::{Fleet, SessionContext};
use crate::run::RunError;
use crate::run::common::check_free;
use crate::run::router_process::Router;

/// Name on the bus of the process that distributes the sweeps.
const NAME: &str = "stepped";
/// Longest time for closing the session.
const LEAVE_LIMIT: Duration = Duration::from_secs(2);

/// Agent processes and their session.
pub(crate) struct AgentProcesses {
    supervisor: Supervisor,
    bus: Bus,
    router: Router,
    grace: Duration,
    _keys: Option<RunKeys>,
}

impl AgentProcesses {
    /// Starts an agent for each vehicle and waits until all have joined.
    ///
    /// # Errors
    /// [`RunError`] when they cannot connect.
    pub(crate) fn start(
        fleet: &Fleet,
        run: &RunId,
        folder: &RunFolder,
        programs: &Path,
    ) -> Result<(Self, RemotePool), RunError> {
        let keys = fleet.keys(folder)?;
        let mut context = SessionContext {
            run,
            endpoint: fleet.scenario.network.endpoint(keys.is_some())?,
            keys: keys.as_ref(),
            programs,
            folder,
        };
        let (events, happened) = channel();
        let stop = Stop::new();
        // A restarted router has lost messages, and the result would depend on the time of the crash.
        let router = Router::start(&fleet.scenario.network, &mut context, 0, &events, &stop)?;
        let specs = fleet.planner(&context)?.specs;
        // Before any process starts: receivers reject the messages of two fleets of one name.
        check_free(&router.place, &fleet.scenario.network, run, &specs)?;
        let process = ProcessId::new(NAME).expect("lower-case letters");
        let cav = CavId::new(NAME).expect("lower-case letters");
        let identity = Identity::new(run.clone(), process, cav);
        let bus = Bus::over(router.place.session.clone(), identity)?;
        // A restarted agent has lost its state, and the result would depend on the time of the crash.
        let supervisor = Supervisor::start(specs, &folder.log_dir(), 0, &events)?;
        // Ends the wait for an agent that has crashed and is not started again.
        thread::spawn({
            let stop = stop.clone();
            move || {
                for event in happened {
                    if let ProcessEventKind::GaveUp { how, .. } = event.what {
                        tracing::error!("{} {how}", event.name);
                        stop.request();
                    }
                }
            }
        });
        let agents = fleet.agents.iter();
        let vehicles = agents.map(|cav| (cav.clone(), fleet.streams_of(cav)));
        let vehicles: Vec<_> = vehicles.collect();
        let timeouts = &fleet.scenario.timeouts;
        let ready = Duration::from_secs_f64(timeouts.ready_s);
        let remote = RemotePool::connect(&bus, &vehicles, ready, &stop);
        let remote = remote.map_err(|error| EvaluateError::from(Box::new(error)))?;
        let processes = Self {
            supervisor,
            bus,
            router,
            grace: Duration::from_secs_f64(timeouts.stop_s),
            _keys: keys,
        };
        Ok((processes, remote))
    }

    /// Ends all processes; returns the names of those that had to be killed.
    pub(crate) fn end(self) -> Vec<String> {
        let killed = self.supervisor.stop(self.grace);
        if let Err(overdue) = self.bus.leave(LEAVE_LIMIT) {
            tracing::warn!("{overdue}");
        }
        self.router.end();
        killed
    }
}
