//! Generated scenes, read back like any other data set.

use std::collections::BTreeMap;
use std::fs;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use dataset::frame::{Frame, Object};
use dataset::pcd;
use dataset::{self, LoadOptions};
use nalgebra::Point3;
use protocol::{CameraMetadata, ImageFormat};
use simulator::generate::lidar::LIDAR_MOUNT_M;
use simulator::generate::{
    ImageSize, Subset, Summary, SynthError, SynthOptions, Weather, generate,
};
use simulator::map::RoadMapSource;

fn v2vdet(seed: u64, out: &Path) -> SynthOptions {
    SynthOptions {
        frames: 3,
        agents: 2..=3,
        ..SynthOptions::new(Subset::V2vdet, seed, out.to_owned())
    }
}

fn made(options: &SynthOptions) -> Summary {
    generate(options, &|_| {}).unwrap()
}

/// Every file below a folder: path and content.
fn contents(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files.extend(
                contents(&path)
                    .into_iter()
                    .map(|(name, bytes)| (path.file_name().unwrap().into(), name, bytes))
                    .map(|(parent, name, bytes): (PathBuf, PathBuf, Vec<u8>)| {
                        (parent.join(name), bytes)
                    }),
            );
        } else {
            files.insert(path.file_name().unwrap().into(), fs::read(&path).unwrap());
        }
    }
    files
}

/// All frames of all scenarios: by scenario and tick, one frame for each agent.
fn frames(folder: &Path) -> Vec<Vec<Frame>> {
    let dataset = dataset::open(folder).unwrap();
    assert!(dataset.problems.is_empty(), "{:?}", dataset.problems);
    let options = LoadOptions {
        lidar_variant: None,
        radar: true,
        ..LoadOptions::default()
    };
    let mut ticks = Vec::new();
    for scenario in &dataset.scenarios {
        for tick in 0..scenario.ticks.len() {
            ticks.push(
                (0..scenario.agents.len())
                    .map(|agent| scenario.load(agent, tick, &options).unwrap())
                    .collect(),
            );
        }
    }
    ticks
}

/// Number of points of a sweep in an object's box, grown by `margin_m`.
fn points_in(frame: &Frame, object: &Object, margin_m: f64) -> usize {
    let world_from_lidar = frame.world_from_lidar.unwrap().isometry();
    let object_from_lidar = object.world_from_object.isometry().inverse() * world_from_lidar;
    let is_inside = |&&[x, y, z, _]: &&[f32; 4]| {
        let point = object_from_lidar * Point3::new(x, y, z).cast::<f64>();
        (0..3).all(|axis| point[axis].abs() < 0.5 * object.size_m[axis] + margin_m)
    };
    frame.points.xyzi.iter().filter(is_inside).count()
}

#[test]
fn same_seed_same_bytes_on_any_number_of_threads() {
    let folders: Vec<_> = (0..3).map(|_| tempfile::tempdir().unwrap()).collect();
    made(&SynthOptions {
        scenes: 2,
        threads: 1,
        ..v2vdet(5, folders[0].path())
    });
    made(&SynthOptions {
        scenes: 2,
        threads: 3,
        ..v2vdet(5, folders[1].path())
    });
    made(&SynthOptions {
        scenes: 2,
        threads: 2,
        ..v2vdet(6, folders[2].path())
    });
    let [one, same, other] = [0, 1, 2].map(|index: usize| contents(folders[index].path()));
    assert!(one.len() > 20, "{} files", one.len());
    assert_eq!(
        one.keys().collect::<Vec<_>>(),
        same.keys().collect::<Vec<_>>()
    );
    for (path, bytes) in &one {
        assert!(*bytes == same[path], "{} differs", path.display());
    }
    assert_ne!(
        one.values().collect::<Vec<_>>(),
        other.values().collect::<Vec<_>>()
    );
}

