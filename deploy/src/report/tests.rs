use dataset::evaluation_protocol::{ApOrder, EvaluationProtocol};
use protocol::{Account, Ledger, ProcessUsage, StageSummary, ThreadUsage, TopicTraffic};
use support::provenance::Provenance;

use super::*;
use crate::score::StageStamps;
use crate::score::metrics::tests::metrics;

const SECOND: u64 = 1_000_000_000;

/// A tick every 100 ms, from one second on; an answered one has a latency.
fn record(tick: u64, latency_ms: Option<f64>) -> FrameRecord {
    let began_nanos = Some(SECOND + tick * SECOND / 10);
    FrameRecord {
        tick,
        agent_frame: latency_ms.map(|_| tick),
        capture_nanos: tick * SECOND / 10,
        latency_ms,
        stamps: StageStamps {
            began_nanos,
            detected_ms: latency_ms,
            ..StageStamps::default()
        },
        detected: 0,
        truth: 0,
        found: 0,
        fused: 0,
        skipped: 0,
        oldest_ms: None,
        stale: 0,
        payload_bytes: 0,
        wire_bytes: 0,
        ego_error_m: None,
        ego_error_deg: None,
        streamed: None,
    }
}

/// One thread with this CPU time.
fn thread(cpu_s: f64) -> Vec<ThreadUsage> {
    let name = "main".into();
    vec![ThreadUsage { name, cpu_s }]
}

/// A process with one stage, its CPU time in total and before the first tick, and one published topic.
fn process(
    name: &str,
    (stage, count, p50_ms): (&str, u64, f64),
    cpu_s: [f64; 2],
    topic: &str,
) -> ProcessStats {
    let (p95_ms, p99_ms, max_ms) = (2.0 * p50_ms, 2.5 * p50_ms, 3.0 * p50_ms);
    ProcessStats {
        process: name.parse().unwrap(),
        ledger: Ledger::default(),
        stages: vec![StageSummary {
            stage: stage.into(),
            count,
            sum_ms: count as f64 * p50_ms,
            p50_ms,
            p95_ms,
            p99_ms,
            max_ms,
        }],
        usage: ProcessUsage {
            cpu_s: cpu_s[0],
            resident_bytes: 1 << 20,
            peak_resident_bytes: 3 << 20,
            threads: thread(0.6 * cpu_s[0]),
        },
        usage_before: ProcessUsage {
            cpu_s: cpu_s[1],
            threads: thread(0.6 * cpu_s[1]),
            ..ProcessUsage::default()
        },
        traffic: vec![TopicTraffic {
            topic: topic.parse().unwrap(),
            messages: count,
            bytes: 1_000 * count,
        }],
    }
}

/// Four ticks, of which the second is unanswered: detections at 1.05, 1.3 and 1.6 s.
fn report() -> RunReport {
    let records = [
        record(0, Some(50.0)),
        record(1, None),
        record(2, Some(100.0)),
        record(3, Some(300.0)),
    ];
    let processes = [
        process("scorer", ("decode", 4, 0.1), [0.5, 0.2], "truth"),
        process("ego-1", ("fuse", 3, 30.0), [1.0, 0.4], "1/detections"),
        process("agent-2", ("agent", 2, 60.0), [0.9, 0.5], "2/bev"),
        process("agent-1", ("agent", 4, 40.0), [0.9, 0.5], "1/bev"),
        // Restarted: it loaded its models while the scene played.
        process("agent-2", ("agent", 1, 50.0), [0.6, 0.0], "2/bev"),
    ];
    let metrics = Metrics {
        ticks: 4,
        answered: 3,
        ..metrics("pastat")
    };
    RunReport::new(&"r1".parse().unwrap(), &metrics, &records, &processes, None)
}

fn is_near(found: Option<f64>, expected: f64) -> bool {
    found.is_some_and(|found| (found - expected).abs() < 1e-6)
}

#[test]
fn the_pace_counts_computed_and_answered_ticks_and_the_time_between_detections() {
    let RunReport {
        pace, latency_ms, ..
    } = report();
    assert_eq!(
        (pace.ticks, pace.answered, pace.answered_share()),
        (4, 3, Some(0.75))
    );
    assert_eq!(
        pace.agents["1"],
        AgentPace {
            computed: 4,
            sent: None,
            share: 1.0
        }
    );
    assert_eq!(
        pace.agents["2"],
        AgentPace {
            computed: 3,
            sent: None,
            share: 0.75
        },
        "both instances"
    );
    assert!(
        is_near(pace.interval_ms.p50, 275.0) && is_near(pace.interval_ms.max, 300.0),
        "{pace:?}"
    );
    assert!(
        is_near(pace.rate_hz, 2.0 / 0.55) && is_near(Some(pace.seconds), 0.6),
        "{pace:?}"
    );
    assert!(is_near(latency_ms.p50, 100.0) && is_near(latency_ms.max, 300.0));
}

