//! `v2vloc up` as a user runs it: to the end of a scene, interrupted, with a vehicle or the launcher killed.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use deploy::report::TrackReport;
use protocol::{Stream, Topic, TracksReport};
use recording::Recording;
use runner::scenario::Scenario;
use serde_json::Value;
use sim_replay::config::LinkProcessConfig;
use support::file_digests::FileDigests;
use support::random::scenario_seed;
use tests::fleet::{
    TIMEOUT, Up, check_origin, fused, is_running, programs, results, signal, write_scenario,
    write_sighted_weights, write_weights_with_box_input,
};
use tests::locks::exclusive_lock;

fn json(path: &std::path::Path) -> Value {
    serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap()
}

#[test]
fn a_fleet_plays_its_scene_and_accounts_for_every_message() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(
        folder.path(),
        8,
        "lockstep: true, seek: 2",
        "record: {without: [bev]}",
    );
    // There are no tracks without detections.
    write_sighted_weights(&folder.path().join("weights.safetensors"));
    let mut up = Up::start(folder.path(), &scenario);
    let status = up.wait();
    let run = &up.folder;
    let ledger = json(&run.join("ledger.json"));
    assert_eq!(ledger["balances"], true, "{}", ledger["balance"]);
    assert_eq!(status.code(), Some(0), "{}", ledger["total"]);

    let metrics = json(&run.join("metrics.json"));
    assert_eq!(
        (&metrics["frames"], &metrics["method"], &metrics["clock"]),
        (&6.into(), &"max".into(), &"wall".into())
    );
    assert_eq!(metrics["pose"]["success_3m"], 1.0);
    assert!(
        metrics["latency_ms"]["capture_to_detection"]["p50"]
            .as_f64()
            .unwrap()
            > 0.0
    );
    // An f32 feature map of 8 channels on 64 x 64 cells, and a little more.
    let payload = metrics["comm"]["payload_bytes_mean"].as_f64().unwrap();
    assert!((131_072.0..140_000.0).contains(&payload), "{payload}");
    check_origin(run, &folder.path().join("weights.safetensors"));

    let results = results(run);
    assert_eq!(results.len(), 6);
    assert!(
        results.iter().all(|result| fused(result) == 1),
        "in lockstep no message is late"
    );
    let ticks: Vec<_> = results
        .iter()
        .map(|result| (result["tick"].as_u64(), result["agent_frame"].as_u64()))
        .collect();
    assert_eq!(
        ticks,
        (0..6)
            .map(|frame| (Some(frame + 2), Some(frame)))
            .collect::<Vec<_>>()
    );
    let frames = fs::read_to_string(run.join("frames.csv")).unwrap();
    let of_table: Vec<_> = frames
        .lines()
        .skip(1)
        .map(|line| line.split(',').take(3).collect::<Vec<_>>())
        .collect();
    let of_results = |result: &Value| {
        ["tick", "agent_frame", "capture_nanos"].map(|name| result[name].to_string())
    };
    assert_eq!(
        of_table,
        results.iter().map(of_results).collect::<Vec<_>>(),
        "both files count alike"
    );
    assert!(fs::metadata(run.join("frame.png")).unwrap().len() > 1_000);
    let recording = Recording::open(&run.join("recording.mcap")).unwrap();
    assert_eq!(recording.damage(), []);
    let recorded = |stream| {
        let is_it = |topic: &Topic| matches!(topic, Topic::Stream { stream: known, .. } if *known == stream);
        recording
            .entries()
            .iter()
            .filter(|entry| is_it(&entry.key.topic))
            .count()
    };
    assert_eq!(
        [
            Stream::Lidar,
            Stream::Detections,
            Stream::Tracks,
            Stream::Bev
        ]
        .map(recorded),
        [12, 6, 6, 0]
    );
    for process in ["agent-4279", "agent-4288", "ego-4279", "replay", "recorder"] {
        assert!(run.join(format!("log/{process}.log")).exists(), "{process}");
        assert!(
            run.join(format!("config/{process}.yaml")).exists(),
            "{process}"
        );
    }
    let resolved = Scenario::load(&run.join("scenario.yaml")).unwrap();
    assert_eq!(resolved.scene.agents.len(), 2);
    let provenance = resolved.provenance.unwrap();
    assert_eq!(provenance.data_sha256.len(), 64);
    assert_eq!(provenance.files_sha256.len(), 1, "the weights");
    check_tracks(run);
}

