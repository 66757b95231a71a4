//! Names of object classes in the annotations of all layouts.
//!
//! Names are compared without case, blanks, `_` and `-`. They are those of V2V4Real, V2X-Real and V2XPnP (their
//! misspellings included), V2X-Radar, RCooper, DAIR-V2X, KITTI, nuScenes, and CARLA's blueprints.

use std::path::Path;

use protocol::text::excerpt;

use super::{Problem, ReadError};
use crate::frame::ObjectClass;

/// Names of each class, of [`plain`] form. V2X-Real counts `LongVehicle` among cars and `TrashCan` among trucks.
const NAMES: [(ObjectClass, &str); 7] = [
    (
        ObjectClass::Car,
        "car suv sedan vehicle motorvehicle passengercar policecar tourcar taxi longvehicle",
    ),
    (ObjectClass::Van, "van minibus ambulance"),
    (
        ObjectClass::Truck,
        "truck concretetruck firetruck boxtruck pickuptruck trailer hugevehicle largevehicle construction \
         constructionvehicle engineeringvehicle crane forklift bulldozer excavator trashcan",
    ),
    (ObjectClass::Bus, "bus tram coach"),
    (
        ObjectClass::TwoWheeler,
        "cyclist bicycle bike bicyclerider bicyclegroup densebicycle biker rider motorcycle motorcyclist \
         motorcyclerider motorcylerider motorbike motorrider nonmotorrider scooter scooterrider tricycle tricyclist \
         tricyclerider trimotorcycle threewheeler twowheeler barrow barrowlist",
    ),
    (
        ObjectClass::Pedestrian,
        "pedestrian person personsitting humansitting child roadworker walker adult",
    ),
    (
        ObjectClass::Other,
        "other misc dontcare cone trafficcone trafficsign trafficsigns barrier trafficbarrier roadbarrel babycart \
         firehydrant saftytriangle safetytriangle animal dog unknown unknownmovable unknownunmovable unknownsmovable \
         unknownsunmovable pedestrianignore carignore otherignore",
    ),
];

/// CARLA's blueprints of the library `vehicle.*` that are no cars, by their last word.
const BLUEPRINTS: [(ObjectClass, &str); 4] = [
    (
        ObjectClass::TwoWheeler,
        "crossbike century omafiets lowrider ninja yzf zx125",
    ),
    (ObjectClass::Truck, "carlacola firetruck europeanhgv"),
    (ObjectClass::Van, "ambulance sprinter t2 t22021"),
    (ObjectClass::Bus, "fusorosa"),
];

/// The class of a name; `None` if the name is unknown.
pub(super) fn of_name(name: &str) -> Option<ObjectClass> {
    of_library(&name.to_ascii_lowercase()).or_else(|| listed(&NAMES, &plain(name)))
}

fn listed(classes: &[(ObjectClass, &str)], name: &str) -> Option<ObjectClass> {
    let mut classes = classes.iter();
    let class = classes.find(|(_, names)| names.split(' ').any(|known| known == name));
    class.map(|(class, _)| *class)
}

/// The finding about an unknown type, the same for all its objects below `dir`.
pub(super) fn unknown(dir: &Path, field: &str, found: &str) -> Problem {
    let reason =
        format!("{found} is an unknown type of object: it counts as other, not as a vehicle");
    Problem::from(&ReadError::malformed_at(dir, None, Some(field), reason))
}

/// The finding about the type of an object in a list of labels, if that is unknown.
pub(super) fn unknown_label(path: &Path, kind: &str) -> Option<Problem> {
    let (dir, shown) = (path.parent().unwrap_or(path), excerpt(kind, 40));
    of_name(kind)
        .is_none()
        .then(|| unknown(dir, "type", &format!("{shown:?}")))
}

/// Names with dots: nuScenes' categories and CARLA's blueprints.
fn of_library(name: &str) -> Option<ObjectClass> {
    let (library, rest) = name.split_once('.')?;
    match library {
        "human" | "walker" => Some(ObjectClass::Pedestrian),
        "movable_object" | "static_object" | "static" | "traffic" | "animal" => {
            Some(ObjectClass::Other)
        }
        "vehicle" => {
            let kind = rest.split('.').next().unwrap_or(rest);
            let model = plain(rest.rsplit('.').next().unwrap_or(rest));
            // `vehicle.bus.rigid` and `vehicle.emergency.police` of nuScenes, or make and model.
            let class = listed(&BLUEPRINTS, &model)
                .or_else(|| of_name(if kind == "emergency" { &model } else { kind }));
            // Makes are not listed: what has no other class in the library of vehicles is a car.
            Some(class.unwrap_or(ObjectClass::Car))
        }
        _ => None,
    }
}

fn plain(name: &str) -> String {
    name.chars()
        .filter(char::is_ascii_alphanumeric)
        .map(|letter| letter.to_ascii_lowercase())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_all_layouts_are_known() {
        let cases: [(ObjectClass, &[&str]); 7] = [
            (
                ObjectClass::Car,
                &[
                    "Car",
                    "car",
                    "PoliceCar",
                    "LongVehicle",
                    "vehicle.car",
                    "vehicle.audi.tt",
                ],
            ),
            (
                ObjectClass::Van,
                &[
                    "Van",
                    "vehicle.emergency.ambulance",
                    "vehicle.volkswagen.t2_2021",
                ],
            ),
            (
                ObjectClass::Truck,
                &[
                    "Truck",
                    "ConcreteTruck",
                    "huge_vehicle",
                    "vehicle.truck",
                    "vehicle.carlamotors.european_hgv",
                ],
            ),
            (
                ObjectClass::Bus,
                &[
                    "Bus",
                    "Tram",
                    "vehicle.bus.rigid",
                    "vehicle.mitsubishi.fusorosa",
                ],
            ),
            (
                ObjectClass::TwoWheeler,
                &[
                    "Cyclist",
                    "BicycleRider",
                    "MotorcyleRider",
                    "ScooterRider",
                    "Tricyclist",
                    "Barrowlist",
                    "vehicle.bicycle",
                    "vehicle.bh.crossbike",
                    "vehicle.harley-davidson.low_rider",
                ],
            ),
            (
                ObjectClass::Pedestrian,
                &[
                    "Pedestrian",
                    "Person_sitting",
                    "Child",
                    "RoadWorker",
                    "human.pedestrian.adult",
                    "walker.pedestrian.0001",
                ],
            ),
            (
                ObjectClass::Other,
                &[
                    "Misc",
                    "TrafficCone",
                    "Traffic cone",
                    "movable_object.barrier",
                ],
            ),
        ];
        for (class, names) in cases {
            for name in names {
                assert_eq!(of_name(name), Some(class), "{name}");
            }
        }
        assert_eq!(of_name("vehicle.emergency.police"), Some(ObjectClass::Car));
        assert_eq!(of_name("Spaceship"), None);
        assert_eq!(of_name(""), None);
    }

    #[test]
    fn our_own_names_are_read_as_they_are() {
        for class in ObjectClass::ALL.iter().copied() {
            assert_eq!(of_name(class.name()), Some(class));
        }
    }
}
