//! Findings about a data set as a whole: sweeps, boxes and poses that are valid one by one and implausible together.
//!
//! Inspection passes every frame; commands that report numbers print the findings of a sample ([`sampled`]).

mod boxes;
pub(crate) mod cells;
mod fit;
mod lists;
mod sweeps;

use std::path::Path;

use protocol::CavId;
use rayon::prelude::*;

use boxes::EmptyBoxes;
use lists::FramesOfTicks;
pub use sweeps::{SweepFindings, SweepReport};

use crate::frame::Frame;
use crate::ground_truth::GroundTruthRule;
use crate::pcd::PcdCloud;
use crate::{IntensityScale, LoadOptions, Problem, Scenario, overlap};
use support::output;
use support::sampling::evenly_spread;

/// Largest number of scenarios of a sample.
const MOST_SCENARIOS: usize = 4;
/// Number of frames of a sample, over all scenarios and agents.
const FRAMES: usize = 40;
/// Least number of ticks of a scenario in a sample.
const LEAST_TICKS: usize = 3;

/// Findings of one frame of an agent.
#[derive(Debug, Default)]
pub struct FrameFindings {
    /// Findings of its sweep, if that was read.
    pub sweep: Option<SweepFindings>,
    /// The frame without points, if it was read.
    pub frame: Option<Frame>,
    /// Objects of a frame with a pose whose sweep was read, and those near it that are left out as no point hits them.
    placed_boxes: usize,
    /// Listed objects of such a frame that hold none of the agent's own points.
    pub boxes_without_points: usize,
    /// Those of the placed boxes that hold none, also with axes of the points negated.
    empty_boxes: EmptyBoxes,
}

impl FrameFindings {
    /// Findings of a frame and its plain sweep, as far as they could be read.
    pub fn of(frame: Option<Frame>, sweep: Option<&PcdCloud>) -> Self {
        let mut findings = Self {
            sweep: sweep.map(SweepFindings::of),
            frame,
            ..Self::default()
        };
        if let Some((frame, sweep)) = findings.frame.as_ref().zip(sweep)
            && let Some(pose) = &frame.world_from_lidar
        {
            let empty = boxes::without_points(frame, pose, &sweep.points);
            [findings.boxes_without_points, ..] = empty;
            findings.empty_boxes = empty.map(|count| count + frame.missed_objects);
            findings.placed_boxes = frame.objects.len() + frame.missed_objects;
        }
        findings
    }
}

/// Findings of the frames of a scenario together: `frames` are those of each agent, in the order of
/// [`Scenario::agents`], with their ticks. Intensities were divided by `scale`. By the `rule`, if one is given, it is
/// judged whether there is any ground truth.
pub fn of_scenario(
    scenario: &Scenario,
    frames: &[Vec<(usize, &FrameFindings)>],
    scale: IntensityScale,
    rule: Option<&GroundTruthRule>,
) -> Vec<Problem> {
    let mut problems = Vec::new();
    for (agent, (id, frames)) in scenario.agents.iter().zip(frames).enumerate() {
        problems.extend(without_pose(scenario, (agent, id), frames));
        let (mut boxes, mut empty) = (0, EmptyBoxes::default());
        for (_, one) in frames {
            boxes += one.placed_boxes;
            (empty.iter_mut().zip(one.empty_boxes)).for_each(|(sum, count)| *sum += count);
        }
        problems.extend(boxes::empty(&scenario.name, id, (boxes, empty)));
        let sweeps: Vec<&SweepFindings> = (frames.iter())
            .filter_map(|(_, one)| one.sweep.as_ref())
            .collect();
        let first = frames.iter().find(|(_, one)| one.sweep.is_some());
        let path = first.and_then(|(tick, _)| scenario.points_path(agent, *tick, None).ok());
        let (path, named) = (path.unwrap_or_default(), format!(" of agent {id}"));
        let folder = path.parent().unwrap_or(&path);
        problems.extend(sweeps::problems(folder, &named, &sweeps, scale));
    }
    problems.extend(of_objects(scenario, frames, rule));
    problems.extend(overlap::pose_problems(scenario));
    problems
}

