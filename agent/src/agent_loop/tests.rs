use std::path::{Path, PathBuf};

use localization::pose_source::RecordedPose;
use perception::detector::Detector;
use perception::model_config::DetectorConfig;
use perception::pillars::point_pillars::PointPillars;
use perception::weights::{CONFIG_KEY, Precision, save};
use protocol::{EgoMotion, PointCloud, Pose, Stamp};
use tch::{Device, nn::VarStore};

use super::*;
use crate::config::AgentSettings;
use crate::rate::Turn;

/// A time on the loop's clock, nanoseconds.
const NOW: u64 = 1_000_000_000;

fn cav() -> CavId {
    CavId::new("4279").unwrap()
}

/// Writes weights of a small detector with random parameters.
fn write_weights(folder: &Path) -> PathBuf {
    tch::set_num_threads(1);
    let config = DetectorConfig {
        lidar_range_m: [-12.8, -6.4, -3.0, 12.8, 6.4, 1.0],
        ..DetectorConfig::lean()
    };
    let network = VarStore::new(Device::Cpu);
    PointPillars::new(&network.root(), &config).unwrap();
    let config = serde_json::to_string(&config).unwrap();
    let path = folder.join("detector.safetensors");
    let metadata = [(CONFIG_KEY.to_owned(), config)].into();
    save(&path, &network, &metadata, Precision::Single).unwrap();
    path
}

fn agent(weights: &Path) -> Agent {
    let detector = Detector::load(weights, Device::Cpu).unwrap();
    Agent::new(cav(), Box::new(RecordedPose), detector)
}

fn sweep(capture_nanos: u64) -> LoopInput {
    let points = (0..500_u64).map(|k| {
        [
            ((k + capture_nanos) % 83) as f32 * 0.3 - 12.0,
            (k % 41) as f32 * 0.3 - 6.0,
            -1.5,
            0.2,
        ]
    });
    LoopInput::Sweep(Sweep {
        capture_nanos,
        arrived_nanos: 7_000 + capture_nanos,
        cloud: PointCloud {
            xyzi: points.collect(),
        },
    })
}

fn gnss(capture_nanos: u64, source: GnssSource) -> LoopInput {
    let gnss = Gnss {
        world_from_lidar: Pose::from_xyz_yaw([capture_nanos as f64, 6.0, 0.0], 0.3),
        position_std_m: 0.0,
        heading_std_rad: 0.0,
        source,
    };
    LoopInput::Gnss(capture_nanos, gnss)
}

/// Hands inputs to a loop, each with all the steps that follow; returns what is published, as `(stream, number)`.
fn published(agent_loop: &mut AgentLoop, inputs: Vec<LoopInput>) -> Vec<(Stream, u64)> {
    outputs(agent_loop, inputs)
        .into_iter()
        .filter_map(|output| match output {
            LoopOutput::Publish(message) => Some((message.stream, message.number)),
            _ => None,
        })
        .collect()
}

fn outputs(agent_loop: &mut AgentLoop, inputs: Vec<LoopInput>) -> Vec<LoopOutput> {
    let mut outputs = Vec::new();
    for input in inputs {
        outputs.extend(agent_loop.handle(input, NOW));
        outputs.extend(agent_loop.handle(LoopInput::Wake, NOW));
        while agent_loop.is_computing() {
            outputs.extend(agent_loop.handle(LoopInput::Wake, NOW));
        }
    }
    outputs
}

/// Streams of the outputs that are published.
fn streams(outputs: Vec<LoopOutput>) -> Vec<Stream> {
    let streams = outputs.into_iter().filter_map(|output| match output {
        LoopOutput::Publish(message) => Some(message.stream),
        _ => None,
    });
    streams.collect()
}

#[test]
fn a_sweep_waits_for_its_pose_and_its_steps_are_published_one_by_one() {
    let folder = tempfile::tempdir().unwrap();
    let agent = agent(&write_weights(folder.path()));
    let mut agent_loop = AgentLoop::new(agent, LoopOptions::default());
    // The agent does not know yet that its vehicle measures no motion.
    let motion = LoopInput::Motion(10, EgoMotion::default());
    let first = published(&mut agent_loop, vec![motion, sweep(10)]);
    assert_eq!(first, [(Stream::Descriptor, 0), (Stream::Descriptor, 1)]);
    assert!(!agent_loop.is_computing() && agent_loop.wakes_nanos() > NOW);

    let pose = gnss(10, GnssSource::Recorded);
    assert!(streams(agent_loop.handle(pose, NOW)).is_empty());
    for step in [&[Stream::Pose][..], &[Stream::Bev], &[]] {
        assert_eq!(streams(agent_loop.handle(LoopInput::Wake, NOW)), step);
    }
    assert!(!agent_loop.is_computing());
    let report = agent_loop.report();
    assert_eq!((report.sweeps, report.no_pose, report.failed), (1, 0, 0));
}

#[test]
fn after_the_end_a_sweep_waits_for_nothing() {
    let agent = Agent::without_detector(cav(), Box::new(RecordedPose));
    let options = LoopOptions {
        publish: Vec::new(),
        ..LoopOptions::default()
    };
    let mut agent_loop = AgentLoop::new(agent, options);
    assert!(published(&mut agent_loop, vec![sweep(10), sweep(20)]).is_empty());
    assert!(!agent_loop.is_finished());
    let last = published(&mut agent_loop, vec![LoopInput::Ended]);
    assert_eq!(last, [(Stream::Pose, 0)]);
    assert!(agent_loop.is_finished());
    assert_eq!(agent_loop.report().no_pose, 1);
}

