//! `agent locate` and `agent map`: one sweep in every format, foreign and unreadable clouds, and a map of a robot's bag.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use dataset::LoadOptions;
use mcap::records::MessageHeader;
use re_cdr::{CdrWriter, LittleEndian};
use serde_json::Value;
use simulator::generate::{Subset, SynthOptions, generate};
use tests::fleet::programs;

/// Weights of the repository.
fn weights(name: &str) -> String {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../deploy/weights")
        .join(name)
        .display()
        .to_string()
}

fn agent(arguments: &[&str]) -> Output {
    Command::new(programs().join("agent"))
        .args(arguments)
        .output()
        .unwrap()
}

/// A short drive through a town of [`Subset::Town1loc`].
fn drive(out: &Path, frames: usize, period_s: f64) -> PathBuf {
    let options = SynthOptions {
        frames,
        period_s,
        ..SynthOptions::new(Subset::Town1loc, 903, out.to_owned())
    };
    generate(&options, &|_| {}).unwrap();
    out.to_owned()
}

fn little_endian(points: &[[f32; 4]]) -> Vec<u8> {
    points
        .iter()
        .flatten()
        .flat_map(|number| number.to_le_bytes())
        .collect()
}

/// The same points in every format; the returned files are named by their endings.
fn write_all(folder: &Path, points: &[[f32; 4]]) -> Vec<PathBuf> {
    let count = points.len();
    let pcd = format!(
        "VERSION .7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nWIDTH {count}\nHEIGHT 1\nDATA binary\n"
    );
    let ply = points.iter().fold(
        format!(
            "ply\nformat ascii 1.0\nelement vertex {count}\nproperty float x\nproperty float y\nproperty float z\n\
             property float intensity\nend_header\n"
        ),
        |mut text, [x, y, z, intensity]| {
            let _ = writeln!(text, "{x} {y} {z} {intensity}");
            text
        },
    );
    let npy = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({count}, 4), }}\n");
    let npy_head = [
        b"\x93NUMPY\x01\x00",
        &u16::try_from(npy.len()).unwrap().to_le_bytes()[..],
        npy.as_bytes(),
    ]
    .concat();
    let body = little_endian(points);
    let files = [
        ("sweep.bin", body.clone()),
        ("sweep.npy", [npy_head, body.clone()].concat()),
        ("sweep.pcd", [pcd.into_bytes(), body].concat()),
        ("sweep.ply", ply.into_bytes()),
    ];
    files
        .map(|(name, bytes)| (folder.join(name), bytes))
        .map(|(path, bytes)| fs::write(&path, bytes).map(|()| path).unwrap())
        .into()
}

/// One JSON object per line.
/// `sensor_msgs/PointCloud2` of x, y, z and intensity in single precision.
fn point_cloud(nanos: u64, points: &[[f32; 4]]) -> Vec<u8> {
    let mut bytes = vec![0, 1, 0, 0];
    let mut cdr = CdrWriter::<LittleEndian>::new(&mut bytes);
    cdr.write_i32((nanos / 1_000_000_000) as i32);
    cdr.write_u32((nanos % 1_000_000_000) as u32);
    cdr.write_string("os_sensor");
    cdr.write_u32(1);
    cdr.write_u32(points.len() as u32);
    cdr.write_sequence_length(4);
    for (offset, name) in (0..).step_by(4).zip(["x", "y", "z", "intensity"]) {
        cdr.write_string(name);
        cdr.write_u32(offset);
        cdr.write_u8(7);
        cdr.write_u32(1);
    }
    cdr.write_bool(false);
    cdr.write_u32(16);
    cdr.write_u32(16 * points.len() as u32);
    cdr.write_bytes(&little_endian(points));
    cdr.write_bool(true);
    bytes
}

