//! Hints that a head is not one for these sweeps: it may be of another place, or of another LiDAR.

use std::path::Path;

use protocol::PointCloud;
use support::statistics;

use super::head_config::SceneHeadConfig;
use super::head_files::head_config;
use crate::registration::icp::surfel_map::SurfelMap;

/// Smallest ratio of numbers of points, and the inverse of the largest, at which sweeps count as those of one LiDAR: the
/// numbers of one in a street and on a square differ by less.
const LEAST_RATIO: f64 = 0.6;
/// Largest height of the ground that counts as 0, metres.
const LEVEL_M: f32 = 0.3;

/// The hint, with the place in the head's metadata and the map of the scene, as far as they are known.
pub fn wrong_place_hint(sweeps: u64, head: &Path, scene_map: Option<&str>) -> String {
    let place = config_of(head).map(|config| config.scene_name);
    let place = place.or_else(|| Some(SurfelMap::load(head).ok()?.place));
    let head = head.display().to_string();
    hint(sweeps, &head, place.as_deref(), scene_map)
}

/// Median number of points of the sweeps that a head was made from, if its file states it.
pub fn sweep_points(head: &Path) -> Option<usize> {
    config_of(head)?.sweep_points
}

fn config_of(head: &Path) -> Option<SceneHeadConfig> {
    Some(head_config(head).ok()?.1)
}

/// The hint that sweeps are those of another LiDAR, if their median number of points is far from that of
/// the sweeps that the head was made from ([`SceneHeadConfig::sweep_points`]).
pub fn other_lidar_hint(head_points: Option<usize>, points: &[usize]) -> Option<String> {
    let points: Vec<f64> = points.iter().map(|points| *points as f64).collect();
    let (own, of_head) = (statistics::median(&points)?, head_points?);
    let ratio = own / of_head.max(1) as f64;
    (!(LEAST_RATIO..=1.0 / LEAST_RATIO).contains(&ratio)).then(|| {
        format!(
            "the sweeps have {own:.0} points (median), those that the head was made from {of_head}: for another LiDAR it finds \
             few poses, or wrong ones; make a head with this one (agent map)"
        )
    })
}

/// Height that 5 % of the points of a cloud are below, metres: mostly that of the ground; `None` of an empty cloud.
pub fn lowest_m(cloud: &PointCloud) -> Option<f32> {
    let mut heights: Vec<f32> = cloud.xyzi.iter().map(|point| point[2]).collect();
    // NaN would take part in the order and shift the rank.
    heights.retain(|height| height.is_finite());
    let rank = heights.len() / 20;
    (!heights.is_empty()).then(|| *heights.select_nth_unstable_by(rank, f32::total_cmp).1)
}

/// The hint that clouds without a pose are in the frame of the vehicle, of the heights of their lowest points
/// ([`lowest_m`]): their ground is at a height of 0, not a metre or more below the LiDAR.
pub fn vehicle_frame_hint(lowest_m: &[f32]) -> Option<String> {
    let count = (lowest_m.iter().filter(|height| height.abs() < LEVEL_M)).count();
    (count > 0).then(|| {
        format!(
            "{count} of {} clouds without a pose have their ground at z 0, as in the frame of the vehicle (base_link): give \
             them in the frame of the LiDAR, z less its height above the ground",
            lowest_m.len()
        )
    })
}

fn hint(sweeps: u64, head: &str, place: Option<&str>, scene_map: Option<&str>) -> String {
    let known = match (place, scene_map) {
        (Some(place), Some(map)) => format!(" It is of {place}, the scene is of {map}"),
        (Some(place), None) => format!(" It is of {place}"),
        (None, Some(map)) => format!(" The scene is of {map}"),
        (None, None) => String::new(),
    };
    format!(
        "no vehicle found itself in {sweeps} sweeps: is {head} the head of this place and this LiDAR?{known}"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_places_of_head_and_scene_are_named_as_far_as_they_are_known() {
        let text = hint(10, "pgc-town1.safetensors", Some("town1"), Some("town4:0"));
        let expected = "no vehicle found itself in 10 sweeps: is pgc-town1.safetensors the head of this place and this \
                        LiDAR? It is of town1, the scene is of town4:0";
        assert_eq!(text, expected);
        assert!(hint(10, "h", Some("town1"), None).ends_with("? It is of town1"));
        assert!(
            wrong_place_hint(3, Path::new("/no/head"), None)
                .ends_with("is /no/head the head of this place and this LiDAR?")
        );
    }

    #[test]
    fn clouds_whose_ground_is_at_zero_are_named() {
        let lowest = [-1.9, 0.05, 0.02].map(|ground: f32| {
            let points = (0..200).map(|k| [k as f32, 1.0, ground + (k / 40) as f32, 0.0]);
            let xyzi = points.collect();
            lowest_m(&PointCloud { xyzi }).unwrap()
        });
        assert_eq!(lowest, [-1.9, 0.05, 0.02]);
        let text = vehicle_frame_hint(&lowest).unwrap();
        assert!(
            text.starts_with("2 of 3 clouds") && text.contains("base_link"),
            "{text}"
        );
        assert_eq!(vehicle_frame_hint(&lowest[..1]), None);
        let nan = PointCloud {
            xyzi: vec![[f32::NAN; 4]; 9],
        };
        assert_eq!(lowest_m(&nan), None);
    }

    #[test]
    fn sweeps_of_another_density_are_named_with_both_numbers() {
        let text = other_lidar_hint(Some(57_000), &[21_000, 22_000, 400]).unwrap();
        assert!(
            text.contains("21000 points") && text.contains("57000"),
            "{text}"
        );
        assert!(other_lidar_hint(Some(57_000), &[150_000]).is_some());
        assert_eq!(
            [
                other_lidar_hint(Some(57_000), &[40_000]),
                other_lidar_hint(Some(57_000), &[]),
                other_lidar_hint(None, &[9])
            ],
            [None, None, None]
        );
    }
}
