//! Comparison of alignment methods over scenes: the ego, a scenario's first agent, with every neighbour in range, at
//! every tick.

pub mod table;

use std::time::{Duration, Instant};

use agent::agent::Agent;
use dataset::class_set::ClassSet;
use dataset::frame::Frame;
use dataset::{LeftOut, LoadOptions, Scenario, ground_truth};
use nalgebra::Isometry3;
use protocol::message::Message;
use protocol::{Box3d, HEADER_LEN, wire};

use super::participant::stamp;
use super::sweeps::without_true_pose;
use crate::alignment::{AlignError, AlignInput, AlignmentMethod, AlignmentSpec, NotAligned};

/// Source of boxes.
#[derive(Debug)]
pub enum BoxSource {
    /// A vehicle's own detections.
    Detected(Box<Agent>),
    /// The recording's annotations of the objects in this vehicle's view, as in the paper's table.
    Annotated,
}

/// One method on one pair at one tick.
#[derive(Debug, Clone, PartialEq)]
pub struct PairOutcome {
    /// Index of the method in the list that was compared.
    pub method: usize,
    /// Payload that the neighbour sends for it, metadata and body, bytes.
    pub bytes: u64,
    /// Latency of the alignment: the preparation of a vehicle's message (both at the same time) and the alignment
    /// itself. Boxes are available anyway: their detection does not count.
    pub time: Duration,
    /// Its error, or the reason why there is no alignment.
    pub result: Result<PairError, NotAligned>,
}

/// Error of an alignment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairError {
    /// Metres, in three dimensions.
    pub metres: f64,
    /// Degrees, about any axis.
    pub degrees: f64,
}

/// Compares methods on the ticks of a scenario in `ticks`, for neighbours within the communication range, metres; reports
/// every pair when it is done. Returns the frames that cannot be read or have no true pose; without the ego's its tick is
/// left out.
///
/// # Errors
/// [`AlignError`] of a method.
pub fn run(
    specs: &[AlignmentSpec],
    box_source: &mut BoxSource,
    (scenario, comm_range_m): (&Scenario, f64),
    ticks: impl Iterator<Item = usize>,
    on_outcome: &mut dyn FnMut(PairOutcome),
) -> Result<LeftOut, AlignError> {
    let mut left_out = LeftOut::default();
    let mut methods: Vec<_> = specs.iter().map(|spec| (spec.for_scene)()).collect();
    let needs_boxes = specs.iter().any(|spec| spec.needs_boxes);
    for tick in ticks {
        let agents = scenario.present_agents(tick);
        let loaded = scenario.load_tick(tick, agents, &LoadOptions::default());
        left_out.add_tick(&loaded);
        let (mut frames, mut truth) = (Vec::<Frame>::new(), Vec::new());
        for (agent, frame) in loaded.frames {
            match frame.world_from_lidar {
                Some(pose) => {
                    truth.push(pose.isometry());
                    frames.push(frame);
                }
                None if agent == 0 => {
                    left_out.add_unreadable(0, without_true_pose(scenario, tick, &frame.cav));
                }
                None => {
                    let (scene, stem) = (&scenario.name, &scenario.ticks[tick].stem);
                    let place = format!("scenario {scene}, tick {stem}, agent {}", frame.cav);
                    left_out.add_failed(&place, "no true pose to compare with");
                }
            }
        }
        if frames.first().map(|ego| &ego.cav) != scenario.agents.first() {
            continue;
        }
        let boxes = needs_boxes.then_some(&mut *box_source);
        let at = (&frames[..], &truth[..]);
        moment(&mut methods, boxes, at, comm_range_m, on_outcome)?;
    }
    Ok(left_out)
}

