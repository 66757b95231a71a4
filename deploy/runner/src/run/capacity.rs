//! Capacity: estimate of the pace of a live run on this machine, from a few frames of its scene, and remedies for a
//! machine that does not keep up.

use std::io;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use agent::config::{AgentSettings, SentBoxes};
use bus::process_cpu_s;
use dataset::{LoadOptions, period_nanos};
use deploy::report::{Capacity, Machine};
use ego_fuser_offline::evaluation::{EvaluateError, Evaluator};
use fusion::{Exchange, Method};
use perception::compute_device::ComputeDevice;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::fleet::{Fleet, RUNNER};
use crate::run::RunError;
use crate::run::machine::{AVX2, this_machine};

/// Time for computing frames before a run; loading the models comes on top.
pub(crate) const BUDGET: Duration = Duration::from_millis(600);
/// CPU time of replay, transport, encoding, router and scorer for each megabyte of sweeps and maps, in units
/// ([`Capacity::unit_ms`]): 58 ms for 5.0 MB where a unit takes 19.4 ms (EPYC 7003, AVX2). The report of a run shows the
/// parts.
const UNITS_PER_MB: f64 = 0.6;
/// Share of all cores' time that a run can use: the processes of a frame wait for each other. Without it eight runs near
/// or above a machine's limit answered 1 to 19 % fewer frames than expected, with it 10 % fewer to 5 % more.
const USABLE_SHARE: f64 = 0.9;

/// Compute times of a fleet's processes on this machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    /// CPU time of an agent per frame, milliseconds.
    agent_ms: f64,
    /// CPU time of the fusion per frame, milliseconds.
    fuse_ms: f64,
    /// Medians of the stages of an agent, then of the ego, milliseconds.
    stages: [Vec<(String, f64)>; 2],
    /// Share of a core that other programs leave, 0..=1.
    free_share: f64,
}

/// Estimates the pace of a fleet from [`measure`] in short-lived processes of their own, so that models and their memory
/// are not kept by the process that runs the fleet: as many at once as will share caches and memory in the run. `None`
/// for a run without a pace of its own. `programs` is the folder of the programs.
///
/// # Errors
/// The error of such a process, or of starting it.
pub fn estimate(fleet: &Fleet, programs: &Path, budget: Duration) -> io::Result<Option<Capacity>> {
    let Some(period_ms) = period_ms(fleet) else {
        return Ok(None);
    };
    let program = programs.join(RUNNER);
    // Measured alone, before the other processes load the cores.
    let unit = Command::new(&program)
        .args(["capacity", "--unit"])
        .envs(AVX2)
        .output()?;
    let machine = this_machine();
    // As many as compute at once in the run: an agent for each local vehicle, and the ego.
    let beside = machine.cores.min(local_vehicles(fleet) + 1);
    let children: Vec<Child> = (0..beside)
        .map(|_| start(&program, fleet, budget))
        .collect::<io::Result<_>>()?;
    // All have ended before the first error is returned: none computes beside the run.
    let ended: Vec<_> = children.into_iter().map(Child::wait_with_output).collect();
    let measured = ended.into_iter().map(|output| answer(output?));
    let measured = measured.collect::<io::Result<Vec<Measured>>>()?;
    Ok(Some(capacity_of(
        machine,
        &measured,
        (
            fleet.scenario.method.to_string(),
            fleet.agents.len(),
            local_vehicles(fleet),
        ),
        frame_mb(fleet).map_err(io::Error::other)?,
        (period_ms, answer(unit)?),
    )))
}

/// Starts a process that measures.
fn start(program: &Path, fleet: &Fleet, budget: Duration) -> io::Result<Child> {
    let mut child = Command::new(program)
        .args(["capacity", "--budget-ms", &budget.as_millis().to_string()])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()?;
    // A process that ends before it has read the scenario says why itself.
    let scenario = child.stdin.take();
    drop(scenario.map(|stdin| serde_json::to_writer(stdin, &fleet.scenario)));
    Ok(child)
}

/// The JSON that a process printed; its last line on standard error if it failed.
fn answer<T: DeserializeOwned>(output: Output) -> io::Result<T> {
    if output.status.success() {
        return Ok(serde_json::from_slice(&output.stdout)?);
    }
    let reasons = String::from_utf8_lossy(&output.stderr);
    let last = reasons.lines().last().unwrap_or_default();
    Err(io::Error::other(last.to_owned()))
}

