//! `ego-fuser align`: alignment methods without GNSS, side by side.

use std::path::PathBuf;
use std::sync::Arc;

use agent::agent::Agent;
use agent_offline::icp_map::{IcpMapPose, read_map};
use anyhow::{Context, Result};
use clap::ValueEnum;
use dataset::frame::Frame;
use dataset::{self, Dataset, LeftOut, Scenario};
use ego_fuser_offline::alignment::{AlignmentSpec, BoxIcp, CloudIcp, FreeAlign, Poses};
use ego_fuser_offline::evaluation::alignment::table::{MethodRow, PairTally, markdown};
use ego_fuser_offline::evaluation::alignment::{self, BoxSource};
use localization::pose_source::{PoseSource, PoseSourceConfig, RecordedPose};
use localization::registration::icp::IcpConfig;
use perception::detector::Detector;
use perception::inference::Inference;
use protocol::CavId;
use support::config_file;
use support::file_error::AtFile;
use support::output;
use tch::Device;
use terminal::progress;

use super::{DataSets, print_left_out, rows_with_provenance};
use support::cli::{BadInput, Outcome};

/// Compares methods to align the ego and a neighbour: time per pair, transmitted bytes, success.
///
/// Pairs are the ego and every neighbour within the communication range of the data set's protocol, at every tick. A pair
/// that is not aligned counts as missed.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    data: DataSets,
    /// Methods; none named: all but icp-map.
    #[arg(long, num_args = 1.., value_delimiter = ',', value_enum)]
    method: Vec<BuiltIn>,
    /// One more method: the poses of a source, described as in a scenario file. May be repeated.
    #[arg(long, value_name = "NAME=FILE.yaml", value_parser = parse_source)]
    pose_source: Vec<(String, PathBuf)>,
    /// Sources of boxes; with several, methods that match boxes have a row for each.
    #[arg(long, value_enum, num_args = 1.., value_delimiter = ',', default_value = "detected")]
    boxes: Vec<BoxOrigin>,
    /// Weights of the detector, for detected boxes.
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    /// Drives through the same place with true poses from which the map of icp-map is built.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    icp_map: Vec<PathBuf>,
    /// Distance between two sweeps of the map, metres.
    #[arg(long, value_name = "M", default_value_t = 5.0, requires = "icp_map")]
    map_spacing_m: f64,
    /// Use every N-th tick of a scenario.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    every: u32,
    /// Largest number of frames of each scenario [default: all].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    frames: Option<u32>,
    /// Torch threads.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: u16,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// A built-in method.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum BuiltIn {
    /// The difference of both vehicles' GNSS and IMU estimates.
    Gnss,
    /// ICP of the neighbour's sweep against the ego's, starting at the identity.
    Icp,
    /// The same, starting at the difference of both GNSS poses.
    IcpGnss,
    /// Each vehicle's sweep against a map (`--icp-map`), starting at its GNSS pose.
    IcpMap,
    /// ICP on box centres, starting at the identity: the row "ICP" of the paper.
    BoxIcp,
    /// Graph matching of boxes.
    FreeAlign,
}

/// Source of boxes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum BoxOrigin {
    /// The detector.
    Detected,
    /// The annotations of the objects in a vehicle's view, as in the paper.
    Annotated,
}

fn parse_source(text: &str) -> Result<(String, PathBuf), String> {
    match text.split_once('=') {
        Some((name, file)) if !name.is_empty() && !file.is_empty() => {
            Ok((name.to_owned(), file.into()))
        }
        _ => Err(format!("{text:?} is not NAME=FILE.yaml")),
    }
}

impl Arguments {
    /// Compares, and prints the table.
    pub(crate) fn run(self) -> Result<Outcome> {
        tch::set_num_threads(i32::from(self.threads));
        let mut left_out = LeftOut::default();
        let scenarios = self.data.arranged(&mut left_out)?;
        let mut rows = Vec::new();
        for (number, &boxes) in self.boxes.iter().enumerate() {
            // Maps and frames are read for every source of boxes; what is left out of them is counted once.
            let mut lost = LeftOut::default();
            let mut methods = self.methods(&mut lost)?;
            // What exchanges no boxes is compared once.
            methods.retain(|method| number == 0 || method.needs_boxes);
            let mut source = self.box_source(boxes, &methods)?;
            let found = self.compare(&methods, &mut source, &scenarios, &mut lost)?;
            if number == 0 {
                left_out.merge(&lost);
            }
            for (mut row, method) in found.into_iter().zip(&methods) {
                if self.boxes.len() > 1 && method.needs_boxes {
                    row.method += match boxes {
                        BoxOrigin::Detected => ", detected boxes",
                        BoxOrigin::Annotated => ", annotated boxes",
                    };
                }
                rows.push(row);
            }
        }
        if self.json {
            let maps = self.icp_map.iter().map(|folder| dataset::open(folder));
            let maps: Vec<Dataset> = maps.collect::<Result<_, _>>()?;
            let all = maps.into_iter().flat_map(|data| data.scenarios);
            let scenarios = scenarios.into_iter().map(|(scenario, _)| scenario);
            let all: Vec<Scenario> = scenarios.chain(all).collect();
            let sources = self.pose_source.iter().map(|(_, file)| file.clone());
            let files = self.weights.iter().cloned().chain(sources);
            output::line(rows_with_provenance(&rows, &all, files)?)?;
        } else {
            output::text(markdown(&rows))?;
        }
        Ok(print_left_out(&left_out))
    }