#[test]
fn a_vehicle_that_is_there_for_a_part_of_the_scene_computes_all_sweeps_sent_to_it() {
    let lidar = Account::published("2/lidar".parse().unwrap());
    let mut replay = process("replay", ("read", 4, 1.0), [0.1, 0.1], "2/lidar");
    (0..2).for_each(|_| replay.ledger.sent(&lidar));
    let agent = process("agent-2", ("agent", 2, 60.0), [0.9, 0.5], "2/bev");
    let metrics = Metrics {
        ticks: 4,
        answered: 4,
        ..metrics("max")
    };
    let name = "r1".parse().unwrap();
    let report = RunReport::new(&name, &metrics, &[], &[replay, agent], None);
    let expected = AgentPace {
        computed: 2,
        sent: Some(2),
        share: 1.0,
    };
    assert_eq!(report.pace.agents["2"], expected);
    assert!(report.to_string().contains("computed  2 2/2 (100 %)"));
}

#[test]
fn stages_are_by_kind_and_of_the_slowest_process() {
    let stages = report().stages;
    let names: Vec<_> = stages
        .iter()
        .map(|stage| (stage.kind.as_str(), stage.stage.as_str()))
        .collect();
    assert_eq!(
        names,
        [("agent", "agent"), ("ego", "fuse"), ("scorer", "decode")]
    );
    let agent = &stages[0];
    assert_eq!(
        (agent.processes, agent.count, agent.p50_ms, agent.p95_ms),
        (3, 7, 60.0, 120.0)
    );
}

#[test]
fn cpu_time_is_per_process_and_per_frame() {
    let processes = report().processes;
    let names: Vec<&str> = processes
        .iter()
        .map(|process| process.process.as_str())
        .collect();
    assert_eq!(names, ["agent-1", "agent-2", "ego-1", "scorer"]);
    let [first, second, ego, scorer] = &processes[..] else {
        panic!("{processes:?}")
    };
    assert!(is_near(Some(first.playing_cpu_s), 0.4) && is_near(first.cores, 0.4 / 0.6));
    assert!(is_near(first.cpu_ms_per_frame, 100.0) && first.peak_resident_bytes == 3 << 20);
    assert_eq!(second.instances, 2);
    assert!(
        is_near(Some(second.playing_cpu_s), 1.0) && is_near(second.cpu_ms_per_frame, 1000.0 / 3.0)
    );
    // Threads that have ended have the rest.
    let [thread, ended] = &second.threads[..] else {
        panic!("{second:?}")
    };
    assert!(is_near(Some(thread.cpu_ms_per_frame), 200.0) && thread.name == "main");
    assert!(is_near(Some(ended.cpu_ms_per_frame), 400.0 / 3.0) && ended.name == "(ended)");
    // A stage that is the sum of others is no time of its own.
    assert!(is_near(ego.stages_ms_per_frame, 30.0) && first.stages_ms_per_frame.is_none());
    assert!(is_near(ego.cpu_ms_per_frame, 200.0) && is_near(scorer.cpu_ms_per_frame, 75.0));
}

#[test]
fn bytes_are_by_stream() {
    let streams = report().streams;
    let bev = StreamBytes {
        stream: "bev".into(),
        messages: 7,
        bytes: 7_000,
    };
    assert_eq!(streams[0], bev);
    assert_eq!(
        streams
            .iter()
            .map(|stream| stream.stream.as_str())
            .collect::<Vec<_>>(),
        ["bev", "truth", "detections"]
    );
}

#[test]
fn a_report_reads_back_and_is_a_table_for_people() {
    let folder = tempfile::tempdir().unwrap();
    let missing = RunReport::read(folder.path()).unwrap_err().to_string();
    assert!(
        missing.contains("report.json") && missing.contains("has ended"),
        "{missing}"
    );
    let machine = Machine {
        cores: 2,
        instructions: "AVX2".into(),
    };
    let capacity = Capacity {
        machine,
        method: "pastat".into(),
        vehicles: 2,
        local_vehicles: 2,
        agent_ms: 100.0,
        fuse_ms: 100.0,
        messages_ms: 26.0,
        period_ms: 100.0,
        unit_ms: 20.0,
        stages: Default::default(),
        free_share: 1.0,
        needed_ms: 326.0,
        available_ms: 200.0,
        expected_share: 0.6,
    };
    for (expected_share, answered) in [(0.985, "about 9 of 10"), (0.99, "about 10 of 10")] {
        let capacity = Capacity {
            expected_share,
            ..capacity.clone()
        };
        assert!(capacity.to_string().contains(answered), "{capacity}");
    }
    let report = RunReport {
        capacity: Some(capacity),
        ..report()
    };
    std::fs::write(
        folder.path().join(FILE),
        serde_json::to_string(&report).unwrap(),
    )
    .unwrap();
    let text = report.to_string();
    // Numbers are read back to their last digit but one.
    assert_eq!(RunReport::read(folder.path()).unwrap().to_string(), text);
    insta::assert_snapshot!(text);
    std::fs::write(folder.path().join(FILE), "{").unwrap();
    RunReport::read(folder.path()).unwrap_err();
}

