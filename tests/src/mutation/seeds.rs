//! Valid inputs to damage, made by the project's own code.

use std::path::Path;
use std::time::Duration;

use agent::input_log::Start;
use dataset::pcd::{Encoding, IntensityField, encode};
use ego_fuser::ego_loop::recorded::{EgoRecord, KIND, PublishedResult, WireMessage};
use ego_fuser::ego_loop::{Input, Reception};
use localization::registration::icp::IcpTarget;
use localization::registration::icp::surfel_map::SurfelMap;
use nalgebra::Isometry3;
use protocol::{CavId, Key, Lidar, Message, Pose, PoseEstimate, RunId, Stamp, Stream, Topic, wire};
use recording::{ExportTimes, RecordingOptions, RecordingWriter, export_ros2};
use ros2::{Mount, Translator};
use support::record_log::RecordWriter;

#[path = "../../../protocol/tests/sample/mod.rs"]
mod sample;

/// A sealed message of every kind, and a feature map in every codec.
///
/// # Panics
/// Never: the samples are valid.
#[must_use]
pub fn messages() -> Vec<Vec<u8>> {
    let maps = sample::every_codec()
        .into_iter()
        .map(|config| protocol::Message::Bev(sample::bev(&config)));
    let all = sample::every_kind().into_iter().chain(maps);
    all.map(|message| {
        wire::encode_any(&sample::stamp(), message)
            .expect("a sound message")
            .to_vec()
    })
    .collect()
}

/// Sweeps as text, binary and compressed, with and without colours, and as PCL writes them: organised, and padded.
#[must_use]
pub fn clouds() -> Vec<Vec<u8>> {
    let kinds = [Encoding::Ascii, Encoding::Binary]
        .into_iter()
        .flat_map(|encoding| {
            [IntensityField::Intensity, IntensityField::Red].map(|field| (encoding, field))
        });
    let mut files: Vec<Vec<u8>> = kinds
        .map(|(encoding, field)| encode(&sample::points(), encoding, field))
        .collect();
    let packed = compressed();
    files.push(packed.clone());
    files.push([&packed[..], &[0; 300]].concat());
    files.push(padded());
    files.push(SPARSE.as_bytes().to_vec());
    files
}

/// Points in ASCII, with an element before them that is skipped.
pub const PLY: &str = "ply\nformat ascii 1.0\ncomment seed\nelement sensor 1\nproperty float height\nelement vertex 2\n\
    property double x\nproperty float y\nproperty float z\nproperty uchar intensity\nend_header\n1.7\n1 2 3 40\n4 5 -1 2\n";

/// Two points as an array.
pub fn npy() -> Vec<u8> {
    let header = "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 4), }\n";
    let numbers = (1..9_u8).flat_map(|number| f32::from(number).to_le_bytes());
    [
        b"\x93NUMPY\x01\x00",
        &[header.len() as u8, 0][..],
        header.as_bytes(),
    ]
    .concat()
    .into_iter()
    .chain(numbers)
    .collect()
}

/// Three points with the padding of a message, some of it of no bytes, and more bytes after them than stated.
fn padded() -> Vec<u8> {
    let mut file = b"# .PCD v0.7\nVERSION .7\nFIELDS x y z _ intensity _ ring _\nSIZE 4 4 4 1 1 1 2 1\n\
        TYPE F F F U U U U U\nCOUNT 1 1 1 4 1 0 1 9\nWIDTH 3\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA binary\n"
        .to_vec();
    for number in 0..3_u8 {
        file.extend(
            [1.5, -2.0, f32::from(number)]
                .into_iter()
                .flat_map(f32::to_le_bytes),
        );
        file.extend([9, 9, 9, 9, 100 * number, number, 0]);
        file.extend([7; 9]);
    }
    file.extend([0; 200]);
    file
}

/// A minimal header, and the number texts of C libraries.
const SPARSE: &str = "# points\nCOLUMNS x y z reflectivity\nSIZE 4 4 8 2\nTYPE F F F U\nWIDTH 4\nDATA ascii\n\
    1 2 3 4 \r\n\n-1.5e-05 68.34235382 .5 65535\nnan -nan inf 0\n1.#QNAN 0 0 0\n";

/// Four points, compressed by LZF as literals only.
fn compressed() -> Vec<u8> {
    let body: Vec<u8> = (0..16)
        .flat_map(|number| (number as f32).to_le_bytes())
        .collect();
    let packed: Vec<u8> = body
        .chunks(32)
        .flat_map(|run| [&[run.len() as u8 - 1][..], run].concat())
        .collect();
    let mut file =
        b"VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 4\nHEIGHT 1\n\
                     VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 4\nDATA binary_compressed\n"
            .to_vec();
    file.extend((packed.len() as u32).to_le_bytes());
    file.extend((body.len() as u32).to_le_bytes());
    file.extend(packed);
    file
}