/// Writes a drive as the bag of a robot that records its sweeps, and where they are as transforms.
fn write_bag(scene: &Path, bag: &Path) {
    let options = mcap::WriteOptions::new().profile("ros2");
    let mut writer = options.create(fs::File::create(bag).unwrap()).unwrap();
    let mut channel = |topic: &str, type_name: &str| {
        let schema = writer.add_schema(type_name, "ros2msg", b"").unwrap();
        let none = std::collections::BTreeMap::new();
        writer.add_channel(schema, topic, "cdr", &none).unwrap()
    };
    let channels = [
        channel("/tf", "tf2_msgs/msg/TFMessage"),
        channel("/points", "sensor_msgs/msg/PointCloud2"),
    ];
    let scenario = &dataset::open(scene).unwrap().scenarios[0];
    for tick in 0..scenario.ticks.len() {
        let frame = scenario.load(0, tick, &LoadOptions::default()).unwrap();
        let nanos = 1_000_000_000_000 + frame.capture_nanos;
        let pose = frame.world_from_lidar.unwrap();
        let place = ("map".to_owned(), "os_sensor".to_owned(), pose);
        let messages = [
            ros2::transforms(nanos, &[place]),
            point_cloud(nanos, &frame.points.xyzi),
        ];
        for (channel_id, message) in channels.into_iter().zip(messages) {
            let head = MessageHeader {
                channel_id,
                sequence: 0,
                log_time: nanos,
                publish_time: nanos,
            };
            writer.write_to_known_channel(&head, &message).unwrap();
        }
    }
    writer.finish().unwrap();
}

fn objects(output: &Output) -> Vec<Value> {
    String::from_utf8_lossy(&output.stdout)
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect()
}

fn position_m(located: &Value) -> [f64; 3] {
    serde_json::from_value(located["pose"]["position_m"].clone()).unwrap()
}

#[test]
fn the_same_sweep_has_the_same_pose_in_every_format_and_a_foreign_cloud_has_none() {
    let folder = tempfile::tempdir().unwrap();
    let scene = drive(&folder.path().join("drive"), 2, 3.0);
    let scenario = &dataset::open(&scene).unwrap().scenarios[0];
    let frame = scenario.load(0, 1, &LoadOptions::default()).unwrap();
    let truth = frame.world_from_lidar.unwrap();
    let clouds = folder.path().join("clouds");
    fs::create_dir(&clouds).unwrap();
    // Duplicates, points without a return and without a number change nothing.
    let mut points = frame.points.xyzi;
    points.extend([[0.0; 4], [f32::NAN, 1.0, 2.0, 0.5], points[7]]);
    write_all(&clouds, &points);
    let head = weights("pgc-town1.safetensors");
    let whole = scenario.points_path(0, 1, None).unwrap();
    let located = agent(&[
        "locate",
        clouds.to_str().unwrap(),
        whole.to_str().unwrap(),
        "--head",
        &head,
        "--json",
    ]);
    assert_eq!(
        located.status.code(),
        Some(0),
        "{}",
        String::from_utf8_lossy(&located.stderr)
    );
    let objects_found = objects(&located);
    assert_eq!(objects_found.len(), 5, "{objects_found:?}");
    let bag = folder.path().join("drive.mcap");
    write_bag(&scene, &bag);
    let of_bag = objects(&agent(&[
        "locate",
        bag.to_str().unwrap(),
        "--head",
        &head,
        "--json",
    ]));
    assert_eq!(of_bag.len(), 2, "{of_bag:?}");
    // Equal within a tenth of a millimetre.
    let [of_bag, of_file] = [&of_bag[1], &objects_found[0]].map(position_m);
    for axis in 0..3 {
        assert!((of_bag[axis] - of_file[axis]).abs() < 1e-4, "{of_bag:?}");
    }
    for object in &objects_found[..4] {
        let position = position_m(object);
        let off: f64 = (0..3)
            .map(|axis| (position[axis] - truth.translation_m[axis]).powi(2))
            .sum::<f64>()
            .sqrt();
        assert!(off < 1.0, "{object}: {:?}", truth.translation_m);
        assert_eq!(object["pose"], objects_found[0]["pose"]);
        assert_eq!(
            (&object["points_left_out"], &object["is_mirrored"]),
            (&Value::from(2), &Value::from(false))
        );
        let yaw = object["pose"]["roll_pitch_yaw_deg"][2].as_f64().unwrap();
        assert!(
            (yaw - truth.yaw_rad().to_degrees()).abs() < 1.0 && object["map"] == "town1",
            "{object}"
        );
    }
    // The file of the data set is left-handed; the one of the same points alone is found with y negated.
    let alone = folder.path().join("alone.pcd");
    fs::copy(&whole, &alone).unwrap();
    let located = agent(&["locate", alone.to_str().unwrap(), "--head", &head, "--json"]);
    assert_eq!(objects(&located)[0]["is_mirrored"], true);

    let foreign: Vec<[f32; 4]> = (0..4000)
        .map(|k| {
            [
                (k % 50) as f32 * 0.2 + 3.0,
                5.1,
                (k / 50) as f32 * 0.05 - 1.5,
                0.1,
            ]
        })
        .collect();
    fs::write(folder.path().join("foreign.bin"), little_endian(&foreign)).unwrap();
    let foreign = folder.path().join("foreign.bin");
    let located = agent(&[
        "locate",
        foreign.to_str().unwrap(),
        alone.to_str().unwrap(),
        "--head",
        &head,
    ]);
    let text = String::from_utf8_lossy(&located.stdout).into_owned();
    assert_eq!(
        (located.status.code(), text.lines().count()),
        (Some(3), 2),
        "{text}"
    );
    assert!(text.contains("foreign.bin: no pose, "), "{text}");
}

