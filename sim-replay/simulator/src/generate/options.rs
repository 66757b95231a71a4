//! Options of scene generation.

use std::ops::RangeInclusive;
use std::path::PathBuf;

use clap::ValueEnum;
use protocol::config::{FieldError, require, within};

use super::camera::ImageSize;
use super::layout::SceneLayout;
use super::traffic::STEP_S;
use super::weather::Weather;
use crate::map::RoadMapSource;

/// The three subsets of V2VLoc.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, ValueEnum, strum::IntoStaticStr)]
#[strum(serialize_all = "lowercase")]
pub enum Subset {
    /// One agent drives through town 1, in several traversals.
    Town1loc,
    /// One agent drives through town 4, in several traversals.
    Town4loc,
    /// Two to four agents drive near each other in the same two towns.
    V2vdet,
}

impl Subset {
    /// The name in files and on the command line.
    pub fn name(self) -> &'static str {
        self.into()
    }
}

/// Options of scene generation. The same options give the same files, byte for byte.
///
/// By convention seeds 0 to 999 are for training and validation, and 1000 and above for measuring only, so that no
/// measured scene was ever trained on. The map seed is the same for all: it determines the map.
#[derive(Debug, Clone, PartialEq)]
pub struct SynthOptions {
    /// Subset: number of agents and default maps.
    pub subset: Subset,
    /// Fixes routes, lanes, speeds, traffic, parked vehicles and noise.
    pub seed: u64,
    /// Folder of the scenarios.
    pub out: PathBuf,
    /// Layout of the files.
    pub layout: SceneLayout,
    /// The map; by default that of the subset, for V2VDet both in turn.
    pub map: Option<RoadMapSource>,
    /// Determines all static objects.
    pub map_seed: u64,
    /// Number of scenarios; of a localization subset each is another traversal of the map.
    pub scenes: usize,
    /// Number of agents of a V2VDet scenario.
    pub agents: RangeInclusive<usize>,
    /// The weather.
    pub weather: Weather,
    /// Weathers in which every sweep is written once more, beside the plain one ([`Weather::variant`]).
    pub copies: Vec<Weather>,
    /// Size of the images of the four cameras; `None`: no cameras.
    pub cameras: Option<ImageSize>,
    /// Frames of each scenario.
    pub frames: usize,
    /// Simulated time from one stored frame to the next, seconds; a multiple of 0.05.
    pub period_s: f64,
    /// True to write into a folder that is not empty; scenarios of the same name are replaced.
    pub force: bool,
    /// Threads that cast and write; does not change the files.
    pub threads: usize,
}

impl SynthOptions {
    /// The defaults of a subset, with a thread per core.
    pub fn new(subset: Subset, seed: u64, out: PathBuf) -> Self {
        Self {
            subset,
            seed,
            out,
            layout: SceneLayout::Opv2v,
            map: None,
            map_seed: 0,
            scenes: 1,
            agents: 2..=4,
            weather: Weather::Sunny,
            copies: Vec::new(),
            cameras: None,
            frames: if subset == Subset::V2vdet { 60 } else { 2000 },
            period_s: 0.1,
            force: false,
            threads: std::thread::available_parallelism().map_or(1, usize::from),
        }
    }

    /// Size of the images as text.
    pub(crate) fn image_size(&self) -> String {
        let size = self.cameras.map(|size| size.to_string());
        size.unwrap_or_else(|| "none".to_owned())
    }

    /// Steps of the simulation from one stored frame to the next.
    pub(crate) fn steps_per_frame(&self) -> usize {
        (self.period_s / STEP_S).round() as usize
    }

    /// Checks the numbers.
    ///
    /// # Errors
    /// [`FieldError`] with the first invalid option.
    pub fn validate(&self) -> Result<(), FieldError> {
        let steps = self.period_s / STEP_S;
        // 0.15 / 0.05 is not exactly 3 in binary, hence the tolerance.
        let is_multiple = (1.0..=1e4).contains(&steps) && (steps - steps.round()).abs() < 1e-6;
        let rule = "must be a multiple of 0.05 s up to 500 s";
        require(is_multiple, "--period-s", self.period_s, rule)?;
        within("--frames", self.frames, 1, 100_000)?;
        within("--scenes", self.scenes, 1, 10_000)?;
        let copies: Vec<&str> = self.copies.iter().map(|weather| weather.name()).collect();
        let copies = copies.join(",");
        let is_opv2v = self.layout == SceneLayout::Opv2v;
        let mut variants = self.copies.iter().map(|weather| weather.variant());
        let have_names = variants.all(|name| name.is_some());
        let rule = "must be fog, snow or both";
        require(have_names, "--weather-copies", &copies, rule)?;
        let rule = "must be none, as the layout opv2v alone has copies of sweeps";
        let are_held = copies.is_empty() || is_opv2v;
        require(are_held, "--weather-copies", &copies, rule)?;
        let images = self.image_size();
        let edges = 16..=4096;
        let are_small = self
            .cameras
            .is_none_or(|size| edges.contains(&size.width_px) && edges.contains(&size.height_px));
        let rule = "must be 16 to 4096 pixels along each edge";
        require(are_small, "--cameras", &images, rule)?;
        let rule = "must be none, as images are written in the layout opv2v alone";
        let are_held = self.cameras.is_none() || is_opv2v;
        require(are_held, "--cameras", images, rule)?;
        let (low, high) = (*self.agents.start(), *self.agents.end());
        let agents = format!("{low}-{high}");
        let is_range = low >= 1 && low <= high && high <= 7;
        let rule = "must be a number or a range within 1-7";
        require(is_range, "--vehicles", &agents, rule)?;
        if !self.layout.needs_two_agents() {
            return Ok(());
        }
        let (is_detection, subset) = (self.subset == Subset::V2vdet, self.subset.name());
        let rule = "must be v2vdet, as the layout needs two agents";
        require(is_detection, "--subset", subset, rule)?;
        let rule = "must be 2 or more, as the layout needs two agents";
        require(low >= 2, "--vehicles", agents, rule)
    }
}
