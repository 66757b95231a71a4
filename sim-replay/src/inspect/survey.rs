//! Survey: reads all frames of a data set and counts.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use protocol::CavId;
use rayon::prelude::*;

use super::{AgentReport, CountSummary, Problem, Report, ScenarioReport, TickReport};
use dataset::evaluation_protocol::ProtocolConfig;
use dataset::findings::{self, FrameFindings, SweepReport};
use dataset::frame::Frame;
use dataset::ground_truth::{self, GroundTruthRule};
use dataset::pcd::{PcdCloud, PcdPlace};
use dataset::{self, IntensityScale, OpenOptions, ReadError, Scenario};

/// Largest share of points that are not finite: with more of them a sweep is faulty, not merely sparse.
const MOST_DROPPED: f64 = 0.9;

/// One agent's frame.
#[derive(Debug, Default)]
struct FrameSurvey {
    findings: FrameFindings,
    dropped: usize,
    radar_points: Option<usize>,
    problems: Vec<Problem>,
}

/// Findings of one tick.
#[derive(Debug)]
struct TickFindings {
    agents: Vec<FrameSurvey>,
    merged: Vec<TickReport>,
}

/// Reads all of the data set in `dir`, its ground truth by the protocol. `progress` receives the number of completed
/// ticks and their total.
pub fn inspect(
    dir: &Path,
    open: &OpenOptions,
    protocol: &ProtocolConfig,
    progress: &(dyn Fn(usize, usize) + Sync),
) -> Report {
    let mut report = Report {
        path: dir.display().to_string(),
        ..Report::default()
    };
    let opened = dataset::open_with(dir, open);
    let Some(dataset) = or_problem(opened, &mut report.problems) else {
        return report;
    };
    report.layout = Some(dataset.layout);
    let protocol = protocol.resolve(dataset.layout);
    let protocol = protocol.map_err(|reason| ReadError::malformed(dir, reason));
    let Some(protocol) = or_problem(protocol, &mut report.problems) else {
        return report;
    };
    report.protocol = Some(protocol.clone());
    let mut problems: Vec<_> = dataset.problems.iter().map(Problem::from).collect();
    let scenarios = dataset.scenarios.iter();
    let total = scenarios.map(|scenario| scenario.ticks.len()).sum();
    let done = AtomicUsize::new(0);
    for scenario in &dataset.scenarios {
        let findings: Vec<TickFindings> = (0..scenario.ticks.len())
            .into_par_iter()
            .map(|tick| {
                let findings = survey_tick(scenario, tick, &protocol.ground_truth);
                progress(done.fetch_add(1, Ordering::Relaxed) + 1, total);
                findings
            })
            .collect();
        report.scenarios.push(summarize(scenario, &findings));
        let (scale, rule) = (open.intensity_scale, &protocol.ground_truth);
        problems.extend(scenario_problems(scenario, &findings, scale, rule));
        for tick in findings {
            report.ticks.extend(tick.merged);
            problems.extend(tick.agents.into_iter().flat_map(|agent| agent.problems));
        }
    }
    report.problems = counted(problems);
    report
}

/// Each problem once, with its number of occurrences: several frames may need one file, or have objects of one unknown
/// type.
fn counted(problems: Vec<Problem>) -> Vec<Problem> {
    let mut counts: BTreeMap<Problem, usize> = BTreeMap::new();
    for problem in problems {
        *counts.entry(problem).or_default() += 1;
    }
    let problems = counts.into_iter().map(|(problem, count)| match count {
        1 => problem,
        count => Problem {
            message: format!("{} ({count} times)", problem.message),
            ..problem
        },
    });
    problems.collect()
}

/// Problems of a scenario as a whole.
fn scenario_problems(
    scenario: &Scenario,
    ticks: &[TickFindings],
    scale: IntensityScale,
    rule: &GroundTruthRule,
) -> Vec<Problem> {
    let agents = (0..scenario.agents.len()).map(|agent| {
        let frames = ticks.iter().map(|tick| &tick.agents[agent].findings);
        frames.enumerate().collect()
    });
    let agents: Vec<Vec<(usize, &FrameFindings)>> = agents.collect();
    findings::of_scenario(scenario, &agents, scale, Some(rule))
}

