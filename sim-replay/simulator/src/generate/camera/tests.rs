use nalgebra::Point3;

use super::*;
use crate::generate::raycast::{Bounds, Convex, Plane, SolidShape};
use crate::generate::world::World;
use crate::map::{RoadMapSource, build};

const SIZE: ImageSize = ImageSize {
    width_px: 120,
    height_px: 80,
};

fn block() -> SolidShape {
    SolidShape::new(
        vec![Convex::Box(Bounds::centered(
            [0.0, 0.0, 0.75],
            [2.0, 0.9, 0.75],
        ))],
        0.5,
    )
}

/// Depth of the ray of a pixel, metres.
fn depth_m(camera: &MountedCamera, column: f64, row: f64) -> f32 {
    let pixel = row as usize * SIZE.width_px as usize + column as usize;
    let (column, channel) = camera.rays[pixel];
    let pattern = &camera.caster.pattern;
    let column = (column as usize).min(pattern.columns - 1);
    let channel = (channel as usize).min(pattern.channels - 1);
    camera.caster.image.depths_m[column * pattern.channels + channel]
}

#[test]
fn a_box_is_where_the_calibration_projects_it_in_every_camera() {
    let map = build(&RoadMapSource::Town1, 0).unwrap();
    let world = World::new(&map);
    let shape = block();
    let vehicle = Placement::level([0.0, 0.0, 0.0], 0.4);
    let mut rig = CameraRig::new(SIZE);
    for (number, yaw_deg) in [0.0f64, -100.0, 100.0, 180.0].into_iter().enumerate() {
        let ahead = vehicle.isometry() * Isometry3::rotation(Vector3::z() * yaw_deg.to_radians());
        let place = ahead * Point3::new(14.0, 1.0, 0.0);
        let bodies = [RayBody {
            shape: &shape,
            motion: Course::still(Placement::level(place.coords.into(), 0.4)),
        }];
        let surroundings = Surroundings {
            ground: &Plane(0.0),
            bodies: &bodies,
            paints: &[of_vehicle(1)],
            weather: Weather::Sunny,
        };
        let camera = &mut rig.cameras[number];
        camera.render(&vehicle, &surroundings, &mut GroundPaint::new(&world), 1);
        let metadata = camera.metadata;
        let world_from_lidar = vehicle.mounted(LIDAR_MOUNT_M).isometry();
        let camera_from_world =
            (world_from_lidar * metadata.lidar_from_camera.unwrap().isometry()).inverse();
        let middle = camera_from_world * (place + Vector3::z() * 0.75);
        let [column, row] = metadata
            .pinhole
            .unwrap()
            .project(middle.coords.into())
            .unwrap();
        let distance_m = middle.coords.norm() as f32;
        let box_m = depth_m(camera, column, row);
        assert!(
            (box_m - distance_m).abs() < 2.1,
            "{number}: {box_m} {distance_m}"
        );
        // Well above the box there is sky, well below ground that is nearer.
        assert!(
            depth_m(camera, column, row - 20.0) > 149.0
                && depth_m(camera, column, row + 12.0) < distance_m - 2.1
        );
    }
}

#[test]
fn images_are_the_same_for_the_same_arguments_and_differ_by_weather() {
    let map = build(&RoadMapSource::Town1, 0).unwrap();
    let world = World::new(&map);
    let vehicle = Placement::level([0.0, 0.0, 0.0], 0.0);
    let [sunny, again, snowy] = [Weather::Sunny, Weather::Sunny, Weather::Snow].map(|weather| {
        let surroundings = Surroundings {
            ground: &Plane(0.0),
            bodies: &[],
            paints: &[],
            weather,
        };
        CameraRig::new(SIZE).images(&vehicle, &surroundings, &mut GroundPaint::new(&world), 5)
    });
    assert_eq!(
        sunny.iter().map(|(number, _)| *number).collect::<Vec<_>>(),
        [0, 1, 2, 3]
    );
    assert_eq!(sunny, again);
    assert_ne!(sunny, snowy);
    assert!(
        sunny
            .iter()
            .all(|(_, camera)| ImageFormat::of_bytes(&camera.image) == Some(ImageFormat::Png))
    );
}

#[test]
fn sizes_are_read_as_they_are_written() {
    assert_eq!(
        "480x300".parse::<ImageSize>().unwrap().to_string(),
        "480x300"
    );
    for text in ["480", "480x", "x300", "480×300", "-1x3"] {
        assert!(text.parse::<ImageSize>().is_err(), "{text}");
    }
}
