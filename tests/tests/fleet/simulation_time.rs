//! Simulation time: the same bytes every time, in one process or in several, and the pipelines of a live run.

use std::fs;
use std::ops::ControlFlow;
use std::path::Path;
use std::process::{Command, Output};

use dataset::evaluation_protocol::EvaluationProtocol;
use dataset::ground_truth::{GroundTruth, GroundTruthRule};
use deploy::score::FrameScores;
use ego_fuser::config::EgoSettings;
use ego_fuser_offline::evaluation::stepped::ComputeTimes;
use ego_fuser_offline::evaluation::{AgentPool, EmulatedLink, EvaluatedFrame, Evaluator, Setup};
use fusion::Method;
use link::{ClockStep, DeviceClock, LatencyModel, LinkConfig, LossModel};
use protocol::{CavId, DropReason, Dtype};
use runner::fleet::Fleet;
use runner::run::run_fleet::{RunOptions, RunResult, run_scenario};
use runner::scenario::Scenario;
use serde_json::Value;
use tests::fleet::{
    check_origin, fused, programs, results, write_scenario, write_sighted_weights,
    write_weights_of_another_network, write_weights_with_box_input,
};
use tests::locks::exclusive_lock;

pub(super) const TICKS: usize = 8;
/// One vehicle more than the protocol of the layout lets take part.
const EIGHT: [&str; 8] = ["11", "12", "13", "14", "15", "16", "17", "18"];
/// A method that comes with the programs.
const ATTENTION: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../deploy/examples/attention.pt"
);
pub(super) const MS: u64 = 1_000_000;

/// A fleet with feature maps in half precision and zero compute times, over a link.
pub(super) fn config(link: LinkConfig) -> Setup {
    over(link, in_half_precision())
}

fn over(config: LinkConfig, setup: Setup) -> Setup {
    Setup {
        link: Some(EmulatedLink {
            config,
            folder: ".".into(),
            seed: 3,
        }),
        ego: EgoSettings {
            max_age_ms: 300,
            ..EgoSettings::default()
        },
        ..setup
    }
}

/// A fleet with feature maps in half precision, without a link.
fn in_half_precision() -> Setup {
    let mut setup = Setup::default();
    setup.agents.codec.dtype = Dtype::F16;
    setup
}

#[test]
fn as_many_vehicles_run_as_the_protocol_allows_or_the_scene_names() {
    let folder = tempfile::tempdir().unwrap();
    let file = write_scenario(folder.path(), 1, "", "");
    fs::remove_dir_all(folder.path().join("scene")).unwrap();
    tests::scene::write(folder.path(), &EIGHT, 1);
    let scenario = Scenario::read(&file).unwrap();
    let planned = |ego: Option<&str>, named: &[&str]| {
        let mut scenario = scenario.clone();
        scenario.ego.id = ego.map(|ego| CavId::new(ego).unwrap());
        scenario.scene.agents = named.iter().map(|cav| CavId::new(cav).unwrap()).collect();
        let fleet = Fleet::plan(&scenario).unwrap();
        let agents: Vec<String> = fleet.agents.iter().map(ToString::to_string).collect();
        (agents.join(" "), fleet.protocol.max_agents)
    };
    let seven = EIGHT[..7].join(" ");
    assert_eq!(planned(None, &[]), (seven, 7));
    let eight = EIGHT.join(" ");
    assert_eq!(planned(Some("18"), &[]), (eight.clone(), 8));
    assert_eq!(planned(None, &EIGHT), (eight, 8));
}

/// The frames of a scene in `folder`, and the ledger.
pub(super) fn evaluate(folder: &Path, mut setup: Setup) -> (Vec<EvaluatedFrame>, protocol::Ledger) {
    tch::set_num_threads(1);
    setup.models.weights = folder.join("weights.safetensors");
    setup.method = Some(Method::MAX);
    let mut evaluator = Evaluator::new(setup).unwrap();
    let scenario = dataset::open(&folder.join("scene"))
        .unwrap()
        .scenarios
        .remove(0);
    let mut frames = Vec::new();
    let _ = evaluator
        .run(&scenario, &mut |frame| {
            frames.push(frame);
            ControlFlow::Continue(())
        })
        .unwrap();
    let ledger = evaluator.ledger.clone();
    (frames, ledger)
}

pub(super) fn scene() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    tests::scene::write(folder.path(), &["4279", "4288", "4297"], TICKS);
    write_sighted_weights(&folder.path().join("weights.safetensors"));
    folder
}