/// Findings of the objects that the agents of a scenario list.
fn of_objects(
    scenario: &Scenario,
    frames: &[Vec<(usize, &FrameFindings)>],
    rule: Option<&GroundTruthRule>,
) -> Vec<Problem> {
    let mut ticks = FramesOfTicks::new();
    for (tick, findings) in frames.iter().flatten() {
        ticks.entry(*tick).or_default().extend(&findings.frame);
    }
    let mut problems = lists::contradictions(scenario, &ticks);
    for (agent, (id, frames)) in scenario.agents.iter().zip(frames).enumerate() {
        for list in fit::LISTS {
            let read = frames.iter().flat_map(|(_, one)| &one.frame);
            let objects = read.flat_map(list.1);
            problems.extend(boxes::unlike_cars(&scenario.name, id, objects));
            problems.extend(fit::problem(scenario, (agent, id), list));
        }
        problems.extend(boxes::unlike_cooperative(&scenario.name, id, &ticks));
    }
    problems.extend(rule.and_then(|rule| boxes::without_ground_truth(scenario, &ticks, rule)));
    problems
}

/// Findings of single clouds of a folder together.
pub fn of_clouds(folder: &Path, sweeps: &[&SweepFindings], scale: IntensityScale) -> Vec<Problem> {
    sweeps::problems(folder, "", sweeps, scale)
}

/// The finding that frames with objects have no pose.
fn without_pose(
    scenario: &Scenario,
    (agent, id): (usize, &CavId),
    frames: &[(usize, &FrameFindings)],
) -> Option<Problem> {
    let frames_read = frames.iter().map(|(tick, one)| (tick, one.frame.as_ref()));
    let mut lacking = frames_read.filter(|(_, frame)| frame.is_some_and(boxes::is_without_pose));
    let count = lacking.clone().count();
    let (tick, _) = lacking.next()?;
    let stem = scenario.ticks.get(*tick)?;
    let path = (scenario.source.frame_files(id, stem).into_iter().next())
        .or_else(|| scenario.points_path(agent, *tick, None).ok())
        .unwrap_or_default();
    let reason = format!(
        "lidar_pose: missing in {count} of {} frames of agent {id}, this is the first: boxes cannot be placed",
        frames.len()
    );
    let path = path.display().to_string();
    Some(Problem::about(&path, "lidar_pose", &reason))
}

/// Findings of some frames, evenly spread over the scenarios, as [`of_scenario`]. Frames that cannot be read are left
/// out: their reader reports them.
pub fn sampled(
    scenarios: &[Scenario],
    scale: IntensityScale,
    rule: Option<&GroundTruthRule>,
) -> Vec<Problem> {
    let scenarios: Vec<&Scenario> = scenarios.iter().collect();
    let scenarios = evenly_spread(&scenarios, MOST_SCENARIOS);
    let agents: usize = scenarios.iter().map(|scenario| scenario.agents.len()).sum();
    let ticks = (FRAMES / agents.max(1)).max(LEAST_TICKS);
    let problems = scenarios.into_iter().flat_map(|scenario| {
        let indices: Vec<usize> = (0..scenario.ticks.len()).collect();
        let ticks = evenly_spread(&indices, ticks);
        let agents = (0..scenario.agents.len()).into_par_iter().map(|agent| {
            let frames = ticks.par_iter();
            let frames = frames.filter_map(|&tick| Some((tick, read(scenario, agent, tick)?)));
            frames.collect::<Vec<(usize, FrameFindings)>>()
        });
        let agents: Vec<_> = agents.collect();
        let of_agents = agents.iter().map(|frames| {
            let frames = frames.iter().map(|(tick, frame)| (*tick, frame));
            frames.collect::<Vec<(usize, &FrameFindings)>>()
        });
        let of_agents: Vec<_> = of_agents.collect();
        of_scenario(scenario, &of_agents, scale, rule)
    });
    problems.collect()
}

fn read(scenario: &Scenario, agent: usize, tick: usize) -> Option<FrameFindings> {
    let without_points = LoadOptions::without_points();
    let frame = scenario.load(agent, tick, &without_points).ok();
    let sweep = scenario.load_points(agent, tick, None).ok();
    (frame.is_some() || sweep.is_some()).then(|| FrameFindings::of(frame, sweep.as_ref()))
}

/// Prints findings to standard error, a line each.
pub fn note<'a>(findings: impl IntoIterator<Item = &'a Problem>) {
    for finding in findings {
        output::note(format_args!("check the data: {finding}"));
    }
}

#[cfg(test)]
mod tests;
