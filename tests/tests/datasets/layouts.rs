//! One generated scene in every layout: the same ground truth, and the same AP to the digit.

use std::fs;
use std::path::Path;

use dataset::evaluation_protocol::ProtocolConfig;
use dataset::pcd::{self, Encoding, IntensityField};
use dataset::{self, Layout, OpenOptions};
use fusion::Method;
use protocol::PointCloud;
use runner::experiment::evaluation::{OpenedData, Trial, evaluate};
use serde_json::{Value, json};
use sim_replay::inspect::inspect;
use simulator::generate::{SceneLayout, Subset, SynthOptions, generate};

/// Layouts that hold both agents and their boxes, with the layout detected by the reader. A line for each.
const LAYOUTS: [(SceneLayout, Layout); 7] = [
    (SceneLayout::Opv2v, Layout::OPV2V),
    (SceneLayout::V2v4real, Layout::V2V4REAL),
    (SceneLayout::V2xreal, Layout::V2XREAL),
    (SceneLayout::Dair, Layout::DAIR),
    (SceneLayout::V2xseq, Layout::V2XSEQ),
    (SceneLayout::V2xsim, Layout::V2XSIM),
    (SceneLayout::Mars, Layout::MARS),
];
/// Methods without and with messages.
const METHODS: [Method; 2] = [Method::NONE, Method::MAX];
/// Released weights, trained with other scenes.
const WEIGHTS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/weights");

/// Average precision of a method, by threshold and order.
fn average_precision(scene: &Path, method: Method) -> Value {
    let mut trial = Trial {
        dataset: scene.to_owned(),
        // One protocol for all: each layout has its own otherwise.
        protocol: ProtocolConfig {
            preset: Some("opv2v".into()),
            ..ProtocolConfig::default()
        },
        ..Trial::default()
    };
    trial.setup.models.weights = WEIGHTS.into();
    let data = OpenedData::open(&trial).unwrap();
    let metrics = evaluate(&trial, &data, method, &mut || {}).unwrap();
    assert_eq!(metrics.frames, 4);
    json!([metrics.ap_global, metrics.ap_frame_order])
}

#[test]
fn every_layout_gives_the_same_average_precision() {
    tch::set_num_threads(1);
    let mut expected = Vec::new();
    for (layout, found) in LAYOUTS {
        let folder = tempfile::tempdir().unwrap();
        let options = SynthOptions::new(Subset::V2vdet, 1007, folder.path().to_owned());
        generate(
            &SynthOptions {
                layout,
                frames: 4,
                agents: 2..=2,
                ..options
            },
            &|_| {},
        )
        .unwrap();
        let dataset = dataset::open(folder.path()).unwrap();
        assert!(
            dataset.layout == found && dataset.problems.is_empty(),
            "{layout:?}: {:?}",
            dataset.problems
        );
        let found: Vec<Value> = METHODS
            .map(|method| average_precision(folder.path(), method))
            .to_vec();
        if expected.is_empty() {
            // Equality of zeros would show nothing.
            let at_30 = |precision: &Value| {
                precision[0]["0.3"]
                    .as_f64()
                    .unwrap_or_else(|| panic!("{precision}"))
            };
            assert!(
                found.iter().all(|precision| at_30(precision) > 0.3),
                "{found:?}"
            );
            assert_ne!(found[0], found[1]);
            expected = found;
        } else {
            assert_eq!(found, expected, "{layout:?}");
        }
    }
}

/// Rewrites every sweep below `folder`: intensities as bytes, stored by `write`.
fn rewrite_sweeps(folder: &Path, write: &dyn Fn(PointCloud) -> Vec<u8>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            rewrite_sweeps(&path, write);
        } else if path.extension().is_some_and(|kind| kind == "pcd") {
            let mut cloud = pcd::decode(&fs::read(&path).unwrap()).unwrap().points;
            cloud
                .xyzi
                .iter_mut()
                .for_each(|point| point[3] = (point[3] * 255.0).round());
            fs::write(path, write(cloud)).unwrap();
        }
    }
}

#[test]
fn intensity_in_three_spellings_gives_the_same_average_precision() {
    tch::set_num_threads(1);
    let unit = |mut cloud: PointCloud| {
        cloud.xyzi.iter_mut().for_each(|point| point[3] /= 255.0);
        pcd::encode(&cloud, Encoding::Binary, IntensityField::Intensity)
    };
    let byte = |cloud: PointCloud| pcd::encode(&cloud, Encoding::Binary, IntensityField::Intensity);
    let other_name = |cloud: PointCloud| {
        let file = byte(cloud);
        let at = file
            .windows(9)
            .position(|window| window == b"intensity")
            .unwrap();
        [&file[..at], b"Intensity", &file[at + 9..]].concat()
    };
    let spellings: [&dyn Fn(PointCloud) -> Vec<u8>; 3] = [&unit, &byte, &other_name];
    let found = spellings.map(|write| {
        let folder = tempfile::tempdir().unwrap();
        let options = SynthOptions::new(Subset::V2vdet, 1007, folder.path().to_owned());
        generate(
            &SynthOptions {
                frames: 4,
                agents: 2..=2,
                ..options
            },
            &|_| {},
        )
        .unwrap();
        rewrite_sweeps(folder.path(), write);
        let report = inspect(
            folder.path(),
            &OpenOptions::default(),
            &ProtocolConfig::default(),
            &|_, _| {},
        );
        assert!(report.problems.is_empty(), "{:?}", report.problems);
        METHODS.map(|method| average_precision(folder.path(), method))
    });
    assert!(found[0][1][0]["0.3"].as_f64().unwrap() > 0.3, "{found:?}");
    assert_eq!(found[1], found[0], "0 to 255");
    assert_eq!(found[2], found[0], "0 to 255 in a field Intensity");
}