fn ages_ms(frame: &EvaluatedFrame) -> Vec<i64> {
    frame
        .result
        .fused
        .iter()
        .map(|neighbour| neighbour.age_nanos / MS as i64)
        .collect()
}

#[test]
fn over_an_ideal_link_boxes_are_those_of_an_evaluation_without_one() {
    let folder = scene();
    let (offline, nothing) = evaluate(folder.path(), in_half_precision());
    let (stepped, ledger) = evaluate(folder.path(), config(LinkConfig::default()));
    assert_eq!(offline.len(), TICKS);
    for (offline, stepped) in offline.iter().zip(&stepped) {
        assert!(!offline.result.detections.is_empty());
        assert_eq!(offline.result.detections, stepped.result.detections);
        assert_eq!(
            (&offline.result.fused, &offline.truth),
            (&stepped.result.fused, &stepped.truth)
        );
    }
    assert!(
        nothing.is_empty() && ledger.balance().is_exact(),
        "{:?}",
        ledger.balance()
    );
    // Two neighbours with a pose and a map each per tick.
    assert_eq!(
        (ledger.total().sent, ledger.total().received),
        (4 * TICKS as u64, 4 * TICKS as u64)
    );
}

/// Cells that the ego masks out for others are present in its own map, over a link and without one.
#[test]
fn a_budget_cuts_the_neighbours_maps_and_not_the_egos_own() {
    let folder = scene();
    let mut settings = in_half_precision();
    settings.agents.codec.budget_bytes = Some(4000);
    let (offline, _) = evaluate(folder.path(), settings.clone());
    let ideal = over(LinkConfig::default(), settings);
    let (stepped, _) = evaluate(folder.path(), ideal);
    assert_eq!(offline.len(), TICKS);
    for (offline, stepped) in offline.iter().zip(&stepped) {
        // A complete feature map has 65 kB.
        assert!(
            offline
                .result
                .fused
                .iter()
                .all(|neighbour| neighbour.payload_bytes < 20_000)
        );
        assert!(!offline.result.detections.is_empty());
        assert_eq!(offline.result.detections, stepped.result.detections);
    }
}

/// A range of the ground truth that is narrower than the area of the network.
const NARROW: GroundTruthRule = GroundTruthRule {
    x_m: [-20.0, 20.0],
    y_m: [-10.0, 10.0],
    ..GroundTruthRule::OPV2V
};

/// Turns the cars of the scene by 90 degrees, the heading of all boxes that the sighted weights detect.
fn turn_cars(folder: &Path) {
    for agent in fs::read_dir(folder.join("scene")).unwrap() {
        for file in fs::read_dir(agent.unwrap().path()).unwrap() {
            let path = file.unwrap().path();
            if path.extension().is_some_and(|name| name == "yaml") {
                let text = fs::read_to_string(&path).unwrap();
                let turned = text.replace("angle: [0.0, 0.0, 0.0]", "angle: [0.0, 90.0, 0.0]");
                fs::write(&path, turned).unwrap();
            }
        }
    }
}

/// Scores of the frames, each with a ground truth.
fn judged(
    frames: &[EvaluatedFrame],
    truth_of: impl Fn(&EvaluatedFrame) -> GroundTruth,
) -> FrameScores {
    let mut scores = FrameScores::new(frames[0].result.ego.clone(), NARROW, 1);
    for frame in frames {
        let at = (frame.tick as u64, frame.stamp.capture_nanos);
        let (result, truth) = (frame.result.clone(), truth_of(frame));
        scores.judge_whole(at, None, Some(result), &truth, &[], Vec::new());
    }
    scores
}

/// AP at an IoU of 0.3: in both orders, and of each distance and class.
fn all_at_30(scores: &FrameScores) -> Vec<f64> {
    let [by_score, by_frame] = scores.average_precision();
    let [by_distance, by_class] = scores.average_precision_by_part();
    let parts = by_distance.values().chain(by_class.values());
    [by_score, by_frame]
        .into_iter()
        .chain(parts.map(|part| part.ap))
        .map(|ap| ap.at_30.unwrap())
        .collect()
}

