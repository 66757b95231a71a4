//! Live figures of `v2vloc up`: answered ticks, the three precisions, the report of a run, and the Prometheus series.

use std::fs;
use std::net::{SocketAddr, TcpListener};
use std::path::Path;
use std::process::Command;
use std::time::Instant;

use serde_json::Value;
use tests::fleet::{TIMEOUT, Up, programs, signal, write_scenario};
use tests::locks::exclusive_lock;

fn json(path: &Path) -> Value {
    serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap()
}

/// Standard output of `v2vloc report`.
fn report(arguments: &[&str], run: &Path) -> String {
    let output = Command::new(programs().join("v2vloc"))
        .arg("report")
        .arg(run)
        .args(arguments)
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// Number of boxes in a line of `truth.jsonl`.
fn line_boxes(line: &str) -> usize {
    let line: Value = serde_json::from_str(line).unwrap();
    line["boxes"].as_array().unwrap().len()
}

/// Column of a CSV file.
fn column<'a>(table: &'a str, name: &str) -> Vec<&'a str> {
    let mut lines = table.lines();
    let index = lines
        .next()
        .unwrap()
        .split(',')
        .position(|column| column == name)
        .unwrap();
    lines
        .map(|line| line.split(',').nth(index).unwrap())
        .collect()
}

#[test]
fn a_run_that_answers_every_tick_reports_its_stages_and_resources() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), 8, "lockstep: true", "");
    let mut up = Up::start(folder.path(), &scenario);
    assert_eq!(up.wait().code(), Some(0));

    let metrics = json(&up.folder.join("metrics.json"));
    assert_eq!(
        (&metrics["answered"], &metrics["ticks"]),
        (&8.into(), &8.into())
    );
    for name in ["ap_answered", "ap_unanswered_empty", "ap_streaming"] {
        let thresholds: Vec<&String> = metrics[name].as_object().unwrap().keys().collect();
        assert_eq!(thresholds, ["0.3", "0.5", "0.7"], "{name}");
    }
    assert_eq!(metrics["ap_answered"], metrics["ap_global"]);
    assert_eq!(
        metrics["ap_answered"], metrics["ap_unanswered_empty"],
        "no tick is missing"
    );
    let frames = fs::read_to_string(up.folder.join("frames.csv")).unwrap();
    assert_eq!(column(&frames, "answered"), ["1"; 8]);
    // In lockstep the previous result is there at each tick.
    assert_eq!(
        column(&frames, "streamed_tick"),
        ["", "0", "1", "2", "3", "4", "5", "6"]
    );

    let truth = fs::read_to_string(up.folder.join("truth.jsonl")).unwrap();
    let boxes: Vec<usize> = truth.lines().map(line_boxes).collect();
    let of_table: Vec<usize> = column(&frames, "truth")
        .iter()
        .map(|count| count.parse().unwrap())
        .collect();
    assert_eq!(boxes, of_table, "every tick with its true boxes");

    let text = report(&[], &up.folder);
    for part in [
        "answered 8/8 (100 %)",
        "agent, slowest of 2",
        "backbone",
        "fuse",
        "router",
        "v2vloc (scorer)",
        "bev",
    ] {
        assert!(text.contains(part), "{part} is not in\n{text}");
    }
    let report: Value = serde_json::from_str(&report(&["--json"], &up.folder)).unwrap();
    assert_eq!(report["pace"]["agents"]["4288"]["computed"], 8);
    let pose = report["stages"]
        .as_array()
        .unwrap()
        .iter()
        .find(|stage| stage["stage"] == "pose")
        .unwrap();
    assert_eq!(
        (&pose["kind"], &pose["processes"], &pose["count"]),
        (&"agent".into(), &2.into(), &16.into())
    );
    assert!(pose["p50_ms"].as_f64() <= pose["p95_ms"].as_f64(), "{pose}");
    let processes = report["processes"].as_array().unwrap();
    assert_eq!(processes.len(), 6, "{processes:?}");
    for process in processes {
        let [all, playing] = ["cpu_s", "playing_cpu_s"].map(|time| process[time].as_f64().unwrap());
        let name = process["process"].as_str().unwrap();
        let loads_models = name.starts_with("agent") || name.starts_with("ego");
        assert!(all > 0.0, "{process}");
        assert!(
            !loads_models || (0.0 < playing && playing < all),
            "the loading of models belongs to no frame: {process}"
        );
        assert!(
            process["peak_resident_bytes"].as_u64().unwrap() > 1 << 20,
            "{process}"
        );
    }
    let bev = report["streams"]
        .as_array()
        .unwrap()
        .iter()
        .find(|stream| stream["stream"] == "bev")
        .unwrap();
    // Sixteen f32 feature maps of 8 channels on 64 x 64 cells.
    assert!(
        bev["messages"] == 16 && bev["bytes"].as_u64().unwrap() > 16 * 131_072,
        "{bev}"
    );
}

