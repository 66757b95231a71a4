//! `<planView>`: the elements of a road's reference line.

use super::super::curve::{CurveShape, PlanCurve, Pose2};
use super::super::finding::FindingLog;
use super::element::{Element, MAX_COORDINATE_M, MAX_LENGTH_M, Result, children};

/// Tightest bend: a radius of 0.1 m.
const MAX_CURVATURE: f64 = 10.0;
/// Most that one element may turn, radians; bounds the cost of evaluating it.
const MAX_TURN_RAD: f64 = 20.0;
/// Curvatures beyond this are treated as invalid numbers, 1/m.
const ANY_CURVATURE: f64 = 1e9;
/// The elements' lengths may differ from the road's length by this much, metres; rounding in real files stays far
/// below.
const LENGTH_TOLERANCE_M: f64 = 1.0;
/// Largest gap between consecutive elements, metres.
const JOINT_TOLERANCE_M: f64 = 2.0;
/// An element up to this length whose shape is implausible is replaced by a straight line, metres.
const SHORT_M: f64 = 1.0;

/// Reads a reference line; also returns the length of its road: that of the elements where the road's own differs.
pub(super) fn read(road: Element, log: &mut FindingLog) -> Result<(Vec<PlanCurve>, f64)> {
    let plan_view = road.required("planView")?;
    let mut curves: Vec<PlanCurve> = Vec::new();
    for element in children(plan_view, "geometry") {
        let curve = read_curve(element, log)?;
        if let Some(before) = curves.last() {
            if curve.s_m < before.s_m {
                return Err(element.error_order("s", curve.s_m));
            }
            let gap_m = before.end().distance_m(&curve.start);
            if gap_m > JOINT_TOLERANCE_M {
                return Err(element.error_element(&format!(
                    "starts {gap_m:.2} m from the end of the one before; expected at most {JOINT_TOLERANCE_M}"
                )));
            }
        }
        // An element of no length has no direction of its own and adds nothing.
        if curve.length_m > 0.0 || curves.is_empty() {
            curves.push(curve);
        }
    }
    if curves.is_empty() {
        return Err(plan_view.error_element("has no <geometry>"));
    }
    let total_m: f64 = curves.iter().map(|curve| curve.length_m).sum();
    Ok((curves, road_length_m(road, total_m, log)))
}

fn road_length_m(road: Element, total_m: f64, log: &mut FindingLog) -> f64 {
    let error = match road.number("length", 0.0, MAX_LENGTH_M) {
        Ok(length_m) if (total_m - length_m).abs() <= LENGTH_TOLERANCE_M => return length_m,
        Ok(length_m) => {
            let expected = format!("{total_m}, as its <planView>");
            road.error_value("length", length_m, &expected)
        }
        Err(error) => error,
    };
    error.note(log, "the length of its reference line is used");
    total_m
}

fn read_curve(element: Element, log: &mut FindingLog) -> Result<PlanCurve> {
    let x = element.number("x", -MAX_COORDINATE_M, MAX_COORDINATE_M)?;
    let y = element.number("y", -MAX_COORDINATE_M, MAX_COORDINATE_M)?;
    let start = Pose2::new(x, y, element.number("hdg", -1e4, 1e4)?);
    let length_m = element.number("length", 0.0, MAX_LENGTH_M)?;
    let s_m = element.number("s", 0.0, MAX_LENGTH_M)?;
    let Some(kind) = element.elements().find(|child| child.name() != "userData") else {
        return Err(element.error_element("has no shape"));
    };
    let line = PlanCurve::new(s_m, start, length_m, CurveShape::Line);
    let shape = match kind.name() {
        "line" => return Ok(line),
        "arc" => match curvatures(kind, ["curvature"], length_m, log)? {
            Some([curvature]) => CurveShape::Arc { curvature },
            None => CurveShape::Line,
        },
        "spiral" if length_m == 0.0 => CurveShape::Line,
        "spiral" => match curvatures(kind, ["curvStart", "curvEnd"], length_m, log)? {
            Some([start, end]) => CurveShape::Spiral { start, end },
            None => CurveShape::Line,
        },
        "poly3" => CurveShape::Poly3(kind.cubic(["a", "b", "c", "d"])?),
        "paramPoly3" => return read_param_poly3(element, kind, line, log),
        other => {
            return Err(element.error_element(&format!(
                "holds <{other}>; expected line, arc, spiral, poly3 or paramPoly3"
            )));
        }
    };
    checked(element, PlanCurve { shape, ..line }, log)
}