#[test]
fn detections_beyond_the_range_of_the_protocol_count_neither_way_with_and_without_a_link() {
    let folder = scene();
    turn_cars(folder.path());
    let protocol = EvaluationProtocol {
        ground_truth: NARROW,
        ..EvaluationProtocol::preset("opv2v").unwrap()
    };
    let settings = Setup {
        protocol: Some(protocol),
        ..in_half_precision()
    };
    let (offline, _) = evaluate(folder.path(), settings.clone());
    let ideal = over(LinkConfig::default(), settings);
    let (stepped, _) = evaluate(folder.path(), ideal);
    assert_eq!((offline.len(), stepped.len()), (TICKS, TICKS));
    let [without_link, over_link] =
        [&offline, &stepped].map(|frames| judged(frames, |frame| frame.truth.clone()));
    assert_eq!(
        without_link.average_precision(),
        over_link.average_precision()
    );
    assert_eq!(
        without_link.average_precision_by_part(),
        over_link.average_precision_by_part()
    );
    // The same objects, and detections of the whole area of the network.
    let of_whole_area = judged(&offline, |frame| GroundTruth {
        area_m: [f64::MIN, f64::MIN, f64::MAX, f64::MAX],
        ..frame.truth.clone()
    });
    let (cut, whole) = (all_at_30(&without_link), all_at_30(&of_whole_area));
    assert!(
        cut.len() == 4 && whole.len() == 4 && whole.iter().all(|ap| *ap > 0.0),
        "one bin of distance and one class: {cut:?}, {whole:?}"
    );
    assert!(
        cut.iter().zip(&whole).all(|(cut, whole)| cut > whole),
        "{cut:?}, {whole:?}"
    );
}

#[test]
fn the_ego_waits_from_its_own_map_on_for_its_deadline_or_the_next_map() {
    let folder = scene();
    // Decision after the capture: complete, or 100 ms after the own map.
    for (delay_ms, compute_ms, age_ms, first_tick, decided_ms) in [
        (0.0, 100.0, 0, 0, 100),
        (0.0, 80.0, 0, 0, 80),
        (30.0, 80.0, 0, 0, 110),
        (120.0, 80.0, 100, 1, 180),
        (250.0, 0.0, 200, 2, 100),
    ] {
        let link = LinkConfig {
            latency: LatencyModel::ConstantMs(delay_ms),
            ..LinkConfig::default()
        };
        let compute = ComputeTimes {
            pose_ms: 20.0f64.min(compute_ms),
            map_ms: (compute_ms - 20.0).max(0.0),
            fuse_ms: 5.0,
        };
        let (frames, ledger) = evaluate(
            folder.path(),
            Setup {
                compute,
                ..config(link)
            },
        );
        for (tick, frame) in frames.iter().enumerate() {
            let expected = if tick < first_tick {
                vec![]
            } else {
                vec![age_ms; 2]
            };
            assert_eq!(ages_ms(frame), expected, "delay {delay_ms} ms, tick {tick}");
            let took_ms = (frame.stamp.publish_nanos - frame.stamp.capture_nanos) / MS;
            assert_eq!(took_ms, decided_ms + 5, "delay {delay_ms} ms, tick {tick}");
        }
        assert!(ledger.balance().is_exact(), "{:?}", ledger.balance());
    }
    // Older than the age limit of the fusion.
    let link = LinkConfig {
        latency: LatencyModel::ConstantMs(450.0),
        ..LinkConfig::default()
    };
    let (frames, ledger) = evaluate(folder.path(), config(link));
    assert!(
        frames
            .iter()
            .all(|frame| frame.result.fused.is_empty() && frame.result.skipped.len() == 2)
    );
    assert!(ledger.total().dropped[&DropReason::Stale] > 0 && ledger.balance().is_exact());
}

#[test]
fn a_clock_that_is_off_shifts_what_belongs_together() {
    let folder = scene();
    for (offset_ms, drift_ppm, ages_in_ms) in [
        (-20.0, 0.0, [20, 20, 20]),
        (-40.0, 0.0, [40, 40, 40]),
        // 5 ms a frame.
        (0.0, -5e4, [10, 15, 20]),
    ] {
        let clock = DeviceClock {
            offset_ms,
            drift_ppm,
            step: None,
        };
        let (frames, ledger) = evaluate(
            folder.path(),
            config(LinkConfig {
                clock,
                ..LinkConfig::default()
            }),
        );
        // The scene begins at 0, and no clock is below that.
        for (frame, age_ms) in frames[2..].iter().zip(ages_in_ms) {
            assert_eq!(ages_ms(frame), [age_ms; 2], "{clock:?}");
        }
        assert!(ledger.balance().is_exact(), "{:?}", ledger.balance());
    }
}