#[test]
fn what_is_read_back_fits_together() {
    let folder = tempfile::tempdir().unwrap();
    let summary = made(&SynthOptions {
        scenes: 4,
        ..v2vdet(11, folder.path())
    });
    let ticks = frames(folder.path());
    assert_eq!(ticks.len(), 12);
    assert_eq!(ticks.iter().flatten().count(), summary.agent_frames);
    assert_eq!(
        ticks
            .iter()
            .flatten()
            .map(|frame| frame.points.len())
            .sum::<usize>(),
        summary.points
    );
    assert_eq!(
        ticks
            .iter()
            .flatten()
            .map(|frame| frame.objects.len())
            .sum::<usize>(),
        summary.annotations
    );
    let (mut met, mut listed_agents) = (0, 0);
    for frame in ticks.iter().flatten() {
        let vehicle = frame.world_from_vehicle.unwrap().isometry();
        let lidar = frame.world_from_lidar.unwrap().isometry();
        let mount = vehicle.inverse() * lidar;
        assert!((mount.translation.vector - nalgebra::Vector3::from(LIDAR_MOUNT_M)).norm() < 1e-6);
        let gnss = frame.gnss_world_from_vehicle.unwrap().isometry();
        let off = gnss.translation.vector - vehicle.translation.vector;
        assert!(off.norm() < 1.0 && off.norm() > 0.0, "{off}");
        // Moving vehicles are measured up to a sweep before the time of the annotation.
        let margin_m = |object: &Object| 0.2 + 0.05 * object.speed_mps.unwrap();
        let hidden = frame
            .objects
            .iter()
            .filter(|object| points_in(frame, object, margin_m(object)) == 0)
            .count();
        assert_eq!(hidden, 0, "annotated without a point");
        met += frame
            .objects
            .iter()
            .map(|object| points_in(frame, object, 0.1))
            .sum::<usize>();
    }
    assert!(met > 100 * summary.agent_frames, "{met} points on vehicles");
    for tick in &ticks {
        for (frame, other) in tick
            .iter()
            .flat_map(|frame| tick.iter().map(move |other| (frame, other)))
        {
            for object in &frame.objects {
                if let Some(same) = other.objects.iter().find(|same| same.id == object.id) {
                    assert_eq!(object, same, "two agents, one vehicle");
                }
                // The box of an agent in another agent's annotation is at its own pose.
                if object.id.to_string() == other.cav.as_str() {
                    assert_ne!(frame.cav, other.cav, "an agent lists itself");
                    let off = object.world_from_object.isometry().inverse()
                        * other.world_from_vehicle.unwrap().isometry();
                    assert!(
                        off.translation.vector.xy().norm() < 0.1 && off.rotation.angle() < 1e-6,
                        "{off}"
                    );
                    listed_agents += 1;
                }
            }
        }
    }
    assert!(listed_agents > 5, "{listed_agents}");
}

#[test]
fn scenes_are_as_dense_as_the_real_ones() {
    let folder = tempfile::tempdir().unwrap();
    let options = SynthOptions {
        scenes: 24,
        frames: 2,
        period_s: 1.0,
        ..v2vdet(21, folder.path())
    };
    let summary = made(&options);
    let per_frame = |count: usize| count as f64 / summary.agent_frames as f64;
    // 22 vehicles on average in V2VDet; 24 scenes scatter by about 2.
    assert!(
        (15.0..30.0).contains(&per_frame(summary.annotations)),
        "{}",
        per_frame(summary.annotations)
    );
    assert!(
        (45_000.0..62_000.0).contains(&per_frame(summary.points)),
        "{}",
        per_frame(summary.points)
    );
    let ticks = frames(folder.path());
    let (mut together, mut pairs) = (0, 0);
    for tick in &ticks {
        for agent in &tick[1..] {
            let place = |frame: &Frame| {
                frame
                    .world_from_lidar
                    .unwrap()
                    .isometry()
                    .translation
                    .vector
                    .xy()
            };
            together += usize::from((place(agent) - place(&tick[0])).norm() < 70.0);
            pairs += 1;
        }
        for frame in tick {
            let attenuated = frame.points.xyzi.iter().all(|&[x, y, z, intensity]| {
                (intensity - (-0.004 * (x * x + y * y + z * z).sqrt()).exp()).abs() < 0.01
            });
            assert!(
                attenuated,
                "intensity is a function of the range, as in CARLA"
            );
        }
    }
    assert!(
        together * 10 >= pairs * 9,
        "{together} of {pairs} companions are in range"
    );
}

