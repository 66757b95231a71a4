//! `sim-replay record`: records a live run into a file.

use bus::log_to_stderr;
use protocol::{CavId, Role};
use sim_replay::config::RecorderConfig;
use sim_replay::recorder::{self, RecordReport, RecorderError};
use support::output;

use super::{ProcessArgs, join, print_json};
use support::cli::Outcome;

/// Records and prints a summary to standard output.
pub(crate) fn run(args: ProcessArgs<RecorderConfig>) -> anyhow::Result<Outcome> {
    log_to_stderr();
    let config = args.config.validated()?;
    let name = CavId::new("recorder")?;
    let (stop, bus) = join(&config.bus, &config.run, Role::Recorder, &name)?;
    // A failure is reported at once to a process that waits for the report; the last line is the final report.
    let report = recorder::record(&bus, &config, &stop, &mut |report: &RecordReport| {
        if args.json && print_json(report).is_err() {
            tracing::error!("the failure cannot be printed");
        }
    });
    let report = match report {
        Ok(report) => report,
        Err(RecorderError::Recording(error)) => return Ok(Outcome::bad_input(&error)),
        Err(error) => return Err(error.into()),
    };
    print(&report, args.json)?;
    bus.leave_at_end();
    Ok(Outcome::of(!report.is_complete()))
}

fn print(report: &RecordReport, as_json: bool) -> anyhow::Result<()> {
    if as_json {
        return print_json(report);
    }
    let (messages, file) = (report.messages, report.file.display());
    let megabytes = report.bytes as f64 / 1e6;
    output::line(format_args!(
        "{messages} messages, {megabytes:.1} MB in {file}"
    ))?;
    report
        .loss_in_words()
        .map_or(Ok(()), |words| Ok(output::line(words)?))
}
