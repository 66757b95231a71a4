//! Router process of a run: started before the fleet, replaced when it fails, ended after it.

use std::ffi::OsString;
use std::path::PathBuf;
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use bus::shutdown::Stop;
use bus::{BusError, ROUTER, STOP_LIMIT};
use deploy::operate::network::{Network, RouterEndpoint};
use deploy::operate::router_report::RouterReport;
use deploy::operate::supervise::{
    ProcessEvent, ProcessEventKind, ProcessSpec, RestartPolicy, SuperviseError, Supervisor,
};
use support::sync::spawn;

use crate::fleet::SessionContext;
use crate::run::RunError;

/// Longest time for the end of the router, which takes [`STOP_LIMIT`] itself at most.
const END_LIMIT: Duration = STOP_LIMIT.saturating_add(Duration::from_secs(1));

/// The router of a run and the session of this process on it.
pub(crate) struct Router {
    /// Session and endpoint.
    pub(crate) place: RouterEndpoint,
    /// Absent where the router runs elsewhere.
    process: Option<RouterProcess>,
}

struct RouterProcess {
    supervisor: Supervisor,
    report: PathBuf,
    /// Description of its end for good.
    gave_up: Arc<OnceLock<String>>,
}

impl Router {
    /// Starts a router at the endpoint of `context`, unless the scenario names one, and connects to it; the endpoint of
    /// `context` is then the one that the other processes are given. The router is restarted at most `restarts` times;
    /// its events go to `events`.
    ///
    /// # Errors
    /// [`RunError`] when the router does not start or does not answer, or `stop` is requested.
    pub(crate) fn start(
        network: &Network,
        context: &mut SessionContext<'_>,
        restarts: u32,
        events: &Sender<ProcessEvent>,
        stop: &Stop,
    ) -> Result<Self, RunError> {
        // Ends the wait for a router: requested by the user, or by the end of the router for good.
        let wait = Stop::new();
        stop.on_request({
            let wait = wait.clone();
            move || wait.request()
        });
        let is_own = network.connect.is_none();
        let process = is_own
            .then(|| RouterProcess::start(network, context, restarts, events.clone(), &wait))
            .transpose()?;
        match RouterEndpoint::open(&context.endpoint, context.keys, &wait) {
            Ok(place) => {
                context.endpoint = place.endpoint.clone();
                Ok(Self { place, process })
            }
            Err(error) => Err(match (process, error) {
                (Some(process), BusError::Unreachable { .. } | BusError::Stopped { .. })
                    if !stop.requested() =>
                {
                    let how = process.gave_up.get().cloned();
                    RunError::Process {
                        process: ROUTER.to_owned(),
                        how: how.unwrap_or_else(|| "does not answer".to_owned()),
                        log: context.folder.log_of(ROUTER),
                    }
                }
                (_, error) => error.into(),
            }),
        }
    }

    /// Supervisor of the router; absent where the router runs elsewhere.
    pub(crate) fn supervisor(&self) -> Option<&Supervisor> {
        self.process.as_ref().map(|process| &process.supervisor)
    }

    /// Closes the session and ends the router. Returns its report, and true if it had to be killed; `None` where the
    /// router runs elsewhere.
    pub(crate) fn end(self) -> Option<(RouterReport, bool)> {
        if let Err(overdue) = self.place.close() {
            tracing::warn!("{overdue}");
        }
        let process = self.process?;
        let killed = !process.supervisor.stop(END_LIMIT).is_empty();
        let report = RouterReport::read(&process.report).unwrap_or_else(|error| {
            tracing::warn!("{}: {error}", process.report.display());
            RouterReport::default()
        });
        for refusal in &report.refused {
            let (rejection, count) = (&refusal.rejection, refusal.count);
            let (peer, reason, what) = (&rejection.peer, &rejection.reason, &rejection.message);
            tracing::warn!(%peer, %reason, %what, count, "refused by the router");
        }
        Some((report, killed))
    }
}

impl RouterProcess {
    fn start(
        network: &Network,
        context: &SessionContext<'_>,
        restarts: u32,
        events: Sender<ProcessEvent>,
        wait: &Stop,
    ) -> Result<Self, SuperviseError> {
        let report = context.folder.file("router.json");
        let stall_limit_s = network.stall_limit_s.to_string();
        let words = ["router", "--supervised", "--stall-limit-s", &stall_limit_s];
        let mut args: Vec<OsString> = words.map(Into::into).into();
        args.extend(["--listen".into(), context.endpoint.as_str().into()]);
        args.extend(["--report".into(), report.clone().into()]);
        if network.shared_memory_mib > 0 {
            args.push("--shared-memory".into());
        }
        if let Some(keys) = context.keys {
            args.extend(["--keys".into(), keys.of_process(ROUTER).into()]);
            args.extend(["--run".into(), context.run.as_str().into()]);
        }
        let spec = ProcessSpec {
            name: ROUTER.to_owned(),
            program: context.programs.join("v2vloc"),
            args,
            life: RestartPolicy::Service,
            metrics: None,
        };
        let (own, happened) = channel();
        let log_dir = context.folder.log_dir();
        let supervisor = Supervisor::start(vec![spec], &log_dir, restarts, &own)?;
        let gave_up = Arc::new(OnceLock::new());
        // Ends with the supervisor.
        let passing_on = spawn("router-events", {
            let (gave_up, wait) = (Arc::clone(&gave_up), wait.clone());
            move || {
                for event in happened {
                    if let ProcessEventKind::GaveUp { how, .. } = &event.what {
                        let _ = gave_up.set(how.clone());
                        wait.request();
                    }
                    if events.send(event).is_err() {
                        break;
                    }
                }
            }
        });
        passing_on.map_err(SuperviseError::Runtime)?;
        Ok(Self {
            supervisor,
            report,
            gave_up,
        })
    }
}
