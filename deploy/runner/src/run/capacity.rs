//! Capacity: estimate of the pace of a live run on this machine, from a few frames of its scene, and remedies for a
//! machine that does not keep up.

use std::io;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use bus::process_cpu_s;
use dataset::LoadOptions;
use deploy::report::{Capacity, Machine};
use ego_fuser_offline::evaluation::stepped::ComputeTimes;
use ego_fuser_offline::evaluation::{EvaluateError, Evaluator};
use fusion::{Exchange, Method};
use perception::compute_device::ComputeDevice;

use crate::fleet::{Fleet, RUNNER};
use crate::run::RunError;
use crate::run::loss::listed;
use crate::run::machine::{CoreSpeed, this_machine};
use crate::run::stepped::setup;

/// Time for computing frames; loading the models comes on top.
const BUDGET: Duration = Duration::from_millis(600);
/// CPU time of replay, transport, encoding, router and scorer for each megabyte of sweeps and maps, relative to
/// [`CoreSpeed::unit_ms`]: 58 ms for 5.0 MB where a unit takes 19.4 ms (EPYC 7003, AVX2). The report of a run shows the
/// parts.
const UNITS_PER_MB: f64 = 0.6;

/// [`estimate`] in a short-lived process of its own, so that models and their memory are not kept by the
/// process that runs the fleet. `programs` is the folder of the programs.
///
/// # Errors
/// The error of that process, or of starting it.
pub fn estimate_apart(fleet: &Fleet, programs: &Path) -> io::Result<Option<Capacity>> {
    if !has_pace(fleet) {
        return Ok(None);
    }
    let mut command = Command::new(programs.join(RUNNER));
    command
        .arg("capacity")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    let mut child = command.spawn()?;
    // A process that ends before it has read the scenario says why itself.
    drop(
        child
            .stdin
            .take()
            .map(|stdin| serde_json::to_writer(stdin, &fleet.scenario)),
    );
    let output = child.wait_with_output()?;
    if output.status.success() {
        return Ok(serde_json::from_slice(&output.stdout)?);
    }
    let reasons = String::from_utf8_lossy(&output.stderr);
    Err(io::Error::other(
        reasons.lines().last().unwrap_or_default().to_owned(),
    ))
}

/// Estimates the pace of a fleet. `None` for a run without a pace of its own: in lockstep, as fast as possible, or
/// of a single tick; and for networks that do not compute on the CPU, which is what is measured.
///
/// # Errors
/// [`RunError`] when models or frames cannot be loaded or computed.
pub fn estimate(fleet: &Fleet) -> Result<Option<Capacity>, RunError> {
    let scene = &fleet.scenario.scene;
    let recorded = &fleet.recorded;
    let steps = recorded
        .ticks
        .windows(2)
        .map(|pair| pair[1].capture_nanos.saturating_sub(pair[0].capture_nanos));
    let Some(period_nanos) = steps.min().filter(|_| has_pace(fleet)) else {
        return Ok(None);
    };
    let period_ms = period_nanos as f64 * 1e-6 / scene.rate;
    fleet.scenario.models.threads.apply();
    let vehicles = fleet.agents.len();
    let mut evaluator = Evaluator::new(setup(fleet)?)?;
    let (began, before_s) = (Instant::now(), process_cpu_s());
    let elapsed = evaluator.estimate(recorded, vehicles, BUDGET)?;
    // Share of a core that other programs leave.
    let left = ((process_cpu_s() - before_s) / began.elapsed().as_secs_f64()).clamp(0.01, 1.0);
    let [pose_ms, map_ms, fuse_ms] =
        [elapsed.pose_ms, elapsed.map_ms, elapsed.fuse_ms].map(|ms| ms * left);
    let times = ComputeTimes {
        pose_ms,
        map_ms,
        fuse_ms,
    };
    let machine = this_machine();
    let speed = CoreSpeed::measure(machine.cores.min(vehicles + 1));
    let remote = fleet.scenario.remote_agents.len();
    let method = fleet.scenario.method.name();
    Ok(Some(capacity_of(
        machine,
        (method, vehicles, vehicles - remote.min(vehicles)),
        (&times, vehicle_mb(fleet)?),
        period_ms,
        CoreSpeed {
            shared: left * speed.shared,
            ..speed
        },
    )))
}

/// Megabytes of a vehicle's sweep and of its map.
fn vehicle_mb(fleet: &Fleet) -> Result<f64, RunError> {
    let is_recorded = |tick: &usize| fleet.recorded.is_present(0, *tick);
    let sweep = (0..fleet.recorded.ticks.len())
        .find(is_recorded)
        .map(|tick| fleet.recorded.load(0, tick, &LoadOptions::default()))
        .transpose()
        .map_err(EvaluateError::from)?;
    let sweep_bytes = sweep.map_or(0, |frame| size_of_val(&frame.points.xyzi[..]) as u64);
    let map_bytes = match fleet.scenario.method.exchange() {
        Exchange::Features => fleet.map_values() * fleet.scenario.agents.codec.dtype.size(),
        _ => 0,
    };
    Ok((sweep_bytes + map_bytes) as f64 * 1e-6)
}

