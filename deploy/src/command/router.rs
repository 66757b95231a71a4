//! `v2vloc router`.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::Context;
use bus::shutdown::Stop;
use bus::{
    BusOptions, Endpoint, RejectionLog, RouterProbe, RouterRejection, SharedMemory, open,
    process_usage,
};
use protocol::{RunId, RunScope};
use support::output;
use zenoh::{Session, Wait};

use crate::operate::network::from_here;
use crate::operate::router_panic;
use crate::operate::router_report::RouterReport;
use crate::operate::router_watch;
use crate::operate::security::guarded;
use support::cli::Outcome;

/// Interval between looks at the router.
const LOOK_ROUND: Duration = Duration::from_millis(200);
/// Interval between reports of refused requests.
const REPORT_ROUND: Duration = Duration::from_secs(5);
/// Longest time for opening the session that watches the router.
const PROBE_LIMIT: Duration = Duration::from_secs(2);

#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Endpoint to listen on, tcp/HOST:PORT; with --keys the same address speaks QUIC (UDP).
    #[arg(long, default_value = "tcp/127.0.0.1:7447")]
    listen: Endpoint,
    /// Folder with the router's keys (`v2vloc keys` writes DIR/router): every process has to show a certificate, and is
    /// restricted to its own topics.
    #[arg(long, value_name = "DIR")]
    keys: Option<PathBuf>,
    /// The only run that is admitted (--keys) [default: any].
    #[arg(long, requires = "keys")]
    run: Option<RunId>,
    /// Longest time for handing one map or sweep to one receiver on another host before its connection is closed,
    /// seconds. Other receivers do not wait for it.
    #[arg(long, value_name = "S", default_value_t = 5.0, value_parser = seconds)]
    stall_limit_s: f64,
    /// Route the messages that processes of this machine have in shared memory there: sockets carry descriptors only.
    #[arg(long)]
    shared_memory: bool,
    /// Largest message, MiB.
    #[arg(long, default_value_t = 32)]
    max_message_mib: usize,
    /// Write the same settings as a configuration for `zenohd -c FILE`, and do not run.
    #[arg(long, value_name = "FILE")]
    zenohd: Option<PathBuf>,
    /// File for CPU time, memory and refused requests, in JSON, every 5 s and at the end; a restarted router adds to it.
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    /// End when standard input ends: for a supervisor that holds the other end of the pipe.
    #[arg(long)]
    supervised: bool,
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if (0.1..=3600.0).contains(&seconds) => Ok(seconds),
        Ok(_) => Err("0.1 to 3600 s".to_owned()),
        Err(_) => Err("not a number".to_owned()),
    }
}

impl Arguments {
    /// Routes messages until Ctrl-C.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        let options = self.options()?;
        if let Some(path) = &self.zenohd {
            let text = serde_json::to_string_pretty(&options.for_zenohd())? + "\n";
            support::atomic_file::write(path, text).with_context(|| path.display().to_string())?;
            output::note(path.display());
            return Ok(Outcome::Done);
        }
        let stop = Stop::of_process(self.supervised)?;
        // Before the session opens, whose threads it watches.
        router_panic::watch(&stop);
        let session = open(&options)?;
        let endpoint = &options.endpoint;
        output::note(format_args!("routing at {endpoint} (Ctrl-C ends it)"));
        let mut reporter = self.reporter(&options);
        let mut report_at = Instant::now() + REPORT_ROUND;
        let mut probe = self.probe(&session, &options);
        let failure = loop {
            let ended = stop.wait_until(Instant::now() + LOOK_ROUND);
            let silence = probe.as_mut().map(|probe| probe.silence(Instant::now()));
            if let Some(panic) = router_panic::first() {
                break Some(panic.to_owned());
            } else if let Some(silence) = silence.filter(|silence| *silence > router_watch::LIMIT) {
                break Some(router_watch::in_words(silence));
            }
            // Also at the end, or what came since the last report would be lost.
            if ended || Instant::now() > report_at {
                report_at = Instant::now() + REPORT_ROUND;
                reporter.report(&session);
            }
            if ended {
                break None;
            }
        };
        if let Some(failure) = failure {
            output::error(format_args!("the router failed and ends: {failure}"));
            // Closing a session whose lock is poisoned would abort, or never end.
            std::process::exit(1);
        }
        if let Some(probe) = probe {
            probe.end(false);
        }
        session.close().wait().map_err(anyhow::Error::from_boxed)?;
        Ok(Outcome::Done)
    }

    fn reporter(&self, options: &BusOptions) -> Reporter {
        let file = self.report.as_ref().map(|file| {
            // A damaged report is no reason not to route.
            let before = RouterReport::read(file).unwrap_or_else(|error| {
                tracing::warn!("{}: {error}; the report begins anew", file.display());
                RouterReport::default()
            });
            (file.clone(), before)
        });
        let guard = options.guard.as_ref();
        Reporter {
            log: guard.map(|_| RejectionLog::of(&options.endpoint)),
            refused: BTreeMap::new(),
            file,
        }
    }

    /// A second session that has to receive what the router's own publishes; `None`, with a warning, if the router cannot
    /// be reached at its address.
    fn probe(&self, router: &Session, options: &BusOptions) -> Option<RouterProbe> {
        let probe = from_here(&options.endpoint).and_then(|endpoint| {
            let client = BusOptions {
                connect_timeout: PROBE_LIMIT,
                credentials: options.credentials.clone(),
                ..BusOptions::client(endpoint)
            };
            RouterProbe::of_router(router, &client)
        });
        probe
            .inspect_err(|error| tracing::warn!("the router is not watched: {error}"))
            .ok()
    }

    fn options(&self) -> anyhow::Result<BusOptions> {
        let mut options = BusOptions::router(self.listen.clone());
        options.stall_limit = Duration::from_secs_f64(self.stall_limit_s);
        if self.shared_memory {
            options.shared_memory = SharedMemory::Attached;
        }
        options.max_message_bytes = self.max_message_mib.max(1) << 20;
        let Some(folder) = &self.keys else {
            return Ok(options);
        };
        let runs = self.run.clone().map_or(RunScope::Any, RunScope::One);
        Ok(guarded(options, folder, runs)?)
    }
}

/// Reporter of a router.
struct Reporter {
    /// Absent without keys, where nothing is refused.
    log: Option<RejectionLog>,
    /// Refused requests so far.
    refused: BTreeMap<RouterRejection, u64>,
    /// File, and the report of the routers before.
    file: Option<(PathBuf, RouterReport)>,
}

impl Reporter {
    /// Logs what was refused since the report before, and writes the file.
    fn report(&mut self, router: &Session) {
        if let Some(log) = &mut self.log {
            log.update(router);
            let counts = log.counts();
            for (refusal, count) in &counts {
                if self.refused.get(refusal) != Some(count) {
                    let (peer, reason, what) = (&refusal.peer, &refusal.reason, &refusal.message);
                    tracing::warn!(peer, reason, what, count, "refused");
                }
            }
            self.refused = counts;
        }
        if let Some((file, before)) = &self.file
            && let Err(error) = before.plus(&process_usage(), &self.refused).write(file)
        {
            tracing::warn!("{}: {error}", file.display());
        }
    }
}
