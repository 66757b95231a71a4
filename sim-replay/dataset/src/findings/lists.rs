//! Lists of objects of two agents at the same ticks. The ground truth merges them by id: an object must have one id and
//! one place in both.

use std::collections::{BTreeMap, HashMap};

use protocol::CavId;

use crate::frame::{Frame, Object};
use crate::ground_truth::annotations;
use crate::{Problem, Scenario};

/// The frames of each tick that were read, in the order of the agents.
pub(super) type FramesOfTicks<'a> = BTreeMap<usize, Vec<&'a Frame>>;

/// Least number of boxes of both agents that are evaluated.
const LEAST_SHARED: usize = 10;
/// Largest distance of two boxes of an object, metres: clocks may be 0.1 s apart at 20 m/s.
const MOST_APART_M: f64 = 2.0;
/// Distance of centres below which two boxes are of one object, relative to the smaller side of the first, seen from
/// above: no body has its centre that deep in another one.
const SAME_PLACE: f64 = 0.5;
/// Distance from its first place from which an object moves, metres.
const MOVED_M: f64 = 3.0;
/// Largest share of contradictions among the boxes of both agents.
const MOST_WRONG: f64 = 1.0 / 3.0;

/// Boxes of two agents at a tick that are of one object by their ids or by their places.
struct SharedBox<'a> {
    tick: usize,
    objects: [&'a Object; 2],
    /// True if the object is not where the first agent listed it first.
    is_moving: bool,
}

/// One problem for each agent whose lists contradict those of an agent before it.
pub(super) fn contradictions(scenario: &Scenario, ticks: &FramesOfTicks<'_>) -> Vec<Problem> {
    let agents = scenario.agents.iter().enumerate();
    let problems = agents.filter_map(|(index, second)| {
        let mut before = scenario.agents.iter().take(index);
        before.find_map(|first| {
            let fault = fault(scenario, &shared_boxes(ticks, [first, second]))?;
            let reason = format!("agents {first} and {second}: {fault}");
            Some(Problem::about(&scenario.name, "id", &reason))
        })
    });
    problems.collect()
}

/// The boxes that two agents share, from what they contribute to the ground truth of each tick.
fn shared_boxes<'a>(ticks: &FramesOfTicks<'a>, agents: [&CavId; 2]) -> Vec<SharedBox<'a>> {
    let (mut shared, mut first_places) = (Vec::new(), HashMap::new());
    for (&tick, frames) in ticks {
        let lists = annotations(frames);
        let [first, second] = agents.map(|agent| {
            let index = frames.iter().position(|frame| frame.cav == *agent);
            let list = index.and_then(|index| lists.get(index).copied());
            list.unwrap_or_default()
        });
        for mine in first {
            let first_place = *first_places.entry(mine.id).or_insert(mine);
            let near_m = SAME_PLACE * mine.size_m[0].min(mine.size_m[1]);
            let same = |other: &&Object| mine.id == other.id || distance_m(mine, other) < near_m;
            shared.extend(second.iter().filter(same).map(|other| SharedBox {
                tick,
                objects: [mine, other],
                is_moving: distance_m(first_place, mine) > MOVED_M,
            }));
        }
    }
    shared
}

/// Distance of the centres in the plane, metres.
pub(super) fn distance_m(one: &Object, other: &Object) -> f64 {
    (one.world_from_object).planar_distance_m(&other.world_from_object)
}

/// The fault of the boxes of two agents together, of all of them or of those that move: parked vehicles hide a late
/// clock.
fn fault(scenario: &Scenario, shared: &[SharedBox<'_>]) -> Option<String> {
    let moving = shared.iter().filter(|shared| shared.is_moving).collect();
    let parts: [Vec<&SharedBox<'_>>; 2] = [shared.iter().collect(), moving];
    parts.into_iter().find_map(|shared| {
        let is_wrong = |[one, other]: [&Object; 2]| {
            one.id != other.id || distance_m(one, other) > MOST_APART_M
        };
        let wrong = shared.iter().filter(|shared| is_wrong(shared.objects));
        let (count, all) = (wrong.clone().count(), shared.len());
        let first = wrong.clone().next()?;
        let [one, other] = first.objects.map(|object| {
            let [x, y, _] = object.world_from_object.translation_m;
            format!("{} at ({x:.1}, {y:.1}) m", object.id)
        });
        let stem = scenario.stem(first.tick);
        let is_fault = all >= LEAST_SHARED && count as f64 > MOST_WRONG * all as f64;
        is_fault.then(|| {
            format!(
                "{count} of {all} boxes that both list contradict each other, first {one} and {other} in {stem}: ids, \
                 clocks or worlds of the two differ"
            )
        })
    })
}
