//! Hint for a run in which no sweep was localized: the head may be of another place.

use std::path::Path;

use perception::weights::Weights;

use super::head_config::SceneHeadConfig;

/// The hint, with the place in the head's metadata and the map of the scene, as far as they are known.
#[must_use]
pub fn wrong_place_hint(sweeps: u64, head: &Path, scene_map: Option<&str>) -> String {
    let place = Weights::load(head).and_then(|weights| weights.config::<SceneHeadConfig>());
    let place = place.ok().map(|config| config.scene_name);
    hint(sweeps, &head.display().to_string(), place.as_deref(), scene_map)
}

fn hint(sweeps: u64, head: &str, place: Option<&str>, scene_map: Option<&str>) -> String {
    let known = match (place, scene_map) {
        (Some(place), Some(map)) => format!(" It is of {place}, the scene is of {map}"),
        (Some(place), None) => format!(" It is of {place}"),
        (None, Some(map)) => format!(" The scene is of {map}"),
        (None, None) => String::new(),
    };
    format!("no vehicle found itself in {sweeps} sweeps: is {head} the head of this place?{known}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_places_of_head_and_scene_are_named_as_far_as_they_are_known() {
        let text = hint(10, "pgc-town1.safetensors", Some("town1"), Some("town4:0"));
        let expected = "no vehicle found itself in 10 sweeps: is pgc-town1.safetensors the head of this place? It is of \
                        town1, the scene is of town4:0";
        assert_eq!(text, expected);
        assert!(hint(10, "h", Some("town1"), None).ends_with("? It is of town1"));
        assert!(wrong_place_hint(3, Path::new("/no/head"), None).ends_with("is /no/head the head of this place?"));
    }
}
