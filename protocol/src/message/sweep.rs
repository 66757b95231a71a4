//! Sweeps and points: LiDAR, radar, and the points that an agent shares for early fusion.

use serde::{Deserialize, Serialize};

use super::{Payload, PoseEstimate, check_limit, private, wrong_body};
use crate::{Body, BodyShape, Kind, Limits, PointCloud, WireError};

/// A LiDAR sweep of one vehicle: replay to that vehicle's agent.
///
/// Body: x, y, z, intensity of every point, `f32`, in the LiDAR's frame.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Lidar {
    /// The points; intensity is the fourth value.
    pub points: PointCloud,
}

/// A radar sweep of one vehicle: replay to that vehicle's agent.
///
/// Body: x, y, z and radial velocity (metres per second, away positive) of every point, `f32`, in the radar's frame.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Radar {
    /// The points; radial velocity is the fourth value.
    pub points: PointCloud,
}

/// The points of one agent, for the early-fusion baseline only: agent to ego.
///
/// Body: as [`Lidar`], in the frame of the sender's LiDAR.
#[derive(Debug, Clone, PartialEq)]
pub struct Points {
    /// Pose estimate of the sender with its confidence.
    pub pose: PoseEstimate,
    /// The points.
    pub points: PointCloud,
}

/// Metadata of [`Lidar`] and [`Radar`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct SweepMetadata {
    /// Points in the body.
    pub count: u64,
}

/// Metadata of [`Points`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PointsMetadata {
    /// Pose estimate of the sender.
    pub pose: PoseEstimate,
    /// Points in the body.
    pub count: u64,
}

fn check_points(count: u64, limits: &Limits) -> Result<BodyShape, WireError> {
    check_limit("points", count, limits.max_points)?;
    Ok(BodyShape::Points(count))
}

fn points_of(body: Body, count: u64) -> Result<PointCloud, WireError> {
    match body {
        Body::Points(xyzi) => Ok(PointCloud { xyzi }),
        body => Err(wrong_body(BodyShape::Points(count).bounds().0, &body)),
    }
}

macro_rules! sweep {
    ($name:ident) => {
        impl private::Sealed for $name {}

        impl Payload for $name {
            const KIND: Kind = Kind::$name;
            type Metadata = SweepMetadata;

            fn into_parts(self) -> (SweepMetadata, Body) {
                let count = self.points.len() as u64;
                (SweepMetadata { count }, Body::Points(self.points.xyzi))
            }

            fn check(metadata: &SweepMetadata, limits: &Limits) -> Result<BodyShape, WireError> {
                check_points(metadata.count, limits)
            }

            fn from_parts(metadata: SweepMetadata, body: Body) -> Result<Self, WireError> {
                let points = points_of(body, metadata.count)?;
                Ok(Self { points })
            }
        }
    };
}
sweep!(Lidar);
sweep!(Radar);

impl private::Sealed for Points {}

impl Payload for Points {
    const KIND: Kind = Kind::Points;
    type Metadata = PointsMetadata;

    fn into_parts(self) -> (PointsMetadata, Body) {
        let Self { pose, points } = self;
        let count = points.len() as u64;
        (PointsMetadata { pose, count }, Body::Points(points.xyzi))
    }

    fn check(metadata: &PointsMetadata, limits: &Limits) -> Result<BodyShape, WireError> {
        metadata.pose.check_values(limits)?;
        check_points(metadata.count, limits)
    }

    fn from_parts(metadata: PointsMetadata, body: Body) -> Result<Self, WireError> {
        let PointsMetadata { pose, count } = metadata;
        let points = points_of(body, count)?;
        Ok(Self { pose, points })
    }
}