/// All pairs of one tick; the ego comes first.
fn moment(
    methods: &mut [Box<dyn AlignmentMethod>],
    mut box_source: Option<&mut BoxSource>,
    (frames, truth): (&[Frame], &[Isometry3<f64>]),
    comm_range_m: f64,
    on_outcome: &mut dyn FnMut(PairOutcome),
) -> Result<(), AlignError> {
    let ego_from: Vec<Isometry3<f64>> = truth.iter().map(|pose| truth[0].inv_mul(pose)).collect();
    let near = ground_truth::contributors(&frames.iter().collect::<Vec<_>>(), 0, comm_range_m);
    let boxes = near
        .iter()
        .map(|&index| match &mut box_source {
            Some(source) => boxes(source, &frames[index], &truth[index]),
            None => Ok(Vec::new()),
        })
        .collect::<Result<Vec<_>, _>>()?;
    let vehicles = near.iter().zip(&boxes).map(|(&index, boxes)| AlignInput {
        frame: &frames[index],
        boxes,
    });
    let vehicles: Vec<AlignInput<'_>> = vehicles.collect();
    for (number, method) in methods.iter_mut().enumerate() {
        let prepared = vehicles.iter().map(|it| prepare(method.as_mut(), it));
        let prepared = prepared.collect::<Result<Vec<_>, _>>()?;
        let Some(((own, _, own_time), neighbours)) = prepared.split_first() else {
            continue;
        };
        for ((message, bytes, time), &index) in neighbours.iter().zip(&near[1..]) {
            let start = Instant::now();
            let found = method.align(&vehicles[0], own, message);
            let time = *own_time.max(time) + start.elapsed();
            let off = found.map(|found| ego_from[index].inv_mul(&found));
            on_outcome(PairOutcome {
                method: number,
                bytes: *bytes,
                time,
                result: off.map(|off| PairError {
                    metres: off.translation.vector.norm(),
                    degrees: off.rotation.angle().to_degrees(),
                }),
            });
        }
    }
    Ok(())
}

/// A vehicle's message, its size and its preparation time.
fn prepare(
    method: &mut dyn AlignmentMethod,
    vehicle: &AlignInput<'_>,
) -> Result<(Message, u64, Duration), AlignError> {
    let start = Instant::now();
    let message = method.prepare(vehicle)?;
    let time = start.elapsed();
    let stamp = stamp(&vehicle.frame.cav, vehicle.frame.capture_nanos);
    let bytes = wire::encode_any(&stamp, message.clone())?.wire_bytes() - HEADER_LEN;
    Ok((message, bytes as u64, time))
}

/// A vehicle's boxes in the frame of its LiDAR, the most confident first.
fn boxes(
    source: &mut BoxSource,
    frame: &Frame,
    world_from_lidar: &Isometry3<f64>,
) -> Result<Vec<Box3d>, AlignError> {
    match source {
        BoxSource::Detected(agent) => {
            let mut found = agent.perceive(&frame.points)?.detections;
            found.sort_by(|a, b| b.score.total_cmp(&a.score));
            Ok(found.into_iter().map(|detection| detection.box3d).collect())
        }
        BoxSource::Annotated => {
            let lidar_from_world = world_from_lidar.inverse();
            let objects = frame.objects.iter();
            let targets = objects.filter(|object| ClassSet::VEHICLES.contains(object.class));
            let mut found: Vec<Box3d> = targets
                .map(|object| ground_truth::upright_box(object, &lidar_from_world))
                .collect();
            // Nearest first, as an estimate of the best detected ones.
            found.sort_by(|a, b| {
                let [a, b] = [a, b].map(|found| found.center_m[0].hypot(found.center_m[1]));
                a.total_cmp(&b)
            });
            Ok(found)
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    const PCD: &str = "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 1\n\
                       HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 1\nDATA ascii\n1 2 3 0.5\n";

    #[test]
    fn frames_without_a_true_pose_are_left_out_and_named() {
        let folder = tempfile::tempdir().unwrap();
        // The ego has no pose at tick 1, its neighbour none at tick 2.
        for (agent, lacking) in [("1", 1), ("2", 2)] {
            let of_agent = folder.path().join(agent);
            fs::create_dir(&of_agent).unwrap();
            for tick in 0..4 {
                let pose = match tick == lacking {
                    true => "",
                    false => "lidar_pose: [0, 0, 2, 0, 0, 0]\n",
                };
                let yaml = format!("{pose}vehicles: {{}}\n");
                fs::write(of_agent.join(format!("{tick:06}.yaml")), yaml).unwrap();
                fs::write(of_agent.join(format!("{tick:06}.pcd")), PCD).unwrap();
            }
        }
        let scenario = dataset::open(folder.path()).unwrap().scenarios.remove(0);
        let mut annotated = BoxSource::Annotated;
        let left_out = run(&[], &mut annotated, (&scenario, 70.0), 0..4, &mut |_| {}).unwrap();
        assert_eq!((left_out.ticks, left_out.failed), (1, 1));
        let reasons = left_out.reasons();
        assert!(
            reasons.contains("no true pose of the ego 1")
                && reasons.contains("tick 000002, agent 2: no true pose"),
            "{reasons}"
        );
    }
}
