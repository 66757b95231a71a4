//! Digest of the data: a flipped byte of any file that is opened gives another one, in every layout.

use std::collections::BTreeMap;
use std::fs;
use std::mem::MaybeUninit;
use std::path::{Path, PathBuf};

use dataset::LoadOptions;
use rustix::fs::inotify::{self, CreateFlags, WatchFlags};
use rustix::io::Errno;
use simulator::generate::{SceneLayout, Subset, SynthOptions, generate};
use support::file_digests::FileDigests;

/// All layouts that scenes are written in.
const LAYOUTS: [SceneLayout; 11] = [
    SceneLayout::Opv2v,
    SceneLayout::V2v4real,
    SceneLayout::V2xreal,
    SceneLayout::Dair,
    SceneLayout::V2xseq,
    SceneLayout::V2xsim,
    SceneLayout::Mars,
    SceneLayout::Nclt,
    SceneLayout::Oxford,
    SceneLayout::KittiOdometry,
    SceneLayout::KittiObject,
];

fn folders_below(root: &Path) -> Vec<PathBuf> {
    let mut folders = vec![root.to_owned()];
    for entry in fs::read_dir(root).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            folders.extend(folders_below(&path));
        }
    }
    folders
}

/// Files below a folder that `read` opens, as the system reports them.
fn opened_by(root: &Path, read: impl FnOnce()) -> Vec<PathBuf> {
    let watch = inotify::init(CreateFlags::NONBLOCK | CreateFlags::CLOEXEC).unwrap();
    let folders: BTreeMap<i32, PathBuf> = folders_below(root)
        .into_iter()
        .map(|folder| {
            let number = inotify::add_watch(&watch, &folder, WatchFlags::OPEN).unwrap();
            (number, folder)
        })
        .collect();
    read();
    let mut buffer = [MaybeUninit::uninit(); 4096];
    let mut events = inotify::Reader::new(&watch, &mut buffer);
    let mut files = Vec::new();
    loop {
        match events.next() {
            Ok(event) => {
                let name = event.file_name().map(|name| name.to_str().unwrap());
                files.extend(name.map(|name| folders[&event.wd()].join(name)));
            }
            Err(Errno::WOULDBLOCK) => break,
            Err(error) => panic!("{error}"),
        }
    }
    files.retain(|path| path.is_file());
    files.sort();
    files.dedup();
    files
}

/// Reads every frame of a data set.
fn load_all(root: &Path) {
    for scenario in dataset::open(root).unwrap().scenarios {
        for tick in 0..scenario.ticks.len() {
            for agent in scenario.present_agents(tick) {
                let frame = scenario.load(agent, tick, &LoadOptions::default());
                assert!(!frame.unwrap().points.is_empty());
            }
        }
    }
}

/// Digest of a data set; `None` if it cannot be opened any more.
fn sha256(root: &Path) -> Option<String> {
    let dataset = dataset::open(root).ok()?;
    let digests = FileDigests::default();
    Some(dataset::content_sha256(&dataset.scenarios, None, &digests))
}

/// Fails where a file is opened whose bytes are not in the digest.
fn assert_covers_all_that_is_opened(name: &str, root: &Path) {
    let original = sha256(root);
    assert!(original.is_some(), "{name}");
    let opened = opened_by(root, || load_all(root));
    assert!(opened.len() >= 2, "{name}: {opened:?}");
    for file in opened {
        let bytes = fs::read(&file).unwrap();
        let mut flipped = bytes.clone();
        let middle = flipped.len() / 2;
        flipped[middle] ^= 1;
        fs::write(&file, flipped).unwrap();
        assert_ne!(sha256(root), original, "{name}: {}", file.display());
        fs::write(&file, bytes).unwrap();
    }
    assert_eq!(sha256(root), original, "{name}");
}

#[test]
fn a_flipped_byte_of_any_opened_file_changes_the_digest_in_every_layout() {
    for layout in LAYOUTS {
        let folder = tempfile::tempdir().unwrap();
        let options = SynthOptions {
            layout,
            frames: 2,
            agents: 2..=2,
            ..SynthOptions::new(Subset::V2vdet, 1007, folder.path().to_owned())
        };
        generate(&options, &|_| {}).unwrap();
        assert_covers_all_that_is_opened(layout.name(), folder.path());
    }
}

#[test]
fn a_flipped_byte_of_clouds_or_poses_changes_the_digest() {
    let folder = tempfile::tempdir().unwrap();
    let cloud = |x: f32| [x, 2.0, 3.0, 0.5].map(f32::to_le_bytes).concat();
    fs::write(folder.path().join("1.bin"), cloud(1.0)).unwrap();
    fs::write(folder.path().join("2.bin"), cloud(2.0)).unwrap();
    fs::write(
        folder.path().join("poses.txt"),
        "1 0 0 0 0 0 0 1\n2 1.5 0 0 0 0 0 1\n",
    )
    .unwrap();
    assert_covers_all_that_is_opened("clouds", folder.path());
}
