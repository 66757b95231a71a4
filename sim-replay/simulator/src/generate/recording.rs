//! Scene recording before any sensor is simulated: vehicles at each stored frame, and the choice of the agents.

use super::error::SynthError;
use super::parking::{ParkedVehicle, park};
use super::raycast::{Course, Placement};
use super::traffic::{Rectangle, STEP_S, Traffic, TrafficOptions};
use super::vehicle::Vehicle;
use super::world::World;
use dataset::ground_truth::GroundTruthRule;
use support::random::{SplitMix64, derive_seed};

/// Communication range: agents farther than this from the ego are not received, metres.
const COMM_RANGE_M: f64 = GroundTruthRule::OPV2V.comm_range_m;
/// Companions are chosen within this, so that few frames fall out of range, metres.
const COMPANION_RANGE_M: f64 = 62.0;
/// Share of frames that a companion should be in range.
const TOGETHER: f64 = 0.9;
/// Scenes that are tried until one has enough companions.
const ATTEMPTS: u64 = 24;
/// A drive during which the ego stands for longer is simulated again, seconds.
const LONGEST_STAND_S: f64 = 60.0;
/// Traffic around the focus, metres: the visible range of a companion at the edge of the communication range, and a
/// margin.
const TRAFFIC_RADIUS_M: f64 = 210.0;
/// Tick of the first stored frame, as in OpenCDA's recordings.
const FIRST_TICK: u64 = 60;

/// Parameters of a scene to record.
#[derive(Debug, Clone)]
pub(crate) struct SceneSpec {
    pub(crate) name: String,
    pub(crate) seed: u64,
    pub(crate) agents: usize,
    pub(crate) frames: usize,
    pub(crate) steps_per_frame: usize,
    pub(crate) explores: bool,
}

/// One scene.
#[derive(Debug)]
pub(crate) struct SceneRecording {
    /// Moving vehicles, by index.
    pub(crate) vehicles: Vec<Vehicle>,
    pub(crate) parked: Vec<ParkedVehicle>,
    pub(crate) frames: Vec<RecordedFrame>,
    /// The agents, ego first, as indices of vehicles.
    pub(crate) agents: Vec<usize>,
}

/// All moving vehicles over the sweep that ends at one capture time.
#[derive(Debug)]
pub(crate) struct RecordedFrame {
    /// Steps of the simulation until the end of the sweep.
    pub(crate) tick: u64,
    /// Present vehicles, in the order of their indices.
    pub(crate) moving: Vec<Moving>,
}

/// One vehicle over one sweep.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Moving {
    pub(crate) vehicle: usize,
    pub(crate) id: i64,
    pub(crate) motion: Course,
    pub(crate) speed_mps: f64,
}

impl RecordedFrame {
    /// The motion of a vehicle that is present.
    pub(crate) fn of(&self, vehicle: usize) -> Option<&Moving> {
        let moving = &self.moving;
        let place = moving.binary_search_by_key(&vehicle, |moving| moving.vehicle);
        Some(&moving[place.ok()?])
    }
}

/// Simulates a scene; tries others of the same seed if too few vehicles stay near the ego.
pub(crate) fn record(world: &World<'_>, spec: &SceneSpec) -> Result<SceneRecording, SynthError> {
    // Labels of the streams: 1 parked vehicles, 2 traffic, 3 choice of agents, and 4 positioning in `scenes`.
    let seed = derive_seed(spec.seed, &[1]);
    let parked = park(world.map_model, &world.lane_index, seed);
    // Quality, vehicles, frames and agents of the best attempt.
    let mut best: Option<(f64, Vec<Vehicle>, _, _)> = None;
    for attempt in 0..ATTEMPTS {
        let seed = derive_seed(spec.seed, &[2, attempt]);
        let (vehicles, frames) = simulate(world, spec, &parked, seed)?;
        let mut random = SplitMix64::derived(spec.seed, &[3, attempt]);
        let (together, agents) = choose_agents(&vehicles, &frames, spec.agents, &mut random);
        // A drive that ends in a permanent jam shows one place again and again.
        let standing_s = longest_stand_s(&frames);
        let quality = match standing_s > LONGEST_STAND_S {
            // Below every drive that goes on, and the lower the longer it stands.
            true => together.min(0.0) - standing_s,
            false => together,
        };
        if best.as_ref().is_none_or(|(least, ..)| quality > *least) {
            best = Some((quality, vehicles, frames, agents));
        }
        if quality >= TOGETHER {
            break;
        }
    }
    let (_, vehicles, frames, agents) = best.expect("there are attempts");
    if agents.len() < spec.agents {
        let (scenario, found, wanted) = (&spec.name, agents.len() - 1, spec.agents - 1);
        return Err(SynthError::TooFewCompanions(format!(
            "scene {scenario}: {found} vehicles stay within {COMM_RANGE_M} m of the ego, {wanted} are wanted; fewer \
             --vehicles or --frames help"
        )));
    }
    Ok(SceneRecording {
        vehicles,
        parked,
        frames,
        agents,
    })
}