fn survey_tick(scenario: &Scenario, tick: usize, rule: &GroundTruthRule) -> TickFindings {
    let surveys = (0..scenario.agents.len()).map(|agent| {
        let is_present = scenario.is_present(agent, tick);
        is_present.then(|| survey_frame(scenario, agent, tick))
    });
    let agents: Vec<FrameSurvey> = surveys.map(Option::unwrap_or_default).collect();
    let frames = agents.iter().map(|agent| &agent.findings.frame);
    let frames: Vec<&Frame> = frames.flatten().collect();
    let merged = merged_counts(scenario, tick, &frames, rule);
    TickFindings { agents, merged }
}

fn survey_frame(scenario: &Scenario, agent: usize, tick: usize) -> FrameSurvey {
    let mut survey = FrameSurvey::default();
    // The sweep is read by `survey_points`, which also counts the points that are not finite.
    let without_points = dataset::LoadOptions {
        cameras: true,
        ..dataset::LoadOptions::without_points()
    };
    let frame = scenario.load(agent, tick, &without_points);
    let mut frame = or_problem(frame, &mut survey.problems);
    // Read apart from the frame: a fault of the annotations must not hide one of the sweep.
    let sweep = survey_points(scenario, agent, tick, None, &mut survey.problems);
    for variant in &scenario.lidar_variants {
        survey_points(scenario, agent, tick, Some(variant), &mut survey.problems);
    }
    if let Some(frame) = &mut frame {
        survey.problems.append(&mut frame.problems);
        // The frame is kept; its images were only tried.
        frame.cameras.clear();
    }
    survey.findings = FrameFindings::of(frame, sweep.as_ref());
    survey.dropped = sweep.map_or(0, |sweep| sweep.dropped);
    if scenario.has_radar {
        let radar = or_problem(scenario.load_radar(agent, tick), &mut survey.problems);
        survey.radar_points = radar.map(|cloud| cloud.points.len());
    }
    survey
}

/// Value of a result; its error is added to the problems.
fn or_problem<T>(read: Result<T, ReadError>, problems: &mut Vec<Problem>) -> Option<T> {
    read.map_err(|error| problems.push(Problem::from(&error)))
        .ok()
}

fn survey_points(
    scenario: &Scenario,
    agent: usize,
    tick: usize,
    variant: Option<&str>,
    problems: &mut Vec<Problem>,
) -> Option<PcdCloud> {
    let cloud = or_problem(scenario.load_points(agent, tick, variant), problems)?;
    let path = scenario.points_path(agent, tick, variant);
    let path = path.unwrap_or_default();
    // Organised clouds have a point for every ray, including rays without a hit.
    if cloud.dropped as f64 > MOST_DROPPED * (cloud.dropped + cloud.points.len()) as f64 {
        problems.push(not_finite(&path, &cloud));
    } else if let Some(reason) = cloud.without_returns() {
        problems.push(Problem::from(&ReadError::malformed(&path, reason)));
    }
    Some(cloud)
}

fn not_finite(path: &Path, cloud: &PcdCloud) -> Problem {
    let (line, place) = match cloud.first_dropped {
        Some(PcdPlace::Line(line)) => (Some(line), format!("the first in line {line}")),
        Some(PcdPlace::Point(point)) => {
            (None, format!("the first is point {point}, counted from 0"))
        }
        None => (None, String::new()),
    };
    let path = path.display().to_string();
    let (dropped, all) = (cloud.dropped, cloud.dropped + cloud.points.len());
    let message =
        format!("{path}: {dropped} of {all} points are not finite and are left out, {place}");
    Problem {
        path,
        line,
        field: Some("x y z intensity".into()),
        message,
    }
}

