//! Arbitrary messages: proptest strategies.

use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;
use proptest::sample::select;
use protocol::*;

pub(crate) fn any_cav() -> impl Strategy<Value = CavId> {
    "[a-z0-9_-]{1,32}".prop_filter_map("a reserved word", |text| CavId::new(&text).ok())
}

pub(crate) fn any_stamp() -> impl Strategy<Value = Stamp> {
    (any_cav(), any::<[u64; 4]>()).prop_map(
        |(cav, [epoch, sequence, capture_nanos, publish_nanos])| Stamp {
            cav,
            epoch,
            sequence,
            capture_nanos,
            publish_nanos,
        },
    )
}

fn any_process() -> impl Strategy<Value = ProcessId> {
    "[a-z0-9_-]{1,64}".prop_map(|text| ProcessId::new(&text).unwrap())
}

fn any_stream() -> impl Strategy<Value = Stream> {
    prop_oneof![
        any::<u8>().prop_map(Stream::Camera),
        select(vec![
            Stream::Lidar,
            Stream::Gnss,
            Stream::Radar,
            Stream::Pose,
            Stream::Bev,
            Stream::Boxes
        ]),
        select(vec![
            Stream::Preview,
            Stream::Points,
            Stream::Descriptor,
            Stream::Detections,
            Stream::DetectionsJson,
            Stream::Tracks,
            Stream::TracksJson
        ]),
    ]
}

fn any_topic() -> impl Strategy<Value = Topic> {
    prop_oneof![
        (any_cav(), any_stream()).prop_map(|(cav, stream)| Topic::Stream { cav, stream }),
        (any_cav(), any_cav(), any_stream()).prop_map(|(ego, cav, stream)| Topic::Received {
            ego,
            cav,
            stream
        }),
        Just(Topic::Truth),
        select(Verb::ALL.to_vec()).prop_map(Topic::Control),
        any_process().prop_map(Topic::Ready),
        any_process().prop_map(Topic::Stats),
        (select(Role::ALL.to_vec()), any_cav()).prop_map(|(role, cav)| Topic::Alive { role, cav }),
    ]
}

fn any_pose() -> impl Strategy<Value = Pose> {
    (
        prop::array::uniform3(-1e6..1e6f64),
        prop::array::uniform4(-1.0..1.0f64),
    )
        .prop_filter("a rotation", |(_, q)| {
            q.iter().map(|x| x * x).sum::<f64>() > 1e-3
        })
        .prop_map(|(translation_m, q)| {
            let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            Pose {
                translation_m,
                rotation_wxyz: q.map(|x| x / norm),
            }
        })
}

fn any_covariance() -> impl Strategy<Value = PlanarCovariance> {
    (0f32..1e6, -1f32..1.0, 0f32..1e6, 0f32..10.0).prop_map(
        |(xx_m2, correlation, yy_m2, yaw_rad2)| PlanarCovariance {
            xx_m2,
            xy_m2: correlation * (xx_m2 * yy_m2).sqrt(),
            yy_m2,
            yaw_rad2,
        },
    )
}

fn any_estimate() -> impl Strategy<Value = PoseEstimate> {
    let reasons = vec![
        NoPoseReason::TooFewPoints,
        NoPoseReason::TooFewInliers,
        NoPoseReason::NoSource,
        NoPoseReason::LowConfidence,
        NoPoseReason::Failed,
    ];
    prop_oneof![
        (any_pose(), 0f32..=1.0).prop_map(|(pose, confidence)| PoseEstimate::new(pose, confidence)),
        (any_pose(), 0f32..=1.0, any_covariance()).prop_map(
            |(world_from_cav, confidence, covariance)| {
                PoseEstimate::Pose {
                    world_from_cav,
                    confidence,
                    covariance: Some(covariance),
                }
            }
        ),
        (select(reasons), any::<u32>()).prop_map(|(reason, inlier_count)| PoseEstimate::NoPose {
            reason,
            inlier_count
        }),
    ]
}

fn any_points() -> impl Strategy<Value = PointCloud> {
    vec(prop::array::uniform4(-1e6f32..1e6), 0..300).prop_map(|xyzi| PointCloud { xyzi })
}

fn any_object() -> impl Strategy<Value = PerceivedObject> {
    let covariance = || {
        (0f32..4e4, -1f32..1.0, 0f32..4e4)
            .prop_map(|(xx, correlation, yy)| [xx, correlation * (xx * yy).sqrt(), yy])
    };
    let speeds = prop::array::uniform2(-200f32..200.0);
    let track = (any::<u64>(), speeds, covariance(), covariance()).prop_map(
        |(id, velocity_mps, position_covariance, velocity_covariance)| ObjectTrack {
            id,
            velocity_mps,
            position_covariance,
            velocity_covariance,
        },
    );
    (any_detection(), option::of(track))
        .prop_map(|(detection, track)| PerceivedObject { detection, track })
}