/// Tracks that the ego has made are those that a report makes of its detections.
fn check_tracks(run: &Path) {
    let file = run.join("tracks.jsonl");
    let lines = fs::read_to_string(&file).unwrap();
    let frames: Vec<TracksReport> = lines
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    let ticks: Vec<_> = frames.iter().map(|frame| frame.tick).collect();
    assert_eq!(ticks, (2..8).map(Some).collect::<Vec<_>>());
    assert!(frames.iter().any(|frame| !frame.result.tracks.is_empty()));
    let recorded = TrackReport::read(run).unwrap();
    fs::remove_file(file).unwrap();
    let made = TrackReport::read(run).unwrap();
    assert!(recorded.recorded && !made.recorded);
    let numbers = |report: &TrackReport| match serde_json::to_value(&report.quality).unwrap() {
        Value::Object(fields) => fields
            .into_iter()
            .map(|(name, value)| (name, value.as_f64())),
        other => panic!("{other}"),
    };
    // Numbers in JSON are rounded in their last digit.
    for ((name, one), (_, other)) in numbers(&recorded).zip(numbers(&made)) {
        let difference = one
            .zip(other)
            .map_or(0.0, |(one, other)| (one - other).abs());
        assert!(
            one.is_some() == other.is_some() && difference < 1e-9,
            "{name}: {one:?} {other:?}"
        );
    }
}

#[test]
fn a_fleet_runs_over_an_emulated_link() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    // 131 kB at 20 Mbit/s take 53 ms; the next message has to wait.
    let link = "capacity: {token_bucket: {bandwidth_mbps: 20}}\nlatency: {constant_ms: 30}\n";
    fs::write(folder.path().join("link.yaml"), link).unwrap();
    let rest = "link: {model: link.yaml, seed: 5}\nego: {deadline_ms: 5000}";
    let scenario = write_scenario(folder.path(), 4, "lockstep: true", rest);
    let mut up = Up::start(folder.path(), &scenario);
    let status = up.wait();
    let run = &up.folder;
    let ledger = json(&run.join("ledger.json"));
    assert_eq!(ledger["balances"], true, "{}", ledger["balance"]);
    assert_eq!(status.code(), Some(0), "{}", ledger["total"]);
    let results = results(run);
    assert!(
        results.len() == 4 && results.iter().all(|result| fused(result) == 1),
        "all maps came through"
    );
    let metrics = json(&run.join("metrics.json"));
    let latency_ms = metrics["latency_ms"]["capture_to_detection"]["p50"]
        .as_f64()
        .unwrap();
    assert!(
        latency_ms > 82.0,
        "{latency_ms} ms are less than the link takes"
    );
    assert!(run.join("log/link-4279.log").exists());
    // The seed of simulation time: the same messages are lost on both clocks.
    let config = fs::read_to_string(run.join("config/link-4279.yaml")).unwrap();
    let config: LinkProcessConfig = serde_saphyr::from_str(&config).unwrap();
    let scenario = Scenario::load(&run.join("scenario.yaml")).unwrap();
    let expected = scenario_seed(5, &scenario.scene.scenario.unwrap());
    assert_eq!(config.link.seed, expected);
    assert_eq!(scenario.link.unwrap().seed, 5, "as configured");
}

