//! `v2vloc view`.

use std::net::SocketAddr;
use std::sync::Arc;

use crate::operate::status::{Phase, RunStatus};
use crate::view::{LiveRun, serve_live, show_recorded, until_stopped};
use bus::Endpoint;
use dataset::evaluation_protocol::EvaluationProtocol;
use protocol::RunId;
use support::output;

use super::watched_run::WatchedRun;
use support::cli::Outcome;

/// Niceness of the viewer relative to the processes of a run. Not the largest value: on a machine without spare time
/// the page would show nothing.
const VIEWER_NICENESS: i32 = 15;

#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    run: WatchedRun,
    /// Address of the page.
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:8088")]
    page: SocketAddr,
}

impl Arguments {
    /// Serves the page until Ctrl-C.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        if let Some((name, router)) = self.run.remote() {
            return self.show_live(name, router, None);
        }
        let file = self.run.run.clone().filter(|path| path.is_file());
        let path = file.map_or_else(|| self.run.folder(), Ok)?;
        match RunStatus::read(&path) {
            Ok(status) if status.phase == Phase::Running => {
                let (run, endpoint) = (&status.run, &status.endpoint);
                output::note(format_args!("run {run} goes on at {endpoint}"));
                self.show_live(&run.parse()?, &endpoint.parse()?, status.protocol)
            }
            // Without a status it may be or hold a recording.
            _ => {
                show_recorded(&path, self.page)?;
                Ok(Outcome::Done)
            }
        }
    }

    /// Shows a run that goes on, judged by its evaluation protocol if that is known.
    fn show_live(
        &self,
        name: &RunId,
        router: &Endpoint,
        protocol: Option<EvaluationProtocol>,
    ) -> anyhow::Result<Outcome> {
        // On the machine of the run, the run has priority.
        let _ = rustix::process::nice(VIEWER_NICENESS);
        let run = Arc::new(LiveRun::start(self.run.bus(name, router)?, protocol)?);
        until_stopped(self.page, |address| serve_live(address, run))?;
        Ok(Outcome::Done)
    }
}