fn any_detection() -> impl Strategy<Value = Detection> {
    let box3d = (
        prop::array::uniform3(-1e3..1e3f64),
        prop::array::uniform3(0.1..30.0f64),
        -7.0..7.0f64,
    )
        .prop_map(|(center_m, size_m, heading_rad)| Box3d {
            center_m,
            size_m,
            heading_rad,
        });
    (box3d, 0f32..=1.0, option::of(any_cav())).prop_map(|(box3d, score, source)| Detection {
        box3d,
        score,
        source,
    })
}

/// A map of up to 6 x 20 x 20, a confidence for each of its cells, and a codec.
pub(crate) fn any_map() -> impl Strategy<Value = (BevFeatures, Vec<f32>, CodecConfig)> {
    let grid = (
        -100.0..100.0f64,
        -100.0..100.0f64,
        0.1..2.0f64,
        1..20u32,
        1..20u32,
    )
        .prop_map(|(x_min_m, y_min_m, cell_m, width, height)| BevGrid {
            x_min_m,
            y_min_m,
            cell_m,
            width,
            height,
        });
    let gate =
        (0f32..1.0, option::of((0..4u32, 0.2f32..3.0))).prop_map(|(threshold, smoothing)| {
            let smoothing = smoothing.map(|(half, sigma)| Smoothing {
                kernel: 2 * half + 1,
                sigma,
            });
            ConfidenceGate {
                threshold,
                smoothing,
            }
        });
    let dtype = select(vec![Dtype::F32, Dtype::F16, Dtype::I8]);
    let shape = (grid, 1..6u32, option::of(6..64u32));
    (
        shape,
        dtype,
        option::of(80..3000u64),
        option::of(1..4i32),
        option::of(gate),
    )
        .prop_flat_map(
            |((grid, channels, code_of), dtype, budget_bytes, zstd_level, gate)| {
                let cells = grid.cells();
                let values = vec(
                    prop_oneof![Just(0f32), -100f32..100.0],
                    cells * channels as usize,
                );
                let config = CodecConfig {
                    dtype,
                    gate,
                    budget_bytes,
                    zstd_level,
                };
                (values, vec(0f32..1.0, cells)).prop_map(move |(values, confidence)| {
                    (
                        BevFeatures {
                            grid,
                            channels,
                            code_of,
                            values,
                        },
                        confidence,
                        config,
                    )
                })
            },
        )
}

fn any_bev() -> impl Strategy<Value = Bev> {
    let choice =
        (select(RateReason::ALL.to_vec()), any::<u64>()).prop_map(|(reason, limit_bytes)| {
            RateChoice {
                reason,
                limit_bytes,
            }
        });
    (any_estimate(), any_map(), option::of(choice)).prop_map(
        |(pose, (features, confidence, config), rate)| {
            let features = encode_features(features, &config, Some(&confidence)).unwrap();
            Bev {
                pose,
                features: EncodedFeatures { rate, ..features },
            }
        },
    )
}

fn any_descriptor() -> impl Strategy<Value = Descriptor> {
    let sweep = any::<[u64; 2]>().prop_map(|[before_nanos, arrived_nanos]| SweepArrival {
        before_nanos,
        arrived_nanos,
    });
    let lists = (vec(any_stream(), 0..8), vec(sweep, 0..8));
    (any::<[u8; 32]>(), any_map(), lists).prop_map(
        |(hash, (features, _, config), (streams, sweeps))| {
            let (model_hash, dtype) = (ModelHash(hash), config.dtype);
            Descriptor {
                model_hash,
                grid: features.grid,
                channels: features.channels,
                dtype,
                streams,
                sweeps,
            }
        },
    )
}

fn any_timing() -> impl Strategy<Value = StageTiming> {
    ("[a-z ]{0,16}", 0..1_000_000_000_000u64)
        .prop_map(|(stage, nanos)| StageTiming { stage, nanos })
}