#[test]
fn a_run_without_processes_has_pace_and_latency_only() {
    let records = [record(0, Some(80.0)), record(1, Some(80.0))];
    let metrics = Metrics {
        ticks: 2,
        answered: 2,
        ..metrics("max")
    };
    let text = RunReport::new(&"r1".parse().unwrap(), &metrics, &records, &[], None).to_string();
    insta::assert_snapshot!(text);
}

/// Writes report, metrics and scenario of a run of this name.
fn write_run(folder: &Path, metrics: &Metrics, scenario: &str) {
    std::fs::create_dir(folder).unwrap();
    let report = RunReport {
        run: folder.file_name().unwrap().to_string_lossy().into_owned(),
        ..report()
    };
    let report = serde_json::to_string(&report).unwrap();
    std::fs::write(folder.join(FILE), report).unwrap();
    let metrics = serde_json::to_string(metrics).unwrap();
    std::fs::write(folder.join(crate::score::metrics::FILE), metrics).unwrap();
    std::fs::write(folder.join("scenario.yaml"), scenario).unwrap();
}

#[test]
fn runs_are_compared_column_by_column() {
    let runs = tempfile::tempdir().unwrap();
    let folders = ["one", "two"].map(|name| runs.path().join(name));
    for (folder, answered) in folders.iter().zip([3, 4]) {
        let metrics = Metrics {
            ticks: 4,
            answered,
            ..metrics("pastat")
        };
        write_run(folder, &metrics, "ego: {id: '7'}");
    }
    let text = Comparison::read(&folders).unwrap().to_string();
    insta::assert_snapshot!(text);

    std::fs::remove_file(folders[1].join(crate::score::metrics::FILE)).unwrap();
    let message = Comparison::read(&folders).unwrap_err().to_string();
    assert!(message.contains("two/metrics.json"), "{message}");
}

#[test]
fn what_differs_between_runs_whose_precisions_cannot_be_compared_is_named() {
    let runs = tempfile::tempdir().unwrap();
    let folders = ["one", "two", "three"].map(|name| runs.path().join(name));
    let protocol = EvaluationProtocol::preset("opv2v").unwrap();
    let narrow = EvaluationProtocol {
        max_agents: 2,
        ap_order: ApOrder::Frame,
        ..protocol.clone()
    };
    let conditions = [
        (4, Some(narrow), "aa", "ego: {id: '7'}"),
        (4, Some(protocol), "aa", "ego: {id: '7'}"),
        (
            12,
            None,
            "bb",
            "scene: {dir: a}\nego: {id: '8', trust: true}",
        ),
    ];
    for (folder, (ticks, protocol, data, scenario)) in folders.iter().zip(conditions) {
        let provenance = Provenance {
            data_sha256: data.into(),
            ..Provenance::default()
        };
        let metrics = Metrics {
            ticks,
            answered: ticks,
            protocol,
            provenance: Some(provenance),
            ..metrics("pastat")
        };
        write_run(folder, &metrics, scenario);
    }
    let notes_of = |folders: &[PathBuf]| {
        let text = Comparison::read(folders).unwrap().to_string();
        let notes = text.split_once("\n\n").map(|(_, notes)| notes.to_owned());
        notes.unwrap_or_default()
    };
    assert_eq!(notes_of(&folders[..1]), "");
    let both = Comparison::read(&folders[..2]).unwrap().to_string();
    let orders = both.lines().find(|line| line.starts_with("order of AP "));
    let orders: Vec<&str> = orders.unwrap().split_whitespace().skip(3).collect();
    assert_eq!(orders, ["frame", "global"]);
    assert_eq!(
        notes_of(&folders[..2]),
        "Runs differ in protocol ap_order: one \"frame\", two \"global\"\n\
         Runs differ in protocol max_agents: one 2, two 7\n\
         The precisions of these runs cannot be compared.\n"
    );
    let notes = notes_of(&folders[1..]);
    assert!(notes.contains(", three null\n"), "no protocol: {notes}");
    for line in [
        "Runs differ in SHA-256 of the data: two \"aa\", three \"bb\"\n",
        "Runs differ in ego: two \"7\", three \"8\"\n",
        "Runs differ in ticks: two 4, three 12\n",
    ] {
        assert!(notes.contains(line), "{line}: {notes}");
    }
    assert!(!notes.contains("AP@0.5 all"), "{notes}");
    std::fs::write(folders[0].join("scenario.yaml"), "ego: [").unwrap();
    let message = Comparison::read(&folders).unwrap_err().to_string();
    assert!(message.contains("one/scenario.yaml"), "{message}");
}
