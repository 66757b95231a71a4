//! `sim-replay link`: the emulated air between the agents of a run and an ego.

use anyhow::Context;
use bus::{BusArgs, PeerArgs, STOP_LIMIT, log_to_stderr};
use link::{Air, PRESETS};
use protocol::{CavId, Role, Stream};
use sim_replay::link_node::{self, LinkReport, NodeOptions};
use support::output;

use support::cli::Outcome;

/// Carry what agents send to an ego, as a wireless link would: late, in a queue, or not at all.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    bus: BusArgs,
    /// The vehicle that receives.
    #[arg(long)]
    ego: CavId,
    /// A preset or a file that describes the link.
    #[arg(long, value_name = "PRESET|FILE", default_value = "ideal", long_help = link_help())]
    link: String,
    /// Same seed, same losses and delays.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// What crosses the link.
    #[arg(long, value_delimiter = ',', default_value = "pose,bev,descriptor")]
    streams: Vec<Stream>,
    #[command(flatten)]
    peers: PeerArgs,
    /// Go on when all agents have ended, for the next ones; always so with --supervised.
    #[arg(long)]
    keep_running: bool,
    /// Print a JSON summary.
    #[arg(long)]
    json: bool,
}

fn link_help() -> String {
    let presets = PRESETS.map(|(name, about)| format!("\n  {name}: {about}")).concat();
    format!("A YAML file with the stages of the link, or a preset:{presets}")
}

/// Carries messages and prints a summary to standard output.
pub(crate) fn run(args: &Args) -> anyhow::Result<Outcome> {
    log_to_stderr();
    let air = match Air::open(&args.link, args.seed) {
        Ok(air) => air,
        Err(error) => {
            output::note(format_args!("error: {error}"));
            return Ok(Outcome::BadInput);
        }
    };
    let stop = args.bus.stop().context("installing signal handlers")?;
    let bus = args.bus.join(Role::Link, &args.ego)?;
    let options = NodeOptions {
        keeps_running: args.keep_running || args.bus.supervised,
        inbox: args.peers.limits(),
        ..NodeOptions::new(args.ego.clone(), args.streams.clone())
    };
    let report = link_node::run(&bus, air, &options, &stop)?;
    print(&report, args.json)?;
    if let Err(overdue) = bus.leave(STOP_LIMIT) {
        tracing::warn!("{overdue}");
    }
    Ok(if report.is_complete() { Outcome::Done } else { Outcome::DataLost })
}

fn print(report: &LinkReport, as_json: bool) -> anyhow::Result<()> {
    if as_json {
        output::line(serde_json::to_string(report)?)?;
        return Ok(());
    }
    let LinkReport { offered, arrived, copies, under_way, longest_ms, dropped } = report;
    output::line(format_args!(
        "{offered} messages: {arrived} arrived, {copies} of them twice, {under_way} still under way"
    ))?;
    for (reason, count) in dropped {
        output::line(format_args!("{count} dropped: {reason}"))?;
    }
    // What the run lost stands last.
    if !report.is_complete() {
        let seconds = *longest_ms as f64 * 1e-3;
        output::line(format_args!(
            "{under_way} of {offered} messages were still under way at the end, the oldest for {seconds:.1} s"
        ))?;
    }
    Ok(())
}