/// A sweep as `sensor_msgs/PointCloud2`.
///
/// # Panics
/// Never: the sample is valid.
#[must_use]
pub fn ros2_cloud() -> Vec<u8> {
    let topic = Topic::Stream {
        cav: CavId::new("4279").expect("an identifier"),
        stream: Stream::Lidar,
    };
    let message = Message::Lidar(Lidar {
        points: sample::points(),
    });
    let mut translator = Translator::new(&RunId::new("test").expect("an identifier"));
    translator
        .translate(&topic, 1_500_000_000, &message)
        .remove(0)
        .cdr
}

/// A motion as `nav_msgs/Odometry`, `geometry_msgs/TwistStamped` and `sensor_msgs/Imu`, each behind a byte with the number
/// of its type.
#[must_use]
pub fn ros2_motions() -> Vec<Vec<u8>> {
    let text = |text: &str| {
        [
            &(text.len() as u32 + 1).to_le_bytes(),
            text.as_bytes(),
            &[0],
        ]
        .concat()
    };
    let message = |number: u8, texts: &[&str], values: &[f64]| {
        let mut body = [7_u32, 8].map(u32::to_le_bytes).concat();
        for value in texts {
            body.resize(body.len().next_multiple_of(4), 0);
            body.extend(text(value));
        }
        body.resize(body.len().next_multiple_of(8), 0);
        body.extend(values.iter().flat_map(|value| value.to_le_bytes()));
        [&[number, 0, 1, 0, 0][..], &body].concat()
    };
    vec![
        message(0, &["odom", "base_link"], &[0.5; 7 + 36 + 6 + 36]),
        message(1, &["base_link"], &[0.5; 6]),
        message(2, &["imu_link"], &[0.5; 4 + 9 + 3 + 9 + 3 + 9]),
    ]
}

/// A recording of a message of every kind.
///
/// # Panics
/// When a file cannot be written.
#[must_use]
pub fn recording(scratch: &Path) -> Vec<u8> {
    let path = scratch.join("seed.mcap");
    let _ = std::fs::remove_file(&path);
    let mut writer =
        RecordingWriter::create(&path, RecordingOptions::default()).expect("a writable folder");
    let run = RunId::new("test").expect("an identifier");
    for (number, bytes) in messages().iter().enumerate() {
        let topic = ["4279/bev", "4279/lidar", "truth", "4288/pose"][number % 4]
            .parse()
            .expect("a topic");
        writer
            .write(
                &Key {
                    run: run.clone(),
                    topic,
                },
                1_000 * number as u64,
                bytes,
            )
            .expect("a writable folder");
    }
    writer.finish().expect("a writable folder");
    std::fs::read(&path).expect("it was written")
}

/// A bag of a robot: three sweeps of its LiDAR, and its poses at their times.
///
/// # Panics
/// When a file cannot be written.
#[must_use]
pub fn rosbag(scratch: &Path) -> Vec<u8> {
    let [recording, bag] = ["seed-robot.mcap", "seed-bag.mcap"].map(|name| scratch.join(name));
    for file in [&recording, &bag] {
        let _ = std::fs::remove_file(file);
    }
    let run = RunId::new("test").expect("an identifier");
    let mut writer = RecordingWriter::create(&recording, RecordingOptions::default())
        .expect("a writable folder");
    for tick in 0..3_u32 {
        let stamp = Stamp {
            sequence: tick.into(),
            capture_nanos: 100_000_000 * u64::from(tick + 1),
            ..sample::stamp()
        };
        let pose = Pose::from_xyz_yaw([f64::from(tick), -2.0, 1.9], 0.3);
        let points = sample::points();
        for (stream, message) in [
            (
                Stream::Pose,
                wire::encode(&stamp, PoseEstimate::new(pose, 0.9)),
            ),
            (Stream::Lidar, wire::encode(&stamp, Lidar { points })),
        ] {
            let key = Key::stream(&run, &stamp.cav, stream);
            let bytes = message.expect("a sound message").to_vec();
            writer
                .write(&key, stamp.capture_nanos, &bytes)
                .expect("a writable folder");
        }
    }
    writer.finish().expect("a writable folder");
    export_ros2(
        &recording,
        &bag,
        ExportTimes::Capture,
        &Mount::default(),
        None,
    )
    .expect("a sound recording");
    std::fs::read(&bag).expect("it was written")
}

