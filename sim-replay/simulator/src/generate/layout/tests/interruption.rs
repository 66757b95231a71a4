//! Runs that are interrupted.

use std::fs;

use super::{open, options, write};
use crate::generate::{SceneLayout, SynthError, SynthOptions, generate};
use dataset::{self, UNFINISHED};

#[test]
fn an_interrupted_run_is_reported_until_it_is_done_again() {
    let folder = tempfile::tempdir().unwrap();
    write(SceneLayout::Opv2v, folder.path());
    let scenario = folder.path().join(&open(folder.path()).scenarios[0].name);
    for place in [folder.path(), &scenario] {
        fs::write(place.join(UNFINISHED), "").unwrap();
    }
    let problems = dataset::open(folder.path()).unwrap().problems;
    assert_eq!(problems.len(), 2, "{problems:?}");
    assert!(
        problems[1]
            .to_string()
            .contains(".unfinished: the run that wrote this folder did not end"),
        "{problems:?}"
    );
    assert_eq!(dataset::open(&scenario).unwrap().problems.len(), 1);
    let again = options(SceneLayout::Opv2v, folder.path());
    let refused = generate(&again, &|_| {}).unwrap_err();
    assert!(matches!(refused, SynthError::NotEmpty(_)), "{refused}");
    generate(
        &SynthOptions {
            force: true,
            ..again
        },
        &|_| {},
    )
    .unwrap();
    open(folder.path());
}

#[test]
fn a_run_that_fails_leaves_its_mark() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let broken = SynthOptions {
        force: true,
        ..options(SceneLayout::Dair, &out)
    };
    // A file where a folder has to be.
    fs::create_dir_all(&out).unwrap();
    fs::write(out.join("cooperative"), "").unwrap();
    let error = generate(&broken, &|_| {}).unwrap_err().to_string();
    assert!(error.contains("out/cooperative: "), "{error}");
    assert!(out.join(UNFINISHED).is_file());
}

#[test]
fn files_of_an_earlier_run_are_not_mixed_in() {
    for layout in [
        SceneLayout::KittiObject,
        SceneLayout::V2xsim,
        SceneLayout::Nclt,
    ] {
        let folder = tempfile::tempdir().unwrap();
        let count = |scenes: usize, force: bool| {
            let options = SynthOptions {
                scenes,
                force,
                frames: 1,
                ..options(layout, folder.path())
            };
            generate(&options, &|_| {}).unwrap();
            let sweeps = [
                "training/velodyne",
                "sweeps/LIDAR_TOP_id_1",
                "2012-01-01/velodyne_sync",
            ];
            sweeps
                .iter()
                .filter_map(|name| fs::read_dir(folder.path().join(name)).ok())
                .flatten()
                .count()
        };
        let (two, one) = (count(2, false), count(1, true));
        assert!(one <= two && one > 0, "{layout:?}: {two} {one}");
        assert_eq!(
            one,
            if layout == SceneLayout::KittiObject {
                2
            } else {
                1
            },
            "{layout:?}"
        );
    }
}
