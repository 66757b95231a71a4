//! Mount of a LiDAR: its place on the body of a vehicle.

use std::str::FromStr;

use protocol::Pose;

/// Largest distance between a LiDAR and the origin of its vehicle, metres.
const MAX_M: f64 = 100.0;

/// Place of a vehicle's LiDAR on its body, the same for all vehicles of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mount {
    /// Pose of the LiDAR in the frame of the body: metres.
    pub base_from_lidar: Pose,
}

/// The origin of the body is the LiDAR.
impl Default for Mount {
    fn default() -> Self {
        Self {
            base_from_lidar: Pose::IDENTITY,
        }
    }
}

/// Error of a text that is no mount.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{0:?} is no place of a LiDAR: X,Y,Z in metres within {MAX_M} and optionally its yaw in degrees, 1.5,0,1.9 for example"
)]
pub struct MountError(String);

/// `X,Y,Z` or `X,Y,Z,YAW`: metres in the frame of the body, degrees.
impl FromStr for Mount {
    type Err = MountError;

    fn from_str(text: &str) -> Result<Self, MountError> {
        let parts = text.split(',');
        let numbers: Option<Vec<f64>> = parts.map(|part| part.trim().parse().ok()).collect();
        let (xyz, yaw_deg) = match numbers.as_deref() {
            Some(&[x, y, z]) => ([x, y, z], 0.0),
            Some(&[x, y, z, yaw_deg]) => ([x, y, z], yaw_deg),
            _ => ([f64::NAN; 3], 0.0),
        };
        // A number that is none is in no range.
        let is_place = xyz.iter().all(|value| value.abs() <= MAX_M) && yaw_deg.abs() <= 360.0;
        if !is_place {
            return Err(MountError(text.chars().take(100).collect()));
        }
        let base_from_lidar = Pose::from_xyz_yaw(xyz, yaw_deg.to_radians());
        Ok(Self { base_from_lidar })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mount_is_three_or_four_numbers() {
        let mount: Mount = "1.5, 0,1.9".parse().unwrap();
        assert_eq!(mount.base_from_lidar.translation_m, [1.5, 0.0, 1.9]);
        let turned: Mount = "0,0,2,90".parse().unwrap();
        assert!((turned.base_from_lidar.yaw_rad() - std::f64::consts::FRAC_PI_2).abs() < 1e-12);
        for text in [
            "",
            "1,2",
            "1,2,3,4,5",
            "a,0,0",
            "nan,0,0",
            "0,0,101",
            "0,0,0,361",
        ] {
            assert!(text.parse::<Mount>().is_err(), "{text}");
        }
    }
}