fn any_track() -> impl Strategy<Value = Track> {
    let covariance =
        (prop::array::uniform4(0.0..1e3f32), -1.0..1.0f32).prop_map(|(sigmas, correlation)| {
            let at = |row: usize, column: usize| {
                let scale = if row == column { 1.0 } else { correlation };
                sigmas[row] * sigmas[column] * scale
            };
            std::array::from_fn(|row| std::array::from_fn(|column| at(row, column)))
        });
    let times = (0.0..1e5f64, 0.0..=1.0f64);
    (
        any_detection(),
        any::<(u64, u32)>(),
        [-50.0..50.0f64, -50.0..50.0f64],
        (covariance, 0.0..=1.0f64, times),
    )
        .prop_map(
            |(seen, (id, hits), velocity_mps, (covariance, score, (age_s, share)))| Track {
                id,
                box3d: seen.box3d,
                velocity_mps,
                covariance,
                score,
                hits,
                age_s,
                unseen_s: age_s * share,
            },
        )
}

fn any_tracks() -> impl Strategy<Value = Tracks> {
    let numbers = any::<(u64, u32)>();
    (any_cav(), numbers, any_estimate(), vec(any_track(), 0..20)).prop_map(
        |(ego, (agent_frame, left_out), pose, tracks)| Tracks {
            ego,
            agent_frame,
            pose,
            tracks,
            left_out,
        },
    )
}

fn any_detections() -> impl Strategy<Value = Detections> {
    let fused = (
        any_cav(),
        -1_000_000_000..1_000_000_000i64,
        0f32..=1.0,
        any::<[u64; 2]>(),
    )
        .prop_map(
            |(cav, age_nanos, confidence, [payload_bytes, wire_bytes])| FusedNeighbour {
                cav,
                age_nanos,
                confidence,
                payload_bytes,
                wire_bytes,
            },
        );
    let skipped = (any_cav(), option::of(select(DropReason::ALL.to_vec())))
        .prop_map(|(cav, reason)| SkippedNeighbour { cav, reason });
    let misbehaviour = option::of(select(MisbehaviourReason::ALL.to_vec()));
    let states = (
        any_cav(),
        option::of(0.0..=1.0f64),
        misbehaviour,
        [option::of(-1e9..1e9f64), option::of(-1e9..1e9f64)],
    )
        .prop_map(
            |(cav, trust, misbehaviour, [clock_offset_s, capture_offset_s])| NeighbourState {
                cav,
                trust,
                misbehaviour,
                clock_offset_s,
                capture_offset_s,
            },
        );
    let neighbours = (vec(fused, 0..4), vec(skipped, 0..4), vec(states, 0..4));
    let lists = (
        vec(any_detection(), 0..20),
        neighbours,
        vec(any_timing(), 0..4),
    );
    (
        any_cav(),
        any::<u64>(),
        "[a-z]{1,10}",
        any_estimate(),
        lists,
    )
        .prop_map(
            |(
                ego,
                agent_frame,
                method,
                pose,
                (detections, (fused, skipped, neighbours), stages),
            )| Detections {
                ego,
                agent_frame,
                method,
                pose,
                detections,
                fused,
                skipped,
                neighbours,
                stages,
            },
        )
}

fn any_truth() -> impl Strategy<Value = Truth> {
    let size = prop::array::uniform3(0.1..30.0f64);
    let object = (
        any::<i64>(),
        "[a-z]{1,10}",
        any_pose(),
        size,
        option::of(-50.0..50.0f64),
    )
        .prop_map(
            |(id, class, world_from_object, size_m, speed_mps)| TrueObject {
                id,
                class,
                world_from_object,
                size_m,
                speed_mps,
            },
        );
    let agent =
        (any_cav(), any_pose(), vec(object, 0..8)).prop_map(|(cav, world_from_lidar, objects)| {
            AgentTruth {
                cav,
                world_from_lidar,
                objects,
            }
        });
    (any::<u64>(), vec(agent, 0..4)).prop_map(|(tick, agents)| Truth { tick, agents })
}

fn any_control() -> impl Strategy<Value = Control> {
    let sent =
        (any_topic(), any::<u64>()).prop_map(|(topic, messages)| TopicCount { topic, messages });
    prop_oneof![
        (0.0..100.0f64).prop_map(|rate| Control::Start { rate }),
        Just(Control::Pause),
        Just(Control::Resume),
        Just(Control::Probe),
        any::<u64>().prop_map(|ticks| Control::Step { ticks }),
        any::<u64>().prop_map(|tick| Control::Seek { tick }),
        (any::<u64>(), vec(sent, 0..6)).prop_map(|(ticks, sent)| Control::End { ticks, sent }),
        (any_process(), vec(any_topic(), 0..6)).prop_map(|(process, subscribed)| Control::Ready {
            process,
            subscribed
        }),
        (any_process(), any::<u64>()).prop_map(|(process, tick)| Control::Done { process, tick }),
    ]
}