/// Capacity from measured times.
fn capacity_of(
    machine: Machine,
    (method, vehicles, local_vehicles): (&str, usize, usize),
    (times, vehicle_mb): (&ComputeTimes, f64),
    period_ms: f64,
    speed: CoreSpeed,
) -> Capacity {
    let (agent_ms, fuse_ms) = (times.pose_ms + times.map_ms, times.fuse_ms);
    let shared_speed = speed.shared;
    let messages_ms = vehicles as f64 * vehicle_mb * UNITS_PER_MB * speed.unit_ms;
    let needed_ms = local_vehicles as f64 * agent_ms + fuse_ms + messages_ms;
    let available_ms = machine.cores as f64 * shared_speed * period_ms;
    // Neither an agent nor the ego computes two frames at once.
    let longest_ms = agent_ms.max(fuse_ms) / shared_speed;
    let expected_share = (available_ms / needed_ms)
        .min(period_ms / longest_ms)
        .min(1.0);
    let method = method.to_owned();
    Capacity {
        machine,
        method,
        vehicles,
        local_vehicles,
        agent_ms,
        fuse_ms,
        messages_ms,
        period_ms,
        shared_speed,
        needed_ms,
        available_ms,
        expected_share,
    }
}
/// True if a run has a pace of its own, and one that can be estimated.
fn has_pace(Fleet { scenario, .. }: &Fleet) -> bool {
    !scenario.scene.lockstep
        && scenario.scene.rate > 0.0
        && scenario.models.device == ComputeDevice::Cpu
}

/// Changes that let a fleet answer more ticks, the mildest first, as text: `tracked poses, method max or clock: stepped`.
#[must_use]
pub fn remedies(fleet: &Fleet, capacity: Option<&Capacity>) -> String {
    let scenario = &fleet.scenario;
    let mut all = Vec::new();
    if fleet.pose_source() == "pgc" {
        all.push("tracked poses (agents.pose.tracked)".to_owned());
    }
    if scenario.method.exchange() == Exchange::Features && scenario.method != Method::MAX {
        all.push("method max".to_owned());
    }
    if fleet.agents.len() > 2 {
        all.push("fewer vehicles (scene.agents)".to_owned());
    }
    let relative = capacity.map_or(0.5, Capacity::relative_rate);
    all.push(format!(
        "--rate {}",
        rounded(relative * scenario.scene.rate)
    ));
    // Simulation time refuses processes that are slower than the scene.
    let fits = capacity
        .is_none_or(|capacity| capacity.agent_ms.max(capacity.fuse_ms) < 0.9 * capacity.period_ms);
    all.push(
        if fits {
            "clock: stepped"
        } else {
            "scene.lockstep: true"
        }
        .to_owned(),
    );
    listed(&all, "or")
}

/// A rate with at most two significant digits after the point.
fn rounded(rate: f64) -> f64 {
    (rate * 100.0).round() / 100.0
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Capacity of a machine with 10 ms for the messages of a frame.
    fn capacity(cores: usize, pose_ms: f64, fuse_ms: f64, shared: f64) -> Capacity {
        let speed = CoreSpeed {
            unit_ms: 10.0,
            shared,
        };
        capacity_with(cores, [pose_ms, 40.0, fuse_ms], 0.5 / UNITS_PER_MB, speed)
    }

    fn capacity_with(
        cores: usize,
        [pose_ms, map_ms, fuse_ms]: [f64; 3],
        vehicle_mb: f64,
        speed: CoreSpeed,
    ) -> Capacity {
        let machine = Machine {
            cores,
            instructions: "AVX2".into(),
        };
        let times = ComputeTimes {
            pose_ms,
            map_ms,
            fuse_ms,
        };
        capacity_of(
            machine,
            ("pastat", 2, 2),
            (&times, vehicle_mb),
            100.0,
            speed,
        )
    }

    /// Measured on two cores of an EPYC 7003, AVX2: alone an agent takes 37 ms and the ego 78; a run took 240 ms of CPU
    /// per frame of 200 ms.
    #[test]
    fn a_run_that_needs_240_of_200_ms_answers_50_of_60_frames() {
        let speed = CoreSpeed {
            unit_ms: 19.4,
            shared: 0.875,
        };
        let capacity = capacity_with(2, [3.0, 34.0, 78.0], 2.5, speed);
        let at_full_speed_ms = capacity.needed_ms / capacity.shared_speed;
        assert!((at_full_speed_ms - 240.0).abs() < 5.0, "{capacity:?}");
        assert_eq!((60.0 * capacity.expected_share).round(), 50.0);
    }

    #[test]
    fn a_machine_with_time_to_spare_keeps_up() {
        let capacity = capacity(4, 20.0, 40.0, 1.0);
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
        let together = capacity(2, 60.0, 100.0, 1.0);
        assert!((together.expected_share - 200.0 / 310.0).abs() < 1e-9 && !together.keeps_up());
        assert!((together.relative_rate() - 0.6).abs() < 1e-9);
        // Hyperthreads of one core.
        assert!((capacity(2, 60.0, 100.0, 0.6).expected_share - 120.0 / 310.0).abs() < 1e-9);
        // Many cores do not help an agent that needs 160 ms for a sweep.
        assert!((capacity(16, 120.0, 50.0, 1.0).expected_share - 100.0 / 160.0).abs() < 1e-9);
    }
}
