//! Sample messages for tests: one of every kind with every field set, and arbitrary ones.
#![allow(dead_code, reason = "not every test file uses every sample")]

pub(crate) mod any;

use std::time::Duration;

use protocol::*;

pub(crate) fn cav(text: &str) -> CavId {
    CavId::new(text).unwrap()
}

pub(crate) fn stamp() -> Stamp {
    Stamp {
        cav: cav("4279"),
        epoch: 77,
        sequence: 12,
        capture_nanos: 1_500_000_000,
        publish_nanos: 1_600_000_000,
    }
}

pub(crate) fn grid() -> BevGrid {
    BevGrid {
        x_min_m: -51.2,
        y_min_m: -38.4,
        cell_m: 0.8,
        width: 16,
        height: 12,
    }
}

/// `[3, 12, 16]` with values of both signs and different sizes per channel.
pub(crate) fn features() -> BevFeatures {
    let values = (0..3 * 12 * 16)
        .map(|index| ((index * 37 % 101) as f32 - 50.0) * 0.1 * (1 + index / 192) as f32);
    BevFeatures {
        grid: grid(),
        channels: 3,
        code_of: None,
        values: values.collect(),
    }
}

pub(crate) fn confidence() -> Vec<f32> {
    (0..12 * 16)
        .map(|cell| (cell * 29 % 97) as f32 / 97.0)
        .collect()
}

/// Rotated by 2 atan(3/4), in numbers that are the same on every machine.
fn pose_at(translation_m: [f64; 3]) -> Pose {
    Pose {
        translation_m,
        rotation_wxyz: [0.8, 0.0, 0.0, 0.6],
    }
}

pub(crate) fn tracked_pose() -> PoseEstimate {
    PoseEstimate::Pose {
        world_from_cav: pose_at([120.5, -30.25, 1.75]),
        confidence: 0.875,
        covariance: Some(PlanarCovariance {
            xx_m2: 0.04,
            xy_m2: -0.01,
            yy_m2: 0.09,
            yaw_rad2: 0.0001,
        }),
    }
}

pub(crate) fn pose() -> PoseEstimate {
    PoseEstimate::new(pose_at([120.5, -30.25, 1.75]), 0.875)
}

pub(crate) fn points() -> PointCloud {
    PointCloud {
        xyzi: (0..100u8)
            .map(|n| {
                [
                    f32::from(n),
                    -0.5 * f32::from(n),
                    0.25,
                    f32::from(n) / 255.0,
                ]
            })
            .collect(),
    }
}

fn detection(score: f32) -> Detection {
    let box3d = Box3d {
        center_m: [10.0, -3.5, 0.4],
        size_m: [4.2, 1.8, 1.5],
        heading_rad: -0.3,
    };
    Detection {
        box3d,
        score,
        source: Some(cav("-1")),
    }
}

/// Five objects, every second one with a track.
fn objects() -> Vec<PerceivedObject> {
    let track = |id| ObjectTrack {
        id,
        velocity_mps: [8.25, -0.5],
        position_covariance: [0.25, 0.0, 0.5],
        velocity_covariance: [1.0, -0.25, 2.0],
    };
    let object = |id: u64| PerceivedObject {
        detection: detection(0.25),
        track: id.is_multiple_of(2).then(|| track(300 * id)),
    };
    (0..5).map(object).collect()
}

/// A feature map in every codec: dtype times selection times compression.
pub(crate) fn every_codec() -> Vec<CodecConfig> {
    let mut configs = Vec::new();
    for dtype in [Dtype::F32, Dtype::F16, Dtype::I8] {
        for budget_bytes in [None, Some(400)] {
            for zstd_level in [None, Some(3)] {
                configs.push(CodecConfig {
                    dtype,
                    budget_bytes,
                    zstd_level,
                    gate: None,
                });
            }
        }
    }
    configs
}

pub(crate) fn bev(config: &CodecConfig) -> Bev {
    Bev {
        pose: pose(),
        features: encode_features(features(), config, Some(&confidence())).unwrap(),
    }
}