fn any_stats() -> impl Strategy<Value = Stats> {
    let account =
        (any_topic(), option::of(any_process())).prop_map(|(topic, to)| Account { topic, to });
    let line = (
        account,
        select(DropReason::ALL.to_vec()),
        select(RateReason::ALL.to_vec()),
        0..1000u64,
    );
    let ledger = vec(line, 0..8).prop_map(|lines| {
        let mut ledger = Ledger::default();
        for (account, reason, rate, in_flight) in &lines {
            ledger.sent(account);
            ledger.dropped(account, *reason);
            ledger.adapted(account, *rate);
            ledger.set_in_flight(account, *in_flight);
        }
        ledger
    });
    let stage = (
        "[a-z]{1,10}",
        any::<u64>(),
        prop::array::uniform5(0.0..1e6f64),
    )
        .prop_map(
            |(stage, count, [sum_ms, p50_ms, p95_ms, p99_ms, max_ms])| StageSummary {
                stage,
                count,
                sum_ms,
                p50_ms,
                p95_ms,
                p99_ms,
                max_ms,
            },
        );
    let thread = ("[a-z]{1,10}", 0.0..1e6f64).prop_map(|(name, cpu_s)| ThreadUsage { name, cpu_s });
    let threads = prop::collection::vec(thread, 0..4);
    let usage = (0.0..1e6f64, any::<[u64; 2]>(), threads).prop_map(
        |(cpu_s, [resident_bytes, peak_resident_bytes], threads)| ProcessUsage {
            cpu_s,
            resident_bytes,
            peak_resident_bytes,
            threads,
        },
    );
    let traffic =
        (any_topic(), any::<[u64; 2]>()).prop_map(|(topic, [messages, bytes])| TopicTraffic {
            topic,
            messages,
            bytes,
        });
    (
        any_process(),
        ledger,
        vec(stage, 0..4),
        usage,
        vec(traffic, 0..4),
        vec("[a-z0-9 ]{0,40}", 0..4),
    )
        .prop_map(
            |(process, ledger, stages, usage, traffic, problems)| Stats {
                process,
                ledger,
                stages,
                usage,
                traffic,
                problems,
            },
        )
}

fn any_camera() -> impl Strategy<Value = Camera> {
    let pinhole =
        prop::array::uniform4(1.0..1e5f64).prop_map(|[fx_px, fy_px, cx_px, cy_px]| Pinhole {
            fx_px,
            fy_px,
            cx_px,
            cy_px,
        });
    let format = select(vec![ImageFormat::Png, ImageFormat::Jpeg]);
    let metadata = (
        format,
        1..9000u32,
        1..9000u32,
        option::of(pinhole),
        option::of(any_pose()),
    )
        .prop_map(
            |(format, width_px, height_px, pinhole, lidar_from_camera)| CameraMetadata {
                format,
                width_px,
                height_px,
                pinhole,
                lidar_from_camera,
            },
        );
    (metadata, vec(any::<u8>(), 1..500)).prop_map(|(metadata, image)| Camera { metadata, image })
}

pub(crate) fn any_message() -> impl Strategy<Value = Message> {
    prop_oneof![
        1 => any_points().prop_map(|points| Message::Lidar(Lidar { points })),
        1 => any_points().prop_map(|points| Message::Radar(Radar { points })),
        1 => any_camera().prop_map(Message::Camera),
        1 => (any_pose(), 0.0..100.0f64, 0.0..3.0f64).prop_map(|(world_from_lidar, position_std_m, heading_std_rad)| {
            let source = if position_std_m > 50.0 { GnssSource::Gnss } else { GnssSource::Recorded };
            Message::Gnss(Gnss { world_from_lidar, position_std_m, heading_std_rad, source })
        }),
        1 => any_estimate().prop_map(Message::Pose),
        3 => any_bev().prop_map(Message::Bev),
        1 => (any_estimate(), vec(any_object(), 0..20))
            .prop_map(|(pose, objects)| Message::Boxes(Boxes::new(pose, &objects))),
        1 => (any_estimate(), any_points()).prop_map(|(pose, points)| Message::Points(Points { pose, points })),
        1 => any_descriptor().prop_map(Message::Descriptor),
        1 => any_detections().prop_map(Message::Detections),
        1 => any_tracks().prop_map(Message::Tracks),
        1 => any_truth().prop_map(Message::Truth),
        1 => any_control().prop_map(Message::Control),
        1 => any_stats().prop_map(Message::Stats),
    ]
}
