//! Programs and their siblings: what each links, and subcommands that another program carries out.

use std::collections::BTreeSet;
use std::env;
use std::ffi::OsString;
use std::fs;
use std::process::Command;

use tests::fleet::programs;

/// Programs that hand subcommands to a sibling, with a subcommand and one of its options.
const FORWARDING: [(&str, &str, &[&str], &str); 3] = [
    ("v2vloc", "v2vloc-runner", &["eval"], "--dataset"),
    ("agent", "agent-offline", &["train", "scene"], "--init"),
    ("ego-fuser", "ego-fuser-offline", &["train"], "--steps"),
];
/// Crates that read, write or generate scenes.
const SCENES: [&str; 3] = ["dataset", "recording", "simulator"];
/// Crates that link libtorch.
const NETWORKS: [&str; 4] = ["tch", "torch-sys", "perception", "fusion"];

/// Standard output of a program that succeeds.
fn output(program: &str, words: &[&str], environment: &[(&str, &str)]) -> String {
    let mut command = Command::new(programs().join(program));
    let output = command
        .args(words)
        .envs(environment.iter().copied())
        .output()
        .unwrap();
    assert!(output.status.success(), "{program} {words:?}: {output:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// Names of the crates that a package links, directly or not.
fn crates_of(package: &str) -> BTreeSet<String> {
    let cargo = env::var_os("CARGO").unwrap_or_else(|| OsString::from("cargo"));
    let mut tree = Command::new(cargo);
    tree.args([
        "tree",
        "--offline",
        "--edges",
        "normal",
        "--prefix",
        "none",
        "--format",
        "{p}",
        "--package",
        package,
    ]);
    let output = tree
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    assert!(output.status.success(), "{output:?}");
    let text = String::from_utf8(output.stdout).unwrap();
    text.lines()
        .filter_map(|line| line.split(' ').next())
        .map(str::to_owned)
        .collect()
}

#[test]
fn a_program_links_what_it_runs() {
    for (package, unneeded) in [
        ("deploy", &NETWORKS[..]),
        ("sim-replay", &NETWORKS[..]),
        ("agent", &SCENES[..]),
        ("ego-fuser", &SCENES[..]),
    ] {
        let linked = crates_of(package);
        assert!(linked.contains("zenoh"), "{package}: {linked:?}");
        let found: Vec<_> = unneeded
            .iter()
            .filter(|name| linked.contains(**name))
            .collect();
        assert!(found.is_empty(), "{package} links {found:?}");
    }
}

#[test]
fn libtorch_is_loaded_by_the_programs_that_compute() {
    // The loader lists the libraries instead of running the program.
    let libraries = |program| output(program, &[], &[("LD_TRACE_LOADED_OBJECTS", "1")]);
    for (program, computes) in [
        ("v2vloc", false),
        ("sim-replay", false),
        ("v2vloc-runner", true),
        ("agent", true),
        ("ego-fuser", true),
    ] {
        let libraries = libraries(program);
        assert!(libraries.contains("libc.so"), "{program}: {libraries}");
        assert_eq!(
            libraries.contains("libtorch"),
            computes,
            "{program}: {libraries}"
        );
    }
}

#[test]
fn every_subcommand_of_a_sibling_is_listed() {
    let listed = |program: &str| -> BTreeSet<String> {
        let help = output(program, &["--help"], &[]);
        let commands = help
            .lines()
            .skip_while(|line| *line != "Commands:")
            .skip(1)
            .take_while(|line| !line.is_empty());
        commands
            .filter_map(|line| line.split_whitespace().next())
            .map(str::to_owned)
            .collect()
    };
    for (program, sibling, ..) in FORWARDING {
        let (all, of_sibling) = (listed(program), listed(sibling));
        assert!(
            of_sibling.len() > 1 && of_sibling.is_subset(&all),
            "{program}: {all:?}, {sibling}: {of_sibling:?}"
        );
    }
}

#[test]
fn the_help_of_a_sibling_is_that_of_the_program() {
    for (program, _, words, option) in FORWARDING {
        let help = output(program, &[words, &["--help"]].concat(), &[]);
        assert!(help.contains(option), "{help}");
        assert!(
            help.contains(&format!("Usage: {program} {}", words.join(" "))),
            "{help}"
        );
        assert_eq!(output(program, &[&["help"], words].concat(), &[]), help);
    }
}

#[test]
fn completions_and_manual_pages_know_the_options_of_a_sibling() {
    for (program, _, words, option) in FORWARDING {
        for shell in ["bash", "zsh", "fish"] {
            let script = output(program, &[], &[("V2VLOC_GENERATE", shell)]);
            assert!(
                script.contains(option.trim_start_matches("--")),
                "{program}: {option} in {shell}"
            );
        }
        let folder = tempfile::tempdir().unwrap();
        let wanted = format!("man:{}", folder.path().display());
        output(program, &[], &[("V2VLOC_GENERATE", &wanted)]);
        let page = folder
            .path()
            .join(format!("{program}-{}.1", words.join("-")));
        let text = fs::read_to_string(&page).unwrap().replace('\\', "");
        assert!(text.contains(option), "{}: {option}", page.display());
    }
}

#[test]
fn a_program_without_its_sibling_names_it() {
    // A link, of one file system: a copy cannot be started while a process that another test begins has it open.
    let folder = tempfile::tempdir_in(programs()).unwrap();
    for (program, sibling, words, _) in FORWARDING {
        let lonely = folder.path().join(program);
        fs::hard_link(programs().join(program), &lonely).unwrap();
        let run = |words: &[&str], shell: Option<&str>| {
            let mut command = Command::new(&lonely);
            command
                .args(words)
                .env("PATH", "/nowhere")
                .envs(shell.map(|shell| ("V2VLOC_GENERATE", shell)));
            let output = command.output().unwrap();
            (
                output.status.code(),
                String::from_utf8_lossy(&output.stderr).into_owned(),
            )
        };
        let (code, stderr) = run(words, None);
        assert_eq!(code, Some(1), "{stderr}");
        assert!(
            stderr.contains(&format!("{} is part of the program {sibling}", words[0])),
            "{stderr}"
        );
        let (code, stderr) = run(&[], Some("bash"));
        assert!(
            code == Some(1) && stderr.contains(&format!("is part of the program {sibling}")),
            "{stderr}"
        );
    }
}
