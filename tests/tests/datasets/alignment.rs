//! Alignment of two vehicles on real and generated sweeps.

use std::collections::HashSet;
use std::process::Command;
use std::sync::Arc;

use agent_offline::icp_map::{IcpMapPose, read_map};
use dataset::frame::Frame;
use dataset::pcd;
use dataset::{self, LeftOut, LoadOptions};
use ego_fuser_offline::alignment::{AlignmentSpec, BoxIcp, CloudIcp, FreeAlign, Poses};
use ego_fuser_offline::evaluation::alignment::table::PairTally;
use ego_fuser_offline::evaluation::alignment::{self, BoxSource, PairOutcome};
use localization::pose_source::{PoseSource, RecordedPose};
use localization::registration::icp::{self, IcpConfig, IcpSource, IcpTarget};
use nalgebra::{Isometry3, Matrix4, Point3};
use protocol::{PointCloud, Pose};
use simulator::generate::{Subset, SynthOptions, generate};
use tests::fixtures::data;
use tests::fleet::programs;

/// Difference between two motions, metres and degrees.
fn off(truth: &Isometry3<f64>, found: &Isometry3<f64>) -> (f64, f64) {
    let off = truth.inv_mul(found);
    (
        off.translation.vector.norm(),
        off.rotation.angle().to_degrees(),
    )
}

/// Number of voxels of 0.2 m of `target` in which a moved `source` has points too.
fn overlap(target: &PointCloud, source: &PointCloud, target_from_source: &Isometry3<f64>) -> usize {
    let voxels = |cloud: &PointCloud, motion: &Isometry3<f64>| -> HashSet<[i64; 3]> {
        let moved = |&[x, y, z, _]: &[f32; 4]| motion * Point3::new(x, y, z).cast();
        cloud
            .xyzi
            .iter()
            .map(moved)
            .map(|p: Point3<f64>| [p.x, p.y, p.z].map(|v| (v / 0.2).floor() as i64))
            .collect()
    };
    voxels(target, &Isometry3::identity())
        .intersection(&voxels(source, target_from_source))
        .count()
}

/// Registers a sweep with one taken shortly before. Their known motion has an error of some decimetres itself, so the
/// sweeps are the criterion: after registration they must overlap at least as well.
fn follow(target: &PointCloud, source: &PointCloud, known: &Isometry3<f64>) {
    let config = IcpConfig::default();
    let planes = IcpTarget::of_sweep(&target.xyzi, &config);
    let decimate = IcpSource::of_sweep(&source.xyzi);
    let found = icp::register(&decimate, &planes, &Isometry3::identity(), &config)
        .unwrap()
        .target_from_source;
    let (metres, degrees) = off(known, &found);
    assert!(
        metres < 0.25 && degrees < 0.6,
        "{metres} m, {degrees} degrees"
    );
    let [before, by_known, by_found] =
        [&Isometry3::identity(), known, &found].map(|motion| overlap(target, source, motion));
    assert!(
        100 * by_found > 98 * by_known && by_found > before,
        "{before} as given, {by_known} known, {by_found} found"
    );
}

#[test]
#[ignore = "needs V2V_DATA"]
fn icp_places_two_real_scans_as_another_registration_did() {
    let folder = data("fast_gicp-pair");
    let [target, source] = ["251370668.pcd", "251371071.pcd"].map(|name| {
        pcd::decode(&std::fs::read(folder.join(name)).unwrap())
            .unwrap()
            .points
    });
    let text = std::fs::read_to_string(folder.join("relative.txt")).unwrap();
    let numbers: Vec<f64> = text
        .split_whitespace()
        .map(|number| number.parse().unwrap())
        .collect();
    follow(
        &target,
        &source,
        &Pose::from_matrix(&Matrix4::from_row_slice(&numbers))
            .unwrap()
            .isometry(),
    );
}

#[test]
#[ignore = "needs V2V_DATA"]
fn icp_follows_a_real_drive() {
    let folder = data("kitti-odometry-00");
    let scenario = dataset::open(&folder).unwrap().scenarios.remove(0);
    let frames: Vec<_> = (0..scenario.ticks.len())
        .map(|tick| scenario.load(0, tick, &LoadOptions::default()).unwrap())
        .collect();
    let mut pairs = 0;
    for pair in frames.windows(2) {
        let known = pair[0]
            .world_from_lidar
            .unwrap()
            .from_world(&pair[1].world_from_lidar.unwrap())
            .isometry();
        if known.translation.vector.norm() < 5.0 {
            follow(&pair[0].points, &pair[1].points, &known);
            pairs += 1;
        }
    }
    assert!(pairs >= 2, "{pairs}");
}

/// Outcomes of methods on a folder.
fn outcomes(folder: &std::path::Path, methods: &[AlignmentSpec]) -> Vec<PairOutcome> {
    let mut found = Vec::new();
    for scenario in dataset::open(folder).unwrap().scenarios {
        let ticks = 0..scenario.ticks.len();
        alignment::run(
            methods,
            &mut BoxSource::Annotated,
            (&scenario, 70.0),
            ticks,
            &mut |outcome| found.push(outcome),
        )
        .unwrap();
    }
    found
}

