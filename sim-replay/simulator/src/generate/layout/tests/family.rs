//! Layouts that the readers of this crate open as the same scenarios, with boxes; and the text of OPV2V's files.

use std::path::Path;

use protocol::{CavId, Handedness, Pose};

use super::{assert_same, expected, open, options, ticks, write};
use crate::generate::layout::{
    AgentFrame, BoxAnchor, Moment, Omissions, SceneAgent, SceneHeader, SceneLayout, Simulated,
    SweepVariant,
};
use crate::generate::positioning::Fix;
use crate::generate::raycast::Placement;
use crate::generate::{Converted, SynthError, SynthOptions, Weather, convert, generate};
use dataset::Layout;
use dataset::frame::{Frame, Object, ObjectClass};

/// Layouts for which there is a reader.
const LAYOUTS: [(SceneLayout, Layout); 2] = [
    (SceneLayout::V2v4real, Layout::V2V4REAL),
    (SceneLayout::V2xreal, Layout::V2XREAL),
];

#[test]
fn a_scene_is_the_same_in_every_layout_that_is_read() {
    let expected = expected();
    for (layout, found) in LAYOUTS {
        let folder = tempfile::tempdir().unwrap();
        let summary = write(layout, folder.path());
        assert_eq!((summary.scenarios, summary.agent_frames), (2, 8));
        assert!(summary.omitted.is_empty(), "{:?}", summary.omitted);
        let dataset = open(folder.path());
        assert_eq!(dataset.layout, found);
        assert_same(&ticks(&dataset), &expected, layout);
    }
}

fn converted(layout: SceneLayout, from: &Path, out: &Path) -> Result<Converted, SynthError> {
    convert(&open(from), out, layout, false, &|_, _| {})
}

#[test]
fn a_converted_data_set_is_the_same_as_a_generated_one() {
    let expected = expected();
    let [first, second, third] = [(); 3].map(|()| tempfile::tempdir().unwrap());
    write(SceneLayout::Opv2v, first.path());
    let there = converted(SceneLayout::V2v4real, first.path(), second.path()).unwrap();
    assert_eq!(
        (
            there.scenarios,
            there.agent_frames,
            there.left_out.is_nothing()
        ),
        (2, 8, true)
    );
    assert_same(
        &ticks(&open(second.path())),
        &expected,
        SceneLayout::V2v4real,
    );
    converted(SceneLayout::Opv2v, second.path(), third.path()).unwrap();
    let back = open(third.path());
    assert_eq!(back.layout, Layout::OPV2V);
    assert_same(&ticks(&back), &expected, SceneLayout::Opv2v);
    let names = |path| {
        open(path)
            .scenarios
            .iter()
            .map(|scenario| scenario.name.clone())
            .collect::<Vec<_>>()
    };
    assert_eq!(names(first.path()), names(third.path()));
    // Existing files are not overwritten without `force`.
    let again = converted(SceneLayout::Opv2v, first.path(), third.path());
    assert!(again.unwrap_err().to_string().contains("is not empty"));
}

#[test]
fn a_conversion_counts_what_the_layout_does_not_hold() {
    let folders = [(); 5].map(|()| tempfile::tempdir().unwrap());
    let [from, same, pairs, single, fewer] = folders.each_ref().map(tempfile::TempDir::path);
    let three = SynthOptions {
        scenes: 1,
        agents: 3..=3,
        ..options(SceneLayout::Opv2v, from)
    };
    generate(&three, &|_| {}).unwrap();
    let same = converted(SceneLayout::Opv2v, from, same).unwrap();
    assert_eq!((same.agent_frames, same.omitted.len()), (6, 0));
    let pairs = converted(SceneLayout::Dair, from, pairs).unwrap();
    let beyond = pairs.omitted["frames of agents beyond one vehicle and one roadside unit"];
    assert_eq!((pairs.agent_frames, beyond), (4, 2));
    let single = converted(SceneLayout::KittiObject, from, single).unwrap();
    for what in ["poses", "yaw rates", "poses by GNSS"] {
        let found = single.omitted.get(what);
        assert_eq!(found, Some(&6), "{what}: {:?}", single.omitted);
    }
    let sweep = open(from).scenarios[0].points_path(0, 1, None).unwrap();
    std::fs::write(sweep.with_extension("yaml"), "vehicles: {}\n").unwrap();
    let fewer = converted(SceneLayout::Opv2v, from, fewer).unwrap();
    let without = fewer.omitted["frames of moments without the ego"];
    assert_eq!((fewer.agent_frames, without), (3, 2));
}

#[test]
fn copies_and_radar_come_through_a_conversion() {
    let [first, second] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let plain = options(SceneLayout::Opv2v, first.path());
    generate(
        &SynthOptions {
            scenes: 1,
            frames: 1,
            copies: vec![Weather::Fog],
            ..plain
        },
        &|_| {},
    )
    .unwrap();
    converted(SceneLayout::Opv2v, first.path(), second.path()).unwrap();
    let (from, to) = (open(first.path()), open(second.path()));
    let (from, to) = (&from.scenarios[0], &to.scenarios[0]);
    assert_eq!(
        (&from.lidar_variants, to.has_radar),
        (&to.lidar_variants, true)
    );
    assert_eq!(from.ticks, to.ticks);
    let variant = from.lidar_variants[0].as_str();
    let radar = dataset::LoadOptions {
        radar: true,
        ..Default::default()
    };
    for agent in 0..2 {
        let [was, is] =
            [from, to].map(|scenario| scenario.load_points(agent, 0, Some(variant)).unwrap());
        assert_eq!((was.points, was.labels), (is.points, is.labels));
        let [was, is] = [from, to].map(|scenario| scenario.load(agent, 0, &radar).unwrap());
        assert_eq!(
            (was.points, was.radar, was.objects.len()),
            (is.points, is.radar, is.objects.len())
        );
        assert!(
            was.objects
                .iter()
                .zip(&is.objects)
                .all(|(was, is)| was.id == is.id && was.size_m == is.size_m)
        );
    }
}