#[test]
fn a_constant_offset_of_capture_times_changes_no_box() {
    let folder = scene();
    let (right, _) = evaluate(folder.path(), config(LinkConfig::default()));
    for offset_ms in [100.0, 300.0, 3000.0] {
        let clock = DeviceClock {
            offset_ms,
            ..DeviceClock::default()
        };
        let link = LinkConfig {
            clock,
            ..LinkConfig::default()
        };
        let (frames, ledger) = evaluate(folder.path(), config(link));
        for (frame, right) in frames.iter().zip(&right) {
            assert_eq!(frame.result.detections, right.result.detections);
            assert_eq!(frame.result.fused, right.result.fused);
            let offsets = frame.result.neighbours.iter();
            let offsets: Vec<_> = offsets.map(|state| state.capture_offset_s).collect();
            assert_eq!(offsets, [Some(offset_ms / 1e3); 2]);
        }
        assert!(ledger.balance().is_exact(), "{:?}", ledger.balance());
    }
}

#[test]
fn a_clock_that_is_set_costs_only_its_vehicle() {
    let folder = scene();
    let run = |by_ms| {
        let clock = DeviceClock {
            step: Some(ClockStep { at_s: 0.2, by_ms }),
            ..DeviceClock::default()
        };
        let (frames, ledger) = evaluate(
            folder.path(),
            config(LinkConfig {
                clock,
                ..LinkConfig::default()
            }),
        );
        assert!(
            frames.len() == TICKS && ledger.balance().is_exact(),
            "by {by_ms} ms: {ledger:?}"
        );
        (frames.iter().map(ages_ms).collect::<Vec<_>>(), ledger)
    };
    let (ages_ms, ledger) = run(10_000.0);
    // Its earlier messages serve until they are too old; its later ones are left out until its offset is certain, in 1.3 s.
    let expected: Vec<Vec<i64>> = [0, 0, 100, 200, 300].map(|age_ms| vec![age_ms; 2]).into();
    assert_eq!(ages_ms[..5], expected);
    assert!(ages_ms[5..].iter().all(Vec::is_empty), "{ages_ms:?}");
    assert_eq!(
        ledger.total().dropped[&DropReason::Clock],
        2 * (TICKS as u64 - 2),
        "{ledger:?}"
    );
    let (ages_ms, _) = run(-30.0);
    assert!(
        ages_ms[..2].iter().all(|ages| ages == &[0, 0]),
        "{ages_ms:?}"
    );
    assert!(
        ages_ms[2..].iter().all(|ages| ages == &[30, 30]),
        "{ages_ms:?}"
    );
}

#[test]
fn fewer_vehicles_leave_the_truth_as_it_is() {
    let folder = scene();
    let with_agents = |count| Setup {
        pool: AgentPool::First(count),
        ..config(LinkConfig::default())
    };
    let (all, _) = evaluate(folder.path(), with_agents(3));
    let (two, _) = evaluate(folder.path(), with_agents(2));
    assert!(
        all.iter()
            .zip(&two)
            .all(|(all, two)| all.truth == two.truth)
    );
    assert!(all.iter().all(|frame| frame.result.fused.len() == 2));
    assert!(two.iter().all(|frame| frame.result.fused.len() == 1));
}

#[test]
fn losses_are_counted_and_come_from_the_seed() {
    let folder = scene();
    let link = LinkConfig {
        loss: LossModel::Bernoulli(0.4),
        duplicate: 0.3,
        ..LinkConfig::default()
    };
    let run = |seed| {
        let mut setup = config(link.clone());
        if let Some(link) = &mut setup.link {
            link.seed = seed;
        }
        evaluate(folder.path(), setup)
    };
    let ((frames, ledger), (again, same)) = (run(1), run(1));
    assert_eq!(ledger, same);
    assert!(
        frames
            .iter()
            .zip(&again)
            .all(|(one, other)| one.result == other.result && one.stamp == other.stamp)
    );
    let total = ledger.total();
    assert!(
        total.dropped[&DropReason::LinkLoss] > 0
            && !total.dropped.contains_key(&DropReason::Duplicate),
        "{total:?}"
    );
    assert!(ledger.balance().is_exact(), "{:?}", ledger.balance());
    assert_ne!(run(2).1, ledger);
}

const FILES: [&str; 6] = [
    "metrics.json",
    "frames.csv",
    "ledger.json",
    "detections.jsonl",
    "tracks.jsonl",
    "truth.jsonl",
];