#[test]
fn between_two_scenes_the_descriptor_names_no_stream() {
    let folder = tempfile::tempdir().unwrap();
    let agent = agent(&write_weights(folder.path()));
    let mut agent_loop = AgentLoop::new(agent, LoopOptions::default());
    let publishes = vec![Stream::Pose, Stream::Bev];
    for (input, second, expected) in [
        (LoopInput::Wake, 1, vec![publishes.clone()]),
        (LoopInput::SceneEnded, 1, vec![]),
        (LoopInput::Wake, 2, vec![vec![]]),
        (LoopInput::Wake, 3, vec![vec![]]),
        (sweep(10), 3, vec![publishes]),
    ] {
        let outputs = agent_loop.handle(input, second * NOW).into_iter();
        let named = outputs.filter_map(|output| match output {
            LoopOutput::Publish(message) => match message.content {
                Content::Fixed(Message::Descriptor(descriptor)) => Some(descriptor.streams),
                _ => None,
            },
            _ => None,
        });
        assert_eq!(named.collect::<Vec<_>>(), expected, "at {second} s");
    }
    assert!(!agent_loop.is_finished());
}

#[test]
fn a_sweep_that_does_not_fail_by_its_values_is_counted_apart() {
    let agent = Agent::without_detector(cav(), Box::new(RecordedPose));
    let mut agent_loop = AgentLoop::new(agent, LoopOptions::default());
    let outputs = outputs(&mut agent_loop, vec![sweep(10), LoopInput::Ended]);
    let dropped = outputs.into_iter().filter_map(|output| match output {
        LoopOutput::Dropped(_, reason) => Some(reason),
        _ => None,
    });
    assert_eq!(dropped.collect::<Vec<_>>(), [DropReason::Shape]);
}

/// The encoded messages of two sweeps, each with its stream.
fn encoded(options: &LoopOptions, weights: &Path) -> Vec<(Stream, Vec<u8>)> {
    let mut agent_loop = AgentLoop::new(agent(weights), options.clone());
    let encoder = MessageEncoder::new(options);
    let inputs = vec![
        gnss(5, GnssSource::Stated),
        gnss(10, GnssSource::Recorded),
        sweep(10),
        sweep(20),
        LoopInput::Motion(20, EgoMotion::default()),
        gnss(20, GnssSource::Recorded),
        LoopInput::Ended,
    ];
    let mut bytes = Vec::new();
    for output in outputs(&mut agent_loop, inputs) {
        let LoopOutput::Publish(message) = output else {
            continue;
        };
        let turn = Turn {
            number: message.number,
            submitted_nanos: NOW,
            begun_nanos: NOW,
        };
        let stamp = Stamp {
            cav: cav(),
            epoch: 1,
            sequence: message.number,
            capture_nanos: message.capture_nanos,
            publish_nanos: NOW,
        };
        let stream = message.stream;
        let (encoded, _) = encoder.encode(message, &stamp, Some(&turn)).unwrap();
        bytes.push((stream, encoded.to_vec()));
    }
    bytes
}

#[test]
fn the_same_inputs_give_the_same_bytes() {
    let options = LoopOptions {
        publish: vec![Stream::Bev, Stream::Boxes, Stream::Points],
        falsification: Some(Falsification::Noise),
        rate: RateConfig {
            bytes_per_second: Some(1_000_000),
            ..RateConfig::default()
        },
        ..LoopOptions::default()
    };
    let folder = tempfile::tempdir().unwrap();
    let weights = write_weights(folder.path());
    let first = encoded(&options, &weights);
    let of_sweeps = [Stream::Pose, Stream::Bev, Stream::Boxes, Stream::Points];
    assert_eq!(
        of_sweeps.map(|stream| first.iter().filter(|(of, _)| *of == stream).count()),
        [1; 4],
        "the second has superseded the first"
    );
    assert_eq!(first, encoded(&options, &weights));
}

#[test]
fn a_byte_limit_below_a_map_without_cells_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let agent = agent(&write_weights(folder.path()));
    // 256 of header and metadata, 4 for each of 64 scales, one bit for each of 32 x 16 cells.
    let smallest = 256 + 4 * 64 + 32 * 16 / 8;
    let check = |limits: serde_json::Value, sent| {
        let settings: AgentSettings = serde_json::from_value(limits).unwrap();
        settings
            .check_limits(&[sent], agent.detector().unwrap())
            .map_err(|error| error.to_string())
    };
    for (section, field, least) in [
        ("codec", "budget_bytes", smallest - 256),
        ("rate", "message_bytes", smallest),
        ("rate", "bytes_per_second", 10 * smallest),
    ] {
        let limit = |bytes: u64| serde_json::json!({section: {field: bytes}});
        assert_eq!(check(limit(least), Stream::Bev), Ok(()));
        assert_eq!(check(limit(1), Stream::Boxes), Ok(()));
        let error = check(limit(least - 1), Stream::Bev).unwrap_err();
        assert_eq!(
            error,
            format!(
                "{section}.{field} is {}: must be at least {least}: a map without cells",
                least - 1
            )
        );
    }
}