fn simulate(
    world: &World<'_>,
    spec: &SceneSpec,
    parked: &[ParkedVehicle],
    seed: u64,
) -> Result<(Vec<Vehicle>, Vec<RecordedFrame>), SynthError> {
    let mut random = SplitMix64::new(seed);
    let spawns = &world.roads.spawns;
    if spawns.is_empty() {
        return Err(SynthError::NoRoad(world.map_model.name.clone()));
    }
    let footprints: Vec<Rectangle> = parked.iter().map(ParkedVehicle::rectangle).collect();
    let options = TrafficOptions {
        vehicles_per_km: random.between(7.0, 21.0),
        radius_m: TRAFFIC_RADIUS_M,
        focus_explores: spec.explores,
    };
    let start = spawns[random.below(spawns.len())];
    let seed = derive_seed(seed, &[1]);
    let mut traffic = Traffic::new(&world.roads, &footprints, options, start, seed);
    // Until gaps and speeds are those of traffic rather than of the random initial state.
    let settling_steps = (random.between(6.0, 12.0) / STEP_S) as usize;
    (0..settling_steps).for_each(|_| traffic.step());
    let mut frames = Vec::with_capacity(spec.frames);
    for frame in 0..spec.frames {
        let steps = if frame == 0 { 1 } else { spec.steps_per_frame };
        (0..steps).for_each(|_| traffic.step());
        let tick = FIRST_TICK + (frame * spec.steps_per_frame) as u64;
        let cars = traffic.cars.iter().enumerate();
        let present = cars.filter(|(_, car)| car.is_present);
        let moving = present.map(|(vehicle, car)| Moving {
            vehicle,
            id: car.id,
            motion: car.motion,
            speed_mps: car.speed_mps,
        });
        let moving = moving.collect();
        frames.push(RecordedFrame { tick, moving });
    }
    let vehicles = traffic.cars.into_iter().map(|car| car.vehicle);
    Ok((vehicles.collect(), frames))
}

/// Chooses the ego's companions at random among those that stay near it. Also returns the smallest share of frames in
/// which one of them is in range.
fn choose_agents(
    vehicles: &[Vehicle],
    frames: &[RecordedFrame],
    count: usize,
    random: &mut SplitMix64,
) -> (f64, Vec<usize>) {
    let mut together: Vec<(f64, usize)> = (1..vehicles.len())
        .filter(|&vehicle| vehicles[vehicle].kind.is_low())
        .map(|vehicle| (share_together(frames, vehicle), vehicle))
        .filter(|(share, _)| *share > 0.0)
        .collect();
    random.shuffle(&mut together);
    // All that stay near are equivalent, so that following, opposite and crossing agents all occur.
    together.sort_by(|a, b| b.0.min(TOGETHER).total_cmp(&a.0.min(TOGETHER)));
    together.truncate(count - 1);
    let quality = if together.len() + 1 < count {
        -((count - 1 - together.len()) as f64)
    } else {
        together.iter().map(|(share, _)| *share).fold(1.0, f64::min)
    };
    let mut agents: Vec<usize> = together.into_iter().map(|(_, vehicle)| vehicle).collect();
    agents.push(0);
    // The ego is vehicle 0, so sorting puts it first.
    agents.sort_unstable();
    (quality, agents)
}

/// Share of the frames in which a vehicle is near the ego; 0 for one that was replaced by another on the way.
fn share_together(frames: &[RecordedFrame], vehicle: usize) -> f64 {
    let first = frames.first().and_then(|frame| frame.of(vehicle));
    let id = first.map(|moving| moving.id);
    let mut near = 0;
    for frame in frames {
        let (Some(ego), Some(other)) = (frame.of(0), frame.of(vehicle)) else {
            return 0.0;
        };
        if Some(other.id) != id {
            return 0.0;
        }
        near += usize::from(distance_m(&ego.motion.end, &other.motion.end) < COMPANION_RANGE_M);
    }
    near as f64 / frames.len() as f64
}

/// Longest time for which the ego stands still, seconds.
fn longest_stand_s(frames: &[RecordedFrame]) -> f64 {
    let mut since: Option<(&Moving, u64)> = None;
    let mut longest = 0;
    for frame in frames {
        let Some(own) = frame.of(0) else { continue };
        match since {
            // Compared with the beginning of the stand, so that slow creeping ends it in time.
            Some((before, tick)) if distance_m(&before.motion.end, &own.motion.end) < 0.1 => {
                longest = longest.max(frame.tick - tick);
            }
            _ => since = Some((own, frame.tick)),
        }
    }
    longest as f64 * STEP_S
}

fn distance_m(a: &Placement, b: &Placement) -> f64 {
    (a.position_m - b.position_m).xy().norm()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stand_is_as_long_as_the_place_is_the_same() {
        let places = [0.0, 5.0, 5.0, 5.05, 5.0, 9.0, 9.0];
        let frames: Vec<_> = places
            .iter()
            .zip(0..)
            .map(|(&x_m, k)| RecordedFrame {
                tick: 60 + 20 * k,
                moving: vec![Moving {
                    vehicle: 0,
                    id: 1000,
                    motion: Course::still(Placement::level([x_m, 0.0, 0.0], 0.0)),
                    speed_mps: 0.0,
                }],
            })
            .collect();
        assert!((longest_stand_s(&frames) - 3.0).abs() < 1e-9);
        assert_eq!(longest_stand_s(&[]), 0.0);
    }
}