#[test]
fn a_neighbour_that_sends_boxes_is_fused_where_the_weights_read_them() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let link = "capacity: {token_bucket: {bandwidth_mbps: 50}}\nlatency: {constant_ms: 10}\n";
    fs::write(folder.path().join("link.yaml"), link).unwrap();
    let weights = folder.path().join("weights.safetensors");
    let mut scenario = PathBuf::new();
    for boxes in ["only", "beside"] {
        let rest = format!(
            "link: {{model: link.yaml}}\nego: {{deadline_ms: 5000}}\nvehicles: {{\"4288\": {{boxes: {boxes}}}}}"
        );
        scenario = write_scenario(folder.path(), 4, "lockstep: true", &rest);
        write_weights_with_box_input(&weights);
        let mut up = Up::start(folder.path(), &scenario);
        let status = up.wait();
        let ledger = json(&up.folder.join("ledger.json"));
        assert_eq!(ledger["balances"], true, "{}", ledger["balance"]);
        assert_eq!(status.code(), Some(0), "{}", ledger["total"]);
        let results = results(&up.folder);
        let counts: Vec<usize> = results.iter().map(fused).collect();
        assert_eq!(counts, [1; 4], "{boxes}");
        // Boxes that come after the map of their sweep was fused have missed their frame; nothing else is left out.
        let dropped = ledger["total"]["dropped"].as_object().unwrap();
        let is_late = |(reason, count): (&String, &Value)| {
            boxes == "beside" && reason == "unneeded" && count.as_u64() < Some(4)
        };
        assert!(dropped.iter().all(is_late), "{}", ledger["total"]);
        fs::remove_dir_all(&up.folder).unwrap();
    }

    write_sighted_weights(&weights);
    let mut up = Up::start(folder.path(), &scenario);
    up.wait_for_line("has no box input, and the boxes of neighbours would be left out");
    assert_eq!(up.wait().code(), Some(2));
}

#[test]
fn ctrl_c_ends_everything_within_five_seconds() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), 3, "loop: true", "");
    let mut up = Up::start(folder.path(), &scenario);
    up.wait_for_results("five results", |results| results.len() >= 5);
    let pids = up.pids();
    assert_eq!(pids.len(), 5, "{pids:?}");

    let asked = Instant::now();
    signal(up.pid(), "INT");
    let status = up.wait();
    assert!(
        asked.elapsed() < Duration::from_secs(5),
        "{:?}",
        asked.elapsed()
    );
    assert!(matches!(status.code(), Some(0 | 3)), "{status}");
    assert!(pids.values().all(|pid| !is_running(*pid)), "{pids:?}");
    let metrics = json(&up.folder.join("metrics.json"));
    assert!(
        metrics["frames"].as_u64().unwrap() >= 5,
        "the run is written all the same: {metrics}"
    );
}

#[test]
fn a_killed_agent_is_started_again_and_fused_again() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    // A fifth of the messages is lost, so that the run cannot be repeated from its scene.
    fs::write(folder.path().join("link.yaml"), "loss: {bernoulli: 0.2}\n").unwrap();
    // The size of a map depends on the moment at which its turn to be sent comes.
    let rest = "link: {model: link.yaml}\nagents: {rate: {bytes_per_second: 1000000, watch_queue: true}}\n\
                record: {inputs: true, without: [lidar]}";
    let scenario = write_scenario(folder.path(), 3, "loop: true", rest);
    let mut up = Up::start(folder.path(), &scenario);
    let is_fused = |result: &Value| fused(result) == 1;
    up.wait_for_results("a fused result", |results| {
        results.last().is_some_and(is_fused)
    });
    signal(up.pids()["agent-4288"], "KILL");
    up.wait_for_results("the ego going on without it", |results| {
        results.last().is_some_and(|last| !is_fused(last))
    });
    let crashed = up.wait_for_line("agent-4288 was ended by signal 9");
    assert!(crashed.contains("starting it again"), "{crashed}");
    up.wait_for_results("the agent being fused again", |results| {
        results.last().is_some_and(is_fused)
    });
    signal(up.pid(), "INT");
    assert_eq!(
        up.wait().code(),
        Some(3),
        "what was lost with the agent is not hidden"
    );

    let inputs = up.folder.join("inputs-ego-4279.log");
    for (options, file) in [
        (&[][..], "detections.jsonl"),
        (&["--tracks"][..], "tracks.jsonl"),
    ] {
        let replayed = replay_inputs("ego-fuser", &inputs, options, &[0]);
        let recorded = fs::read_to_string(up.folder.join(file)).unwrap();
        assert_eq!(
            replayed, recorded,
            "the same decisions from the same inputs"
        );
    }
    check_replayed_agents(&up.folder);
}

/// Replays recorded inputs; returns the standard output.
fn replay_inputs(program: &str, file: &Path, options: &[&str], codes: &[i32]) -> String {
    let replayed = Command::new(programs().join(program))
        .arg("replay-inputs")
        .arg(file)
        .args(options)
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&replayed.stderr);
    let code = replayed.status.code().unwrap();
    assert!(
        codes.contains(&code),
        "{}: {code}: {errors}",
        file.display()
    );
    String::from_utf8(replayed.stdout).unwrap()
}

