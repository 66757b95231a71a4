//! Objects and optional fields in the YAML of the OPV2V family. An invalid part is left out and reported; the rest of
//! the frame is kept.

use std::collections::HashMap;
use std::path::Path;

use protocol::{EgoMotion, Handedness, InvalidPose, Pose};

use super::yaml::{Value, YamlField, whole};
use super::{Problem, ReadError, Result, classes};
use crate::carla_pose::CarlaPose;
use crate::frame::{Frame, Object, ObjectClass};

/// Kilometres per hour in a metre per second.
const KMH_PER_MPS: f64 = 3.6;
/// Largest half size of an object, metres. Simulators have written bicycles of 500 m.
const MAX_HALF_SIZE_M: f64 = 50.0;
/// Largest speed of an object, metres per second.
const MAX_SPEED_MPS: f64 = 1000.0;
/// Keys of an object's type in related formats; the first key present is used.
const CLASS_KEYS: [&str; 4] = ["obj_type", "object_type", "class", "type"];

/// A frame's annotations, and the parts left out of them.
#[derive(Debug)]
pub(super) struct Annotations<'a> {
    root: YamlField<'a>,
    /// Parts that were left out.
    pub(super) problems: Vec<Problem>,
}

impl<'a> Annotations<'a> {
    pub(super) fn new(root: YamlField<'a>) -> Self {
        Self {
            root,
            problems: Vec::new(),
        }
    }