#[test]
fn radar_sees_what_moves() {
    let folder = tempfile::tempdir().unwrap();
    made(&SynthOptions {
        scenes: 3,
        ..v2vdet(31, folder.path())
    });
    let (mut returns, mut moving) = (0, 0);
    for frame in frames(folder.path()).iter().flatten() {
        let radar = frame.radar.as_ref().unwrap();
        returns += radar.len();
        for &[x, y, z, red] in &radar.xyzi {
            assert!(
                x > 0.0 && (y / x).abs() < 1.9 && x.hypot(y).hypot(z) < 154.0,
                "{x} {y} {z}"
            );
            // Static objects approach at most at the speed of the vehicle, which it measures with 0.2 m/s of noise.
            let own = frame.speed_mps.unwrap() as f32;
            let velocity = (red - 0.5) * 2.0 * 64.0;
            moving += usize::from(velocity < -own - 2.0 || velocity > 2.0);
        }
    }
    assert!(
        returns > 2000 && moving > 10,
        "{moving} of {returns} returns are of moving vehicles"
    );
}

#[test]
fn traversals_of_a_town_differ_and_share_static_objects() {
    let folder = tempfile::tempdir().unwrap();
    let options = SynthOptions {
        scenes: 2,
        frames: 30,
        period_s: 1.0,
        ..SynthOptions::new(Subset::Town1loc, 3, folder.path().to_owned())
    };
    assert_eq!(made(&options).scenarios, 2);
    let ticks = frames(folder.path());
    assert!(ticks.iter().all(|tick| tick.len() == 1));
    let (first, second) = ticks.split_at(30);
    let path = |ticks: &[Vec<Frame>]| -> Vec<_> {
        ticks
            .iter()
            .map(|tick| {
                tick[0]
                    .world_from_lidar
                    .unwrap()
                    .isometry()
                    .translation
                    .vector
            })
            .collect()
    };
    let driven = |path: &[nalgebra::Vector3<f64>]| {
        path.windows(2)
            .map(|pair| (pair[1] - pair[0]).norm())
            .sum::<f64>()
    };
    let (first, second) = (path(first), path(second));
    assert!(
        driven(&first) > 40.0 && driven(&second) > 40.0,
        "{} {}",
        driven(&first),
        driven(&second)
    );
    assert_ne!(first, second);
}

#[test]
fn weather_takes_the_far_and_adds_clutter() {
    let farthest = |weather: Weather| {
        let folder = tempfile::tempdir().unwrap();
        made(&SynthOptions {
            weather,
            frames: 1,
            ..v2vdet(41, folder.path())
        });
        let ticks = frames(folder.path());
        let mut ranges: Vec<f32> = ticks[0][0]
            .points
            .xyzi
            .iter()
            .map(|&[x, y, z, _]| (x * x + y * y + z * z).sqrt())
            .collect();
        ranges.sort_unstable_by(f32::total_cmp);
        (ranges[0], ranges[ranges.len() * 99 / 100], ranges.len())
    };
    let (sunny, fog, snow) = (
        farthest(Weather::Sunny),
        farthest(Weather::Fog),
        farthest(Weather::Snow),
    );
    assert!(fog.1 < 45.0 && sunny.1 > 60.0, "{sunny:?} {fog:?}");
    assert!(snow.1 < sunny.1 && snow.1 > fog.1, "{snow:?}");
    assert!(
        fog.0 < 2.0 && snow.0 < 2.5,
        "flakes and drops near the sensor: {fog:?} {snow:?}"
    );
    assert!(fog.2 < sunny.2 && snow.2 > sunny.2 * 8 / 10);
}

