//! `sim-replay inspect`: contents and faults of a dataset.

use std::fmt::Display;
use std::path::PathBuf;

use dataset::evaluation_protocol::ProtocolConfig;
use dataset::{IntensityScale, OpenOptions, layouts_text};
use serde::Serialize;
use sim_replay::inspect::{inspect, inspect_map};
use support::output;
use terminal::progress;

use support::cli::{BadInput, Outcome};

/// Report the contents of a dataset (agents, frames, points, rates, boxes, merged ground truth) and its faults.
#[derive(Debug, clap::Args)]
#[command(after_help = format!("Layouts, and the files that identify them:\n{}", layouts_text()))]
pub(crate) struct Args {
    /// Dataset, split, scenario or sequence, whose layout is detected; or an OpenDRIVE map (.xodr).
    dir: PathBuf,
    /// Number that stored intensities are divided by [default: 255 for bytes and red; other numbers by the range of
    /// each agent's first sweeps: up to 1 unchanged, up to 255 by 255].
    #[arg(long, value_name = "auto|1|255|NUMBER", default_value_t)]
    #[arg(hide_default_value = true)]
    intensity_scale: IntensityScale,
    #[command(flatten)]
    protocol: ProtocolConfig,
    /// Print JSON instead of a table.
    #[arg(long)]
    json: bool,
}

/// Prints the findings to standard output.
pub(crate) fn run(args: &Args) -> anyhow::Result<Outcome> {
    // The folder of a data set may end in .xodr too.
    let extension = args.dir.extension();
    if extension.is_some_and(|it| it.eq_ignore_ascii_case("xodr")) && args.dir.is_file() {
        if args.protocol != ProtocolConfig::default()
            || args.intensity_scale != IntensityScale::default()
        {
            let map = args.dir.display();
            return Ok(Outcome::bad_input(&format_args!(
                "{map}: a map has no intensities and no protocol: leave such options out"
            )));
        }
        let report = inspect_map(&args.dir).map_err(BadInput::of)?;
        return print(&report, args.json).map(|()| Outcome::Done);
    }
    // The bar hides itself if stderr is no terminal.
    let bar = progress::bar(0, "frames");
    let options = OpenOptions::with_intensity_scale(args.intensity_scale);
    let on_frame = progress::shown_on(&bar);
    let report = inspect(&args.dir, &options, &args.protocol, &on_frame);
    bar.finish_and_clear();
    print(&report, args.json)?;
    Ok(match report.problems.is_empty() {
        true => Outcome::Done,
        false => Outcome::BadInput,
    })
}

/// As JSON, or as a table.
fn print(report: &(impl Serialize + Display), json: bool) -> anyhow::Result<()> {
    let text = match json {
        true => serde_json::to_string_pretty(report)?,
        false => report.to_string(),
    };
    Ok(output::line(text)?)
}
