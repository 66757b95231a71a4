//! Reports and exit codes of `v2vloc` when a part of a run fails and the rest goes on, and runs that it refuses to
//! begin.

use std::fs;
use std::net::TcpListener;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use recording::Recording;
use tests::fleet::{Up, programs, results, signal, write_scenario};
use tests::locks::exclusive_lock;

/// Runs `program` to its end; exit code and both outputs.
fn outcome(command: &mut Command) -> (Option<i32>, String) {
    let Output {
        status,
        stdout,
        stderr,
    } = command.stdin(Stdio::null()).output().unwrap();
    (
        status.code(),
        [stdout, stderr]
            .map(|bytes| String::from_utf8_lossy(&bytes).into_owned())
            .concat(),
    )
}

fn up(folder: &Path, scenario: &Path, name: &str) -> (Option<i32>, String) {
    let mut command = Command::new(programs().join("v2vloc"));
    outcome(
        command
            .arg("up")
            .arg(scenario)
            .arg("--name")
            .arg(name)
            .arg("--runs")
            .arg(folder.join("runs")),
    )
}

#[test]
fn a_cut_recording_is_reported_by_report_status_and_exit_code() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    // A tick of some 200 kB every half second; no file may be larger than 1.5 MB.
    let scenario = write_scenario(folder.path(), 14, "rate: 0.2", "record: {without: [bev]}");
    let limited = "ulimit -f 3000; trap '' XFSZ; exec \"$0\" \"$@\"";
    let mut command = Command::new("/bin/sh");
    command
        .args(["-c", limited])
        .arg(programs().join("v2vloc"))
        .arg("up")
        .arg(&scenario);
    let (code, output) = outcome(command.arg("--runs").arg(folder.path().join("runs")));
    assert_eq!(code, Some(3), "{output}");
    let run = folder.path().join("runs/test");
    let recording = run.join("recording.mcap");
    let advice = format!(
        "messages missing; sim-replay recover {} --out ",
        recording.display()
    );
    for text in ["recorder: recording cut at ", " s: ", &advice] {
        assert_eq!(
            output.matches(text).count(),
            3,
            "at once, in the report and as the reason of the exit code: {output}"
        );
    }
    assert_eq!(results(&run).len(), 14, "the run goes on");
    let (code, status) = outcome(
        Command::new(programs().join("v2vloc"))
            .arg("status")
            .arg(&run),
    );
    assert!(
        code == Some(1) && status.contains("recorder is") && status.contains("recording cut at"),
        "{status}"
    );
    let whole = run.join("whole.mcap");
    let recover = [
        "recover".as_ref(),
        recording.as_os_str(),
        "--out".as_ref(),
        whole.as_os_str(),
    ];
    let (code, output) = outcome(Command::new(programs().join("sim-replay")).args(recover));
    assert!(
        code == Some(3) && output.contains("ends without an index"),
        "{output}"
    );
    let [cut, whole] = [&recording, &whole].map(|file| Recording::open(file).unwrap());
    assert!(!whole.entries().is_empty() && whole.entries().len() == cut.entries().len());
    assert_eq!(whole.damage(), []);
}

#[test]
fn a_second_fleet_of_the_same_name_is_refused_and_the_first_continues() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let free = TcpListener::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap();
    let scenario = write_scenario(
        folder.path(),
        3,
        "loop: true",
        &format!("network: {{listen: tcp/{free}}}"),
    );
    let joining = folder.path().join("joining.yaml");
    fs::write(
        &joining,
        fs::read_to_string(&scenario)
            .unwrap()
            .replace("listen:", "connect:"),
    )
    .unwrap();
    let mut first = Up::start(folder.path(), &scenario);
    first.wait_for_results("a result", |results| !results.is_empty());
    let others = folder.path().join("others");
    let (code, output) = up(&others, &joining, "test");
    assert_eq!(code, Some(2), "{output}");
    assert!(
        output.contains(&format!("run test is already live on tcp/{free}")),
        "{output}"
    );
    for process in ["agent-4279", "agent-4288", "ego-4279", "replay", "scorer"] {
        assert!(output.contains(process), "{process}: {output}");
    }
    assert!(!others.join("runs/test").exists(), "nothing of it began");
    let before = results(&first.folder).len();
    first.wait_for_results("the first going on", |results| results.len() > before + 3);
    signal(first.pid(), "INT");
    assert!(matches!(first.wait().code(), Some(0 | 3)));
}

