//! Programs whose standard output and error have no reader, as before `| head -1`.

use std::io::pipe;
use std::net::TcpListener;
use std::process::{Command, Stdio};

use tests::fleet::{programs, write_weights};

/// Exit code of a program whose standard output, and if requested standard error, has no reader.
fn code_unread(program: &str, arguments: &[&str], is_error_unread: bool) -> Option<i32> {
    let (reader, writer) = pipe().unwrap();
    drop(reader);
    let mut command = Command::new(programs().join(program));
    command.args(arguments).stdin(Stdio::null());
    if is_error_unread {
        command.stderr(writer.try_clone().unwrap());
    }
    command.stdout(writer).status().unwrap().code()
}

#[test]
fn every_program_comes_to_its_quiet_end() {
    let folder = tempfile::tempdir().unwrap();
    tests::scene::write(folder.path(), &["4279"], 1);
    let (scene, keys) = (folder.path().join("scene"), folder.path().join("keys"));
    let (scene, keys) = (scene.to_str().unwrap(), keys.to_str().unwrap());
    let weights = folder.path().join("weights.safetensors");
    write_weights(&weights);
    let free = TcpListener::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap();
    let listen = format!("tcp/{free}");
    // Its supervisor has ended, so that it ends.
    let agent = [
        "run",
        "--run=t",
        "--cav=4279",
        "--supervised",
        "--listen",
        &listen,
        "--weights",
    ];
    let agent = [&agent[..], &[weights.to_str().unwrap()]].concat();
    let commands: [(&str, &[&str]); 6] = [
        ("sim-replay", &["inspect", scene]),
        ("sim-replay", &["inspect", "--json", scene]),
        ("agent", &agent),
        ("ego-fuser", &["methods"]),
        ("ego-fuser", &["methods", "--json"]),
        ("v2vloc", &["keys", "--out", keys, "--agents", "4279"]),
    ];
    for (program, arguments) in commands {
        // An agent that is stopped while it waits for its router was interrupted.
        let expected = if program == "agent" { 130 } else { 0 };
        assert_eq!(
            code_unread(program, arguments, false),
            Some(expected),
            "{program} {arguments:?}"
        );
    }
}

#[test]
fn an_error_without_a_reader_keeps_its_exit_code() {
    for (program, arguments, code) in [
        (
            "sim-replay",
            ["recover", "/no/recording.mcap", "--out=/no/whole.mcap"],
            2,
        ),
        (
            "ego-fuser",
            [
                "eval",
                "--weights=/no/weights.safetensors",
                "--dataset=/no/scene",
            ],
            2,
        ),
        ("v2vloc", ["status", "/no/run", "--json"], 2),
    ] {
        assert_eq!(
            code_unread(program, &arguments, true),
            Some(code),
            "{program} {arguments:?}"
        );
    }
}