/// Curvatures of an element; `None` where one is tighter than any road bends: the element becomes a straight
/// line.
fn curvatures<const N: usize>(
    element: Element,
    names: [&'static str; N],
    length_m: f64,
    log: &mut FindingLog,
) -> Result<Option<[f64; N]>> {
    let bound = MAX_CURVATURE.min(MAX_TURN_RAD / length_m.max(1e-9));
    let mut values = [0.0; N];
    for (value, name) in values.iter_mut().zip(names) {
        *value = element.number(name, -ANY_CURVATURE, ANY_CURVATURE)?;
    }
    let mut named = values.iter().zip(names);
    let Some((value, name)) = named.find(|(value, _)| value.abs() > bound) else {
        return Ok(Some(values));
    };
    let error = element.error_range(name, value, -bound, bound);
    error.note(log, &format!("built as a straight line of {length_m} m"));
    Ok(None)
}

/// `line` gives start and length. The parameter runs from 0 to 1 unless the element has it run over the length.
fn read_param_poly3(
    element: Element,
    kind: Element,
    line: PlanCurve,
    log: &mut FindingLog,
) -> Result<PlanCurve> {
    let u = kind.cubic(["aU", "bU", "cU", "dU"])?;
    let v = kind.cubic(["aV", "bV", "cV", "dV"])?;
    let [by_length, by_share] = [false, true].map(|normalized| PlanCurve {
        shape: CurveShape::ParamPoly3 { u, v, normalized },
        ..line
    });
    let has_length = line.length_m > 0.0;
    let default = if has_length { by_share } else { by_length };
    match kind.optional_text("pRange").map(str::trim) {
        Some("arcLength") => return checked(element, by_length, log),
        Some("normalized") => return checked(element, default, log),
        Some(_) => kind.note_value(log, "pRange", "treated as absent: normalized"),
        None => {}
    }
    if has_length && !fits(&by_share) && fits(&by_length) {
        let found = "has no pRange and fits its length only by arcLength";
        kind.note(log, found, "arcLength is used");
        return Ok(by_length);
    }
    checked(element, default, log)
}

/// The curve, if it is about as long as its element; a short one that is not becomes a straight line.
fn checked(element: Element, curve: PlanCurve, log: &mut FindingLog) -> Result<PlanCurve> {
    // No tenth may be longer than twice its nominal length, which arbitrary polynomials exceed.
    if tenths_m(&curve).all(|chord_m| chord_m <= 0.2 * curve.length_m + 0.1) {
        return Ok(curve);
    }
    let expected = "about the length of its curve";
    let error = element.error_value("length", curve.length_m, expected);
    if curve.length_m > SHORT_M {
        return Err(error);
    }
    error.note(log, "built as a straight line");
    let shape = CurveShape::Line;
    Ok(PlanCurve { shape, ..curve })
}

/// True if a curve is as long as its element up to a factor of two.
fn fits(curve: &PlanCurve) -> bool {
    let measured_m: f64 = tenths_m(curve).sum();
    measured_m > 0.5 * curve.length_m && measured_m < 2.0 * curve.length_m
}

/// Distances between the ends of each tenth of a curve, metres.
fn tenths_m(curve: &PlanCurve) -> impl Iterator<Item = f64> {
    (0..10).map(move |tenth: u32| {
        let [from, to] =
            [tenth, tenth + 1].map(|tenth| curve.at(curve.length_m * f64::from(tenth) / 10.0));
        from.distance_m(&to)
    })
}
