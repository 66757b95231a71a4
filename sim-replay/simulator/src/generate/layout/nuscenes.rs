//! Data sets in the tables of nuScenes: sweeps of five floats (x, y, z, intensity, ring) and JSON tables beside them.
//!
//! A sample holds the sweeps of all agents at one capture time. Its annotations are those of any agent, in the world.

use std::path::{Path, PathBuf};
use std::sync::Mutex;

use serde_json::{Map, Value};

use super::boxes::{float_bytes, points_in, ring};
use super::disk::{make_folder, make_fresh_folder, write_file, write_origin};
use super::nuscenes_tables::{SampleRecord, SceneTables, SweepRecord, TableSet};
use super::{DAY_MICROS, Moment, Omissions, SceneHeader, SceneWriter, locked};
use crate::generate::error::SynthError;

/// Time stamps of the first scene start here, microseconds.
const EPOCH_MICROS: u64 = 1_696_454_400_000_000;
/// The folder of the sweeps.
const SWEEPS: &str = "sweeps";

/// Differences between data sets with these tables.
#[derive(Debug)]
pub(super) struct TableStyle {
    /// The folder of the tables.
    pub(super) version: &'static str,
    /// The channel of each agent's LiDAR.
    pub(super) channels: fn(&SceneHeader) -> Vec<String>,
    /// The file of a sweep in the folder of its channel, by number of scene and capture time and time in microseconds.
    pub(super) file_name: fn(usize, usize, u64) -> String,
    /// Value in the file for an intensity of 0 to 1.
    pub(super) intensity: fn(f32) -> f32,
    /// Fields of a row of scenes that only this data set has.
    pub(super) scene_fields: fn(&SceneHeader) -> Map<String, Value>,
}

/// The writer.
#[derive(Debug)]
pub(super) struct NuScenes {
    root: PathBuf,
    style: &'static TableStyle,
    /// Number of the scene that is being written.
    number: usize,
    scene: SceneHeader,
    channels: Vec<String>,
    samples: Mutex<Vec<SampleRecord>>,
    tables: TableSet,
}

impl NuScenes {
    pub(super) fn new(root: &Path, style: &'static TableStyle) -> Self {
        Self {
            root: root.to_owned(),
            style,
            number: 0,
            scene: SceneHeader::default(),
            channels: Vec::new(),
            samples: Mutex::default(),
            tables: TableSet::default(),
        }
    }
}

impl SceneWriter for NuScenes {
    fn begin(&mut self, scene: &SceneHeader) -> Result<(), SynthError> {
        if self.number == 0 {
            make_fresh_folder(&self.root.join(SWEEPS))?;
            make_fresh_folder(&self.root.join(self.style.version))?;
        }
        write_origin(&self.root, scene)?;
        let channels = (self.style.channels)(scene);
        channels
            .iter()
            .try_for_each(|channel| make_folder(&self.root.join(SWEEPS).join(channel)))?;
        (self.scene, self.channels) = (scene.clone(), channels);
        Ok(())
    }

    fn write(&self, moment: &Moment, _: &Omissions) -> Result<usize, SynthError> {
        let offset = EPOCH_MICROS + self.number as u64 * DAY_MICROS;
        let micros = offset + self.scene.capture_nanos[moment.index] / 1000;
        let name = (self.style.file_name)(self.number, moment.index, micros);
        let mut sweeps = Vec::with_capacity(moment.frames.len());
        for frame in &moment.frames {
            let file = format!("{SWEEPS}/{}/{name}", self.channels[frame.agent]);
            let points = float_bytes(frame.frame.points.xyzi.iter().map(|&point| {
                let [x, y, z, intensity] = point;
                let intensity = (self.style.intensity)(intensity);
                [x, y, z, intensity, f32::from(ring(point))]
            }));
            write_file(&self.root.join(&file), points)?;
            sweeps.push(SweepRecord {
                agent: frame.agent,
                file,
                world_from_lidar: frame.world_from_lidar(),
                world_from_vehicle: frame.frame.world_from_vehicle,
            });
        }
        let annotations = Moment::union(&moment.frames).into_iter().map(|object| {
            let points = moment.frames.iter().map(|frame| points_in(frame, object));
            (object.clone(), points.sum::<usize>())
        });
        let annotations = annotations.collect();
        locked(&self.samples).push(SampleRecord {
            moment: moment.index,
            micros,
            sweeps,
            annotations,
        });
        Ok(moment.frames.len())
    }

    fn end(&mut self) -> Result<(), SynthError> {
        let mut samples = std::mem::take(&mut *locked(&self.samples));
        samples.sort_by_key(|sample| sample.moment);
        self.tables.add(SceneTables {
            number: self.number,
            name: &self.scene.name,
            channels: &self.channels,
            fields: (self.style.scene_fields)(&self.scene),
            samples: &samples,
        });
        self.number += 1;
        Ok(())
    }

    fn finish(&mut self) -> Result<(), SynthError> {
        let folder = self.root.join(self.style.version);
        let tables = std::mem::take(&mut self.tables).into_tables();
        tables.into_iter().try_for_each(|(name, rows)| {
            let rows = Value::Array(rows).to_string();
            write_file(&folder.join(format!("{name}.json")), rows)
        })
    }
}