#[test]
fn a_bad_cloud_is_named_and_the_others_are_located() {
    let folder = tempfile::tempdir().unwrap();
    let scene = drive(&folder.path().join("drive"), 1, 3.0);
    let whole = dataset::open(&scene).unwrap().scenarios[0]
        .points_path(0, 0, None)
        .unwrap();
    let bad = folder.path().join("bad.ply");
    fs::write(
        &bad,
        "ply\nformat ascii 1.0\nelement vertex 2\nend_header\n",
    )
    .unwrap();
    let head = weights("pgc-town1.safetensors");
    let located = agent(&[
        "locate",
        bad.to_str().unwrap(),
        whole.to_str().unwrap(),
        "--head",
        &head,
    ]);
    let (out, err) = (
        String::from_utf8_lossy(&located.stdout),
        String::from_utf8_lossy(&located.stderr),
    );
    assert_eq!(
        (located.status.code(), out.lines().count()),
        (Some(2), 1),
        "{out}{err}"
    );
    assert!(
        err.contains("bad.ply: element vertex has no property x")
            && err.contains("1 cannot be read"),
        "{err}"
    );
    let none = agent(&[
        "locate",
        whole.to_str().unwrap(),
        "--head",
        "town-that-nobody-drove",
    ]);
    let err = String::from_utf8_lossy(&none.stderr);
    assert_eq!(none.status.code(), Some(2));
    assert!(
        err.contains("town-that-nobody-drove: no such file or released head"),
        "{err}"
    );
}

#[test]
fn a_map_of_a_drive_finds_its_sweeps_and_reports_where_it_was_driven() {
    let folder = tempfile::tempdir().unwrap();
    let scene = drive(&folder.path().join("drive"), 30, 0.5);
    let out = folder.path().join("my place");
    // As a robot records it.
    let bag = folder.path().join("drive.mcap");
    write_bag(&scene, &bag);
    let (bag_text, out_text) = (bag.to_str().unwrap(), out.to_str().unwrap());
    let encoder = weights("pgc-encoder.safetensors");
    let arguments = [
        "map",
        bag_text,
        "--out",
        out_text,
        "--encoder",
        &encoder,
        "--minutes",
        "1",
        "--json",
    ];
    let made = agent(&arguments);
    let err = String::from_utf8_lossy(&made.stderr);
    assert_eq!(made.status.code(), Some(0), "{err}");
    let report: Value = serde_json::from_slice(&made.stdout).unwrap();
    assert_eq!(
        (&report["place"], &report["held_out"]["sweeps"]),
        (&Value::from("my place"), &Value::from(4)),
        "{report}"
    );
    assert!(
        report["held_out"]["under_3m"].as_f64().unwrap() >= 0.25,
        "{report}"
    );
    assert_eq!(
        report["coverage"]["sweeps"], report["training_sweeps"],
        "{report}"
    );
    let card = fs::read_to_string(out.join("model-card.md")).unwrap();
    assert!(
        card.contains("Roads that were not driven give no pose"),
        "{card}"
    );
    // The folder is all that is needed.
    let whole = dataset::open(&scene).unwrap().scenarios[0]
        .points_path(0, 3, None)
        .unwrap();
    let located = agent(&["locate", whole.to_str().unwrap(), "--head", out_text]);
    assert_eq!(
        located.status.code(),
        Some(0),
        "{}",
        String::from_utf8_lossy(&located.stdout)
    );
    assert!(!String::from_utf8_lossy(&located.stderr).contains("another LiDAR"));
    let cloud = whole.to_str().unwrap();
    let least = |least: &str| {
        let with_map = [
            "locate",
            cloud,
            "--head",
            out_text,
            "--surfel-map",
            out_text,
        ];
        agent(&[&with_map[..], &["--min-confidence", least]].concat())
    };
    assert_eq!(least("0").status.code(), Some(0));
    let strict = least("1");
    let text = String::from_utf8_lossy(&strict.stdout);
    assert!(
        strict.status.code() == Some(3) && text.contains("low confidence"),
        "{text}"
    );
    assert_eq!(least("1.5").status.code(), Some(2));
    // Without a head the cloud is sought among the planes of the place.
    let surfels = out.join("surfels.safetensors").display().to_string();
    let at = [
        ["--head", out_text, "--surfel-map", out_text].as_slice(),
        &["--head", &surfels],
    ]
    .map(|place| {
        let located = agent(&[&["locate", cloud, "--json"], place].concat());
        assert_eq!(located.status.code(), Some(0), "{place:?}");
        position_m(&objects(&located)[0])
    });
    let off_m = at[0]
        .iter()
        .zip(at[1])
        .map(|(with, without)| (with - without).abs());
    assert!(off_m.fold(0.0, f64::max) < 0.02, "{at:?}");
    // The planes of this place are of no use to the head of another.
    let town1 = weights("pgc-town1.safetensors");
    let other = agent(&["locate", cloud, "--head", &town1, "--surfel-map", out_text]);
    let err = String::from_utf8_lossy(&other.stderr);
    assert!(
        other.status.code() == Some(2)
            && err.contains("a surfel map of \"my place\", the head is of \"town1\""),
        "{err}"
    );
    // One of fewer lasers.
    let frame = dataset::open(&scene).unwrap().scenarios[0]
        .load(0, 3, &LoadOptions::default())
        .unwrap();
    let sparse = folder.path().join("sparse.bin");
    let points: Vec<[f32; 4]> = frame.points.xyzi.iter().copied().step_by(4).collect();
    fs::write(&sparse, little_endian(&points)).unwrap();
    let located = agent(&["locate", sparse.to_str().unwrap(), "--head", out_text]);
    let err = String::from_utf8_lossy(&located.stderr);
    assert!(
        err.contains(&format!("the sweeps have {} points", points.len()))
            && err.contains("another LiDAR"),
        "{err}"
    );
    let again = agent(&arguments);
    assert_eq!(again.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&again.stderr).contains("it already holds a training"));
}