#[test]
fn unanswered_ticks_are_in_every_figure_and_the_exit_code_is_explained() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), 30, "", "");
    let mut up = Up::start(folder.path(), &scenario);
    let line = up.wait_for_line("this machine: ");
    assert!(
        line.contains("max with 2 vehicles needs about") && line.contains("of 10 frames answered"),
        "{line}"
    );
    up.wait_for_results("three results", |results| results.len() >= 3);
    // An ego that does not compute for half a second.
    let ego = up.pids()["ego-4279"];
    signal(ego, "STOP");
    std::thread::sleep(std::time::Duration::from_millis(500));
    signal(ego, "CONT");
    let line = up.wait_for_line("exit 3: ");
    assert!(
        line.contains("of 30 ticks unanswered") && line.contains("would answer more"),
        "{line}"
    );
    assert_eq!(up.wait().code(), Some(3));

    let metrics = json(&up.folder.join("metrics.json"));
    let answered = metrics["answered"].as_u64().unwrap();
    assert!(
        metrics["ticks"] == 30 && (3..30).contains(&answered),
        "{metrics}"
    );
    let frames = fs::read_to_string(up.folder.join("frames.csv")).unwrap();
    let counted = column(&frames, "answered");
    assert_eq!(
        (
            counted.len(),
            counted.iter().filter(|is| **is == "1").count() as u64
        ),
        (30, answered)
    );
    let missing = 30 - answered;
    assert_eq!(
        column(&frames, "agent_frame")
            .iter()
            .filter(|frame| frame.is_empty())
            .count() as u64,
        missing
    );
    assert!(report(&[], &up.folder).contains(&format!("answered {answered}/30")));
}

/// First of `count` ports in a row that are free.
fn free_ports(count: u16) -> SocketAddr {
    loop {
        let first = TcpListener::bind("127.0.0.1:0")
            .unwrap()
            .local_addr()
            .unwrap();
        let is_free =
            |offset| TcpListener::bind(("127.0.0.1", first.port().checked_add(offset)?)).ok();
        if (1..count).all(|offset| is_free(offset).is_some()) {
            return first;
        }
    }
}

#[test]
fn prometheus_gets_latency_answered_ticks_fused_neighbours_and_resources() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let address = free_ports(5);
    let scenario = write_scenario(
        folder.path(),
        3,
        "loop: true",
        &format!("network: {{metrics: \"{address}\"}}"),
    );
    let mut up = Up::start(folder.path(), &scenario);
    up.wait_for_results("five results", |results| results.len() >= 5);
    let value = |text: &str, name: &str| -> Option<f64> {
        text.lines()
            .find(|line| line.starts_with(&format!("{name}{{")))?
            .rsplit(' ')
            .next()?
            .parse()
            .ok()
    };
    let deadline = Instant::now() + TIMEOUT;
    let text = loop {
        let text = String::from_utf8(bus::web::fetch(address, "/metrics").unwrap().1).unwrap();
        if value(&text, "v2vloc_answered_ticks_total").is_some_and(|answered| answered >= 5.0) {
            break text;
        }
        assert!(Instant::now() < deadline, "{text}");
        std::thread::sleep(std::time::Duration::from_millis(50));
    };
    assert!(
        value(&text, "v2vloc_ticks_total") >= value(&text, "v2vloc_answered_ticks_total"),
        "{text}"
    );
    let answer = text
        .lines()
        .filter(|line| line.starts_with("v2vloc_process_up{") && line.ends_with(" 1"))
        .count();
    assert!(
        answer >= 3,
        "agents, ego and replay are served at one address\n{text}"
    );
    assert_eq!(
        text.matches("# TYPE v2vloc_stage_seconds").count(),
        1,
        "{text}"
    );
    let board = fs::read_to_string(concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../deploy/monitoring/grafana.json"
    ))
    .unwrap();
    for series in [
        "v2vloc_published_bytes",
        "v2vloc_stage_seconds",
        "v2vloc_process_up",
        "process_cpu_seconds",
    ] {
        assert!(
            board.contains(series) && text.contains(series),
            "{series}\n{text}"
        );
    }
    for name in [
        "v2vloc_capture_to_detection_seconds_count",
        "v2vloc_capture_to_detection_seconds_sum",
        "v2vloc_fused_neighbours_total",
        "process_cpu_seconds_total",
        "process_resident_memory_bytes",
    ] {
        assert!(
            value(&text, name).is_some_and(|value| value > 0.0),
            "{name} in\n{text}"
        );
    }
    signal(up.pid(), "INT");
    up.wait();
}
