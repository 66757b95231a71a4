//! Reading everything and counting.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use protocol::{CavId, PointCloud, Pose};
use rayon::prelude::*;

use super::{AgentReport, Problem, Report, ScenarioReport, Summary, TickReport};
use crate::dataset::{self, Layout, Scenario};
use crate::frame::{Frame, Object};
use crate::ground_truth::{self, GroundTruthRule};
use crate::pcd::{PcdCloud, Place};

/// What was found in one agent's frame.
#[derive(Debug, Default)]
struct FrameFindings {
    points: Option<usize>,
    dropped: usize,
    radar_points: Option<usize>,
    boxes: Option<usize>,
    boxes_without_points: usize,
    world_from_lidar: Option<Pose>,
    problems: Vec<Problem>,
}

/// What was found at one tick.
#[derive(Debug)]
struct TickFindings {
    agents: Vec<FrameFindings>,
    merged: Vec<TickReport>,
}

/// Reads all of the dataset in `dir`. `progress` is told how many ticks are done and how many there are.
#[must_use]
pub fn inspect(dir: &Path, progress: &(dyn Fn(usize, usize) + Sync)) -> Report {
    let mut report =
        Report { path: dir.display().to_string(), layout: None, scenarios: vec![], ticks: vec![], problems: vec![] };
    let dataset = match dataset::open(dir) {
        Ok(dataset) => dataset,
        Err(error) => {
            report.problems.push(Problem::from(&error));
            return report;
        }
    };
    report.layout = Some(dataset.layout);
    report.problems.extend(dataset.problems.iter().map(Problem::from));
    let total = dataset.scenarios.iter().map(|scenario| scenario.ticks.len()).sum();
    let done = AtomicUsize::new(0);
    for scenario in &dataset.scenarios {
        let findings: Vec<TickFindings> = (0..scenario.ticks.len())
            .into_par_iter()
            .map(|tick| {
                let findings = survey_tick(scenario, tick);
                progress(done.fetch_add(1, Ordering::Relaxed) + 1, total);
                findings
            })
            .collect();
        report.scenarios.push(summarize(scenario, &findings));
        for tick in findings {
            report.ticks.extend(tick.merged);
            report.problems.extend(tick.agents.into_iter().flat_map(|agent| agent.problems));
        }
    }
    // A file that several frames need is wrong once.
    report.problems = report.problems.into_iter().collect::<BTreeSet<_>>().into_iter().collect();
    report
}

fn survey_tick(scenario: &Scenario, tick: usize) -> TickFindings {
    let mut agents = Vec::with_capacity(scenario.agents.len());
    let mut frames = Vec::with_capacity(scenario.agents.len());
    for agent in 0..scenario.agents.len() {
        let (findings, frame) = survey_frame(scenario, agent, tick);
        agents.push(findings);
        frames.extend(frame);
    }
    let frames: Vec<&Frame> = frames.iter().collect();
    let merged = merged_counts(scenario, tick, &frames);
    TickFindings { agents, merged }
}

fn survey_frame(scenario: &Scenario, agent: usize, tick: usize) -> (FrameFindings, Option<Frame>) {
    let mut findings = FrameFindings::default();
    let without_points = dataset::LoadOptions { points: false, ..Default::default() };
    let frame = scenario.load(agent, tick, &without_points);
    let frame = frame.map_err(|error| findings.problems.push(Problem::from(&error))).ok();
    let plain = survey_points(scenario, agent, tick, None, &mut findings);
    for variant in &scenario.lidar_variants {
        survey_points(scenario, agent, tick, Some(variant), &mut findings);
    }
    if let Some(frame) = &frame {
        findings.boxes = Some(frame.objects.len());
        findings.world_from_lidar = frame.world_from_lidar;
        if let Some(points) = &plain {
            let empty = |object: &&Object| !holds_point(frame.world_from_lidar.as_ref(), object, points);
            findings.boxes_without_points = frame.objects.iter().filter(empty).count();
        }
    }
    if scenario.has_radar {
        let with_radar = dataset::LoadOptions { points: false, radar: true, ..Default::default() };
        match scenario.load(agent, tick, &with_radar) {
            Ok(frame) => findings.radar_points = frame.radar.map(|cloud| cloud.len()),
            // The frame itself has been complained about already.
            Err(error) if frame.is_some() => findings.problems.push(Problem::from(&error)),
            Err(_) => {}
        }
    }
    (findings, frame)
}

fn survey_points(
    scenario: &Scenario,
    agent: usize,
    tick: usize,
    variant: Option<&str>,
    findings: &mut FrameFindings,
) -> Option<PointCloud> {
    let cloud = match scenario.load_points(agent, tick, variant) {
        Ok(cloud) => cloud,
        Err(error) => {
            findings.problems.push(Problem::from(&error));
            return None;
        }
    };
    if cloud.dropped > 0 {
        let path = scenario.points_path(agent, tick, variant).unwrap_or_default();
        findings.problems.push(not_finite(&path, &cloud));
    }
    if variant.is_none() {
        findings.points = Some(cloud.points.len());
        findings.dropped = cloud.dropped;
    }
    Some(cloud.points)
}

