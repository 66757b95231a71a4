//! Values along a road as cubics, and the road's cross-sections: `<lateralProfile>`.

use super::super::finding::FindingLog;
use super::super::lateral::{CrossShape, LateralProfile, MAX_SHAPE_M, MAX_SLOPE_RAD};
use super::super::profile::Profile;
use super::super::road::MAX_OFFSET_M;
use super::element::{Element, MAX_LENGTH_M, Result, children, noted};

/// Samples along a road at which slopes are checked.
const LOOKS: u32 = 50;
/// Action for parts that are not read or not built.
const LEFT_OUT: &str = "left out: the road is built without it";

/// Cubics a, b, c, d from the elements `name` of `parent`, by rising `start`.
pub(super) fn read_profile(
    parent: Element,
    name: &'static str,
    start: &'static str,
    bound: f64,
) -> Result<Profile> {
    let mut records: Vec<(f64, [f64; 4])> = Vec::new();
    for element in children(parent, name) {
        let s = element.number(start, 0.0, MAX_LENGTH_M)?;
        element.number("a", -bound, bound)?;
        if records.last().is_some_and(|&(before, _)| s < before) {
            return Err(element.error_order(start, s));
        }
        records.push((s, element.cubic(["a", "b", "c", "d"])?));
    }
    Ok(Profile { records })
}

/// Reads the cross-sections of a road. A part that cannot be read, or is steeper than the limit, is left out.
pub(super) fn read_lateral(road: Element, length_m: f64, log: &mut FindingLog) -> LateralProfile {
    let mut lateral = LateralProfile::default();
    let Some(element) = road.child("lateralProfile") else {
        return lateral;
    };
    lateral.superelevation_rad = slope(element, "superelevation", None, length_m, log);
    lateral.crossfall_rad =
        ["left", "right"].map(|side| slope(element, "crossfall", Some(side), length_m, log));
    let shapes = noted(read_shapes(element), log, "shape of the road left out");
    let shapes = shapes.filter(|shapes| shapes.iter().any(|shape| !is_zero(&shape.height_m)));
    lateral.shapes = shapes.unwrap_or_default();
    for other in element.elements() {
        if !["superelevation", "crossfall", "shape", "userData"].contains(&other.name()) {
            let found = format!("up to {:.2} m high", other.largest("constant", "a"));
            other.note(log, &found, LEFT_OUT);
        }
    }
    lateral
}

/// The records `name`; with a `side`, those of this side or of both.
fn slope(
    parent: Element,
    name: &'static str,
    side: Option<&str>,
    length_m: f64,
    log: &mut FindingLog,
) -> Profile {
    let read = read_profile(parent, name, "s", MAX_OFFSET_M);
    let mut profile = noted(read, log, LEFT_OUT).unwrap_or_default();
    let sides = children(parent, name).map(|record| record.optional_text("side"));
    let mut wanted =
        sides.map(|of| side.is_none() || of == side || matches!(of, None | Some("both")));
    profile.records.retain(|_| wanted.next().unwrap_or(false));
    // Records of zeros only would make a level road count as banked.
    if is_zero(&profile) {
        return Profile::default();
    }
    let slopes = profile.samples(length_m, LOOKS);
    let steepest = slopes.map(f64::abs).fold(0.0, f64::max);
    if steepest > MAX_SLOPE_RAD {
        let found =
            format!("holds <{name}> up to {steepest:.2} rad, expected at most {MAX_SLOPE_RAD}");
        parent.note(log, &found, LEFT_OUT);
        return Profile::default();
    }
    profile
}

/// The records of one place along the road, by rising `t`, are one cross-section.
fn read_shapes(parent: Element) -> Result<Vec<CrossShape>> {
    let mut shapes: Vec<CrossShape> = Vec::new();
    for element in children(parent, "shape") {
        let s_m = element.number("s", 0.0, MAX_LENGTH_M)?;
        let t_m = element.number("t", -MAX_OFFSET_M, MAX_OFFSET_M)?;
        element.number("a", -MAX_SHAPE_M, MAX_SHAPE_M)?;
        let record = (t_m, element.cubic(["a", "b", "c", "d"])?);
        match shapes.last_mut() {
            Some(last) if last.s_m == s_m => {
                let records = &mut last.height_m.records;
                if records.last().is_some_and(|&(before, _)| t_m < before) {
                    return Err(element.error_order("t", t_m));
                }
                records.push(record);
            }
            Some(last) if last.s_m > s_m => return Err(element.error_order("s", s_m)),
            _ => shapes.push(CrossShape {
                s_m,
                height_m: Profile {
                    records: vec![record],
                },
            }),
        }
    }
    Ok(shapes)
}

fn is_zero(profile: &Profile) -> bool {
    let mut records = profile.records.iter();
    records.all(|(_, coefficients)| *coefficients == [0.0; 4])
}
