//! `sim-replay synth`: generate scenes.

use std::collections::BTreeMap;
use std::io;
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::time::Instant;

use simulator::generate::{
    self, ImageSize, SceneLayout, Subset, Summary, SynthError, SynthOptions, Weather,
};
use simulator::map::RoadMapSource;
use support::output;
use terminal::progress;

use support::cli::{BadInput, Outcome};

/// Findings of a map that are printed one by one.
const PRINTED_FINDINGS: usize = 20;

/// Generate scenes, in the layout of OPV2V or another: the same arguments give the same files, byte for byte.
///
/// Seeds 0 to 999 are for training and validation, seeds from 1000 on for measuring only.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Subset of V2VLoc to imitate: one agent on several traversals of a map, or several agents together.
    #[arg(long, value_enum)]
    subset: Subset,
    /// Determines routes, lanes, speeds, traffic, parked vehicles and noise.
    #[arg(long)]
    seed: u64,
    /// Folder for the scenarios; made if missing.
    #[arg(long)]
    out: PathBuf,
    /// Layout of the files.
    #[arg(long, value_enum, default_value_t)]
    layout: SceneLayout,
    /// town1, town4 or an OpenDRIVE map (.xodr). By default that of the subset; v2vdet takes both in turn.
    #[arg(long, value_parser = parse_map)]
    map: Option<RoadMapSource>,
    /// Determines roads, buildings, trees and signs.
    #[arg(long, default_value_t = 0)]
    map_seed: u64,
    /// Number of scenarios; of town1loc and town4loc each is another drive through the map.
    #[arg(long, value_name = "N", default_value_t = 1)]
    scenes: usize,
    /// Vehicles of a v2vdet scenario, a number or a range [default: 2-4].
    #[arg(long, value_name = "N|N-N", value_parser = parse_vehicles)]
    vehicles: Option<RangeInclusive<usize>>,
    /// The weather of all scenarios.
    #[arg(long, value_enum, default_value_t)]
    weather: Weather,
    /// Write every sweep in these weathers too, beside the plain one and named as in V2X-R: fog, snow or both. Clutter
    /// points (fog, snow) have 1 in the green byte of their colour, all others 0. Annotations are the objects hit by
    /// the plain sweep.
    #[arg(long, value_enum, value_delimiter = ',', value_name = "WEATHER")]
    weather_copies: Vec<Weather>,
    /// Render the images of four cameras per vehicle (ahead, right, left, back; 100 degrees wide), for example 480x300.
    #[arg(long, value_name = "WIDTHxHEIGHT")]
    cameras: Option<ImageSize>,
    /// Frames of each scenario [default: 60 for v2vdet, 2000 for the others].
    #[arg(long)]
    frames: Option<usize>,
    /// Simulated seconds from one frame to the next, a multiple of 0.05.
    #[arg(long, value_name = "S", default_value_t = 0.1)]
    period_s: f64,
    /// Write into a folder that is not empty; scenarios of the same name are replaced, and so are the common files of
    /// all scenarios.
    #[arg(long)]
    force: bool,
    /// Print a JSON summary.
    #[arg(long)]
    json: bool,
    /// Threads that cast rays and write files [default: one per core].
    #[arg(long)]
    threads: Option<usize>,
}

/// Generates and prints a summary to standard output.
pub(crate) fn run(args: Args) -> anyhow::Result<Outcome> {
    let json = args.json;
    let options = options(args)?;
    let bar = progress::percent_bar(options.scenes);
    let start = Instant::now();
    let result = generate::generate(&options, &|thousandths| bar.set_position(thousandths));
    bar.finish_and_clear();
    match result {
        Ok(summary) => {
            // Prints the parts that were not built as the map gives them to standard error.
            for finding in summary.findings.iter().take(PRINTED_FINDINGS) {
                output::note(format_args!("map: {finding}"));
            }
            let further = summary.findings.len().saturating_sub(PRINTED_FINDINGS);
            if further > 0 {
                output::note(format_args!(
                    "map: {further} further findings; all are in data_protocol.yaml of each scenario"
                ));
            }
            print(&summary, &options, start.elapsed().as_secs_f64(), json)?;
            Ok(Outcome::Done)
        }
        // The options are valid here: the disk, or the traffic of this seed, is the cause.
        Err(error @ (SynthError::Write(_) | SynthError::TooFewCompanions { .. })) => {
            Err(error.into())
        }
        Err(error) => Ok(Outcome::bad_input(&error)),
    }
}

