//! ROS 2 message definitions, with fields and constants but without comments and default values.

/// A type: `package/Name` and its own fields.
pub(crate) type Definition = (&'static str, &'static str);

/// Every type that is written or read, and the types that these contain: a line `MSG: package/Name`, then the fields.
const DEFINITIONS: &str = include_str!("definitions.txt");

/// The definition of a type.
pub(crate) fn definition(name: &str) -> Option<Definition> {
    let types = DEFINITIONS.split("MSG: ");
    let mut types = types.filter_map(|text| text.split_once('\n'));
    types.find(|(known, _)| *known == name)
}

/// All types that a type contains, directly or not, each before those that it contains.
pub(crate) fn contained((_, fields): Definition) -> Vec<Definition> {
    let mut found = Vec::new();
    add_contained(fields, &mut found);
    found
}

fn add_contained(fields: &str, found: &mut Vec<Definition>) {
    for field in fields.lines() {
        let name = field.split([' ', '[']).next().unwrap_or_default();
        if let Some(new) = definition(name).filter(|new| !found.contains(new)) {
            found.push(new);
            add_contained(new.1, found);
        }
    }
}
