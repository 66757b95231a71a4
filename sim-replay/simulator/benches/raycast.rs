//! Ray casting throughput on one core, noise and de-skewing included.
//!
//! Target: four sensors at 20 Hz with 50,000 points each in real time, that is 4 million points a second.
//! `cargo bench -p simulator --bench raycast -- sweep/town1` runs one case.

use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use simulator::generate::lidar::{LIDAR_MOUNT_M, Lidar};
use simulator::generate::raycast::{Course, Placement, RayBody, SolidShape};
use simulator::generate::vehicle::Vehicle;
use simulator::generate::{Weather, ground_surface};
use simulator::map::{MapModel, RoadMapSource, build};
use support::random::SplitMix64;

/// Vehicles on lanes around the sensor, one every this many metres of lane.
const SPACING_M: f64 = 20.0;
const RANGE_M: f64 = 120.0;

/// The lane and the position on it of the sensor.
fn sensor_motion(map_model: &MapModel) -> Course {
    let center = |lane: &&simulator::map::Lane| {
        let [x, y, _] = lane.at(0.5 * lane.length_m).0;
        x.hypot(y)
    };
    let roads = map_model
        .lanes
        .lanes
        .iter()
        .filter(|lane| lane.junction.is_none() && lane.length_m > 30.0);
    let lane = roads
        .min_by(|a, b| center(a).total_cmp(&center(b)))
        .expect("the map has a road");
    let at = |s_m: f64| {
        let (position, heading) = lane.at(s_m);
        Placement::level(position, heading)
    };
    // 12 m/s.
    Course {
        start: at(15.0),
        end: at(15.6),
    }
    .mounted(LIDAR_MOUNT_M)
}

fn vehicles(map_model: &MapModel, around: &Placement) -> Vec<(Vehicle, Course)> {
    let mut random = SplitMix64::new(1);
    let mut vehicles = Vec::new();
    for lane in &map_model.lanes.lanes {
        let mut s_m = 5.0;
        while s_m < lane.length_m - 5.0 {
            let (position, heading) = lane.at(s_m);
            let distance =
                (position[0] - around.position_m.x).hypot(position[1] - around.position_m.y);
            if (6.0..RANGE_M).contains(&distance) {
                let end = Placement::level(position, heading);
                let start = end.mounted([-0.5, 0.0, 0.0]);
                vehicles.push((Vehicle::random_driving(&mut random), Course { start, end }));
            }
            s_m += SPACING_M;
        }
    }
    vehicles
}

fn bench_map(criterion: &mut Criterion, name: &str, source: &RoadMapSource) {
    let map_model = build(source, 0).expect("procedural maps always build");
    let sensor = sensor_motion(&map_model);
    let ground = ground_surface(&map_model);
    let standing: Vec<(SolidShape, Placement)> = map_model
        .solids
        .iter()
        .map(|solid| {
            (
                SolidShape::from(solid),
                Placement::level(solid.center_m, solid.yaw_rad),
            )
        })
        .filter(|(shape, place)| {
            let distance = (place.position_m - sensor.end.position_m).xy().norm();
            distance < RANGE_M + shape.bounds.radius_m()
        })
        .collect();
    let vehicles = vehicles(&map_model, &sensor.end);
    let moving = vehicles.iter().map(|(vehicle, motion)| RayBody {
        shape: &vehicle.shape,
        motion: *motion,
    });
    let bodies: Vec<RayBody<'_>> = moving
        .chain(standing.iter().map(|(shape, place)| RayBody {
            shape,
            motion: Course::still(*place),
        }))
        .collect();
    let mut lidar = Lidar::default();
    let mut points_of_sweep = || {
        lidar.cast(&sensor, &*ground, &bodies);
        let sweep = lidar.sweep(&sensor, &bodies, Weather::Sunny, 0);
        sweep.points.len()
    };
    let points = points_of_sweep();
    assert!(
        points > 45_000,
        "{name}: a sweep of {points} points is no measure"
    );
    eprintln!(
        "{name}: {points} points, {} vehicles, {} standing solids",
        vehicles.len(),
        standing.len()
    );
    let mut group = criterion.benchmark_group("sweep");
    group.throughput(Throughput::Elements(points as u64));
    group.bench_function(name, |bencher| {
        bencher.iter(|| black_box(points_of_sweep()));
    });
    group.finish();
}

fn sweeps(criterion: &mut Criterion) {
    bench_map(criterion, "town1", &RoadMapSource::Town1);
    bench_map(criterion, "town4", &RoadMapSource::Town4);
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(20).measurement_time(std::time::Duration::from_secs(3));
    targets = sweeps
}
criterion_main!(benches);