/// Removes the poses from all files of the scene.
fn without_poses(scene: &Path) {
    for agent in fs::read_dir(scene).unwrap() {
        for file in fs::read_dir(agent.unwrap().path())
            .unwrap()
            .map(|file| file.unwrap().path())
        {
            if file.extension().is_some_and(|kind| kind == "yaml") {
                let text = fs::read_to_string(&file).unwrap();
                let kept: Vec<&str> = text
                    .lines()
                    .filter(|line| !line.contains("_pose:") && !line.contains("_pos:"))
                    .collect();
                fs::write(&file, kept.join("\n")).unwrap();
            }
        }
    }
}

#[test]
fn a_scene_without_poses_is_played_to_those_who_find_theirs() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let recorded = write_scenario(folder.path(), 4, "lockstep: true", "");
    without_poses(&folder.path().join("scene"));
    let (code, output) = up(folder.path(), &recorded, "recorded");
    assert_eq!(code, Some(2), "{output}");
    assert!(
        output.contains("vehicle 4279: pose is recorded, but scenario")
            && output.contains("pose: pgc"),
        "{output}"
    );
    assert!(!folder.path().join("runs/recorded").exists());

    tests::localizer::write(folder.path(), 3);
    let text = fs::read_to_string(&recorded).unwrap();
    let pose = "agents: {pose: {pgc: {encoder: encoder.safetensors, head: head.safetensors}}}\n";
    let finding = folder.path().join("finding.yaml");
    fs::write(&finding, text + pose).unwrap();
    let (code, output) = up(folder.path(), &finding, "finding");
    // Untrained networks find no pose, and feature maps without one cannot be used.
    assert!(matches!(code, Some(0 | 3)), "{output}");
    let results = results(&folder.path().join("runs/finding"));
    let ticks: Vec<_> = results
        .iter()
        .map(|result| result["tick"].as_u64())
        .collect();
    assert_eq!(ticks, [0, 1, 2, 3].map(Some), "every tick is answered");

    let weights = folder.path().join("weights.safetensors");
    let mut eval = Command::new(programs().join("v2vloc"));
    eval.args(["eval", "--method", "max", "--dataset"])
        .arg(folder.path().join("scene"))
        .arg("--weights")
        .arg(weights);
    let (code, output) = outcome(&mut eval);
    assert!(
        code == Some(2)
            && output.contains("there is no frame in it that can be evaluated")
            && output.contains("lidar_pose: no true pose of the ego 4279"),
        "{output}"
    );
}

#[test]
fn sweeps_without_poses_are_localised_and_no_sweep_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    tests::scene::write(folder.path(), &["4279"], 2);
    let (encoder, head) = tests::localizer::write(folder.path(), 3);
    let scene = folder.path().join("scene");
    for file in fs::read_dir(scene.join("4279"))
        .unwrap()
        .map(|file| file.unwrap().path())
    {
        if file.extension().is_some_and(|kind| kind == "yaml") {
            fs::remove_file(file).unwrap();
        }
    }
    let agent = |command: &str, scene: &Path| {
        let mut agent = Command::new(programs().join("agent"));
        agent
            .arg(command)
            .arg("--dataset")
            .arg(scene)
            .arg("--encoder")
            .arg(&encoder)
            .arg("--head")
            .arg(&head);
        agent
    };
    let table = folder.path().join("poses.csv");
    let (code, output) = outcome(agent("localize", &scene).arg("--out").arg(&table));
    assert!(code == Some(0) && output.contains("2 sweeps, "), "{output}");
    // A head without a confidence: it is named.
    assert!(
        output.contains("head.safetensors: no \"confidence\" in its metadata"),
        "{output}"
    );
    // Done is what the same networks computed from the same data.
    let (code, output) = outcome(agent("localize", &scene).arg("--out").arg(&table));
    assert!(code == Some(0) && output.contains("0 sweeps, "), "{output}");
    let other = folder.path().join("other");
    tests::scene::write(&other, &["4279"], 2);
    let same_name = other.join("scene");
    for (data, refused) in [
        (vec![&same_name], "are of other networks or data"),
        (vec![&scene, &same_name], "both have a scenario scene"),
    ] {
        let mut localize = agent("localize", data[0]);
        localize.arg("--out").arg(&table);
        for more in &data[1..] {
            localize.arg("--dataset").arg(more);
        }
        let (code, output) = outcome(&mut localize);
        assert!(code == Some(2) && output.contains(refused), "{output}");
    }
    let (code, output) = outcome(&mut agent("eval", &scene));
    assert!(
        code == Some(2) && output.contains("there is no pose for this sweep"),
        "{output}"
    );
    let empty = folder.path().join("empty/1");
    fs::create_dir_all(&empty).unwrap();
    let (code, output) = outcome(
        agent("localize", empty.parent().unwrap())
            .arg("--out")
            .arg(folder.path().join("none.csv")),
    );
    assert_eq!(code, Some(2), "{output}");
}