/// A feature map that had to keep within a limit.
pub(crate) fn adapted_bev() -> Bev {
    let limit = ByteLimit {
        bytes: 600,
        by: LimitedBy::Queue,
    };
    let features = encode_within(
        features(),
        &CodecConfig::default(),
        &limit,
        Some(&confidence()),
    )
    .unwrap();
    Bev {
        pose: pose(),
        features,
    }
}

/// A code of three channels for a feature map of 24.
pub(crate) fn compressed_bev() -> Bev {
    let features = BevFeatures {
        code_of: Some(24),
        ..features()
    };
    Bev {
        pose: pose(),
        features: encode_features(features, &CodecConfig::default(), None).unwrap(),
    }
}

pub(crate) fn ledger() -> Ledger {
    let mut ledger = Ledger::default();
    let topic: Topic = "4279/bev".parse().unwrap();
    ledger.sent(&Account::published(topic.clone()));
    let account = Account::towards(topic, &ProcessId::new("ego-4279").unwrap());
    ledger.received(&account);
    ledger.dropped(&account, DropReason::Stale);
    ledger.set_in_flight(&account, 2);
    ledger.adapted(&account, RateReason::QueueFewerCells);
    ledger
}

pub(crate) fn detections() -> Detections {
    Detections {
        ego: cav("4279"),
        agent_frame: 3,
        method: "attention".into(),
        pose: pose(),
        detections: vec![detection(0.5), detection(1.0)],
        fused: vec![FusedNeighbour {
            cav: cav("4288"),
            age_nanos: -5_000_000,
            confidence: 0.5,
            payload_bytes: 24_576,
            wire_bytes: 24_800,
        }],
        skipped: vec![
            SkippedNeighbour {
                cav: cav("-1"),
                reason: None,
            },
            SkippedNeighbour {
                cav: cav("7"),
                reason: Some(DropReason::Stale),
            },
        ],
        neighbours: vec![
            NeighbourState {
                cav: cav("4288"),
                trust: Some(0.75),
                misbehaviour: None,
                clock_offset_s: Some(-0.002),
                capture_offset_s: Some(0.3),
            },
            NeighbourState {
                cav: cav("7"),
                trust: Some(0.0),
                misbehaviour: Some(MisbehaviourReason::Duplicated),
                clock_offset_s: None,
                capture_offset_s: None,
            },
        ],
        stages: vec![StageTiming::new("fuse", Duration::from_millis(12))],
    }
}

pub(crate) fn tracks() -> Tracks {
    let mut covariance = [[0.0; 4]; 4];
    covariance[0] = [0.25, 0.0, 0.125, 0.0];
    (covariance[1][1], covariance[2]) = (0.25, [0.125, 0.0, 1.0, 0.0]);
    covariance[3][3] = 1.0;
    let track = |id, unseen_s| Track {
        id,
        box3d: detection(0.5).box3d,
        velocity_mps: [8.5, -0.25],
        covariance,
        score: 0.75,
        hits: 4,
        age_s: 0.5,
        unseen_s,
    };
    Tracks {
        ego: cav("4279"),
        agent_frame: 3,
        pose: pose(),
        tracks: vec![track(1, 0.0), track(7, 0.25)],
        left_out: 2,
    }
}

fn truth() -> Truth {
    let object = TrueObject {
        id: -17,
        class: "car".into(),
        world_from_object: pose_at([1.0, 2.0, 0.5]),
        size_m: [4.0, 2.0, 1.5],
        speed_mps: Some(8.5),
    };
    let agent = |name| AgentTruth {
        cav: cav(name),
        world_from_lidar: pose_at([5.0, 5.0, 2.0]),
        objects: vec![
            object.clone(),
            TrueObject {
                id: 18,
                speed_mps: None,
                ..object.clone()
            },
        ],
    };
    Truth {
        tick: 9,
        agents: vec![agent("4279"), agent("-1")],
    }
}