    fn methods(&self, left_out: &mut LeftOut) -> Result<Vec<AlignmentSpec>> {
        use BuiltIn::{BoxIcp as BoxIcpMethod, FreeAlign as FreeAlignMethod, Gnss, Icp, IcpGnss};
        let all = [Gnss, Icp, IcpGnss, BoxIcpMethod, FreeAlignMethod];
        let named = match &self.method[..] {
            [] => &all[..],
            named => named,
        };
        let built_in = named.iter().map(|method| self.built_in(*method, left_out));
        built_in
            .chain(self.pose_source.iter().map(from_source))
            .collect()
    }

    fn built_in(&self, method: BuiltIn, left_out: &mut LeftOut) -> Result<AlignmentSpec> {
        Ok(match method {
            BuiltIn::Gnss => Poses::spec("gnss", Frame::gnss_world_from_lidar, || {
                Ok(Box::new(RecordedPose))
            }),
            BuiltIn::Icp => CloudIcp::spec(false),
            BuiltIn::IcpGnss => CloudIcp::spec(true),
            BuiltIn::IcpMap => self.icp_map(left_out)?,
            BuiltIn::BoxIcp => BoxIcp::spec(),
            BuiltIn::FreeAlign => FreeAlign::spec(),
        })
    }

    fn icp_map(&self, left_out: &mut LeftOut) -> Result<AlignmentSpec> {
        if self.icp_map.is_empty() {
            let reason = "icp-map needs --icp-map DIR";
            return Err(BadInput::new(reason).into());
        }
        let config = IcpConfig::default();
        let map =
            read_map(&self.icp_map, self.map_spacing_m, &config, left_out).map_err(BadInput::of)?;
        tracing::info!(planes = map.planes(), "map");
        let source = IcpMapPose::new(Arc::new(map), config);
        Ok(Poses::spec(
            "icp-map",
            Frame::gnss_world_from_lidar,
            move || Ok(Box::new(source.clone()) as Box<dyn PoseSource>),
        ))
    }

    fn box_source(&self, boxes: BoxOrigin, methods: &[AlignmentSpec]) -> Result<BoxSource> {
        // Where no method needs boxes nothing is detected, and no weights are needed.
        if boxes == BoxOrigin::Annotated || !methods.iter().any(|method| method.needs_boxes) {
            return Ok(BoxSource::Annotated);
        }
        let Some(weights) = &self.weights else {
            let reason = "detected boxes need --weights FILE; or use --boxes annotated";
            return Err(BadInput::new(reason).into());
        };
        let detector = Detector::load(weights, Device::Cpu).map_err(BadInput::of)?;
        let cav = CavId::new("detector").context("a name")?;
        let agent = Agent::new(cav, Box::new(RecordedPose), detector);
        Ok(BoxSource::Detected(Box::new(agent)))
    }

    fn compare(
        &self,
        methods: &[AlignmentSpec],
        boxes: &mut BoxSource,
        scenarios: &[(Scenario, f64)],
        left_out: &mut LeftOut,
    ) -> Result<Vec<MethodRow>> {
        let bar = progress::bar(scenarios.len(), "scenes");
        let mut tallies = vec![PairTally::default(); methods.len()];
        for (scenario, range_m) in scenarios {
            let ticks = (0..scenario.ticks.len())
                .step_by(self.every as usize)
                .take(self.frames.map_or(usize::MAX, |frames| frames as usize));
            let scene = (scenario, *range_m);
            let lost = alignment::run(methods, boxes, scene, ticks, &mut |outcome| {
                tallies[outcome.method].add(&outcome);
            })?;
            left_out.merge(&lost);
            bar.inc(1);
        }
        bar.finish_and_clear();
        let rows = tallies.iter().zip(methods);
        let rows = rows.map(|(tally, method)| tally.row(&method.name));
        Ok(rows.collect())
    }
}

fn from_source((name, file): &(String, PathBuf)) -> Result<AlignmentSpec> {
    let config: PoseSourceConfig = config_file::read(file).map_err(BadInput::of)?;
    let config = config.with_networks().at(file).map_err(BadInput::of)?;
    // Built once already here: a source that cannot be built is an error before the comparison.
    let built = config.build(Inference::default());
    built.at(file).map_err(BadInput::of)?;
    let given = |frame: &Frame| frame.world_from_lidar;
    Ok(Poses::spec(name.clone(), given, move || {
        config.build(Inference::default())
    }))
}