#[test]
fn a_head_gets_the_area_of_its_drives_and_other_files_stay_as_they_are() {
    let folder = tempfile::tempdir().unwrap();
    let drives = drive(&folder.path().join("drives"), 3, 1.0);
    let drives = drives.to_str().unwrap();
    let [head, detector] = ["pgc-town1.safetensors", "lean-none.safetensors"].map(|name| {
        let path = folder.path().join(name);
        fs::copy(weights(name), &path).unwrap();
        path.display().to_string()
    });
    let output = agent(&["cover", "--dataset", drives, "--head", &head]);
    let text = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    assert!(
        text.contains("cells of 25 m") && text.contains('#'),
        "{text}"
    );
    let notes = String::from_utf8_lossy(&output.stderr);
    assert!(notes.contains("cells is replaced by one of"), "{notes}");
    let town4 = folder.path().join("pgc-town4.safetensors");
    fs::copy(weights("pgc-town4.safetensors"), &town4).unwrap();
    let town4 = town4.to_str().unwrap();
    let refused = agent(&["cover", "--dataset", drives, "--head", town4]);
    let error = String::from_utf8_lossy(&refused.stderr);
    assert_eq!(refused.status.code(), Some(2), "{error}");
    assert!(
        error.contains("a head of town4, the drives are through town1"),
        "{error}"
    );
    assert_ne!(
        fs::read(&head).unwrap(),
        fs::read(weights("pgc-town1.safetensors")).unwrap()
    );
    // The head is read as before, and knows the area.
    let encoder = weights("pgc-encoder.safetensors");
    let options = [
        "eval",
        "--dataset",
        drives,
        "--head",
        &head,
        "--encoder",
        &encoder,
        "--json",
    ];
    let summary: Value = serde_json::from_slice(&agent(&options).stdout).unwrap();
    assert_eq!(summary["low_coverage"]["sweeps"], 0, "{summary}");

    let refused = agent(&["cover", "--dataset", drives, "--head", &detector]);
    let error = String::from_utf8_lossy(&refused.stderr);
    assert_eq!(refused.status.code(), Some(2), "{error}");
    assert!(error.contains("lean-none.safetensors"), "{error}");
    assert_eq!(
        fs::read(&detector).unwrap(),
        fs::read(weights("lean-none.safetensors")).unwrap()
    );
}