/// Replays the agents of a run from their inputs: every message that the recorder has received has the same bytes.
fn check_replayed_agents(run: &Path) {
    // A killed agent may leave half a record.
    let files = [
        ("inputs-agent-4279.log", &[0][..]),
        ("inputs-agent-4288.log", &[0, 3]),
        ("inputs-agent-4288.2.log", &[0]),
    ];
    let replayed = files.map(|(file, codes)| {
        let file = run.join(file);
        let published = replay_inputs("agent", &file, &[], codes);
        assert_eq!(published, replay_inputs("agent", &file, &[], codes));
        published
    });
    let published: Vec<Value> = replayed
        .iter()
        .flat_map(|published| published.lines())
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    let recording = Recording::open(&run.join("recording.mcap")).unwrap();
    let digests = tempfile::tempdir().unwrap();
    let mut compared = BTreeSet::new();
    for (number, entry) in recording.entries().iter().enumerate() {
        let Topic::Stream { stream, .. } = entry.key.topic else {
            continue;
        };
        // Notifications are no messages.
        if stream.kind() != Some(entry.header.kind) {
            continue;
        }
        let stamp = serde_json::to_value(&entry.header.stamp).unwrap();
        let is_it = |line: &&Value| line["stamp"] == stamp && line["stream"] == stream.to_string();
        let of_agents = [Stream::Pose, Stream::Bev, Stream::Descriptor];
        let Some(line) = published.iter().find(is_it) else {
            // The last record of the killed agent may be damaged.
            let is_known =
                !of_agents.contains(&stream) || entry.header.stamp.cav.as_str() == "4288";
            assert!(is_known, "{stream} {stamp} is not replayed");
            continue;
        };
        let file = digests.path().join(number.to_string());
        fs::write(&file, recording.read(entry).unwrap()).unwrap();
        let digest = FileDigests::default().sha256(&file).unwrap();
        assert_eq!(line["sha256"], digest, "{stream} {stamp}");
        compared.insert((
            entry.header.stamp.cav.to_string(),
            stream,
            stamp["epoch"].as_u64(),
        ));
    }
    // Two vehicles, one of them twice.
    assert_eq!(compared.len(), 3 * 3, "{compared:?}");
}

#[test]
fn a_killed_replay_resumes_at_its_checkpoint() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), 40, "loop: false", "");
    let mut up = Up::start(folder.path(), &scenario);
    up.wait_for_results("five results", |results| results.len() >= 5);
    let before = results(&up.folder).len();
    signal(up.pids()["replay"], "KILL");
    let crashed = up.wait_for_line("replay was ended by signal 9");
    assert!(crashed.contains("starting it again"), "{crashed}");
    let code = up.wait().code();
    // The tick in transit at the crash may be lost; then that is reported.
    let judged = json(&up.folder.join("metrics.json"))["frames"]
        .as_u64()
        .unwrap();
    assert!(
        judged == 40 && matches!(code, Some(0 | 3)) || judged == 39 && code == Some(3),
        "{judged}, {code:?}"
    );
    let results = results(&up.folder);
    let capture = |result: &Value| result["capture_nanos"].as_u64().unwrap();
    assert!(
        results.len() > before
            && results
                .windows(2)
                .all(|pair| capture(&pair[0]) < capture(&pair[1]))
    );
    assert_eq!(
        results.last().unwrap()["tick"],
        39,
        "to the end of the scene, which is the run's"
    );
    let ledger = json(&up.folder.join("ledger.json"));
    assert_eq!(ledger["balances"], true, "{}", ledger["balance"]);
}

#[test]
fn the_death_of_the_launcher_ends_the_fleet() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), 3, "loop: true", "");
    let mut up = Up::start(folder.path(), &scenario);
    up.wait_for_results("a result", |results| !results.is_empty());
    let pids = up.pids();
    signal(up.pid(), "KILL");
    up.wait();
    let deadline = Instant::now() + TIMEOUT;
    while pids.values().any(|pid| is_running(*pid)) {
        assert!(Instant::now() < deadline, "orphans: {pids:?}");
        std::thread::sleep(Duration::from_millis(50));
    }
}