    /// The first of `keys` that is present in `parent`; one that cannot be read is left out.
    fn optional<T>(
        &mut self,
        parent: &YamlField<'a>,
        keys: &[&str],
        read: impl Fn(&YamlField<'a>) -> Result<T>,
    ) -> Option<T> {
        let field = keys
            .iter()
            .find_map(|key| parent.optional(key).ok().flatten())?;
        let value = read(&field).map_err(|error| self.left_out("field", error));
        value.ok()
    }

    /// Adds what a vehicle recorded of itself to its frame: its motion as its sensors measured it (`imu` of generated
    /// scenes), and otherwise its `ego_speed`, and its poses, which `pose` reads. A yaw rate of left-handed files is
    /// clockwise.
    pub(super) fn add_vehicle(
        &mut self,
        frame: &mut Frame,
        pose: impl Fn(&YamlField<'a>) -> Result<Pose>,
    ) {
        let root = self.root.clone();
        if let Some(imu) = root.optional("imu").ok().flatten() {
            let counter_clockwise = match frame.source_handedness {
                Handedness::Left => -1.0,
                Handedness::Right => 1.0,
            };
            frame.yaw_rate_rad_s = self.optional(&imu, &["yaw_rate_degps"], |field| {
                let most_degps = EgoMotion::MAX_YAW_RATE_RAD_S.to_degrees();
                let yaw_rate_degps = within(field, field.number()?, most_degps, "degrees/s")?;
                Ok(counter_clockwise * yaw_rate_degps.to_radians())
            });
            frame.speed_mps = self.optional(&imu, &["speed_mps"], |field| {
                own_speed_mps(field, field.number()?)
            });
        }
        frame.speed_mps = frame.speed_mps.or_else(|| {
            self.optional(&root, &["ego_speed"], |field| {
                own_speed_mps(field, speed_mps_of_kmh(field)?)
            })
        });
        frame.world_from_vehicle = self.optional(&root, &["true_ego_pos", "true_ego_pose"], &pose);
        frame.gnss_world_from_vehicle =
            self.optional(&root, &["predicted_ego_pos", "predicted_ego_pose"], &pose);
    }

    /// All valid objects. `id` gives the id of an object of the listed number, `pose` transforms its pose from the file
    /// to the world.
    pub(super) fn objects(
        &mut self,
        id: impl Fn(i64, &YamlField<'a>) -> Result<i64>,
        pose: impl Fn(&CarlaPose) -> Result<Pose, InvalidPose>,
    ) -> Vec<Object> {
        let entries = self.object_entries().unwrap_or_else(|error| {
            self.left_out("list of objects", error);
            Vec::new()
        });
        // Python keeps the last of equal keys. The others are reported.
        let keys = entries.iter().map(|(key, _)| *key);
        let last: HashMap<&str, usize> = keys.zip(0..).collect();
        let mut objects = Vec::with_capacity(entries.len());
        for (index, (key, field)) in entries.iter().enumerate() {
            let object = if last.get(key) == Some(&index) {
                self.object(key, field, &id, &pose)
            } else {
                Err(field.error("listed again below"))
            };
            match object {
                Ok(object) => objects.push(object),
                Err(error) => self.left_out("object", error),
            }
        }
        objects
    }

    fn object(
        &mut self,
        key: &str,
        field: &YamlField<'a>,
        id: &impl Fn(i64, &YamlField<'a>) -> Result<i64>,
        pose: &impl Fn(&CarlaPose) -> Result<Pose, InvalidPose>,
    ) -> Result<Object> {
        let listed_id = listed_id(key, field)?;
        Ok(Object {
            id: id(listed_id, field)?,
            world_from_object: pose(&place(field)?)
                .map_err(|error| field.error(error.to_string()))?,
            size_m: size_m(field)?,
            class: self.class(field),
            speed_mps: self.optional(field, &["speed"], speed_mps),
        })
    }

    /// The map of annotated objects: `vehicles`, or `objects` in relatives of the format.
    fn object_entries(&self) -> Result<Vec<(&'a str, YamlField<'a>)>> {
        let root = &self.root;
        let mut keys = ["vehicles", "objects"].into_iter();
        let key = keys.find(|key| root.has(key)).unwrap_or("vehicles");
        match root.optional(key)? {
            Some(field) if matches!(&field.node.value, Value::List(items) if items.is_empty()) => {
                Ok(Vec::new())
            }
            Some(field) => field
                .entries()
                .map_err(|_| field.expected("a map of objects by id")),
            // An empty map may be written as nothing; a missing key is a fault.
            None if root.has(key) => Ok(Vec::new()),
            None => root.required(key).map(|_| Vec::new()),
        }
    }

    /// A car if no type is given. An unknown type is not a vehicle, and is reported once per scenario.
    fn class(&mut self, field: &YamlField<'a>) -> ObjectClass {
        let kind = CLASS_KEYS
            .iter()
            .find_map(|key| Some((*key, field.optional(key).ok().flatten()?)));
        let Some((key, kind)) = kind else {
            return ObjectClass::Car;
        };
        let class = kind.text().ok().and_then(classes::of_name);
        class.unwrap_or_else(|| {
            // The scenario's folder: the same finding in several agents' frames is one then.
            let scenario = self.root.path.ancestors().nth(2).unwrap_or(Path::new(""));
            let problem = classes::unknown(scenario, key, &kind.node.value.kind());
            if !self.problems.contains(&problem) {
                self.problems.push(problem);
            }
            ObjectClass::Other
        })
    }

    fn left_out(&mut self, what: &str, error: ReadError) {
        self.problems.push(Problem::left_out(what, error));
    }
}

/// Ids are integers; those that went through an array of floats have a point.
fn listed_id(key: &str, field: &YamlField<'_>) -> Result<i64> {
    let id = key.parse().ok().or_else(|| whole(key.parse().ok()?));
    id.ok_or_else(|| field.error(format!("{key:?} is no object id, expected an integer")))
}

/// Centre and rotation of the box, in the numbers of the file.
fn place(field: &YamlField<'_>) -> Result<CarlaPose> {
    let center = field
        .optional("center")?
        .map_or(Ok([0.0; 3]), |center| center.numbers::<3>())?;
    let location = field.required("location")?.numbers()?;
    let angle = field.required("angle")?;
    let place = CarlaPose::of_box(location, angle.numbers()?, center);
    let place = place.in_degrees().and_then(CarlaPose::upright);
    place.map_err(|reason| angle.error(reason))
}

/// `extent` holds half sizes.
fn size_m(field: &YamlField<'_>) -> Result<[f64; 3]> {
    let extent = field.required("extent")?;
    let half = extent.numbers::<3>()?;
    if half
        .iter()
        .any(|&half| half <= 0.0 || half > MAX_HALF_SIZE_M)
    {
        return Err(extent.error(format!(
            "{half:?} m, expected half sizes above 0 and up to {MAX_HALF_SIZE_M} m"
        )));
    }
    Ok(half.map(|half| 2.0 * half))
}

/// Speed of an object, metres per second.
fn speed_mps(field: &YamlField<'_>) -> Result<f64> {
    within(field, speed_mps_of_kmh(field)?, MAX_SPEED_MPS, "m/s")
}

/// Speed of the vehicle itself, metres per second.
fn own_speed_mps(field: &YamlField<'_>, speed_mps: f64) -> Result<f64> {
    within(field, speed_mps, EgoMotion::MAX_SPEED_MPS, "m/s")
}

/// km/h to m/s. Related formats write a vector; its length is the speed.
fn speed_mps_of_kmh(field: &YamlField<'_>) -> Result<f64> {
    let kmh = field.number().or_else(|error| {
        let (_, vector) = field.array().map_err(|_| error)?;
        let squares = vector.iter().map(|component| component * component);
        Ok(squares.sum::<f64>().sqrt())
    });
    Ok(kmh? / KMH_PER_MPS)
}

/// The value, if its size is at most `most`.
fn within(field: &YamlField<'_>, value: f64, most: f64, unit: &str) -> Result<f64> {
    // NaN does not satisfy this comparison.
    match value.abs() <= most {
        true => Ok(value),
        false => Err(field.error(format!("{value} {unit}, expected at most {most:.0}"))),
    }
}