/// Measures a fleet's processes in this one.
///
/// # Errors
/// [`RunError`] when models or frames cannot be loaded or computed.
pub fn measure(fleet: &Fleet, budget: Duration) -> Result<Measured, RunError> {
    fleet.scenario.models.threads.apply();
    let mut evaluator = Evaluator::new(fleet.setup().map_err(RunError::Fleet)?)?;
    let (began, before_s) = (Instant::now(), process_cpu_s());
    let estimated = evaluator.estimate(&fleet.recorded, fleet.agents.len(), budget)?;
    // Bounded: several threads give more than 1, and 0 would make a frame endless later on.
    let free_share =
        ((process_cpu_s() - before_s) / began.elapsed().as_secs_f64()).clamp(0.01, 1.0);
    let steps = estimated.steps;
    // Wall time times this share is CPU time.
    Ok(Measured {
        agent_ms: (steps.pose_ms + steps.map_ms) * free_share,
        fuse_ms: steps.fuse_ms * free_share,
        stages: estimated.stages.map(|stages| {
            let stages = stages.into_iter();
            stages.map(|(stage, ms)| (stage, ms * free_share)).collect()
        }),
        free_share,
    })
}

fn local_vehicles(fleet: &Fleet) -> usize {
    let (all, remote) = (fleet.agents.len(), fleet.scenario.remote_agents.len());
    all.saturating_sub(remote)
}

/// Time between two frames of a run with a pace of its own that can be estimated: not in lockstep, as fast as possible,
/// or of a single tick, and with networks on the CPU, which is what is measured.
fn period_ms(fleet: &Fleet) -> Option<f64> {
    let (scenario, recorded) = (&fleet.scenario, &fleet.recorded);
    let scene = &scenario.scene;
    let has_pace =
        !scene.lockstep && scene.rate > 0.0 && scenario.models.device == ComputeDevice::Cpu;
    let period_nanos = period_nanos(&recorded.ticks).filter(|_| has_pace)?;
    Some(period_nanos as f64 * 1e-6 / scene.rate)
}

/// Megabytes of a frame: of each vehicle its sweep, and its map if it sends maps.
fn frame_mb(fleet: &Fleet) -> Result<f64, RunError> {
    // One sweep stands for those of all vehicles: the first that vehicle 0 has.
    let sweep = (0..fleet.recorded.ticks.len())
        .find(|tick| fleet.recorded.is_present(0, *tick))
        .map(|tick| fleet.recorded.load(0, tick, &LoadOptions::default()))
        .transpose()
        .map_err(EvaluateError::from)?;
    let sweep_bytes = sweep.map_or(0, |frame| size_of_val(&frame.points.xyzi[..]) as u64);
    let values = match fleet.scenario.method.exchange() {
        Exchange::Features => fleet.map_values(),
        _ => 0,
    };
    let agents = fleet.agents.iter();
    let bytes = agents.map(|cav| sweep_bytes + map_bytes(&fleet.settings_of(cav), values));
    Ok(bytes.sum::<u64>() as f64 * 1e-6)
}

/// Bytes of a vehicle's map of so many `values`; none where it sends boxes only.
fn map_bytes(AgentSettings { codec, boxes, .. }: &AgentSettings, values: u64) -> u64 {
    if *boxes == Some(SentBoxes::Only) {
        return 0;
    }
    let all = values * codec.dtype.size();
    codec.budget_bytes.map_or(all, |budget| all.min(budget))
}

/// Capacity from measured times: their means.
fn capacity_of(
    machine: Machine,
    measured: &[Measured],
    (method, vehicles, local_vehicles): (String, usize, usize),
    frame_mb: f64,
    (period_ms, unit_ms): (f64, f64),
) -> Capacity {
    let count = measured.len().max(1) as f64;
    let agent_ms = measured.iter().map(|one| one.agent_ms).sum::<f64>() / count;
    let fuse_ms = measured.iter().map(|one| one.fuse_ms).sum::<f64>() / count;
    let free_share = measured.iter().map(|one| one.free_share).sum::<f64>() / count;
    let messages_ms = frame_mb * UNITS_PER_MB * unit_ms;
    let needed_ms = local_vehicles as f64 * agent_ms + fuse_ms + messages_ms;
    let available_ms = machine.cores as f64 * free_share * period_ms;
    // Neither an agent nor the ego computes two frames at once.
    // CPU time divided by the free share is the time that passes.
    let longest_ms = agent_ms.max(fuse_ms) / free_share;
    let expected_share = (USABLE_SHARE * available_ms / needed_ms)
        .min(period_ms / longest_ms)
        .min(1.0);
    Capacity {
        machine,
        method,
        vehicles,
        local_vehicles,
        agent_ms,
        fuse_ms,
        messages_ms,
        period_ms,
        unit_ms,
        stages: measured
            .first()
            .map_or_else(Default::default, |one| one.stages.clone()),
        free_share,
        needed_ms,
        available_ms,
        expected_share,
    }
}

