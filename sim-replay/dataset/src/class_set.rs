//! Sets of object classes: the classes of annotated objects that a detector is expected to find.

use std::fmt;
use std::str::FromStr;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::frame::ObjectClass;

/// Name of the four classes of motor vehicles together.
const VEHICLE: &str = "vehicle";

/// A set of object classes. As text: names with commas between, `vehicle` for car, van, truck and bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "Vec<String>", into = "Vec<String>")]
pub struct ClassSet(u8);

impl ClassSet {
    /// Cars, vans, trucks and buses.
    pub const VEHICLES: Self = Self(0b000_1111);
    /// Everything but pedestrians, as V2V4Real evaluates.
    pub(crate) const ALL_BUT_PEDESTRIANS: Self = Self(0b101_1111);

    /// True if a class is in the set.
    pub fn contains(self, class: ObjectClass) -> bool {
        self.0 & bit(class) != 0
    }

    fn of<'a>(names: impl IntoIterator<Item = &'a str>) -> Result<Self, String> {
        let mut set = Self(0);
        for asked in names.into_iter().map(str::trim) {
            set.0 |= match asked.parse::<ObjectClass>() {
                Ok(class) => bit(class),
                Err(_) if asked == VEHICLE => Self::VEHICLES.0,
                Err(error) => return Err(error),
            };
        }
        match set.0 {
            0 => Err("no class is given".into()),
            _ => Ok(set),
        }
    }
}

/// The bits follow the order of the enum, on which the constants above rely.
fn bit(class: ObjectClass) -> u8 {
    1 << class as u8
}

impl FromStr for ClassSet {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::of(text.split(','))
    }
}

impl TryFrom<Vec<String>> for ClassSet {
    type Error = String;

    fn try_from(names: Vec<String>) -> Result<Self, String> {
        Self::of(names.iter().map(String::as_str))
    }
}

impl From<ClassSet> for Vec<String> {
    /// The names of the classes; `vehicle` if all four kinds of vehicles are in the set.
    fn from(set: ClassSet) -> Self {
        let vehicles = ClassSet::VEHICLES;
        let has_vehicles = set.0 & vehicles.0 == vehicles.0;
        let others = ObjectClass::ALL
            .iter()
            .filter(|class| set.contains(**class) && !(has_vehicles && vehicles.contains(**class)));
        let vehicle = has_vehicles.then_some(VEHICLE).into_iter();
        let names = vehicle.chain(others.map(|class| class.name()));
        names.map(str::to_owned).collect()
    }
}

impl fmt::Display for ClassSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&Vec::<String>::from(*self).join(","))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vehicles_are_four_classes() {
        let vehicles: ClassSet = "vehicle".parse().unwrap();
        assert_eq!(vehicles, ClassSet::VEHICLES);
        assert_eq!(vehicles, "car,van,truck,bus".parse().unwrap());
        assert!(
            vehicles.contains(ObjectClass::Truck) && !vehicles.contains(ObjectClass::TwoWheeler)
        );
        assert_eq!(
            ClassSet::ALL_BUT_PEDESTRIANS.to_string(),
            "vehicle,two_wheeler,other"
        );
    }

    #[test]
    fn text_and_files_agree() {
        let set: ClassSet = "pedestrian, car".parse().unwrap();
        assert_eq!(set.to_string(), "car,pedestrian");
        let json = serde_json::to_string(&set).unwrap();
        assert_eq!(json, r#"["car","pedestrian"]"#);
        assert_eq!(serde_json::from_str::<ClassSet>(&json).unwrap(), set);
    }

    #[test]
    fn an_unknown_class_is_reported_with_the_known_ones() {
        let error = "vehicles".parse::<ClassSet>().unwrap_err();
        assert!(
            error.starts_with("\"vehicles\" is no class: expected vehicle, car,"),
            "{error}"
        );
        assert!("".parse::<ClassSet>().is_err());
    }
}
