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
use crate::alignment::{AlignError, AlignInput, AlignmentMethod, AlignmentSpec, NotAligned};
use ego_fuser::ego::Ego;

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

/// Compares methods on the ticks of a scenario in `ticks`; reports every pair when it is done. Returns the frames that
/// cannot be read; without the ego's its tick is left out.
///
/// # Errors
/// [`AlignError`] at the first frame that has no true pose.
pub fn run(
    specs: &[AlignmentSpec],
    box_source: &mut BoxSource,
    scenario: &Scenario,
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
        if loaded.frames.first().is_none_or(|(agent, _)| *agent != 0) {
            continue;
        }
        let frames: Vec<Frame> = loaded.frames.into_iter().map(|(_, frame)| frame).collect();
        let truth = frames.iter().map(|frame| {
            let pose = frame.world_from_lidar.map(|pose| pose.isometry());
            pose.ok_or_else(|| {
                let (scenario, stem) = (&scenario.name, &scenario.ticks[tick].stem);
                AlignError::NoTruth(format!("{scenario}, {stem}: agent {}", frame.cav))
            })
        });
        let truth = truth.collect::<Result<Vec<_>, _>>()?;
        let boxes = needs_boxes.then_some(&mut *box_source);
        moment(&mut methods, boxes, &frames, &truth, on_outcome)?;
    }
    Ok(left_out)
}

/// All pairs of one tick; the ego comes first.
fn moment(
    methods: &mut [Box<dyn AlignmentMethod>],
    mut box_source: Option<&mut BoxSource>,
    frames: &[Frame],
    truth: &[Isometry3<f64>],
    on_outcome: &mut dyn FnMut(PairOutcome),
) -> Result<(), AlignError> {
    let ego_from: Vec<Isometry3<f64>> = truth.iter().map(|pose| truth[0].inv_mul(pose)).collect();
    // The ego is at distance 0, so it is always the first.
    let near: Vec<usize> = (0..frames.len())
        .filter(|&index| ego_from[index].translation.vector.norm() <= Ego::COMM_RANGE_M)
        .collect();
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