fn not_finite(path: &Path, cloud: &PcdCloud) -> Problem {
    let (line, place) = match cloud.first_dropped {
        Some(Place::Line(line)) => (Some(line), format!("the first in line {line}")),
        Some(Place::Point(point)) => (None, format!("the first is point {point}, counted from 0")),
        None => (None, String::new()),
    };
    let path = path.display().to_string();
    let (dropped, all) = (cloud.dropped, cloud.dropped + cloud.points.len());
    let message = format!("{path}: {dropped} of {all} points are not finite and are left out, {place}");
    Problem { path, line, field: Some("x y z intensity".into()), message }
}

fn holds_point(world_from_lidar: Option<&Pose>, object: &Object, points: &PointCloud) -> bool {
    let Some(world_from_lidar) = world_from_lidar else { return false };
    let object_from_lidar = object.world_from_object.isometry().inv_mul(&world_from_lidar.isometry()).cast::<f32>();
    let half = object.size_m.map(|size| (size / 2.0) as f32);
    points.xyzi.iter().any(|&[x, y, z, _]| {
        let local = object_from_lidar * nalgebra::Point3::new(x, y, z);
        (0..3).all(|axis| local[axis].abs() <= half[axis])
    })
}

/// One entry for every ego alone, and one with all in range of it, where there is anyone.
fn merged_counts(scenario: &Scenario, tick: usize, frames: &[&Frame]) -> Vec<TickReport> {
    let rule = match scenario.layout {
        Layout::V2v4Real => GroundTruthRule::V2V4REAL,
        _ => GroundTruthRule::OPV2V,
    };
    let report = |ego: &CavId, agents: Vec<CavId>, merged_boxes: usize| TickReport {
        scenario: scenario.name.clone(),
        tick: scenario.ticks[tick].stem.clone(),
        ego: ego.clone(),
        agents,
        merged_boxes,
    };
    let mut merged = Vec::new();
    for (index, ego) in frames.iter().enumerate() {
        let alone = ground_truth::merge(&[ego], 0, &rule).len();
        merged.push(report(&ego.cav, vec![ego.cav.clone()], alone));
        let contributors = ground_truth::contributors(frames, index, rule.comm_range_m);
        if contributors.len() > 1 {
            let agents = contributors.iter().map(|&other| frames[other].cav.clone()).collect();
            merged.push(report(&ego.cav, agents, ground_truth::merge(frames, index, &rule).len()));
        }
    }
    merged
}

fn summarize(scenario: &Scenario, findings: &[TickFindings]) -> ScenarioReport {
    let times: Vec<u64> = scenario.ticks.iter().map(|tick| tick.capture_nanos).collect();
    let mut steps: Vec<u64> = times.windows(2).map(|pair| pair[1].saturating_sub(pair[0])).collect();
    steps.sort_unstable();
    let median = steps.get(steps.len() / 2).copied().filter(|&step| step > 0);
    let span = times.last().zip(times.first()).map_or(0, |(last, first)| last.saturating_sub(*first));
    ScenarioReport {
        name: scenario.name.clone(),
        layout: scenario.layout,
        handedness: scenario.source_handedness,
        frames: scenario.ticks.len(),
        seconds: span as f64 / 1e9,
        rate_hz: median.map(|step| 1e9 / step as f64),
        agents: (0..scenario.agents.len())
            .map(|agent| {
                let frames: Vec<&FrameFindings> = findings.iter().map(|tick| &tick.agents[agent]).collect();
                summarize_agent(&scenario.agents[agent], &frames)
            })
            .collect(),
        lidar_variants: scenario.lidar_variants.clone(),
        has_radar: scenario.has_radar,
        missing: scenario.missing.clone(),
    }
}

fn summarize_agent(id: &CavId, frames: &[&FrameFindings]) -> AgentReport {
    let counts = |count: fn(&FrameFindings) -> Option<usize>| {
        Summary::of(&frames.iter().filter_map(|frame| count(frame)).collect::<Vec<_>>())
    };
    let positions: Vec<[f64; 3]> =
        frames.iter().filter_map(|frame| Some(frame.world_from_lidar?.translation_m)).collect();
    let step = |pair: &[[f64; 3]]| (0..3).map(|axis| (pair[1][axis] - pair[0][axis]).powi(2)).sum::<f64>().sqrt();
    AgentReport {
        id: id.clone(),
        points: counts(|frame| frame.points),
        dropped_points: frames.iter().map(|frame| frame.dropped).sum(),
        radar_points: counts(|frame| frame.radar_points),
        boxes: counts(|frame| frame.boxes),
        boxes_without_points: frames.iter().map(|frame| frame.boxes_without_points).sum(),
        // An empty sum is -0.
        distance_m: (!positions.is_empty()).then(|| positions.windows(2).map(step).fold(0.0, |sum, step| sum + step)),
    }
}