/// A frame with round numbers.
fn frame() -> AgentFrame {
    let object = |id, class, x| Object {
        id,
        class,
        world_from_object: Pose::from_xyz_yaw([x, 5.0, 0.75], 0.0),
        size_m: [4.0, 2.0, 1.5],
        speed_mps: Some(2.5),
    };
    let objects = vec![
        object(7, ObjectClass::Van, 10.0),
        object(9, ObjectClass::Pedestrian, 20.0),
    ];
    let anchor = |x| BoxAnchor {
        location_m: [x, 5.0, 0.0],
        center_offset_m: [0.0, 0.0, 0.75],
    };
    let estimate = Placement::level([1.5, 2.0, 0.0], 0.0);
    let fix = Fix {
        gnss_m: [0.0; 3],
        heading_rad: 0.0,
        speed_mps: 10.25,
        yaw_rate_radps: 0.0,
        estimate,
    };
    let frame = Frame {
        points: protocol::PointCloud {
            xyzi: vec![[1.0, 2.0, 3.0, 0.5]],
        },
        world_from_lidar: Some(Pose::from_xyz_yaw([1.0, 2.0, 1.95], 0.0)),
        world_from_vehicle: Some(Pose::from_xyz_yaw([1.5, 2.0, 0.0], 0.0)),
        gnss_world_from_vehicle: Some(estimate.isometry().into()),
        speed_mps: Some(10.0),
        objects,
        ..Frame::empty(
            CavId::new("1000").unwrap(),
            3_000_000_000,
            Handedness::Right,
        )
    };
    let variants = vec![SweepVariant {
        name: "fog".into(),
        points: vec![[1.0, 2.0, 3.0, 0.2]],
        labels: vec![1],
    }];
    AgentFrame {
        agent: 0,
        frame,
        variants,
        simulated: Some(Simulated {
            fix,
            anchors: vec![anchor(10.0), anchor(20.0)],
        }),
    }
}

#[test]
fn files_of_opv2v_have_this_text() {
    let folder = tempfile::tempdir().unwrap();
    let header = SceneHeader {
        name: "test/a".into(),
        agents: vec![SceneAgent {
            id: CavId::new("1000").unwrap(),
            is_roadside: false,
        }],
        capture_nanos: vec![3_000_000_000],
        tick_nanos: 50_000_000,
        origin: "world: {}\n".into(),
    };
    let mut writer = SceneLayout::Opv2v.writer(folder.path());
    writer.begin(&header).unwrap();
    writer
        .write(
            &Moment {
                index: 0,
                frames: vec![frame()],
            },
            &Omissions::default(),
        )
        .unwrap();
    writer.end().unwrap();
    let file = |name: &str| std::fs::read(folder.path().join("test/a").join(name)).unwrap();
    assert_eq!(file("data_protocol.yaml"), b"world: {}\n");
    let expected = "\
RSU: false
ego_speed: 36
gnss:
  altitude: 0
  latitude: 0
  longitude: 0
imu:
  heading_deg: -0
  speed_mps: 10.25
  yaw_rate_degps: -0
lidar_pose:
- 1.0
- -2.0
- 1.95
- 0.0
- 0.0
- 0.0
plan_trajectory: []
predicted_ego_pos:
- 1.5
- -2.0
- 0.0
- 0.0
- 0.0
- 0.0
true_ego_pos:
- 1.5
- -2.0
- 0.0
- 0.0
- 0.0
- 0.0
vehicles:
  7:
    angle:
    - 0.0
    - 0.0
    - 0.0
    center:
    - 0.0
    - 0.0
    - 0.75
    class: van
    extent:
    - 2.0
    - 1.0
    - 0.75
    location:
    - 10.0
    - -5.0
    - 0.0
    speed: 9
  9:
    angle:
    - 0.0
    - 0.0
    - 0.0
    center:
    - 0.0
    - 0.0
    - 0.75
    class: pedestrian
    extent:
    - 2.0
    - 1.0
    - 0.75
    location:
    - 20.0
    - -5.0
    - 0.0
    obj_type: Pedestrian
    speed: 9
";
    assert_eq!(
        String::from_utf8(file("1000/000060.yaml")).unwrap(),
        expected
    );
    // x, mirrored y, z, intensity; the copy keeps intensity in the red byte and the label in the green one.
    let point = |fourth: f32| {
        [1.0, -2.0, 3.0, fourth]
            .into_iter()
            .flat_map(f32::to_le_bytes)
            .collect::<Vec<u8>>()
    };
    assert!(file("1000/000060.pcd").ends_with(&point(0.5)));
    assert!(file("1000/000060_fog.pcd").ends_with(&point(f32::from_bits(0x0033_0100))));
    assert_eq!(
        std::fs::read_dir(folder.path().join("test/a"))
            .unwrap()
            .count(),
        2,
        "no mark is left"
    );
}
