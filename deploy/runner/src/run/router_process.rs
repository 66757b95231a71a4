//! Router process of a run: started before the fleet, replaced when it fails, ended after it.

use std::ffi::OsString;
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, Sender};
use std::time::Duration;

use bus::ROUTER;
use bus::shutdown::Stop;
use deploy::operate::network::{Network, RouterEndpoint};
use deploy::operate::refusals::{self, RefusalCount};
use deploy::operate::supervise::{
    ProcessEvent, ProcessEventKind, ProcessSpec, RestartPolicy, SuperviseError, Supervisor,
};

use crate::fleet::{Fleet, SessionContext};
use crate::run::RunError;

/// Longest time for the end of the router.
const END_LIMIT: Duration = Duration::from_secs(2);

/// The router of a run and the session of this process on it.
pub(crate) struct Router {
    /// Session and endpoint.
    pub(crate) place: RouterEndpoint,
    /// Absent where the router runs elsewhere.
    process: Option<RouterProcess>,
}

struct RouterProcess {
    supervisor: Supervisor,
    refusals: PathBuf,
}

impl Router {
    /// Starts a router at the endpoint of `context`, unless the scenario names one, and connects to it. Events of its
    /// process go to `events`, whose other end is `happened`.
    ///
    /// # Errors
    /// [`RunError`] when the router does not start or does not answer.
    pub(crate) fn start(
        fleet: &Fleet,
        context: &SessionContext<'_>,
        (events, happened): (&Sender<ProcessEvent>, &Receiver<ProcessEvent>),
        stop: &Stop,
    ) -> Result<Self, RunError> {
        let (network, restarts) = (&fleet.scenario.network, fleet.scenario.timeouts.restarts);
        let process = match network.connect {
            Some(_) => None,
            None => Some(RouterProcess::start(network, context, restarts, events)?),
        };
        match RouterEndpoint::open(context.endpoint, context.keys, stop) {
            Ok(place) => Ok(Self { place, process }),
            // The cause of a router of its own is in its log.
            Err(error) => Err(gave_up(context, happened).unwrap_or(error.into())),
        }
    }

    /// Supervisor of the router; absent where the router runs elsewhere.
    pub(crate) fn supervisor(&self) -> Option<&Supervisor> {
        self.process.as_ref().map(|process| &process.supervisor)
    }

    /// Closes the session and ends the router. Returns the requests that it refused.
    pub(crate) fn end(self) -> Vec<RefusalCount> {
        if let Err(overdue) = self.place.close() {
            tracing::warn!("{overdue}");
        }
        let Some(process) = self.process else {
            return Vec::new();
        };
        process.supervisor.stop(END_LIMIT);
        let refused = refusals::read(&process.refusals).unwrap_or_else(|error| {
            tracing::warn!("{}: {error}", process.refusals.display());
            Vec::new()
        });
        for RefusalCount { rejection, count } in &refused {
            let (peer, reason, what) = (&rejection.peer, &rejection.reason, &rejection.message);
            tracing::warn!(%peer, %reason, %what, count, "refused by the router");
        }
        refused
    }
}

impl RouterProcess {
    fn start(
        network: &Network,
        context: &SessionContext<'_>,
        restarts: u32,
        events: &Sender<ProcessEvent>,
    ) -> Result<Self, SuperviseError> {
        let refusals = context.folder.file("refusals.json");
        let stall_limit_s = network.stall_limit_s.to_string();
        let words = ["router", "--supervised", "--stall-limit-s", &stall_limit_s];
        let mut args: Vec<OsString> = words.map(Into::into).into();
        args.extend(["--listen".into(), context.endpoint.as_str().into()]);
        if network.shared_memory_mib > 0 {
            args.push("--shared-memory".into());
        }
        if let Some(keys) = context.keys {
            args.extend(["--keys".into(), keys.of_process(ROUTER).into()]);
            args.extend(["--run".into(), context.run.as_str().into()]);
            args.extend(["--refusals".into(), refusals.clone().into()]);
        }
        let spec = ProcessSpec {
            name: ROUTER.to_owned(),
            program: context.programs.join("v2vloc"),
            args,
            life: RestartPolicy::Service,
            metrics: None,
        };
        let log_dir = context.folder.log_dir();
        let supervisor = Supervisor::start(vec![spec], &log_dir, restarts, events)?;
        Ok(Self {
            supervisor,
            refusals,
        })
    }
}

/// The end for good of a process, if one has ended.
fn gave_up(context: &SessionContext<'_>, happened: &Receiver<ProcessEvent>) -> Option<RunError> {
    happened.try_iter().find_map(|event| match event.what {
        ProcessEventKind::GaveUp { how, .. } => Some(RunError::Process {
            log: context.folder.log_of(&event.name),
            process: event.name,
            how,
        }),
        _ => None,
    })
}
