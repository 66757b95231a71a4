//! Coverage of drives: extent, length, and the cells of a grid that were driven through.

use localization::pgc::driven_area::DrivenArea;
use nalgebra::Vector3;
use serde::Serialize;

/// Area of a place that has been driven, in the frame of the map.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Coverage {
    /// Number of sweeps.
    pub sweeps: usize,
    /// Length of all drives, metres.
    pub length_m: f64,
    /// Smallest x and y of the sensor, metres.
    pub low_m: [f64; 2],
    /// Largest x and y of the sensor, metres.
    pub high_m: [f64; 2],
    /// Cells of a grid with sweeps in them.
    #[serde(flatten)]
    pub area: DrivenArea,
}

impl Coverage {
    /// Coverage of drives, each the positions of its sweeps in the order of time, metres; `None` without sweeps.
    pub(super) fn of(drives: &[Vec<Vector3<f64>>]) -> Option<Self> {
        let all = drives.iter().flatten();
        let mut places = all.clone().map(|position| position.xy());
        let positions_m: Vec<[f64; 2]> = places.clone().map(Into::into).collect();
        let first = places.next()?;
        let (low_m, high_m) = places.fold((first, first), |(low, high), place| {
            (low.inf(&place), high.sup(&place))
        });
        let steps = drives.iter().flat_map(|drive| drive.windows(2));
        let length_m = steps.map(|pair| (pair[1] - pair[0]).norm()).sum();
        Some(Self {
            sweeps: all.count(),
            length_m,
            low_m: low_m.into(),
            high_m: high_m.into(),
            area: DrivenArea::of(&positions_m),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_drive_is_measured() {
        let east: Vec<_> = (0..=10)
            .map(|k| Vector3::new(f64::from(k) * 10.0, 30.0, 0.0))
            .collect();
        let south = vec![
            Vector3::new(90.0, 30.0, 0.0),
            Vector3::new(90.0, -10.0, 0.0),
        ];
        let coverage = Coverage::of(&[east, south]).unwrap();
        assert_eq!((coverage.sweeps, coverage.length_m), (13, 140.0));
        assert_eq!(
            (coverage.low_m, coverage.high_m),
            ([0.0, -10.0], [100.0, 30.0])
        );
        assert_eq!(coverage.area.picture(), "#####\n.....\n...#.\n");
        assert_eq!(Coverage::of(&[Vec::new()]), None);
        // The report of `agent map` has the cells beside the rest.
        let json = serde_json::to_value(coverage).unwrap();
        assert_eq!(json["cell_m"], 25.0);
        assert_eq!(json["cells"][0]["corner_m"][1], 25.0);
    }
}