#[test]
fn approaches_meet_on_generated_scenes() {
    let folder = tempfile::tempdir().unwrap();
    let scenes = folder.path().join("scenes");
    let options = SynthOptions::new(Subset::V2vdet, 7, scenes.clone());
    generate(
        &SynthOptions {
            frames: 3,
            agents: 2..=2,
            scenes: 2,
            ..options
        },
        &|_| {},
    )
    .unwrap();
    // A point cloud map of the scenes themselves: exact, so that any error is one of the registration.
    let config = IcpConfig::default();
    no_map_of_nothing(folder.path());
    let map = Arc::new(read_map(&[&scenes], 1.0, &config, &mut LeftOut::default()).unwrap());
    assert!(map.planes() > 1000);
    let source = IcpMapPose::new(map, config);
    let methods = [
        Poses::spec(
            "true",
            |frame| frame.world_from_lidar,
            || Ok(Box::new(RecordedPose)),
        ),
        Poses::spec("gnss", Frame::gnss_world_from_lidar, || {
            Ok(Box::new(RecordedPose))
        }),
        Poses::spec("icp-map", Frame::gnss_world_from_lidar, move || {
            Ok(Box::new(source.clone()) as Box<dyn PoseSource>)
        }),
        CloudIcp::spec(false),
        CloudIcp::spec(true),
        BoxIcp::spec(),
        FreeAlign::spec(),
    ];
    let found = outcomes(&scenes, &methods);
    let rows: Vec<_> = (methods.iter().enumerate())
        .map(|(number, method)| {
            let mut tally = PairTally::default();
            found
                .iter()
                .filter(|outcome| outcome.method == number)
                .for_each(|outcome| tally.add(outcome));
            tally.row(&method.name)
        })
        .collect();
    let [exact, gnss, map, icp, icp_gnss, box_icp, free_align] = &rows[..] else {
        panic!("{rows:?}")
    };
    assert!(
        rows.iter()
            .all(|row| row.pairs == exact.pairs && row.pairs > 0)
    );
    assert!(
        exact.success_1m == 1.0 && exact.mean_m.unwrap() < 1e-6,
        "{exact:?}"
    );
    // Poses have some dozen bytes, boxes some hundred, sweeps some ten thousand.
    assert!(
        exact.log2_bytes.unwrap() < 7.0
            && (6.0..13.0).contains(&free_align.log2_bytes.unwrap())
            && icp.log2_bytes.unwrap() > 14.0,
        "{rows:?}"
    );
    assert!(map.success_1m > 0.9 && map.p50_m < gnss.p50_m, "{rows:?}");
    assert!(
        icp_gnss.success_3m >= icp.success_3m && box_icp.not_aligned <= free_align.not_aligned,
        "{rows:?}"
    );
}

fn no_map_of_nothing(folder: &std::path::Path) {
    let empty = folder.join("nothing");
    std::fs::create_dir(&empty).unwrap();
    assert!(
        read_map(
            &[&empty],
            1.0,
            &IcpConfig::default(),
            &mut LeftOut::default()
        )
        .is_err()
    );
}

#[test]
#[ignore = "needs V2V_DATA"]
fn the_command_compares_recorded_vehicles() {
    let scene = data("v2xset-scene");
    let folder = tempfile::tempdir().unwrap();
    let source = folder.path().join("noisy.yaml");
    std::fs::write(
        &source,
        "noisy:\n  mode: independent\n  position_std_m: 0.1\n  heading_std_deg: 0.1\n",
    )
    .unwrap();
    let run = |arguments: &[&str]| {
        let output = Command::new(programs().join("ego-fuser"))
            .arg("align")
            .args(arguments)
            .output()
            .unwrap();
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        (
            output.status.code(),
            text(&output.stdout),
            text(&output.stderr),
        )
    };
    let scene = scene.to_str().unwrap();
    let named = format!("noisy={}", source.display());
    let (code, stdout, error) = run(&[
        "--dataset",
        scene,
        "--boxes",
        "annotated",
        "--method",
        "icp-gnss",
        "free-align",
        "--pose-source",
        &named,
        "--json",
    ]);
    assert_eq!(code, Some(0), "{error}");
    let rows: Vec<serde_json::Value> = serde_json::from_str(&stdout).unwrap();
    let of = |method: &str| rows.iter().find(|row| row["method"] == method).unwrap();
    assert_eq!((rows.len(), of("noisy")["pairs"].as_u64()), (3, Some(1)));
    assert_eq!(of("noisy")["success_1m"], 1.0, "{stdout}");
    assert!(
        of("icp-gnss")["log2_bytes"].as_f64().unwrap() > 14.0,
        "{stdout}"
    );

    let (code, _, error) = run(&["--dataset", scene, "--method", "free-align"]);
    assert_eq!(code, Some(2), "{error}");
    assert!(error.contains("--weights"), "{error}");
    let (code, _, error) = run(&[
        "--dataset",
        scene,
        "--method",
        "icp-map",
        "--boxes",
        "annotated",
    ]);
    assert!(code == Some(2) && error.contains("--icp-map"), "{error}");
    let (code, _, error) = run(&[
        "--dataset",
        folder.path().join("none").to_str().unwrap(),
        "--boxes",
        "annotated",
    ]);
    assert!(code == Some(2) && error.contains("none"), "{error}");
    let (code, table, error) = run(&[
        "--dataset",
        scene,
        "--boxes",
        "annotated",
        "--method",
        "gnss",
        "box-icp",
    ]);
    assert_eq!(code, Some(0), "{error}");
    assert!(
        table.starts_with("| method | time, s |") && table.contains("| box-icp |"),
        "{table}"
    );
}