pub(crate) fn camera() -> Camera {
    let metadata = CameraMetadata {
        format: ImageFormat::Png,
        width_px: 480,
        height_px: 300,
        pinhole: Some(Pinhole {
            fx_px: 201.5,
            fy_px: 201.25,
            cx_px: 240.0,
            cy_px: 150.0,
        }),
        lidar_from_camera: Some(pose_at([3.0, 0.0, -0.9])),
    };
    Camera {
        metadata,
        image: (0..200u8).collect(),
    }
}

pub(crate) fn every_kind() -> Vec<Message> {
    let process = ProcessId::new("agent-4279").unwrap();
    let topic: Topic = "4279/lidar".parse().unwrap();
    let mut messages = vec![
        Message::Lidar(Lidar { points: points() }),
        Message::Lidar(Lidar::default()),
        Message::Radar(Radar { points: points() }),
        Message::Camera(camera()),
        Message::Pace(Pace {
            period_nanos: 100_000_000,
            phase_nanos: 1_500_000_000,
            computed: 4,
            of: 5,
        }),
        Message::Imu(EgoMotion {
            speed_mps: Some(8.25),
            yaw_rate_rad_s: None,
        }),
        Message::Gnss(Gnss {
            world_from_lidar: pose_at([1.0, 2.0, 3.0]),
            position_std_m: 0.4,
            heading_std_rad: 0.02,
            source: GnssSource::Gnss,
        }),
        Message::Pose(pose()),
        Message::Pose(tracked_pose()),
        Message::Pose(PoseEstimate::NoPose {
            reason: NoPoseReason::TooFewInliers,
            inlier_count: 4,
        }),
        Message::Boxes(Boxes::new(pose(), &objects())),
        Message::Points(Points {
            pose: pose(),
            points: points(),
        }),
        Message::Descriptor(Descriptor {
            model_hash: ModelHash(std::array::from_fn(|index| index as u8)),
            grid: grid(),
            channels: 3,
            dtype: Dtype::F16,
            streams: vec![Stream::Pose, Stream::Bev, Stream::Camera(1)],
            sweeps: vec![SweepArrival {
                before_nanos: 100,
                arrived_nanos: 200,
            }],
        }),
        Message::Detections(detections()),
        Message::Truth(truth()),
        Message::Stats(Stats {
            process: process.clone(),
            ledger: ledger(),
            stages: vec![StageSummary {
                stage: "encode".into(),
                count: 10,
                sum_ms: 12.0,
                p50_ms: 1.0,
                p95_ms: 2.0,
                p99_ms: 3.0,
                max_ms: 4.0,
            }],
            usage: ProcessUsage {
                cpu_s: 1.5,
                resident_bytes: 1 << 20,
                peak_resident_bytes: 2 << 20,
                threads: vec![ThreadUsage {
                    name: "encode".into(),
                    cpu_s: 1.25,
                }],
            },
            traffic: vec![TopicTraffic {
                topic: "4279/bev".parse().unwrap(),
                messages: 3,
                bytes: 4_500_000,
            }],
            problems: vec!["no pose (for 12 s)".into()],
        }),
    ];
    messages.extend(every_codec().iter().map(|config| Message::Bev(bev(config))));
    messages.push(Message::Bev(adapted_bev()));
    messages.push(Message::Bev(compressed_bev()));
    let controls = [
        Control::Start { rate: 1.0 },
        Control::Pause,
        Control::Resume,
        Control::Step { ticks: 2 },
        Control::Seek { tick: 5 },
        Control::End {
            ticks: 100,
            sent: vec![TopicCount {
                topic: topic.clone(),
                messages: 100,
            }],
        },
        Control::Ready {
            process: process.clone(),
            subscribed: vec![topic],
        },
        Control::Probe,
        Control::Done { process, tick: 4 },
    ];
    messages.extend(controls.map(Message::Control));
    messages.push(Message::Tracks(tracks()));
    messages
}