/// Changes that let a fleet answer more ticks, the mildest first, as text: `tracked poses, method max or clock: stepped`.
pub fn remedies(fleet: &Fleet, capacity: Option<&Capacity>) -> String {
    let scenario = &fleet.scenario;
    let relative = capacity.map_or(0.5, Capacity::relative_rate);
    // At most two digits after the point.
    let rate = (relative * scenario.scene.rate * 100.0).round() / 100.0;
    let rate = format!("--rate {rate}");
    let sends_maps = scenario.method.exchange() == Exchange::Features;
    // Simulation time refuses processes that are slower than the scene.
    let fits = capacity
        .is_none_or(|capacity| capacity.agent_ms.max(capacity.fuse_ms) < 0.9 * capacity.period_ms);
    let all = [
        (fleet.pose_source() == "pgc").then_some("tracked poses (agents.pose.tracked)"),
        (sends_maps && scenario.method != Method::MAX).then_some("method max"),
        (fleet.agents.len() > 2).then_some("fewer vehicles (scene.agents)"),
        // A link has the pace of the scene only.
        scenario.link.is_none().then_some(rate.as_str()),
        fits.then_some("clock: stepped"),
        (!fits).then_some("scene.lockstep: true"),
    ];
    let all = all.into_iter().flatten().map(str::to_owned);
    listed(&Vec::from_iter(all), "or")
}

/// `a, b and c`, with `word` for "and".
pub(super) fn listed(parts: &[String], word: &str) -> String {
    match parts {
        [] => String::new(),
        [only] => only.clone(),
        [first @ .., last] => format!("{} {word} {last}", first.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Capacity of a machine with 10 ms for the messages of a frame of two vehicles.
    fn capacity(cores: usize, agent_ms: f64, fuse_ms: f64, free_share: f64) -> Capacity {
        capacity_with(
            cores,
            [agent_ms, fuse_ms, free_share],
            1.0 / UNITS_PER_MB,
            10.0,
        )
    }

    fn capacity_with(
        cores: usize,
        [agent_ms, fuse_ms, free_share]: [f64; 3],
        frame_mb: f64,
        unit_ms: f64,
    ) -> Capacity {
        let measured = Measured {
            agent_ms,
            fuse_ms,
            stages: Default::default(),
            free_share,
        };
        let machine = Machine {
            cores,
            instructions: "AVX2".into(),
        };
        let all = [measured.clone(), measured];
        let fleet = ("pastat".to_owned(), 2, 2);
        capacity_of(machine, &all, fleet, frame_mb, (100.0, unit_ms))
    }

    #[test]
    fn a_vehicle_that_sends_boxes_only_has_no_map_and_a_budget_limits_one() {
        let (mut settings, values) = (AgentSettings::default(), 1000);
        let all = values * settings.codec.dtype.size();
        assert_eq!(map_bytes(&settings, values), all);
        settings.boxes = Some(SentBoxes::Beside);
        settings.codec.budget_bytes = Some(300);
        assert_eq!(map_bytes(&settings, values), 300);
        settings.boxes = Some(SentBoxes::Only);
        assert_eq!(map_bytes(&settings, values), 0);
    }

    /// Measured on two cores of an EPYC 7003, AVX2, while both compute: an agent takes 42 ms and the ego 89.
    #[test]
    fn a_run_that_needs_232_of_200_ms_answers_47_of_60_frames() {
        let capacity = capacity_with(2, [42.3, 89.1, 1.0], 5.0, 19.4);
        assert!((capacity.needed_ms - 232.0).abs() < 1.0, "{capacity:?}");
        assert_eq!((60.0 * capacity.expected_share).round(), 47.0);
    }

    #[test]
    fn a_machine_without_reserve_does_not_keep_up() {
        // 2 x 60 + 70 + 10 ms in 2 x 100 ms.
        let capacity = capacity(2, 60.0, 70.0, 1.0);
        assert!((capacity.expected_share - 0.9).abs() < 1e-9 && !capacity.keeps_up());
    }

    #[test]
    fn a_machine_with_time_to_spare_keeps_up() {
        let capacity = capacity(4, 60.0, 40.0, 1.0);
        assert!(
            capacity.keeps_up() && (capacity.needed_ms, capacity.available_ms) == (170.0, 400.0),
            "{capacity:?}"
        );
        let text = capacity.to_string();
        assert!(
            text.contains("4 cores, AVX2; pastat with 2 vehicles needs about 170 ms"),
            "{text}"
        );
        assert!(
            text.ends_with("expect about 10 of 10 frames answered"),
            "{text}"
        );
    }

    #[test]
    fn all_cores_together_and_each_process_alone_limit_the_pace() {
        // 2 x 100 + 100 + 10 ms in 2 x 100 ms.
        let together = capacity(2, 100.0, 100.0, 1.0);
        assert!((together.expected_share - 180.0 / 310.0).abs() < 1e-9 && !together.keeps_up());
        assert!((together.relative_rate() - 0.55).abs() < 1e-9);
        // Other programs leave 60 % of the cores.
        assert!((capacity(2, 100.0, 100.0, 0.6).expected_share - 108.0 / 310.0).abs() < 1e-9);
        // Many cores do not help an agent that needs 160 ms for a sweep.
        assert!((capacity(16, 160.0, 50.0, 1.0).expected_share - 100.0 / 160.0).abs() < 1e-9);
    }
}
