//! Conversion: writes an opened data set in another layout.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::data_protocol::converted_yaml;
use super::error::SynthError;
use super::layout::{
    AgentFrame, Moment, Omissions, SceneAgent, SceneHeader, SceneLayout, SceneWriter, SweepVariant,
    locked,
};
use super::scenes::{begin_folder, end_folder};
use dataset::frame::ObjectClass;
use dataset::{Dataset, LeftOut, LoadOptions, LoadedTick, Problem, ReadError, Scenario};

/// Candidate lengths of a tick, nanoseconds: the step of a simulator, and resolutions of sensor clocks.
const TICKS_NANOS: [u64; 4] = [50_000_000, 10_000_000, 1_000_000, 1_000];

/// Summary of a conversion.
#[derive(Debug, Default)]
pub struct Converted {
    /// Scenarios.
    pub scenarios: usize,
    /// Frames that were written, of all agents together.
    pub agent_frames: usize,
    /// Data that the layout cannot hold, with the number of times that it was left out.
    pub omitted: BTreeMap<&'static str, u64>,
    /// Frames and files that could not be read.
    pub left_out: LeftOut,
}

/// Writes all scenarios of a data set in a layout into the folder `out`, with `force` even if it is not empty. `progress`
/// is called with the number of completed capture times and their total, from any thread.
///
/// # Errors
/// [`SynthError`] if the layout cannot hold a scene or a file cannot be written. A frame that cannot be read is left
/// out and listed in [`Converted::left_out`].
pub fn convert(
    dataset: &Dataset,
    out: &Path,
    layout: SceneLayout,
    force: bool,
    progress: &(dyn Fn(usize, usize) + Sync),
) -> Result<Converted, SynthError> {
    let unfinished = begin_folder(out, force)?;
    let mut writer = layout.writer(out);
    let (omitted, left_out) = (Omissions::default(), Mutex::new(LeftOut::default()));
    locked(&left_out).add_files(&dataset.problems);
    let mut converted = Converted::default();
    let scenarios = dataset.scenarios.iter();
    let total = scenarios.map(|scenario| scenario.ticks.len()).sum();
    let done = AtomicUsize::new(0);
    for scenario in &dataset.scenarios {
        writer.begin(&header(scenario, dataset)?)?;
        let losses = (&omitted, &left_out);
        let frames = write_moments(scenario, writer.as_ref(), layout, losses, &|| {
            progress(done.fetch_add(1, Ordering::Relaxed) + 1, total)
        })?;
        writer.end()?;
        converted.scenarios += 1;
        converted.agent_frames += frames;
    }
    writer.finish()?;
    end_folder(out, unfinished)?;
    converted.omitted = omitted.into_counts();
    converted.left_out = std::mem::take(&mut *locked(&left_out));
    Ok(converted)
}

fn header(scenario: &Scenario, dataset: &Dataset) -> Result<SceneHeader, SynthError> {
    let capture_nanos = scenario.ticks.iter().map(|tick| tick.capture_nanos);
    let capture_nanos: Vec<u64> = capture_nanos.collect();
    // The coarsest tick that divides all times. File names of OPV2V count ticks.
    let mut ticks = TICKS_NANOS.into_iter();
    let tick_nanos = ticks.find(|tick| capture_nanos.iter().all(|nanos| nanos % tick == 0));
    let tick_nanos = tick_nanos.unwrap_or(TICKS_NANOS[TICKS_NANOS.len() - 1]);
    let mut pairs = capture_nanos.windows(2);
    // Two moments within one tick would share a file name.
    if let Some(pair) = pairs.find(|pair| pair[0] / tick_nanos >= pair[1] / tick_nanos) {
        return Err(SynthError::Layout(format!(
            "of the input: scenario {}: two moments at {} and {} ns: times do not rise",
            scenario.name, pair[0], pair[1]
        )));
    }
    let agents = scenario.agents.iter().map(|id| SceneAgent {
        id: id.clone(),
        is_roadside: scenario.roadside_units.contains(id),
    });
    Ok(SceneHeader {
        name: scenario.name.clone(),
        agents: agents.collect(),
        origin: converted_yaml(dataset.layout.name(), &scenario.name, tick_nanos),
        capture_nanos,
        tick_nanos,
    })
}

