//! Localization of a sweep: the trait of all localizers, and their input.

use nalgebra::Isometry3;
use perception::detector::BackboneLevel;
use protocol::PointCloud;

use super::driven_area::DrivenArea;
use super::error::LocalizerError;
use super::localization::Localization;

/// Input of a localizer: one sweep.
#[derive(Debug, Clone, Copy)]
pub struct LocalizerInput<'a> {
    /// The sweep, in the LiDAR frame.
    pub cloud: &'a PointCloud,
    /// Levels of the backbone of the vehicle's detector for it, if they are computed already and are those of
    /// [`Localize::detector_encoder`].
    pub levels: Option<&'a [BackboneLevel]>,
    /// Predicted pose `world_from_sensor`: a localizer may search near it, which saves time if the sweep confirms it.
    pub predicted: Option<Isometry3<f64>>,
}

impl<'a> LocalizerInput<'a> {
    /// A sweep of which nothing is known yet.
    pub fn of(cloud: &'a PointCloud) -> Self {
        Self {
            cloud,
            levels: None,
            predicted: None,
        }
    }
}

/// Estimates the pose of a sweep.
pub trait Localize: std::fmt::Debug + Send {
    /// Localizes one sweep.
    ///
    /// # Errors
    /// [`LocalizerError::Tensor`] when the tensor library fails. A sweep that cannot be localized is no error but a
    /// result: [`protocol::PoseEstimate::NoPose`].
    fn localize(&mut self, sweep: LocalizerInput<'_>) -> Result<Localization, LocalizerError>;

    /// SHA-256 of the encoder of the detector whose levels it takes; `None` if it has an encoder of its own.
    fn detector_encoder(&self) -> Option<&str> {
        None
    }

    /// Name of the place in whose map the poses are; `None` if it is not known.
    fn place(&self) -> Option<&str> {
        None
    }

    /// True if the confidence of its poses was fitted: bounds behind a map rely on it.
    fn is_calibrated(&self) -> bool {
        true
    }

    /// Area of the drives that it was trained on; `None` if it is not known.
    fn driven_area(&self) -> Option<&DrivenArea> {
        None
    }
}