/// The description of a bag.
pub(crate) const ROSBAG_METADATA: &str = "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n  \
    relative_file_paths:\n    - drive_0.mcap\n";

/// Log of the inputs of an ego: its beginning, a neighbour with its network and small messages, a result.
///
/// # Panics
/// When a file cannot be written.
#[must_use]
pub fn ego_inputs(scratch: &Path) -> Vec<u8> {
    let (stamp, all) = (sample::stamp(), sample::every_kind());
    let descriptor = all.into_iter().find_map(|message| match message {
        Message::Descriptor(descriptor) => Some(descriptor),
        _ => None,
    });
    let descriptor = descriptor.expect("a message of every kind");
    let cav = stamp.cav.clone();
    let message = |bytes| {
        let reception = Reception {
            cav: cav.clone(),
            arrived_nanos: 1_600_000_000,
            transport: Some(Duration::from_millis(12)),
            clock_offset_s: Some(-0.5),
        };
        Input::Message(WireMessage { reception, bytes })
    };
    let small = messages().into_iter().filter(|bytes| bytes.len() < 2048);
    let inputs = [
        Input::Joined(cav.clone()),
        Input::Model(cav.clone(), descriptor.clone()),
    ]
    .into_iter()
    .chain(small.map(message))
    .chain([
        Input::Wake,
        Input::Left(cav.clone()),
        Input::Ended(cav.clone()),
    ]);
    let start = EgoRecord::Start(Start {
        config: "{\"run\":\"test\"}".into(),
        model_hash: Some(descriptor.model_hash),
        version: "0.1.0".into(),
    });
    let published = EgoRecord::Published(PublishedResult {
        stream: Stream::Detections,
        stamp: stamp.clone(),
        stages: Vec::new(),
    });
    let inputs = (0..)
        .zip(inputs)
        .map(|(now_nanos, input)| EgoRecord::Input { now_nanos, input });
    let path = scratch.join("seed-inputs.log");
    let mut writer = RecordWriter::create(&path, KIND).expect("a writable folder");
    for record in std::iter::once(start).chain(inputs).chain([published]) {
        writer.add(&record).expect("a writable folder");
    }
    std::fs::read(&path).expect("it was written")
}

/// Surfel map of a level square of ten metres.
///
/// # Panics
/// When a file cannot be written.
#[must_use]
pub fn surfel_map(scratch: &Path) -> Vec<u8> {
    let square = (0..1600).map(|k| {
        [
            (k % 40) as f32 * 0.25 + 3.0,
            (k / 40) as f32 * 0.25,
            -2.0,
            0.1,
        ]
    });
    let mut target = IcpTarget::new(&SurfelMap::building(0.5));
    target.add(
        &square.collect::<Vec<_>>(),
        &Isometry3::translation(100.0, 200.0, 2.0),
    );
    target.fit();
    let path = scratch.join("seed-surfels.safetensors");
    SurfelMap::write(&path, "yard", &target).expect("a writable folder");
    std::fs::read(&path).expect("it was written")
}

/// The annotation of a frame as OPV2V stores it.
pub const OPV2V: &str = "lidar_pose: [1.5, -2.0, 1.9, 0.0, 90.0, 0.0]\ntrue_ego_pos: [1.5, -2.0, 1.9, 0.0, 90.0, 0.0]\n\
    ego_speed: 36.0\nvehicles:\n  100:\n    angle: [0.0, 12.5, 0.0]\n    center: [0.0, 0.0, 0.8]\n    \
    extent: [2.0, 0.9, 0.8]\n    location: [20.0, 3.0, 0.0]\n    speed: 36.0\n  101: &car\n    angle: [0.0, 0.0, 0.0]\n    \
    center: [0.0, 0.0, 0.8]\n    extent: [2.0, 0.9, 0.8]\n    location: [-8.0, 3.0, 0.0]\n    speed: 0.0\n";

/// The same as V2V4Real stores it: matrices as Python wrote them.
pub const V2V4REAL: &str = concat!(
    include_str!("../../../sim-replay/dataset/src/yaml/numpy_tags/numpy_matrix.yaml"),
    "true_ego_pos: [0, 0, 0, 0, 0, 0]\nego_speed: 3.6\nvehicles:\n  1:\n    angle: [0, 90, 0]\n    center: [0, 0, 0]\n    \
     extent: [2, 1, 0.75]\n    location: [10, 4, -1]\n    ass_id: 5\n    obj_type: Truck\n"
);