/// One ego-only entry for every ego, and one with all agents in range, if there are any.
fn merged_counts(
    scenario: &Scenario,
    tick: usize,
    frames: &[&Frame],
    rule: &GroundTruthRule,
) -> Vec<TickReport> {
    let mut merged = Vec::new();
    for (index, ego) in frames.iter().enumerate() {
        let alone = ground_truth::merged_objects(&[ego], 0, rule).len();
        let mut counts = vec![(vec![ego.cav.clone()], alone)];
        let contributors = ground_truth::contributors(frames, index, rule.comm_range_m);
        // Contributors include the ego: alone it would only repeat the entry above.
        if contributors.len() > 1 {
            let agents = contributors.iter().map(|&other| frames[other].cav.clone());
            let together = ground_truth::merged_objects(frames, index, rule).len();
            counts.push((agents.collect(), together));
        }
        merged.extend(counts.into_iter().map(|(agents, merged_boxes)| TickReport {
            scenario: scenario.name.clone(),
            tick,
            stem: scenario.ticks[tick].stem.clone(),
            ego: ego.cav.clone(),
            agents,
            merged_boxes,
        }));
    }
    merged
}

fn summarize(scenario: &Scenario, findings: &[TickFindings]) -> ScenarioReport {
    let ends = scenario.ticks.first().zip(scenario.ticks.last());
    let span = ends.map_or(0, |(first, last)| {
        last.capture_nanos.saturating_sub(first.capture_nanos)
    });
    let agents = scenario.agents.iter().enumerate().map(|(agent, id)| {
        let frames = findings.iter().map(|tick| &tick.agents[agent]);
        summarize_agent(id, &frames.collect::<Vec<_>>())
    });
    ScenarioReport {
        name: scenario.name.clone(),
        layout: scenario.layout,
        handedness: scenario.source_handedness,
        frames: scenario.ticks.len(),
        seconds: span as f64 / 1e9,
        rate_hz: dataset::period_nanos(&scenario.ticks).map(|period| 1e9 / period as f64),
        agents: agents.collect(),
        lidar_variants: scenario.lidar_variants.clone(),
        has_radar: scenario.has_radar,
        cameras: scenario.cameras.clone(),
        missing: scenario.missing.clone(),
        joins: scenario.joins.clone(),
    }
}

fn summarize_agent(id: &CavId, frames: &[&FrameSurvey]) -> AgentReport {
    let findings = frames.iter().map(|frame| &frame.findings);
    let positions: Vec<[f64; 3]> = (findings.clone())
        .filter_map(|frame| Some(frame.frame.as_ref()?.world_from_lidar?.translation_m))
        .collect();
    let steps = positions.windows(2).map(|pair| {
        let squares = (0..3).map(|axis| (pair[1][axis] - pair[0][axis]).powi(2));
        squares.sum::<f64>().sqrt()
    });
    let sweeps: Vec<_> = (findings.clone())
        .filter_map(|frame| frame.sweep.as_ref())
        .collect();
    AgentReport {
        id: id.clone(),
        points: summary_of(frames, |frame| Some(frame.findings.sweep.as_ref()?.points)),
        dropped_points: frames.iter().map(|frame| frame.dropped).sum(),
        radar_points: summary_of(frames, |frame| frame.radar_points),
        sweeps: SweepReport::of(&sweeps),
        boxes: summary_of(frames, |frame| {
            Some(frame.findings.frame.as_ref()?.objects.len())
        }),
        boxes_without_points: findings.map(|frame| frame.boxes_without_points).sum(),
        frames: sweeps.len(),
        // An empty sum is -0.
        distance_m: (!positions.is_empty()).then(|| steps.fold(0.0, |sum, step| sum + step)),
    }
}