#[test]
fn weather_copies_lie_beside_the_plain_sweep_and_change_nothing_else() {
    let (plain, copied) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    made(&SynthOptions {
        frames: 1,
        ..v2vdet(41, plain.path())
    });
    let copies = vec![Weather::Fog, Weather::Snow];
    made(&SynthOptions {
        frames: 1,
        copies,
        ..v2vdet(41, copied.path())
    });
    let dataset = dataset::open(copied.path()).unwrap();
    assert!(dataset.problems.is_empty(), "{:?}", dataset.problems);
    let scenario = &dataset.scenarios[0];
    assert_eq!(scenario.lidar_variants, ["fog_0.060", "snow_2.5_2.0"]);
    let points = |variant: Option<&str>| {
        let options = LoadOptions {
            lidar_variant: variant.map(str::to_owned),
            ..LoadOptions::default()
        };
        scenario.load(0, 0, &options).unwrap().points.len()
    };
    assert!(
        points(Some("fog_0.060")) < points(None) && points(Some("snow_2.5_2.0")) != points(None)
    );
    let mut files = contents(copied.path());
    files.retain(|path, _| {
        !path.to_string_lossy().contains("fog_") && !path.to_string_lossy().contains("snow_")
    });
    assert_eq!(files, contents(plain.path()));
}

#[test]
fn weather_copies_label_airborne_points() {
    let folder = tempfile::tempdir().unwrap();
    made(&SynthOptions {
        frames: 1,
        copies: vec![Weather::Fog, Weather::Snow],
        ..v2vdet(42, folder.path())
    });
    let files = contents(folder.path());
    // The first file of each variant is of the first agent.
    let sweep = |variant: &str| {
        let is_wanted = |path: &Path| {
            let stem = path
                .extension()
                .is_some_and(|kind| kind == "pcd")
                .then(|| path.file_stem().unwrap());
            stem.is_some_and(|stem| {
                stem.to_str()
                    .unwrap()
                    .split_once('_')
                    .map_or("", |(_, variant)| variant)
                    == variant
            })
        };
        let (_, bytes) = files.iter().find(|(path, _)| is_wanted(path)).unwrap();
        pcd::decode(bytes).unwrap()
    };
    let plain = sweep("");
    assert_eq!(plain.labels, None);
    for variant in ["fog_0.060", "snow_2.5_2.0"] {
        let copy = sweep(variant);
        let labels = copy.labels.unwrap();
        assert!(labels.iter().all(|label| *label <= 1));
        // The noise of a range is some centimetres; the plain sweep loses other rays.
        let share_in_plain = |wanted: u8| {
            let labelled = copy
                .points
                .xyzi
                .iter()
                .zip(&labels)
                .filter(|(_, label)| **label == wanted);
            let some: Vec<_> = labelled.map(|(point, _)| point).step_by(37).collect();
            let is_near = |a: &[f32; 4], b: &[f32; 4]| {
                (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f32>() < 0.15 * 0.15
            };
            let found = some
                .iter()
                .filter(|point| plain.points.xyzi.iter().any(|other| is_near(point, other)));
            found.count() as f64 / some.len() as f64
        };
        let (clean, clutter) = (share_in_plain(0), share_in_plain(1));
        assert!(
            clean > 0.8 && clutter < 0.2,
            "{variant}: {clean:.2} of the clean points, {clutter:.2} of the clutter"
        );
    }
}

#[test]
fn a_folder_in_use_is_not_changed() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("mine.txt"), "keep").unwrap();
    let options = SynthOptions {
        frames: 1,
        ..v2vdet(1, folder.path())
    };
    let refused = generate(&options, &|_| {}).unwrap_err();
    assert!(
        matches!(&refused, SynthError::NotEmpty(path) if path == folder.path()),
        "{refused}"
    );
    assert_eq!(contents(folder.path()).len(), 1);
    made(&SynthOptions {
        force: true,
        ..options
    });
    assert_eq!(fs::read(folder.path().join("mine.txt")).unwrap(), b"keep");
}

