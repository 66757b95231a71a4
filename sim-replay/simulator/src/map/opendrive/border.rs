//! `<border>`: lanes given by the position of their outer edge instead of their width.
//!
//! A border is a `t` coordinate, whatever lies inside it: a lane's width is the distance between its border and the
//! inner border, which is the border or the width of the lane inside it, or the lane offset. Differences of cubics
//! are cubics, so nothing is lost.

use super::super::curve::{cubic, cubic_slope};
use super::super::finding::FindingLog;
use super::super::profile::Profile;
use super::super::road::{MAX_OFFSET_M, RoadLane};
use super::element::{Element, Result};
use super::profile::read_profile;

/// Samples along a section at which widths below zero are searched.
const LOOKS: u32 = 20;
/// A border this far inside the inner border is rounding, metres.
const ROUNDING_M: f64 = 0.01;

/// Position of a section along its road.
pub(super) struct Stretch<'a> {
    pub(super) s_m: f64,
    pub(super) length_m: f64,
    /// Of the whole road, over `s` of the road.
    pub(super) lane_offset: &'a Profile,
}

/// Fills the widths of the lanes of one side, inner lanes first, that have a border and no width.
pub(super) fn widths_from_borders(
    elements: &[Element],
    lanes: &mut [RoadLane],
    sign: i32,
    stretch: &Stretch,
    log: &mut FindingLog,
) -> Result<()> {
    if !elements.iter().any(|one| one.child("border").is_some()) {
        return Ok(());
    }
    let side = f64::from(sign);
    // Outwards from the reference line, as `t` of the left side.
    let mut inner = times(&shifted(stretch.lane_offset, stretch.s_m), side);
    for (element, lane) in elements.iter().zip(lanes) {
        if lane.width.records.is_empty() {
            let border = read_border(*element, side, stretch, log)?;
            if !border.records.is_empty() {
                lane.width = sum(&border, &times(&inner, -1.0));
                let looks = lane.width.samples(stretch.length_m, LOOKS);
                let narrowest = looks.fold(f64::INFINITY, f64::min);
                if narrowest < -ROUNDING_M {
                    let found = format!("has <border> {:.3} m inside the inner border", -narrowest);
                    element.note(log, &found, "width 0 there");
                }
                inner = border;
            }
            continue;
        }
        if element.child("border").is_some() {
            element.note(log, "has both <width> and <border>", "the width is used");
        }
        inner = sum(&inner, &lane.width);
    }
    Ok(())
}

/// A lane's border as a distance outwards from the reference line. Some writers give the borders of right lanes without
/// their sign.
fn read_border(
    element: Element,
    side: f64,
    stretch: &Stretch,
    log: &mut FindingLog,
) -> Result<Profile> {
    let border = read_profile(element, "border", "sOffset", MAX_OFFSET_M)?;
    let looks = border.samples(stretch.length_m, LOOKS);
    let farthest = looks.fold(0.0, |far: f64, t| if t.abs() > far.abs() { t } else { far });
    if farthest * side < 0.0 {
        let found = format!("has <border> at t={farthest:.3} on its other side");
        element.note(log, &found, "its sign is turned");
        return Ok(times(&border, -side));
    }
    Ok(times(&border, side))
}

/// A profile over places counted from `start_m` on.
fn shifted(profile: &Profile, start_m: f64) -> Profile {
    let records = &profile.records;
    let after = records.partition_point(|&(start, _)| start <= start_m);
    let records = records.iter().skip(after.saturating_sub(1));
    let records = records.map(|&(start, coefficients)| match start < start_m {
        true => (0.0, moved(coefficients, start_m - start)),
        false => (start - start_m, coefficients),
    });
    let records = records.collect();
    Profile { records }
}

fn times(profile: &Profile, factor: f64) -> Profile {
    let records = profile.records.iter();
    let records = records.map(|&(start, cubic)| (start, cubic.map(|c| factor * c)));
    let records = records.collect();
    Profile { records }
}

/// Sum of two profiles: a record wherever either has one.
fn sum(a: &Profile, b: &Profile) -> Profile {
    let records = a.records.iter().chain(&b.records);
    let mut starts: Vec<f64> = records.map(|&(start, _)| start).collect();
    starts.sort_unstable_by(f64::total_cmp);
    starts.dedup();
    let records = starts.into_iter().map(|place| {
        let [[a0, a1, a2, a3], [b0, b1, b2, b3]] = [a, b].map(|profile| {
            let record = profile.record_at(place);
            record.map_or([0.0; 4], |(start, coefficients)| {
                moved(coefficients, place - start)
            })
        });
        (place, [a0 + b0, a1 + b1, a2 + b2, a3 + b3])
    });
    let records = records.collect();
    Profile { records }
}

/// The same cubic of a variable that begins `by` later.
fn moved(coefficients: [f64; 4], by: f64) -> [f64; 4] {
    let (value, slope) = (cubic(coefficients, by), cubic_slope(coefficients, by));
    let [_, _, c, d] = coefficients;
    [value, slope, c + 3.0 * d * by, d]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_of_cubics_are_exact_wherever_either_changes() {
        let a = Profile {
            records: vec![
                (0.0, [3.0, 0.1, -0.01, 0.001]),
                (12.0, [2.0, 0.0, 0.02, 0.0]),
            ],
        };
        let b = Profile {
            records: vec![(0.0, [1.0, 0.0, 0.0, 0.0]), (7.5, [0.5, -0.2, 0.0, 0.003])],
        };
        let found = sum(&a, &b);
        assert_eq!(
            found
                .records
                .iter()
                .map(|record| record.0)
                .collect::<Vec<_>>(),
            [0.0, 7.5, 12.0]
        );
        for place in 0..200 {
            let place = f64::from(place) / 10.0;
            assert!(
                (found.at(place) - a.at(place) - b.at(place)).abs() < 1e-9,
                "{place}"
            );
            assert!(
                (shifted(&a, 5.0).at(place) - a.at(place + 5.0)).abs() < 1e-9,
                "{place}"
            );
        }
        assert_eq!(shifted(&Profile::default(), 5.0), Profile::default());
    }
}
