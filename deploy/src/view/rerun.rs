//! A run for Rerun: the moments that the page shows, as a file or sent to its viewer.

use std::collections::{BTreeMap, BTreeSet};

use protocol::{CavId, DropReason};
use re_sdk::{EntityPath, EntityPathPart, RecordingStream, RecordingStreamBuilder, RecordingStreamError};
use re_sdk_types::archetypes::{Boxes3D, Points3D, Scalars, Transform3D, ViewCoordinates};
use re_sdk_types::components::{Color, RotationQuat};
use re_sdk_types::datatypes::Quaternion;

use super::scene_frame::{Link, ShownBox, Vehicle};
use super::{RecordedRun, SceneFrame};

/// Why Rerun gets nothing.
#[derive(Debug, thiserror::Error)]
pub enum RerunError {
    /// The file cannot be written, or the address is none of Rerun's.
    #[error("{destination}: {cause}")]
    Open {
        /// Where to.
        destination: String,
        /// What Rerun's SDK says.
        cause: RecordingStreamError,
    },
    /// A moment could not be written.
    #[error("a moment for Rerun: {0}")]
    Log(#[from] RecordingStreamError),
    /// The recording has changed.
    #[error(transparent)]
    Recording(#[from] recording::RecordingError),
    /// What was written has not arrived.
    #[error("not all that Rerun was told has arrived: {0}")]
    Flush(#[from] re_sdk::sink::SinkFlushError),
}

/// Moments on their way to Rerun.
pub struct RerunLog {
    stream: RecordingStream,
    /// Layers with boxes so far: one without any must be said to be empty, or it goes on showing those of before.
    layers: BTreeSet<EntityPath>,
}

impl RerunLog {
    /// Opens a file, or connects to Rerun where `destination` is an address (`rerun+http://HOST:PORT/proxy`).
    ///
    /// # Errors
    /// [`RerunError::Open`].
    pub fn open(run: &str, destination: &str) -> Result<Self, RerunError> {
        let builder = RecordingStreamBuilder::new("v2vloc").recording_name(run);
        let opened = if destination.contains("://") {
            builder.connect_grpc_opts(destination)
        } else {
            builder.save(destination)
        };
        let stream = opened.map_err(|cause| RerunError::Open { destination: destination.into(), cause })?;
        // Times are those of the scene: when a moment was written says nothing.
        stream.set_log_tick_enabled(false);
        stream.set_log_time_enabled(false);
        stream.log_static("world", &ViewCoordinates::RIGHT_HAND_Z_UP())?;
        Ok(Self { stream, layers: BTreeSet::new() })
    }

    /// Writes a moment.
    ///
    /// # Errors
    /// [`RerunError::Log`].
    pub fn write(&mut self, frame: &SceneFrame) -> Result<(), RerunError> {
        self.stream.set_duration_secs("capture", frame.capture_s);
        match frame.tick.and_then(|tick| i64::try_from(tick).ok()) {
            Some(tick) => self.stream.set_time_sequence("tick", tick),
            None => self.stream.disable_timeline("tick"),
        }
        for (vehicle, points) in frame.clouds() {
            self.vehicle(vehicle, points)?;
        }
        self.boxes(frame)?;
        for link in &frame.links {
            self.link(link)?;
        }
        self.scalar(&["latency_ms"], frame.latency_ms)?;
        for stage in &frame.stages {
            self.scalar(&["stages", &stage.stage, "ms"], Some(stage.nanos as f64 / 1e6))?;
        }
        let mut dropped: BTreeMap<DropReason, u64> = BTreeMap::new();
        for (reason, count) in frame.messages.iter().flat_map(|messages| &messages.dropped) {
            *dropped.entry(*reason).or_default() += count;
        }
        dropped.into_iter().try_for_each(|(reason, count)| {
            self.scalar(&["messages", "dropped", &reason.to_string()], Some(count as f64))
        })
    }

    /// Waits until everything has arrived.
    ///
    /// # Errors
    /// [`RerunError::Flush`].
    pub fn flush(&self) -> Result<(), RerunError> {
        Ok(self.stream.flush_blocking()?)
    }

    fn vehicle(&self, vehicle: &Vehicle, points: Vec<[f32; 3]>) -> Result<(), RerunError> {
        let cav = vehicle.cav.as_str();
        self.scalar(&["vehicles", cav, "confidence"], Some(vehicle.confidence.map_or(0.0, f64::from)))?;
        self.scalar(&["vehicles", cav, "error_m"], vehicle.error_m)?;
        let colour = colour_of(&vehicle.cav);
        let cloud = match &vehicle.world_from_lidar {
            Some(pose) => {
                let place = Transform3D::new()
                    .with_translation(pose.translation_m.map(|metres| metres as f32))
                    .with_quaternion(RotationQuat(Quaternion::from_wxyz(pose.rotation_wxyz.map(|part| part as f32))));
                self.stream.log(path(&["world", "vehicles", cav]), &place)?;
                Points3D::new(points).with_colors([colour])
            }
            None => Points3D::new(Vec::<[f32; 3]>::new()),
        };
        Ok(self.stream.log(path(&["world", "vehicles", cav, "points"]), &cloud)?)
    }

    /// Boxes by layer: what is there, what is detected by source, what is sent by whom.
    fn boxes(&mut self, frame: &SceneFrame) -> Result<(), RerunError> {
        let mut layers: BTreeMap<EntityPath, (Color, Vec<&ShownBox>)> = BTreeMap::new();
        let green = Color::from_rgb(60, 160, 60);
        let red = Color::from_rgb(220, 60, 40);
        for shown in &frame.truth {
            layers.entry(path(&["world", "truth"])).or_insert((green, Vec::new())).1.push(shown);
        }
        for (kind, boxes) in [("detections", &frame.detections), ("sent", &frame.single)] {
            for shown in boxes {
                let source = shown.source.as_ref().map_or("fused", CavId::as_str);
                let colour = shown.source.as_ref().map_or(red, colour_of);
                layers.entry(path(&["world", kind, source])).or_insert((colour, Vec::new())).1.push(shown);
            }
        }
        self.layers.extend(layers.keys().cloned());
        for layer in &self.layers {
            let (colour, boxes) = layers.remove(layer).unwrap_or((red, Vec::new()));
            self.stream.log(layer.clone(), &boxes_3d(&boxes, colour))?;
        }
        Ok(())
    }

    fn link(&self, link: &Link) -> Result<(), RerunError> {
        let name = format!("{} to {}", link.from, link.to);
        self.scalar(&["links", &name, "latency_ms"], link.latency_ms)?;
        self.scalar(&["links", &name, "wire_bytes"], link.wire_bytes.map(|bytes| bytes as f64))?;
        self.scalar(&["links", &name, "age_ms"], link.age_ms)?;
        self.scalar(&["links", &name, "fused"], Some(f64::from(u8::from(link.is_fused))))
    }

    fn scalar(&self, parts: &[&str], value: Option<f64>) -> Result<(), RerunError> {
        match value {
            Some(value) => Ok(self.stream.log(path(parts), &Scalars::new([value]))?),
            None => Ok(()),
        }
    }
}

impl Drop for RerunLog {
    /// Writes the end of the file.
    fn drop(&mut self) {
        self.stream.disconnect();
    }
}

/// Writes every moment of a recorded run.
///
/// # Errors
/// [`RerunError`] when the recording cannot be read any more, or Rerun does not take it.
pub fn write_for_rerun(run: &RecordedRun, destination: &str) -> Result<(), RerunError> {
    let mut log = RerunLog::open(run.name(), destination)?;
    for index in 0..run.len() {
        if let Some(frame) = run.frame(index)? {
            log.write(&frame)?;
        }
    }
    log.flush()
}

fn boxes_3d(boxes: &[&ShownBox], colour: Color) -> Boxes3D {
    let metres = |values: [f64; 3]| values.map(|value| value as f32);
    let turned = |heading_rad: f64| {
        let (sine, cosine) = (heading_rad / 2.0).sin_cos();
        RotationQuat(Quaternion::from_wxyz([cosine as f32, 0.0, 0.0, sine as f32]))
    };
    let label = |shown: &ShownBox| match (&shown.class, shown.score) {
        (Some(class), _) => class.clone(),
        (None, Some(score)) => format!("{score:.2}"),
        (None, None) => String::new(),
    };
    let shapes = || boxes.iter().map(|shown| &shown.box3d);
    Boxes3D::from_centers_and_sizes(
        shapes().map(|shape| metres(shape.center_m)),
        shapes().map(|shape| metres(shape.size_m)),
    )
    .with_quaternions(shapes().map(|shape| turned(shape.heading_rad)))
    .with_colors(vec![colour; boxes.len()])
    .with_labels(boxes.iter().map(|shown| label(shown)))
    .with_show_labels(false)
}

/// Whatever stands in a name is part of it.
fn path(parts: &[&str]) -> EntityPath {
    parts.iter().map(|part| EntityPathPart::new(*part)).collect()
}

/// A colour for each vehicle that stays the same over runs.
fn colour_of(cav: &CavId) -> Color {
    const COLOURS: [[u8; 3]; 6] =
        [[31, 119, 180], [255, 127, 14], [148, 103, 189], [23, 190, 207], [227, 119, 194], [188, 189, 34]];
    let sum: usize = cav.as_str().bytes().map(usize::from).sum();
    let [red, green, blue] = COLOURS[sum % COLOURS.len()];
    Color::from_rgb(red, green, blue)
}