fn options(args: Args) -> Result<SynthOptions, BadInput> {
    let defaults = SynthOptions::new(args.subset, args.seed, args.out);
    if args.vehicles.is_some() && args.subset != Subset::V2vdet {
        let subset = args.subset.name();
        return Err(BadInput::new(format!(
            "--vehicles is for --subset v2vdet: in {subset} one vehicle drives alone"
        )));
    }
    Ok(SynthOptions {
        layout: args.layout,
        map: args.map,
        map_seed: args.map_seed,
        scenes: args.scenes,
        weather: args.weather,
        copies: args.weather_copies,
        cameras: args.cameras,
        period_s: args.period_s,
        force: args.force,
        threads: args.threads.unwrap_or(defaults.threads).max(1),
        agents: args.vehicles.unwrap_or_else(|| defaults.agents.clone()),
        frames: args.frames.unwrap_or(defaults.frames),
        ..defaults
    })
}

fn print(summary: &Summary, options: &SynthOptions, seconds: f64, json: bool) -> io::Result<()> {
    let (scenarios, agent_frames) = (summary.scenarios, summary.agent_frames);
    let (layout, omitted) = (options.layout, &summary.omitted);
    let [points, vehicles] = [summary.points, summary.annotations]
        .map(|count| count as f64 / agent_frames.max(1) as f64);
    if json {
        let report = serde_json::json!({
            "out": options.out, "layout": layout.name(), "scenarios": scenarios, "agent_frames": agent_frames,
            "points_per_frame": points, "vehicles_per_frame": vehicles, "omitted": omitted,
            "seconds": seconds, "map_findings": summary.findings,
        });
        return output::line(report);
    }
    let out = options.out.display();
    output::line(format_args!(
        "{out}: {scenarios} scenarios, {agent_frames} agent-frames, layout {}",
        layout.name()
    ))?;
    output::line(format_args!(
        "{points:.0} points and {vehicles:.1} annotated vehicles a frame"
    ))?;
    output::line(format_args!(
        "{seconds:.1} s, {:.0} agent-frames a second",
        agent_frames as f64 / seconds
    ))?;
    print_omitted(omitted)
}

/// Prints the data that a layout cannot hold.
pub(super) fn print_omitted(omitted: &BTreeMap<&'static str, u64>) -> io::Result<()> {
    omitted.iter().try_for_each(|(what, count)| {
        output::line(format_args!("not in this layout: {count} {what}"))
    })
}

fn parse_map(text: &str) -> Result<RoadMapSource, String> {
    match text {
        "town1" => Ok(RoadMapSource::Town1),
        "town4" => Ok(RoadMapSource::Town4),
        path if path.to_lowercase().ends_with(".xodr") => Ok(RoadMapSource::OpenDrive(path.into())),
        _ => Err("expected town1, town4 or a file that ends in .xodr".into()),
    }
}

fn parse_vehicles(text: &str) -> Result<RangeInclusive<usize>, String> {
    let (low, high) = text.split_once('-').unwrap_or((text, text));
    let [low, high] = [low, high].map(|text| {
        let number = text.trim().parse::<usize>();
        number.map_err(|_| format!("{text:?} is no number"))
    });
    Ok(low?..=high?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vehicles_are_a_number_or_a_range() {
        assert_eq!(parse_vehicles("3"), Ok(3..=3));
        assert_eq!(parse_vehicles("2-4"), Ok(2..=4));
        assert!(parse_vehicles("many").is_err());
    }

    #[test]
    fn maps_are_names_or_files() {
        assert_eq!(parse_map("town4"), Ok(RoadMapSource::Town4));
        assert_eq!(
            parse_map("a/Town01.xodr"),
            Ok(RoadMapSource::OpenDrive("a/Town01.xodr".into()))
        );
        assert!(parse_map("town2").is_err());
    }
}