/// Writes the capture times at which the ego's frame can be read; returns the number of frames.
fn write_moments(
    scenario: &Scenario,
    writer: &dyn SceneWriter,
    layout: SceneLayout,
    (omitted, left_out): (&Omissions, &Mutex<LeftOut>),
    done: &(dyn Fn() + Sync),
) -> Result<usize, SynthError> {
    let moments = (0..scenario.ticks.len()).into_par_iter().map(|index| {
        let loaded = read(scenario, index);
        locked(left_out).add_tick(&loaded);
        done();
        if loaded.frames.first().is_none_or(|(agent, _)| *agent != 0) {
            omitted.add("frames of moments without the ego", loaded.frames.len());
            return Ok(0);
        }
        let frames = loaded.frames.into_iter().map(|(agent, frame)| {
            let variants = variants(scenario, agent, index, left_out);
            AgentFrame {
                agent,
                frame,
                variants,
                simulated: None,
            }
        });
        let moment = Moment {
            index,
            frames: frames.collect(),
        };
        for agent in &moment.frames {
            count_losses(agent, layout, omitted);
        }
        writer.write(&moment, omitted)
    });
    moments.sum()
}

/// Counts the data of a frame that a layout does not hold, beside those that its writer counts.
fn count_losses(agent: &AgentFrame, layout: SceneLayout, omitted: &Omissions) {
    use SceneLayout::{KittiObject, Mars, Opv2v, V2v4real, V2xreal, V2xsim};
    let (frame, copies, is_opv2v) = (&agent.frame, agent.variants.len(), layout == Opv2v);
    let speeds = frame.objects.iter().map(|object| object.speed_mps);
    let speeds = speeds.chain([frame.speed_mps]).flatten().count();
    let vans = (frame.objects.iter()).filter(|object| object.class == ObjectClass::Van);
    let gnss = frame.gnss_world_from_vehicle.iter().len();
    let cooperative = frame.cooperative_objects.iter().flatten().count();
    let has_speeds = matches!(layout, Opv2v | V2v4real | V2xreal);
    let has_vans = !matches!(layout, V2xsim | Mars);
    for (what, count, is_held) in [
        ("poses", 1, layout != KittiObject),
        ("camera images", frame.cameras.len(), is_opv2v),
        ("radar sweeps", frame.radar.iter().len(), is_opv2v),
        ("copies in other weather", copies, is_opv2v),
        ("yaw rates", frame.yaw_rate_rad_s.iter().len(), is_opv2v),
        ("poses by GNSS", gnss, is_opv2v),
        ("speeds", speeds, has_speeds),
        ("boxes of cooperative labels", cooperative, false),
        ("vans, which are cars there", vans.count(), has_vans),
    ] {
        omitted.add(what, count * usize::from(!is_held));
    }
}

/// The frames of a capture time. No layout can hold sweeps without a pose.
fn read(scenario: &Scenario, index: usize) -> LoadedTick {
    let options = LoadOptions {
        radar: true,
        cameras: true,
        ..LoadOptions::default()
    };
    let mut loaded = scenario.load_tick(index, 0..scenario.agents.len(), &options);
    let frames = &mut loaded.frames;
    for (agent, _) in frames.extract_if(.., |(_, frame)| frame.world_from_lidar.is_none()) {
        let path = scenario.points_path(agent, index, None).unwrap_or_default();
        let error = ReadError::malformed(&path, "there is no pose for this sweep");
        loaded.unreadable.push((agent, Problem::from(&error)));
    }
    loaded
}

/// The copies of a sweep that can be read.
fn variants(
    scenario: &Scenario,
    agent: usize,
    index: usize,
    left_out: &Mutex<LeftOut>,
) -> Vec<SweepVariant> {
    let variants = scenario.lidar_variants.iter().filter_map(|name| {
        let cloud = scenario.load_points(agent, index, Some(name));
        // Counted as a file, since a copy is part of its frame.
        let cloud = cloud
            .map_err(|error| locked(left_out).add_files([&error]))
            .ok()?;
        let labels = cloud.labels.unwrap_or_else(|| vec![0; cloud.points.len()]);
        Some(SweepVariant {
            name: name.clone(),
            points: cloud.points.xyzi,
            labels,
        })
    });
    variants.collect()
}
