//! `sim-replay link`: link emulation between the agents of a run and an ego.

use bus::log_to_stderr;
use clap::{Arg, ArgMatches, Command, FromArgMatches};
use link::{LinkConfig, LinkEmulator};
use protocol::Role;
use sim_replay::config::LinkProcessConfig;
use sim_replay::link_node::{self, LinkReport, NodeOptions};
use support::output;

use super::{ProcessArgs, join, print_json};
use support::cli::{BadInput, Outcome};

/// Forward the agents' messages to an ego as a wireless link would: delayed, queued or lost.
#[derive(Debug)]
pub(crate) enum Args {
    /// Forwards messages.
    Forward(Box<ForwardArgs>),
    /// Prints a link by its name or file.
    Print(String),
}

type ForwardArgs = ProcessArgs<LinkProcessConfig>;

impl clap::Args for Args {
    fn augment_args(command: Command) -> Command {
        let print = Arg::new("print")
            .long("print")
            .value_name("PRESET|FILE")
            .exclusive(true);
        let help = "Print a link as YAML, every field with its value, and exit: a start for a file of one's own";
        let about = "Forward the agents' messages to an ego as a wireless link would: delayed, queued or lost";
        // Last: the settings bring a description of their own.
        ForwardArgs::augment_args(command)
            .arg(print.help(help))
            .about(about)
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

impl FromArgMatches for Args {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        match matches.get_one::<String>("print") {
            Some(name) => Ok(Self::Print(name.clone())),
            None => {
                ForwardArgs::from_arg_matches(matches).map(|args| Self::Forward(Box::new(args)))
            }
        }
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

/// Forwards messages and prints a summary to standard output, or prints a link.
pub(crate) fn run(args: Args) -> anyhow::Result<Outcome> {
    match args {
        Args::Forward(args) => forward(*args),
        Args::Print(name) => {
            let (link, _) = LinkConfig::open(&name).map_err(BadInput::of)?;
            output::text(link.to_yaml())?;
            Ok(Outcome::Done)
        }
    }
}

fn forward(args: ForwardArgs) -> anyhow::Result<Outcome> {
    log_to_stderr();
    let config = args.config.validated()?;
    let emulator = LinkEmulator::open(&config.link.model, config.link.seed);
    let emulator = emulator.map_err(BadInput::of)?;
    let (stop, bus) = join(&config.bus, &config.run, Role::Link, &config.ego)?;
    let options = NodeOptions {
        ego: config.ego,
        streams: config.streams,
        keeps_running: config.keep_running || config.bus.supervised,
        // 1 GiB in flight.
        max_kept_bytes: 1 << 30,
        inbox: config.inbox.limits(),
    };
    let report = link_node::run(&bus, emulator, &options, &stop)?;
    print(&report, args.json)?;
    bus.leave_at_end();
    Ok(Outcome::of(!report.is_complete()))
}

fn print(report: &LinkReport, as_json: bool) -> anyhow::Result<()> {
    if as_json {
        return print_json(report);
    }
    let (submitted, under_way) = (report.submitted, report.under_way);
    let (arrived, copies) = (report.arrived, report.copies);
    output::line(format_args!(
        "{submitted} messages: {arrived} arrived, {copies} of them twice, {under_way} still in flight"
    ))?;
    for (reason, count) in &report.dropped {
        output::line(format_args!("{count} dropped: {reason}"))?;
    }
    // The losses of the run are printed last.
    if !report.is_complete() {
        let seconds = report.longest_ms as f64 * 1e-3;
        output::line(format_args!(
            "{under_way} of {submitted} messages were still in flight at the end, the oldest for {seconds:.1} s"
        ))?;
    }
    Ok(())
}
