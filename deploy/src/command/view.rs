//! `v2vloc view`.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::operate::status::{Phase, RunStatus};
use crate::view::{LiveRun, serve_live, show_recorded, until_stopped};
use bus::Endpoint;
use dataset::evaluation_protocol::EvaluationProtocol;
use protocol::RunId;
use support::output;

use super::viewer_bus;
use support::cli::{BadInput, Outcome};

/// Niceness of the viewer relative to the processes of a run. Not the largest value: on a machine without spare time
/// the page would show nothing.
const VIEWER_NICENESS: i32 = 15;

#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Folder of a run, or its name in --runs: shown live while it goes on, otherwise from its recording (`v2vloc up
    /// --record`); or a recording.mcap [default: the newest run in --runs].
    #[arg(conflicts_with = "connect")]
    run: Option<PathBuf>,
    /// Folder of the run folders.
    #[arg(long, default_value = "runs", conflicts_with = "connect")]
    runs: PathBuf,
    /// Router of a live run without a folder here, tcp/HOST:PORT; `v2vloc up` prints it.
    #[arg(long, requires = "name", value_name = "ENDPOINT")]
    connect: Option<Endpoint>,
    /// Name of the run (--connect).
    #[arg(long = "run", id = "name", requires = "connect", value_name = "NAME")]
    name: Option<RunId>,
    /// Folder with the viewer's keys, where the run has security; `v2vloc keys` writes DIR/viewer (--connect).
    #[arg(long, value_name = "DIR", requires = "connect")]
    keys: Option<PathBuf>,
    /// Address of the page.
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:8088")]
    page: SocketAddr,
}

impl Arguments {
    /// Serves the page until Ctrl-C.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        if let (Some(name), Some(router)) = (&self.name, &self.connect) {
            return self.show_live(name, router, None);
        }
        if let Some(file) = self.run.as_ref().filter(|path| path.is_file()) {
            return self.show_recording(file);
        }
        let folder = RunStatus::folder(self.run.clone(), &self.runs).map_err(BadInput::of)?;
        match RunStatus::read(&folder) {
            Ok(status) if status.phase == Phase::Running => {
                let (run, endpoint) = (&status.run, &status.endpoint);
                output::note(format_args!("run {run} goes on at {endpoint}"));
                self.show_live(&run.parse()?, &endpoint.parse()?, status.protocol)
            }
            // Without a status it may still hold a recording.
            _ => self.show_recording(&folder),
        }
    }

    fn show_recording(&self, path: &Path) -> anyhow::Result<Outcome> {
        show_recorded(path, self.page)?;
        Ok(Outcome::Done)
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
        let bus = viewer_bus(name, router, self.keys.as_deref())?;
        let run = Arc::new(LiveRun::start(bus, protocol)?);
        until_stopped(self.page, |address| serve_live(address, run))?;
        Ok(Outcome::Done)
    }
}