#[test]
fn bad_options_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let message = |options: SynthOptions| generate(&options, &|_| {}).unwrap_err().to_string();
    let period = message(SynthOptions {
        period_s: 0.12,
        ..v2vdet(1, folder.path())
    });
    assert_eq!(
        period,
        "--period-s is 0.12: must be a multiple of 0.05 s up to 500 s"
    );
    let agents = message(SynthOptions {
        agents: RangeInclusive::new(4, 2),
        ..v2vdet(1, folder.path())
    });
    assert_eq!(
        agents,
        "--vehicles is \"4-2\": must be a number or a range within 1-7"
    );
    let copies = message(SynthOptions {
        copies: vec![Weather::Sunny],
        ..v2vdet(1, folder.path())
    });
    assert_eq!(
        copies,
        "--weather-copies is \"sunny\": must be fog, snow or both"
    );
    let map = Some(RoadMapSource::OpenDrive("no/such/map.xodr".into()));
    let missing = message(SynthOptions {
        map,
        ..v2vdet(1, folder.path())
    });
    assert!(missing.contains("no/such/map.xodr"), "{missing}");
}

#[test]
fn cameras_are_read_with_the_calibration_that_they_were_rendered_with() {
    let dir = tempfile::tempdir().unwrap();
    let size = ImageSize {
        width_px: 96,
        height_px: 60,
    };
    let options = SynthOptions {
        cameras: Some(size),
        frames: 2,
        agents: 2..=2,
        ..v2vdet(12, dir.path())
    };
    made(&options);
    let dataset = dataset::open(dir.path()).unwrap();
    let scenario = &dataset.scenarios[0];
    assert_eq!(
        (&scenario.cameras[..], dataset.problems.len()),
        (&[0, 1, 2, 3][..], 0)
    );
    let load = LoadOptions {
        cameras: true,
        ..LoadOptions::default()
    };
    let frame = scenario.load(1, 1, &load).unwrap();
    assert!(frame.problems.is_empty(), "{:?}", frame.problems);
    let mounts_m = [
        [3.0, 0.0, -0.95],
        [0.5, -0.3, -0.15],
        [0.5, 0.3, -0.15],
        [-1.5, 0.0, -0.45],
    ];
    for ((number, camera), mount_m) in frame.cameras.iter().zip(mounts_m) {
        let CameraMetadata {
            format,
            width_px,
            height_px,
            pinhole,
            lidar_from_camera,
        } = camera.metadata;
        assert_eq!((format, width_px, height_px), (ImageFormat::Png, 96, 60));
        let found = lidar_from_camera.unwrap();
        let off_m = (0..3)
            .map(|axis| (found.translation_m[axis] - mount_m[axis]).abs())
            .fold(0.0, f64::max);
        assert!(off_m < 1e-3, "camera {number}: {found:?}");
        // 50 degrees to the right of the optical axis is the right edge.
        let [column, row] = pinhole
            .unwrap()
            .project([50f64.to_radians().tan(), 0.0, 1.0])
            .unwrap();
        assert!((column - 96.0).abs() < 1e-6 && (row - 30.0).abs() < 1e-6);
    }
    assert_eq!(frame.cameras.len(), 4);
    // A broken image is left out and named; the rest of the frame is used.
    let broken = dir
        .path()
        .join(&scenario.name)
        .join(scenario.agents[1].as_str());
    std::fs::write(
        broken.join(format!("{}_camera2.png", scenario.ticks[1].stem)),
        b"no image",
    )
    .unwrap();
    let frame = scenario.load(1, 1, &load).unwrap();
    assert_eq!(
        frame
            .cameras
            .iter()
            .map(|(number, _)| *number)
            .collect::<Vec<_>>(),
        [0, 1, 3]
    );
    assert!(
        frame.problems[0].message.contains("_camera2.png"),
        "{:?}",
        frame.problems
    );
    // One that is missing too.
    std::fs::remove_file(broken.join(format!("{}_camera2.png", scenario.ticks[1].stem))).unwrap();
    let frame = scenario.load(1, 1, &load).unwrap();
    assert_eq!(frame.cameras.len(), 3);
    assert!(
        frame.problems[0]
            .message
            .contains("there is no image of this camera"),
        "{:?}",
        frame.problems
    );
    assert!(
        scenario
            .load(1, 1, &LoadOptions::default())
            .unwrap()
            .cameras
            .is_empty()
    );
}
