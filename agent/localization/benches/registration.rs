//! Pose solvers side by side: time, and on stderr accuracy over many problems.
//!
//! One case: `cargo bench -p localization --bench registration -- scene/3000x60`.

use std::hint::black_box;
use std::time::Instant;

use criterion::{Criterion, criterion_group, criterion_main};
use localization::registration::ransac::{self, RansacConfig};
use localization::registration::sc2pcr::{self, Sc2PcrConfig};
use localization::registration::{Correspondence, NoRegistration, Registration};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Problems per row of the table of accuracies.
const PROBLEMS: u64 = 100;

/// Distribution of the pairs of a problem.
#[derive(Clone, Copy)]
struct Shape {
    name: &'static str,
    count: usize,
    outliers: f64,
    /// Smallest and largest standard deviation per axis of a pair, metres.
    noise_m: [f64; 2],
    /// Half the side of the box that source points lie in, metres.
    reach_m: [f64; 3],
    /// Half the side of the square that targets of outliers lie in, metres.
    scene_m: f64,
    /// Inlier threshold, metres.
    threshold_m: f64,
    upright: bool,
}

/// Cells of a vehicle's sweep: errors of 0.2 to 1.5 m, with weights that follow them roughly.
const SCENE: Shape = Shape {
    name: "scene/3000x60",
    count: 3000,
    outliers: 0.6,
    noise_m: [0.2, 1.5],
    reach_m: [60.0, 60.0, 5.0],
    scene_m: 260.0,
    threshold_m: 1.5,
    upright: true,
};

const SHAPES: [Shape; 4] = [
    SCENE,
    Shape {
        name: "scene/3000x92",
        outliers: 0.92,
        ..SCENE
    },
    // The sizes for which reference solutions of SC2-PCR exist.
    Shape {
        name: "indoor/300x60",
        count: 300,
        noise_m: [0.05, 0.05],
        reach_m: [10.0, 10.0, 10.0],
        scene_m: 20.0,
        threshold_m: 0.6,
        upright: false,
        ..SCENE
    },
    Shape {
        name: "indoor/400x85",
        count: 400,
        outliers: 0.85,
        noise_m: [0.03, 0.03],
        reach_m: [10.0, 10.0, 10.0],
        scene_m: 20.0,
        threshold_m: 0.5,
        upright: false,
    },
];

fn problem(shape: &Shape, seed: u64) -> (Isometry3<f64>, Vec<Correspondence>) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let tilt = if shape.upright { 0.05 } else { 1.5 };
    let truth = Isometry3::from_parts(
        Translation3::new(
            random.random_range(-100.0..100.0),
            random.random_range(-100.0..100.0),
            2.0,
        ),
        UnitQuaternion::from_euler_angles(
            random.random_range(-tilt..tilt),
            random.random_range(-tilt..tilt),
            random.random_range(-3.1..3.1),
        ),
    );
    let pairs = (0..shape.count).map(|_| {
        let source = Point3::from(
            shape
                .reach_m
                .map(|reach| random.random_range(-reach..reach)),
        );
        let log_noise = random.random_range(shape.noise_m[0].ln()..=shape.noise_m[1].ln());
        let target = if random.random_bool(shape.outliers) {
            let mut place = |reach: f64| random.random_range(-reach..reach);
            Point3::new(
                place(shape.scene_m),
                place(shape.scene_m),
                place(shape.reach_m[2]),
            )
        } else {
            let mut shaken = truth * source;
            for coordinate in &mut shaken.coords {
                let normal: f64 = StandardNormal.sample(&mut random);
                *coordinate += normal * log_noise.exp();
            }
            shaken
        };
        // A predicted error that is right to a factor of two or so.
        let error_m = (truth * source - target).norm().min(8.0) * random.random_range(0.5..2.0);
        let weight = (1.0 / (1.0 + error_m * error_m)) as f32;
        let single = |point: Point3<f64>| point.coords.map(|x| x as f32).into();
        Correspondence {
            source_m: single(source),
            target_m: single(target),
            weight,
        }
    });
    let pairs = pairs.collect();
    (truth, pairs)
}

type Solver<'a> = (
    &'static str,
    Box<dyn Fn(&[Correspondence]) -> Result<Registration, NoRegistration> + 'a>,
);

fn solvers(shape: &Shape) -> Vec<Solver<'_>> {
    let threshold_m = shape.threshold_m;
    let upright = RansacConfig {
        inlier_threshold_m: threshold_m,
        ..RansacConfig::default()
    };
    let second_order = Sc2PcrConfig {
        inlier_threshold_m: threshold_m,
        distance_threshold_m: threshold_m,
        refinement_threshold_m: threshold_m,
        ..Sc2PcrConfig::default()
    };
    let mut solvers: Vec<Solver<'_>> = vec![(
        "sc2pcr",
        Box::new(move |pairs| sc2pcr::solve(pairs, &second_order)),
    )];
    if shape.upright {
        solvers.push((
            "ransac2",
            Box::new(move |pairs| ransac::solve(pairs, &upright)),
        ));
    }
    solvers
}

/// Errors and times over many problems, as one line.
fn accuracy(shape: &Shape, (name, solve): &Solver<'_>) -> usize {
    let (mut metres, mut degrees, mut millis, mut good) = (Vec::new(), Vec::new(), Vec::new(), 0);
    for seed in 0..PROBLEMS {
        let (truth, pairs) = problem(shape, seed);
        let start = Instant::now();
        let found = solve(&pairs);
        millis.push(start.elapsed().as_secs_f64() * 1e3);
        let Ok(found) = found else { continue };
        let off = truth.inv_mul(&found.target_from_source);
        let distance_m = off.translation.vector.norm();
        good += usize::from(distance_m < 2.0 * shape.threshold_m);
        metres.push(distance_m);
        degrees.push(off.rotation.angle().to_degrees());
    }
    let quantile = |values: &mut Vec<f64>, share: f64| {
        values.sort_by(f64::total_cmp);
        values
            .get((values.len() as f64 * share) as usize)
            .copied()
            .unwrap_or(f64::NAN)
    };
    eprintln!(
        "{:14} {name:8} right {good:3}/{PROBLEMS}  p50 {:.3} m {:.3} deg  p95 {:.3} m {:.3} deg  p50 {:.2} ms  p95 {:.2} ms",
        shape.name,
        quantile(&mut metres, 0.5),
        quantile(&mut degrees, 0.5),
        quantile(&mut metres, 0.95),
        quantile(&mut degrees, 0.95),
        quantile(&mut millis, 0.5),
        quantile(&mut millis, 0.95),
    );
    good
}

fn registration(criterion: &mut Criterion) {
    for shape in &SHAPES {
        for solver in &solvers(shape) {
            let good = accuracy(shape, solver);
            assert!(
                solver.0 == "sc2pcr" || good >= 95,
                "{} {}: {good}",
                shape.name,
                solver.0
            );
            let (_, pairs) = problem(shape, 1000);
            criterion.bench_function(&format!("{}/{}", shape.name, solver.0), |bencher| {
                bencher.iter(|| solver.1(black_box(&pairs)));
            });
        }
    }
}

criterion_group!(benches, registration);
criterion_main!(benches);
