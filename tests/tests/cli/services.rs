//! Service files: systemd units and containers start programs with options that exist.

use std::fs;
use std::path::Path;
use std::process::Command;

use tests::fleet::programs;

/// Program and arguments of every command line in the files that start processes, the subcommand first.
fn commands(folder: &Path) -> Vec<(String, Vec<String>)> {
    let mut commands = Vec::new();
    for entry in fs::read_dir(folder.join("systemd")).unwrap() {
        let text = fs::read_to_string(entry.unwrap().path()).unwrap();
        for line in text
            .lines()
            .filter_map(|line| line.strip_prefix("ExecStart=/opt/v2vloc/bin/"))
        {
            let arguments: Vec<String> = line.split(' ').map(str::to_owned).collect();
            commands.push((arguments[0].clone(), arguments[1..].to_vec()));
        }
    }
    let compose = fs::read_to_string(folder.join("compose/compose.yaml")).unwrap();
    let programs = ["v2vloc", "agent", "ego-fuser", "sim-replay"];
    for line in compose
        .lines()
        .map(|line| line.trim().trim_start_matches("- ").trim_matches('"'))
    {
        if let Some(list) = line.strip_prefix("command: [") {
            let arguments: Vec<String> = list
                .trim_end_matches(']')
                .split(", ")
                .map(|argument| argument.trim_matches('"').into())
                .collect();
            commands.push((arguments[0].clone(), arguments[1..].to_vec()));
        } else if programs.contains(&line) {
            commands.push((line.to_owned(), Vec::new()));
        } else if let Some((_, arguments)) = commands.last_mut()
            && (line.starts_with("--") || (arguments.is_empty() && !line.contains(':')))
        {
            arguments.push(line.to_owned());
        }
    }
    commands
}

#[test]
fn keys_that_are_not_there_are_named_and_not_tried_again() {
    let folder = tempfile::tempdir().unwrap();
    let output = Command::new(programs().join("sim-replay"))
        .args(["record", "--run=test", "--connect=quic/127.0.0.1:1"])
        .arg(format!("--keys={}", folder.path().display()))
        .arg(format!(
            "--out={}",
            folder.path().join("recording.mcap").display()
        ))
        .output()
        .unwrap();
    // The exit code for which the units do not restart a process.
    assert_eq!(output.status.code(), Some(2));
    assert!(
        String::from_utf8_lossy(&output.stderr).contains("ca.pem"),
        "{output:?}"
    );
}

#[test]
fn units_and_containers_start_what_there_is() {
    let commands = commands(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy"));
    assert_eq!(commands.len(), 8, "{commands:?}");
    for (program, arguments) in commands {
        let output = Command::new(programs().join(&program))
            .args([&arguments[0], "--help"])
            .output()
            .unwrap();
        let help = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success(), "{program} {}", arguments[0]);
        for name in arguments
            .iter()
            .filter_map(|argument| argument.strip_prefix("--"))
            .map(|argument| argument.split('=').next().unwrap())
        {
            let is_there = [" ", "\n", "[="]
                .iter()
                .any(|end| help.contains(&format!("--{name}{end}")));
            assert!(is_there, "{program} {}: --{name}", arguments[0]);
        }
    }
}
