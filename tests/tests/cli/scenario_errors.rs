//! Error messages and exit codes of `v2vloc` for missing and invalid input.

use std::fs;
use std::net::TcpListener;
use std::path::Path;
use std::process::Command;

use tch::Cuda;
use tests::fleet::{programs, write_scenario};
use tests::locks::exclusive_lock;

/// Runs `v2vloc up` and returns exit code and standard error.
fn up(program: &Path, folder: &Path, scenario: &Path) -> (Option<i32>, String) {
    let output = Command::new(program)
        .arg("up")
        .arg(scenario)
        .arg("--runs")
        .arg(folder.join("runs"))
        .output()
        .unwrap();
    (
        output.status.code(),
        String::from_utf8_lossy(&output.stderr).into_owned(),
    )
}

/// Like [`up`], with the program under test.
fn refused(folder: &Path, scenario: &Path) -> (Option<i32>, String) {
    up(&programs().join("v2vloc"), folder, scenario)
}

#[test]
fn a_misspelt_field_is_named_with_file_and_line() {
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), 1, "", "ego:\n  dedline_ms: 5");
    let (code, stderr) = refused(folder.path(), &scenario);
    assert_eq!(code, Some(2), "{stderr}");
    assert!(
        stderr.contains("scenario.yaml:6") && stderr.contains("dedline_ms"),
        "{stderr}"
    );
}

#[test]
fn options_of_a_protocol_that_other_fields_choose_are_named() {
    let folder = tempfile::tempdir().unwrap();
    for (option, value) in [
        ("max_agents", "3"),
        ("ego_kind", "unit"),
        ("agent_kinds", "vehicles"),
    ] {
        let scenario = write_scenario(
            folder.path(),
            1,
            "",
            &format!("protocol:\n  {option}: {value}"),
        );
        let (code, stderr) = refused(folder.path(), &scenario);
        assert_eq!(code, Some(2), "{stderr}");
        assert!(
            stderr.contains(&format!(
                "{option}: choose by scene.agents and ego.id instead"
            )),
            "{stderr}"
        );
    }
}

#[test]
fn missing_weights_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), 1, "", "");
    fs::remove_file(folder.path().join("weights.safetensors")).unwrap();
    let (code, stderr) = refused(folder.path(), &scenario);
    assert_eq!(code, Some(2), "{stderr}");
    assert!(
        stderr.contains("models.weights") && stderr.contains("weights.safetensors does not exist"),
        "{stderr}"
    );
}

#[test]
fn cut_off_weights_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), 1, "", "");
    let weights = folder.path().join("weights.safetensors");
    let whole = fs::read(&weights).unwrap();
    fs::write(&weights, &whole[..whole.len() / 2]).unwrap();
    let (code, stderr) = refused(folder.path(), &scenario);
    assert_eq!(code, Some(2), "{stderr}");
    assert!(
        stderr.contains("weights.safetensors: not a complete safetensors file"),
        "{stderr}"
    );
}

#[test]
fn a_scene_without_frames_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), 1, "", "");
    for agent in ["4279", "4288"] {
        for entry in fs::read_dir(folder.path().join("scene").join(agent)).unwrap() {
            fs::remove_file(entry.unwrap().path()).unwrap();
        }
    }
    let (code, stderr) = refused(folder.path(), &scenario);
    assert_eq!(code, Some(2), "{stderr}");
    assert!(
        stderr.contains(&folder.path().join("scene").display().to_string()),
        "{stderr}"
    );
}

#[test]
fn a_vehicle_that_is_not_there_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), 1, "agents: ['4279', '77']", "");
    let (code, stderr) = refused(folder.path(), &scenario);
    assert_eq!(code, Some(2), "{stderr}");
    assert!(
        stderr.contains("scene.agents names vehicle 77") && stderr.contains("4288"),
        "{stderr}"
    );
}

#[test]
fn a_port_in_use_is_named() {
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let endpoint = format!("tcp/{}", taken.local_addr().unwrap());
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(
        folder.path(),
        1,
        "",
        &format!("network: {{listen: \"{endpoint}\"}}"),
    );
    let (code, stderr) = refused(folder.path(), &scenario);
    assert_eq!(code, Some(2), "{stderr}");
    assert!(
        stderr.contains(&endpoint) && stderr.contains("in use"),
        "{stderr}"
    );
    assert!(!stderr.contains("WARN"), "{stderr}");
    assert!(
        !folder.path().join("runs/test").exists(),
        "the name is free for the next attempt"
    );
}

#[test]
fn a_missing_program_is_named() {
    // Links: a copy cannot be started while a process that another test begins has it open.
    let folder = tempfile::tempdir_in(programs()).unwrap();
    let scenario = write_scenario(folder.path(), 1, "", "");
    for name in ["v2vloc", "v2vloc-runner"] {
        fs::hard_link(programs().join(name), folder.path().join(name)).unwrap();
    }
    let (code, stderr) = up(&folder.path().join("v2vloc"), folder.path(), &scenario);
    assert_eq!(code, Some(1), "{stderr}");
    assert!(
        stderr.contains(&folder.path().join("agent").display().to_string())
            && stderr.contains("is missing"),
        "{stderr}"
    );
}

#[test]
fn a_device_that_is_missing_is_named_before_anything_starts() {
    let missing = "models.device is cuda: this libtorch is built without CUDA";
    let is_missing = !Cuda::is_available();
    // The weights do not exist: where there is a device, that is what is refused.
    for [program, vehicle] in [["agent", "--cav"], ["ego-fuser", "--ego"]] {
        let mut command = Command::new(programs().join(program));
        command.args([
            "run",
            "--run",
            "test",
            vehicle,
            "1",
            "--weights",
            "w",
            "--device",
            "cuda",
        ]);
        let output = command.output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{program}");
        assert_eq!(
            String::from_utf8_lossy(&output.stderr).contains(missing),
            is_missing,
            "{program}"
        );
    }
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), 1, "", "");
    let text = fs::read_to_string(&scenario).unwrap();
    fs::write(
        &scenario,
        text.replace("weights.safetensors", "missing.safetensors, device: cuda"),
    )
    .unwrap();
    let (code, stderr) = refused(folder.path(), &scenario);
    assert!(
        code == Some(2) && stderr.contains("scenario.yaml"),
        "{code:?} {stderr}"
    );
    assert_eq!(stderr.contains(missing), is_missing, "{stderr}");
    assert!(!folder.path().join("runs/test").exists());
}

#[test]
fn a_second_run_of_the_same_name_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), 1, "", "");
    fs::create_dir_all(folder.path().join("runs/test")).unwrap();
    let (code, stderr) = refused(folder.path(), &scenario);
    assert_eq!(code, Some(2), "{stderr}");
    assert!(stderr.contains("runs/test exists already"), "{stderr}");
}

#[test]
fn an_agent_that_never_comes_is_named() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let rest = "remote_agents: ['4288']\ntimeouts: {ready_s: 3}";
    let scenario = write_scenario(folder.path(), 1, "", rest);
    let (code, stderr) = refused(folder.path(), &scenario);
    assert_eq!(code, Some(1), "{stderr}");
    assert!(
        stderr.contains("not ready") && stderr.contains("agent-4288"),
        "{stderr}"
    );
}