fn summary_of(
    frames: &[&FrameSurvey],
    count: fn(&FrameSurvey) -> Option<usize>,
) -> Option<CountSummary> {
    let counts: Vec<usize> = frames.iter().filter_map(|frame| count(frame)).collect();
    CountSummary::of(&counts)
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::PathBuf;

    use super::*;
    use dataset::pcd::{Encoding, IntensityField, encode};
    use protocol::PointCloud;

    const YAML: &str = "lidar_pose: [0, 0, 2, 0, 0, 0]\nvehicles:\n  7: {location: [10, 0, 0], center: [0, 0, 0.7], \
                        angle: [0, 0, 0], extent: [2, 1, 0.7]}\n";

    fn write(root: &Path, name: &str, bytes: &[u8]) -> PathBuf {
        let path = root.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, bytes).unwrap();
        path
    }

    fn sweep(points: &[[f32; 4]]) -> Vec<u8> {
        encode(
            &PointCloud {
                xyzi: points.to_vec(),
            },
            Encoding::Ascii,
            IntensityField::Intensity,
        )
    }

    fn survey(root: &Path) -> (Report, Vec<String>) {
        let report = inspect(
            root,
            &OpenOptions::default(),
            &ProtocolConfig::default(),
            &|_, _| {},
        );
        let root = root.to_string_lossy();
        let messages = report
            .problems
            .iter()
            .map(|problem| problem.message.replace(&*root, ""))
            .collect();
        (report, messages)
    }

    #[test]
    fn sound_frames_are_counted() {
        let dir = tempfile::tempdir().unwrap();
        for (stem, points) in [
            ("000010", vec![[10.0, 0.0, -1.3, 0.5]]),
            ("000012", vec![[1.0, 0.0, 0.0, 0.25]; 3]),
        ] {
            write(dir.path(), &format!("1/{stem}.yaml"), YAML.as_bytes());
            write(dir.path(), &format!("1/{stem}.pcd"), &sweep(&points));
        }
        let (report, messages) = survey(dir.path());
        assert!(messages.is_empty(), "{messages:?}");
        let scenario = &report.scenarios[0];
        assert_eq!((scenario.frames, scenario.rate_hz), (2, Some(10.0)));
        let agent = &scenario.agents[0];
        assert_eq!(
            agent.points,
            Some(CountSummary {
                min: 1,
                mean: 2.0,
                max: 3
            })
        );
        assert_eq!(
            agent.boxes_without_points, 1,
            "the second sweep has no point in the box"
        );
        assert_eq!(agent.distance_m, Some(0.0));
        assert!(
            report
                .to_string()
                .contains("ground truth of ego 1: 1 ego-only"),
            "{report}"
        );
    }

    #[test]
    fn every_fault_is_reported_and_the_rest_is_counted() {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path();
        let whole = sweep(&[[10.0, 0.0, -1.3, 0.25], [1.0, 2.0, 3.0, 0.5]]);
        // A cut sweep, a NaN among others (no problem) and alone, a wrong pose, a missing YAML and a sound frame.
        write(root, "1/000010.yaml", YAML.as_bytes());
        write(root, "1/000010.pcd", &whole[..whole.len() - 3]);
        write(root, "1/000012.yaml", YAML.as_bytes());
        write(
            root,
            "1/000012.pcd",
            &sweep(&[[1.0, 2.0, f32::NAN, 0.5], [1.0, 2.0, 3.0, 0.5]]),
        );
        write(root, "1/000013.yaml", YAML.as_bytes());
        write(root, "1/000013.pcd", &sweep(&[[f32::NAN; 4]; 2]));
        write(
            root,
            "1/000014.yaml",
            YAML.replace("[0, 0, 2, 0, 0, 0]", "[0, 0, 2]").as_bytes(),
        );
        write(root, "1/000014.pcd", &whole);
        write(root, "1/000016.pcd", &whole);
        write(root, "1/000018.yaml", YAML.as_bytes());
        write(root, "1/000018.pcd", &whole);
        let (report, messages) = survey(root);
        assert_eq!(
            messages,
            [
                "/1/000010.pcd:13: intensity: \"5e\" is no number: the file is cut off here, after 1 of 2 POINTS",
                "/1/000013.pcd: 2 of 2 points are not finite and are left out, the first in line 12",
                "/1/000014.yaml:1: lidar_pose: a list of 3, expected 6 numbers or a 4x4 matrix",
                "/1/000016.yaml: does not exist beside 000016.pcd: the frame is left out",
            ]
        );
        assert_eq!(
            (report.problems[2].line, report.problems[2].field.as_deref()),
            (Some(1), Some("lidar_pose"))
        );
        let agent = &report.scenarios[0].agents[0];
        assert_eq!(
            (agent.points, agent.dropped_points),
            (CountSummary::of(&[1, 0, 2, 2]), 3)
        );
        assert_eq!(
            report.ticks.len(),
            4,
            "annotations of sound YAML count even where the sweep is broken"
        );
    }

    /// Messages and table of an agent whose sweeps have these intensities.
    fn of_intensities(sweeps: &[&[f32]]) -> (Vec<String>, String) {
        let dir = tempfile::tempdir().unwrap();
        for (stem, intensities) in sweeps.iter().enumerate() {
            let points: Vec<[f32; 4]> = intensities
                .iter()
                .map(|&intensity| [10.0, 0.0, -1.3, intensity])
                .collect();
            write(dir.path(), &format!("1/{stem:06}.yaml"), YAML.as_bytes());
            write(dir.path(), &format!("1/{stem:06}.pcd"), &sweep(&points));
        }
        let (report, messages) = survey(dir.path());
        (messages, report.to_string())
    }

    fn intensity_problems(sweeps: &[&[f32]]) -> String {
        of_intensities(sweeps).0.concat()
    }

    #[test]
    fn intensities_are_reported_and_their_faults_are_problems() {
        let (messages, table) = of_intensities(&[&[0.0, 0.25, 1.0], &[0.5]]);
        assert!(messages.is_empty(), "{messages:?}");
        let line = "  sweeps of 1: PCD, ascii; intensity from intensity, divided by 1: 0.000 to 1.000, median 0.375";
        assert!(table.contains(line), "{table}");
        let (messages, table) = of_intensities(&[&[0.0, 51.0, 255.0]]);
        assert!(
            messages.is_empty() && table.contains("divided by 255: 0.000 to 1.000, median 0.200"),
            "{table}"
        );
        assert_eq!(
            intensity_problems(&[&[0.5; 19]]),
            "",
            "few points are not evaluated"
        );
        assert_eq!(
            intensity_problems(&[&[0.5; 19], &[0.5]]),
            "/1: sweeps of agent 1: all 20 intensities are 0.5 (field intensity divided by 1), expected a sensor's, which \
             differ"
        );
        assert_eq!(
            intensity_problems(&[&[0.5], &[1.0], &[0.25], &[200.0, 0.0]]),
            "/1: sweeps of agent 1: 1 of 5 intensities are above 1, up to 200 (field intensity divided by 1): see \
             --intensity-scale"
        );
        assert!(
            intensity_problems(&[&[-0.5, 0.5]])
                .contains("1 of 2 intensities are below 0, down to -0.5")
        );
        assert_eq!(
            intensity_problems(&[&[1.0, 700.0]]),
            "/1: sweeps of agent 1: intensities reach 700, neither 0 to 1 nor 0 to 255: divided by 1023 unless their \
             scale is stated"
        );
    }

    #[test]
    fn a_missing_intensity_and_implausible_points_are_problems() {
        let dir = tempfile::tempdir().unwrap();
        write(dir.path(), "1/000010.yaml", YAML.as_bytes());
        let head = "FIELDS x y z ring\nSIZE 4 4 4 4\nTYPE F F F F\nWIDTH 2\nDATA ascii\n";
        write(
            dir.path(),
            "1/000010.pcd",
            format!("{head}1 2 3 0\n4000 5 6 1\n").as_bytes(),
        );
        let (_, messages) = survey(dir.path());
        assert_eq!(
            messages,
            [
                "/1: sweeps of agent 1: no intensity field (intensity, reflectivity, remission, rgb, ...): it is 0 for \
                 all points",
                "/1: sweeps of agent 1: 50.0 % of the points lie within 300 m, usual are 95.0 % or more",
            ]
        );
    }

    /// YAML of 20 cars, this far ahead of the agent.
    fn cars_at(x_m: u32) -> String {
        let cars = (0..20).map(|id| {
            format!(
                "  {id}: {{location: [{x_m}, {id}, 0], angle: [0, 0, 0], extent: [2, 1, 0.7]}}\n"
            )
        });
        cars.collect()
    }

    #[test]
    fn boxes_that_cannot_be_in_the_right_frame_are_a_problem() {
        let dir = tempfile::tempdir().unwrap();
        let cars = cars_at(900);
        let yaml = format!("lidar_pose: [0, 0, 2, 0, 0, 0]\nvehicles:\n{cars}");
        write(dir.path(), "scene/1/000010.yaml", yaml.as_bytes());
        write(
            dir.path(),
            "scene/1/000010.pcd",
            &sweep(&[[10.0, 0.0, -1.3, 0.5], [1.0, 0.0, 0.0, 0.4]]),
        );
        let (_, messages) = survey(dir.path());
        assert_eq!(
            messages,
            [
                "scene: agent 1: 20 of 20 boxes (100 %) hold none of its points: frames (axes, order of the pose's \
                 numbers) or units of the boxes may be wrong",
                "scene: ground truth 0 for every ego in 1 of 1 ticks, though agents list 20 objects of its classes: frames (axes, order of \
                 the pose's numbers) or units of the boxes may be wrong",
            ]
        );
    }

    #[test]
    fn a_missing_pose_is_named_and_not_its_consequences() {
        let dir = tempfile::tempdir().unwrap();
        let yaml = format!("vehicles:\n{}", cars_at(9));
        for stem in ["000010", "000012"] {
            write(dir.path(), &format!("scene/1/{stem}.yaml"), yaml.as_bytes());
            let points = sweep(&[[10.0, 0.0, -1.3, 0.5], [1.0, 0.0, 0.0, 0.4]]);
            write(dir.path(), &format!("scene/1/{stem}.pcd"), &points);
        }
        let (_, messages) = survey(dir.path());
        assert_eq!(
            messages,
            [
                "/scene/1/000010.yaml: lidar_pose: missing in 2 of 2 frames of agent 1, this is the first: boxes cannot be placed"
            ]
        );
    }

    #[test]
    fn a_sweep_without_a_point_in_range_is_named() {
        let dir = tempfile::tempdir().unwrap();
        for (stem, x) in [("000010", 10.0), ("000012", 450_000.0), ("000014", 0.0)] {
            write(dir.path(), &format!("1/{stem}.yaml"), YAML.as_bytes());
            let points = if x > 0.0 {
                vec![[x, 0.0, -1.3, 0.5], [x, 1.0, 0.0, 0.4]]
            } else {
                vec![]
            };
            write(dir.path(), &format!("1/{stem}.pcd"), &sweep(&points));
        }
        let (_, messages) = survey(dir.path());
        assert_eq!(
            messages[messages.len() - 2..],
            [
                "/1/000012.pcd: none of the 2 points is a return within 300 m",
                "/1/000014.pcd: the sweep has no point",
            ]
        );
    }

    #[test]
    fn parts_that_were_left_out_are_listed_and_counted() {
        let dir = tempfile::tempdir().unwrap();
        let yaml = format!("{YAML}  8: {{location: [1, 2, 3]}}\n")
            + "  9: {type: Ufo, location: [5, 0, 0], angle: [0, 0, 0], extent: [2, 1, 1]}\n";
        for stem in ["000010", "000012"] {
            write(dir.path(), &format!("1/{stem}.yaml"), yaml.as_bytes());
            write(
                dir.path(),
                &format!("1/{stem}.pcd"),
                &sweep(&[[10.0, 0.0, -1.3, 0.5], [1.0, 0.0, 0.0, 0.4]]),
            );
        }
        let (report, messages) = survey(dir.path());
        assert_eq!(
            messages,
            [
                ": type: the text \"Ufo\" is an unknown type of object: it counts as other, not as a vehicle (2 times)",
                "/1/000010.yaml:4: vehicles.8.angle: missing: the object is left out",
                "/1/000012.yaml:4: vehicles.8.angle: missing: the object is left out",
            ]
        );
        assert_eq!(
            report.scenarios[0].agents[0].boxes,
            CountSummary::of(&[2, 2])
        );
    }

    #[test]
    fn a_folder_that_is_no_data_set_is_a_problem() {
        let dir = tempfile::tempdir().unwrap();
        let (report, messages) = survey(dir.path());
        assert_eq!(report.layout, None);
        assert!(messages[0].contains("no supported layout"), "{messages:?}");
        assert!(report.to_string().contains("1 problem:"));
    }
}