fn assert_same_bytes(one: &RunResult, other: &RunResult) {
    for name in FILES {
        let read = |run: &RunResult| fs::read(run.folder.file(name)).unwrap();
        assert!(read(one) == read(other), "{name}");
    }
}

fn run_up(folder: &Path, scenario: &Path, runs: &str) -> RunResult {
    let options = RunOptions {
        runs: folder.join(runs),
        programs: programs().to_owned(),
        prefix: "up",
    };
    run_scenario(&Scenario::load(scenario).unwrap(), &options).unwrap()
}

#[test]
fn a_stepped_run_is_the_same_bytes_every_time() {
    let folder = tempfile::tempdir().unwrap();
    let link = "capacity: {token_bucket: {bandwidth_mbps: 20}}\nlatency: {normal: {mean_ms: 60, std_ms: 30}}\nloss: {bernoulli: 0.2}\n";
    fs::write(folder.path().join("link.yaml"), link).unwrap();
    let rest = "clock: stepped\nstepped: {compute: {pose_ms: 10, map_ms: 40, fuse_ms: 20}}\n\
        link: {model: link.yaml, seed: 5}\nego: {max_age_ms: 500}\nvehicles: {\"4288\": {pose: {noisy: {position_std_m: 0.5}}}}";
    let scenario = write_scenario(folder.path(), TICKS, "seek: 1", rest);
    let (one, two) = (
        run_up(folder.path(), &scenario, "one"),
        run_up(folder.path(), &scenario, "two"),
    );
    assert_same_bytes(&one, &two);
    check_origin(
        one.folder.path(),
        &folder.path().join("weights.safetensors"),
    );
    assert!(
        one.balance.is_exact()
            && one.metrics.clock == "stepped"
            && one.metrics.frames == TICKS as u64 - 1
    );
    let latency = &one.metrics.latency_ms.capture_to_detection;
    assert_eq!(
        (latency.p50, latency.p99),
        (Some(170.0), Some(170.0)),
        "the own map, the deadline, and the fusion"
    );
    assert!(one.metrics.age_ms.p50.unwrap() >= 100.0 && one.metrics.pose.mean_m.unwrap() > 0.05);
    let frames = fs::read_to_string(one.folder.file("frames.csv")).unwrap();
    assert!(
        frames.starts_with("tick,agent_frame,")
            && frames.lines().nth(1).unwrap().starts_with("1,0,"),
        "{frames}"
    );
    assert_eq!(results(one.folder.path()).len(), TICKS - 1);
}

#[test]
fn agents_in_processes_of_their_own_give_the_same_bytes() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    tests::scene::write(folder.path(), &["4279", "4288", "4297"], TICKS);
    write_sighted_weights(&folder.path().join("weights.safetensors"));
    write_weights_with_box_input(&folder.path().join("boxes.safetensors"));
    write_weights_of_another_network(&folder.path().join("other.safetensors"));
    let mut with_boxes = Vec::new();
    let link = "capacity: {token_bucket: {bandwidth_mbps: 20}}\nlatency: {normal: {mean_ms: 60, std_ms: 30}}\nloss: {bernoulli: 0.2}\n";
    fs::write(folder.path().join("link.yaml"), link).unwrap();
    // All settings that an agent's process needs: noise, codec, limits, one vehicle with settings of its own.
    for (method, rest) in [
        (
            "max",
            "agents: {codec: {dtype: i8, budget_bytes: 4000}}\nvehicles: {\"4288\": {pose: {noisy: {position_std_m: 0.5, mode: autoregressive}}}}",
        ),
        (
            "late",
            "agents: {pose: {noisy: {position_std_m: 0.3, heading_std_deg: 1, mode: independent}}}",
        ),
        (
            "max",
            "vehicles: {\"4288\": {boxes: only}, \"4297\": {boxes: beside}}",
        ),
        (
            "max",
            "vehicles: {\"4288\": {boxes: only, weights: other.safetensors}, \"4297\": {boxes: beside}}",
        ),
        ("none", ""),
    ] {
        let weights = match rest.contains("boxes") {
            true => "boxes.safetensors",
            false => "weights.safetensors",
        };
        let run = |processes| {
            let text = format!(
                "run: test\nscene: {{dir: scene}}\nmodels: {{weights: {weights}}}\nmethod: {method}\nclock: stepped\n\
                 stepped: {{compute: {{pose_ms: 10, map_ms: 40, fuse_ms: 20}}, processes: {processes}}}\n\
                 link: {{model: link.yaml, seed: 5}}\nego: {{max_age_ms: 500}}\n{rest}\n"
            );
            let path = folder.path().join("scenario.yaml");
            fs::write(&path, text).unwrap();
            let name = format!("{method}-{}-{processes}", rest.len());
            run_up(folder.path(), &path, &name)
        };
        let (one, many) = (run(false), run(true));
        assert_same_bytes(&one, &many);
        let decided = results(one.folder.path());
        let is_found = |result: &Value| !result["detections"].as_array().unwrap().is_empty();
        assert!(decided.iter().any(is_found), "{method} {rest}");
        if rest.contains("boxes") {
            with_boxes.push(decided.clone());
        }
        let ledger = fs::read_to_string(one.folder.file("ledger.json")).unwrap();
        let ledger: Value = serde_json::from_str(&ledger).unwrap();
        assert_eq!(ledger["balances"], true, "{}", ledger["balance"]);
        let takes_both = |result: &Value| fused(result) == 2;
        assert!(
            method == "none" || decided.iter().any(takes_both),
            "{method} {rest}"
        );
        let logs = fs::read_dir(many.folder.log_dir()).unwrap().count();
        assert_eq!(
            (logs, many.killed.len()),
            (4, 0),
            "a vehicle each, and a router"
        );
    }
    assert_ne!(with_boxes[0], with_boxes[1], "of another network");
}