/// A road, a junction, a crossing.
pub(crate) const OPENDRIVE: &str = r#"<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="4"/>
<road name="a" length="40.0" id="1" junction="-1"><link><successor elementType="junction" elementId="9"/></link>
<type s="0" type="town"><speed max="50" unit="km/h"/></type>
<planView><geometry s="0" x="0" y="0" hdg="0" length="20"><line/></geometry>
<geometry s="20" x="20" y="0" hdg="0" length="20"><arc curvature="0.02"/></geometry></planView>
<elevationProfile><elevation s="0" a="0" b="0.01" c="0" d="0"/></elevationProfile>
<lanes><laneOffset s="0" a="0" b="0" c="0" d="0"/><laneSection s="0">
<left><lane id="1" type="driving" level="false"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></left>
<center><lane id="0" type="none" level="false"/></center>
<right><lane id="-1" type="driving" level="false"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></right>
</laneSection></lanes></road>
<road name="b" length="10.0" id="2" junction="9"><link><predecessor elementType="road" elementId="1" contactPoint="end"/></link>
<planView><geometry s="0" x="40" y="4" hdg="0.4" length="10"><spiral curvStart="0" curvEnd="0.05"/></geometry></planView>
<lanes><laneSection s="0"><center><lane id="0" type="none" level="false"/></center>
<right><lane id="-1" type="driving" level="false"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></right>
</laneSection></lanes></road>
<junction id="9" name="j"><connection id="0" incomingRoad="1" connectingRoad="2" contactPoint="start">
<laneLink from="-1" to="-1"/></connection></junction></OpenDRIVE>"#;

/// A deployment with most of its fields.
pub const SCENARIO: &str = "run: test\nscene: {dir: scene, rate: 1.0, seek: 0, frames: 10, loop: false}\n\
    models: {weights: weights.safetensors}\nmethod: max\nagents: {codec: {dtype: f16, budget_bytes: 100000, zstd_level: 3}}\n\
    vehicles: {'4288': {pose: recorded}}\nego: {deadline_ms: 50}\ntimeouts: {ready_s: 3}\n";

/// A grid of runs.
pub const EXPERIMENT: &str = include_str!("../../../deploy/experiments/smoke.yaml");

/// A link emulation.
pub(crate) const LINK: &str = include_str!("../../../deploy/experiments/links/newest-first.yaml");

/// Tables of methods.
pub const TABLES: &str = "dataset: scenes\nweights: weights\ndtype: f16\nframes: 40\ntables:\n- name: main\n  scenarios: 3\n  \
    rows:\n  - {name: a, method: max, weights: [a.safetensors]}\n  - {method: none}\n  columns:\n  \
    - {name: PGC, poses: {cached: {file: poses.csv}}, delay_ms: 100}\n  \
    - {name: noisy, poses: {noisy: {mode: independent, position_std_m: 1, heading_std_deg: 1}}}\n";

/// A trace of a link.
pub(crate) const TRACE: &str =
    "time_s,bandwidth_mbps,latency_ms,loss\n0,27,10,0.01\n0.5,6,20.5,0\n1.25,0,100,1\n";

/// Departure times of packets, milliseconds.
pub(crate) const MAHIMAHI: &str = "0\n1\n1\n5\n12\n40\n";

/// A checkpoint of a replay.
pub(crate) const PLACE: &str = "{\"scenario\":\"town\",\"position\":{\"next_tick\":7,\"left\":12,\"shift_nanos\":1000000000,\
    \"last_nanos\":1600000000},\"is_halted\":false,\"ticks\":17,\"unanswered\":0,\"unreadable_frames\":1,\"plan\":\"seek 0, frames all, loop true\",\
    \"has_ended\":false}\n";
/// Options of the replay of [`PLACE`].
pub(crate) const PLAN: &str = "seek 0, frames all, loop true";

/// Poses of a localizer.
pub(crate) const POSES: &str = "scenario,cav,capture_nanos,x_m,y_m,z_m,qw,qx,qy,qz,confidence,no_pose,inliers\n\
    town,1000,3000000000,258.3,296.2,1.99,0.712174537,0.000278377,0.000295992,-0.702002324,0.99,,\n\
    town,1000,3100000000,,,,,,,,,low_confidence,12\n";

/// Errors of poses.
pub(crate) const ERRORS: &str =
    "x_m,y_m,z_m,yaw_deg,confidence\n0.5,-0.25,0.1,1.5,0.9\n-1,2,0,-3,0.4\n";