#[test]
fn compute_times_are_measured_once_and_written_down() {
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), 3, "", "clock: stepped");
    // On a busy machine the compute times may exceed a frame: then the run is refused with a message.
    let options = RunOptions {
        runs: folder.path().join("runs"),
        programs: programs().to_owned(),
        prefix: "up",
    };
    match run_scenario(&Scenario::load(&scenario).unwrap(), &options) {
        Ok(run) => {
            let resolved = Scenario::load(&run.folder.file("scenario.yaml")).unwrap();
            let compute = resolved.stepped.unwrap().compute.unwrap();
            assert!(
                compute.map_ms >= 1.0 && compute.map_ms <= 100.0,
                "{compute:?}"
            );
        }
        Err(error) => assert!(error.to_string().contains("every 100 ms"), "{error}"),
    }
}

fn sweep(folder: &Path, out: &str, jobs: &str, more: &[&str]) -> Output {
    let program = programs().join("v2vloc");
    let mut command = Command::new(program);
    command
        .arg("sweep")
        .arg(folder.join("experiment.yaml"))
        .arg("--out")
        .arg(folder.join(out));
    command.args(["--jobs", jobs]).args(more).output().unwrap()
}

fn text_of(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn a_sweep_is_the_same_csv_in_one_process_and_in_many() {
    let folder = scene();
    let text = "name: e\ntitle: A < B\ndataset: scene\nweights: weights.safetensors\nframes: 4\n\
        compute: {pose_ms: 10, map_ms: 30, fuse_ms: 10}\nnoise_mode: independent\n\
        grid:\n  method: [none, late, max]\n  latency_ms: [0, 200]\n  jitter_ms: [20]\n  bandwidth_mbps: [.inf, 10]\n  \
        codec: [{dtype: f16}, {dtype: i8, keep: 0.25}]\n  loss: [0.2]\n  pose_noise: [{position_std_m: 0.2, heading_std_deg: 0.2}]\n  vehicles: [2]\n  \
        seed: [1]\n";
    fs::write(folder.path().join("experiment.yaml"), text).unwrap();
    let dry = sweep(folder.path(), "dry", "2", &["--dry-run"]);
    assert!(
        dry.status.success() && dry.stdout.is_empty(),
        "{}",
        text_of(&dry)
    );
    // Methods without feature maps have one encoding.
    assert!(
        text_of(&dry).contains(
            "4 method with codec x 2 latency_ms x 2 bandwidth_mbps = 16 runs of 4 frames"
        ),
        "{}",
        text_of(&dry)
    );
    assert!(
        text_of(&dry).contains("minutes for 16 runs with 2 jobs"),
        "{}",
        text_of(&dry)
    );
    assert!(!folder.path().join("dry").exists(), "nothing is written");

    let foreign = folder.path().join("one/maps/of-another-program.maps");
    fs::create_dir_all(foreign.parent().unwrap()).unwrap();
    fs::write(&foreign, b"").unwrap();
    let [one, many] = [
        ("one", "1", [].as_slice()),
        ("many", "3", &["--keep-feature-maps"]),
    ]
    .map(|(out, jobs, more)| sweep(folder.path(), out, jobs, more));
    assert!(
        one.status.success() && many.status.success(),
        "{}\n{}",
        text_of(&one),
        text_of(&many)
    );
    let read =
        |out: &str, name: &str| fs::read_to_string(folder.path().join(out).join(name)).unwrap();
    let maps = |out: &str| {
        fs::read_dir(folder.path().join(out).join("maps"))
            .unwrap()
            .count()
    };
    assert!(
        maps("one") == 1 && foreign.exists(),
        "only the sweep's own maps are removed"
    );
    assert!(maps("many") > 0, "maps are kept on request");
    let csv = read("one", "e.csv");
    assert_eq!(csv, read("many", "e.csv"));
    let table = String::from_utf8_lossy(&one.stdout).into_owned();
    assert!(
        table.starts_with("method  dtype  keep  latency_ms  bandwidth_mbps  ap_global_30"),
        "{table}"
    );
    // Random weights detect nothing, so no run is said to be the best.
    assert!(
        table.lines().count() == 17 && table.lines().all(|line| line.len() <= 120),
        "{table}"
    );
    assert_eq!(read("one", "report.html"), read("many", "report.html"));
    let lines: Vec<Vec<&str>> = csv.lines().map(|line| line.split(',').collect()).collect();
    assert!(
        lines.len() == 17 && lines.iter().all(|line| line.len() == lines[0].len()),
        "{csv}"
    );
    let column = |line: usize, name: &str| {
        let place = lines[0]
            .iter()
            .position(|column| *column == name)
            .unwrap_or_else(|| panic!("{name}"));
        lines[line][place]
    };
    assert_eq!(
        (
            column(1, "method"),
            column(1, "sent"),
            column(1, "frames_used")
        ),
        ("none", "0", "0")
    );
    let dense = (9..17)
        .find(|&line| column(line, "dtype") == "f16" && !column(line, "payload_bytes").is_empty())
        .unwrap();
    let sparse = (9..17)
        .find(|&line| column(line, "keep") == "0.25" && !column(line, "payload_bytes").is_empty())
        .unwrap();
    let bytes = |line| column(line, "payload_bytes").parse::<f64>().unwrap();
    assert!(
        bytes(sparse) < 0.2 * bytes(dense),
        "{} {}",
        bytes(sparse),
        bytes(dense)
    );
    for name in [
        "ap_latency.svg",
        "ap_latency.png",
        "ap_bandwidth.svg",
        "ap_bytes.png",
        "report.html",
    ] {
        assert!(folder.path().join("one").join(name).exists(), "{name}");
    }
    let page = read("one", "report.html");
    assert!(
        page.contains("A &lt; B") && page.contains("<svg") && !page.contains("src="),
        "self-contained"
    );

    // Completed runs are not repeated; the key is the content of the sweep.
    let again = sweep(folder.path(), "one", "2", &[]);
    assert!(
        again.status.success() && text_of(&again).contains("16 done before"),
        "{}",
        text_of(&again)
    );
    assert_eq!(again.stdout, one.stdout);
    fs::write(
        folder.path().join("experiment.yaml"),
        text.replace("seed: [1]", "seed: [1, 2]"),
    )
    .unwrap();
    let more = sweep(folder.path(), "one", "2", &["--dry-run"]);
    assert!(
        text_of(&more).contains("32 runs of 4 frames, 16 done before"),
        "{}",
        text_of(&more)
    );
}

#[test]
fn an_experiment_that_makes_no_sense_is_refused_by_its_field() {
    let folder = scene();
    let rest = "dataset: scene\nweights: weights.safetensors\n";
    for (text, message) in [
        (
            "grid: {method: [max], vehicles: [4]}",
            "grid.vehicles is 4, but scenario scene has 3 vehicles",
        ),
        (
            "link: dsrc\ngrid: {method: [max], loss: [0.1]}",
            "grid.loss and the loss of link dsrc contradict",
        ),
        ("grid: {method: [max], latencies: [1]}", "latencies"),
        (
            "compute: {pose_ms: 60, map_ms: 60, fuse_ms: 0}\ngrid: {method: [max]}",
            "takes 120 ms, but the scene has a frame",
        ),
    ] {
        fs::write(
            folder.path().join("experiment.yaml"),
            format!("name: e\n{rest}{text}\n"),
        )
        .unwrap();
        let output = sweep(folder.path(), "out", "1", &[]);
        assert!(
            output.status.code() == Some(2) && text_of(&output).contains(message),
            "{text}: {}",
            text_of(&output)
        );
    }
}

#[test]
fn an_evaluation_crosses_a_link() {
    let folder = scene();
    let output = Command::new(programs().join("v2vloc"))
        .args([
            "eval",
            "--method",
            "max",
            "--json",
            "--link",
            "opencood-sim",
            "--deadline-ms",
            "0",
        ])
        .args(["--max-age-ms", "300", "--seed", "1", "--dataset"])
        .arg(folder.path().join("scene"))
        .arg("--weights")
        .arg(folder.path().join("weights.safetensors"))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", text_of(&output));
    let metrics: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(
        (&metrics["clock"], &metrics["age_ms"]["p50"]),
        (&"stepped".into(), &100.0.into())
    );
}

#[test]
fn a_dry_run_generates_no_data_set() {
    let folder = tempfile::tempdir().unwrap();
    write_sighted_weights(&folder.path().join("weights.safetensors"));
    let text = "name: e\ndataset: scene\nweights: weights.safetensors\n\
        generate: {seed: 1201, scenes: 2, frames: 3, vehicles: [2, 2]}\ngrid: {method: [max], loss: [0, 0.5]}\n";
    fs::write(folder.path().join("experiment.yaml"), text).unwrap();
    let dry = sweep(folder.path(), "dry", "1", &["--dry-run"]);
    assert!(dry.status.success(), "{}", text_of(&dry));
    assert!(
        text_of(&dry).contains("2 runs of 6 frames; the data set"),
        "{}",
        text_of(&dry)
    );
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
}

#[test]
fn a_run_of_a_sweep_is_computed_anew_after_any_change_of_its_files() {
    let folder = scene();
    let script = folder.path().join("fusion/mine.pt");
    fs::create_dir(folder.path().join("fusion")).unwrap();
    fs::copy(ATTENTION, &script).unwrap();
    let text = format!(
        "name: e\ndataset: scene\nweights: weights.safetensors\nframes: 2\ngrid: {{method: [\"script:{}\"]}}\n",
        script.display()
    );
    fs::write(folder.path().join("experiment.yaml"), text).unwrap();
    let done_before = || {
        let output = sweep(folder.path(), "out", "1", &[]);
        assert!(output.status.success(), "{}", text_of(&output));
        text_of(&output).contains("1 done before")
    };
    assert!(!done_before());
    assert!(done_before());
    let cloud = folder.path().join("scene/4288/000062.pcd");
    let mut points = fs::read(&cloud).unwrap();
    let middle = points.len() / 2;
    points[middle] ^= 1;
    fs::write(&cloud, points).unwrap();
    assert!(!done_before(), "a bit of a point");
    let labels = folder.path().join("scene/4288/000062.yaml");
    let moved = fs::read_to_string(&labels).unwrap().replace("0.8]", "0.9]");
    fs::write(&labels, moved).unwrap();
    assert!(!done_before(), "a label");
    fs::write(&script, b"no TorchScript").unwrap();
    let output = sweep(folder.path(), "out", "1", &[]);
    assert_eq!(output.status.code(), Some(2), "{}", text_of(&output));
}

#[test]
fn an_unreadable_sweep_is_counted_as_in_a_live_run() {
    let folder = tempfile::tempdir().unwrap();
    let rest = "clock: stepped\nstepped: {compute: {pose_ms: 10, map_ms: 40, fuse_ms: 20}}\nego: {id: \"4288\"}";
    let scenario = write_scenario(folder.path(), 3, "", rest);
    let cut_off = |cav: &str| {
        let path = folder.path().join(format!("scene/{cav}/000062.pcd"));
        let bytes = fs::read(&path).unwrap();
        fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    };
    cut_off("4279");
    let neighbour = run_up(folder.path(), &scenario, "neighbour");
    assert!(neighbour.lost_data());
    let left_out = &neighbour.metrics.left_out;
    assert_eq!((left_out.frames, left_out.ticks), (1, 0));
    cut_off("4288");
    let ego = run_up(folder.path(), &scenario, "ego");
    assert_eq!(ego.metrics.left_out.ticks, 1);
    assert_eq!(results(ego.folder.path()).len(), 2);
}
