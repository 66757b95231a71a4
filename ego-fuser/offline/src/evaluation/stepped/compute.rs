//! Compute times of a fleet's processes, in simulation time.

use std::time::{Duration, Instant};

use dataset::{LoadOptions, Scenario, period_nanos};
use ego_fuser::ego::View;
use protocol::config::{FieldError, within};
use protocol::{EgoMotion, StageTiming};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use support::nanos;
use support::statistics::median;

use super::super::{EvaluateError, Evaluator};

/// Ticks that times are measured over.
const MEASURED_TICKS: usize = 5;
/// Vehicles that they are measured with: the ego and a neighbour.
const MEASURED_VEHICLES: usize = 2;
/// Fewest ticks of an estimate: the first half does not count, as every network allocates its memory in the first one,
/// and PASTAT has no earlier maps then.
const ESTIMATED_TICKS: usize = 5;
/// Most ticks of it.
const MOST_ESTIMATED_TICKS: usize = 50;

/// Compute time of each step, milliseconds: the same for all vehicles and ticks. Every sweep is computed, so an agent
/// (`pose_ms` + `map_ms`) and the ego (`fuse_ms`) take at most the period of the scene.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ComputeTimes {
    /// From the capture of a sweep to the publication of the pose.
    pub pose_ms: f64,
    /// From there to the publication of map, boxes or points.
    pub map_ms: f64,
    /// From the decision of the ego to the publication of its detections.
    pub fuse_ms: f64,
}

impl ComputeTimes {
    /// Checks the values; `field` names them in errors.
    ///
    /// # Errors
    /// [`FieldError`] for the first that is not 0 to 60 s.
    pub fn validate(&self, field: &str) -> Result<(), FieldError> {
        within(&format!("{field}.pose_ms"), self.pose_ms, 0.0, 60_000.0)?;
        within(&format!("{field}.map_ms"), self.map_ms, 0.0, 60_000.0)?;
        within(&format!("{field}.fuse_ms"), self.fuse_ms, 0.0, 60_000.0)
    }

    /// Time until an agent has published all messages of a sweep.
    pub(super) fn agent_nanos(&self) -> u64 {
        nanos::of_ms(self.pose_ms).saturating_add(nanos::of_ms(self.map_ms))
    }

    /// In simulation time every sweep is processed: a process that is slower than the scene is rejected.
    pub(super) fn check(&self, scenario: &Scenario) -> Result<(), EvaluateError> {
        let Some(period_nanos) = period_nanos(&scenario.ticks) else {
            return Ok(());
        };
        let steps = [
            ("an agent (pose_ms + map_ms)", self.agent_nanos()),
            ("the ego (fuse_ms)", nanos::of_ms(self.fuse_ms)),
        ];
        for (what, takes_nanos) in steps {
            if takes_nanos > period_nanos {
                let [takes, period] = [takes_nanos, period_nanos].map(|nanos| nanos as f64 * 1e-6);
                return Err(EvaluateError::TooSlow(format!(
                    "{what} takes {takes:.0} ms, but the scene has a frame every {period:.0} ms"
                )));
            }
        }
        Ok(())
    }
}

/// Compute times of a fleet's processes on this machine, and of their stages.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct EstimatedTimes {
    /// Of the steps.
    pub steps: ComputeTimes,
    /// Medians by stage of an agent, then of the ego, milliseconds.
    pub stages: [Vec<(String, f64)>; 2],
}

/// Durations of stages, milliseconds.
#[derive(Debug, Default)]
struct StageDurations {
    pose: Vec<f64>,
    observe: Vec<f64>,
    map: Vec<f64>,
    fuse: Vec<f64>,
    /// By stage of an agent, and of the ego, in the order of their first appearance.
    stages: [Vec<(String, Vec<f64>)>; 2],
    /// Motion of a vehicle in the last sweep.
    motion: EgoMotion,
}

impl StageDurations {
    fn add(&mut self, process: usize, timings: &[StageTiming]) {
        for timing in timings {
            let stages = &mut self.stages[process];
            let known = stages.iter().position(|(stage, _)| *stage == timing.stage);
            let place = known.unwrap_or_else(|| {
                stages.push((timing.stage.clone(), Vec::new()));
                stages.len() - 1
            });
            stages[place].1.push(timing.nanos as f64 * 1e-6);
        }
    }
}

impl Evaluator {
    /// Measures the first ticks of a scenario on this machine: medians, rounded up to whole milliseconds. In a scenario
    /// file they make its run repeatable. Sweeps that cannot be read are left out.
    ///
    /// # Errors
    /// [`EvaluateError`] when a frame cannot be computed.
    pub fn measure(&mut self, scenario: &Scenario) -> Result<ComputeTimes, EvaluateError> {
        let samples = self.samples(scenario, MEASURED_VEHICLES, &|ticks| ticks < MEASURED_TICKS)?;
        Ok(ComputeTimes {
            pose_ms: median(&samples.pose).unwrap_or(0.0).ceil(),
            map_ms: median(&samples.map).unwrap_or(0.0).ceil(),
            fuse_ms: median(&samples.fuse).unwrap_or(0.0).ceil(),
        })
    }

    /// Estimates the compute times of a fleet of `vehicles` on this machine from as many ticks as `budget` allows:
    /// medians of the later half of the ticks. Only two vehicles are computed; the ego fuses the message of the neighbour as
    /// often as there are neighbours.
    ///
    /// # Errors
    /// [`EvaluateError`] when a frame cannot be read or computed.
    pub fn estimate(
        &mut self,
        scenario: &Scenario,
        vehicles: usize,
        budget: Duration,
    ) -> Result<EstimatedTimes, EvaluateError> {
        let began = Instant::now();
        // Few sweeps are timed, so each of them is measured.
        let source = self.setup.agents.pose.clone();
        self.setup.agents.pose = source.clone().measuring_every_sweep();
        let samples = self.samples(scenario, vehicles, &|ticks| {
            ticks < ESTIMATED_TICKS || (ticks < MOST_ESTIMATED_TICKS && began.elapsed() < budget)
        });
        // Restored before an error is returned.
        self.setup.agents.pose = source;
        let samples = samples?;
        // A live vehicle measures one sweep in `interval`: an observation counts as that share.
        let interval = f64::from(self.setup.agents.pose.measuring_interval(&samples.motion));
        let steps = ComputeTimes {
            pose_ms: late_median(&samples.pose) + late_median(&samples.observe) / interval,
            map_ms: late_median(&samples.map),
            fuse_ms: late_median(&samples.fuse),
        };
        let stages = samples.stages.map(|stages| {
            let stages = stages.into_iter();
            let medians = stages.map(|(stage, sample)| (stage, late_median(&sample)));
            medians.collect()
        });
        Ok(EstimatedTimes { steps, stages })
    }

    /// Durations while `is_needed` with the number of ticks so far.
    fn samples(
        &mut self,
        scenario: &Scenario,
        vehicles: usize,
        is_needed: &dyn Fn(usize) -> bool,
    ) -> Result<StageDurations, EvaluateError> {
        let stream = self.ego.method().own_content().stream();
        let mut participants = (0..scenario.agents.len().min(MEASURED_VEHICLES))
            .map(|place| {
                let needed = (place == 0, Some(stream));
                self.participant(&self.setup.agents, scenario, (place, place), needed)
            })
            .collect::<Result<Vec<_>, EvaluateError>>()?;
        let mut samples = StageDurations::default();
        // Maps of an earlier run are no history of these ticks.
        self.ego.forget();
        for tick in (0..scenario.ticks.len()).take_while(|tick| is_needed(*tick)) {
            let (mut own, mut neighbour) = (None, Vec::new());
            for (place, participant) in participants.iter_mut().enumerate() {
                if !scenario.is_present(place, tick) {
                    continue;
                }
                // It is counted when it is evaluated.
                let Ok(frame) = scenario.load(place, tick, &LoadOptions::default()) else {
                    continue;
                };
                samples.motion = frame.motion();
                let began = Instant::now();
                let sent = participant.compute(&frame, None, Default::default)?;
                let sent = sent.into_views();
                match place {
                    0 => own = sent.into_iter().next(),
                    _ => neighbour = sent,
                }
                let all = began.elapsed();
                let [(pose, _), (observe, _), (_, stages)] =
                    ["pose", "pose measurement", "agent"].map(|name| participant.step(name));
                samples.pose.push(ms(pose));
                samples.observe.push(ms(observe));
                samples.add(0, stages);
                // The rest of the time is the map's: pose and observation are measured by themselves.
                samples.map.push(ms(all.saturating_sub(pose + observe)));
            }
            let Some(own) = own else { continue };
            let others = scenario.agents.iter().take(vehicles).skip(1);
            let copies = others.flat_map(|cav| {
                neighbour.iter().map(|view: &View| View {
                    cav: cav.clone(),
                    ..view.clone()
                })
            });
            let neighbours: Vec<View> = copies.collect();
            let began = Instant::now();
            // A frame that fails takes its time too; it is counted when it is evaluated.
            let detected = self.ego.detect(&own, &neighbours);
            samples.fuse.push(ms(began.elapsed()));
            match detected {
                Ok(output) => samples.add(1, &output.stages),
                Err(error) if error.is_of_frame() => {}
                Err(error) => return Err(error.into()),
            }
        }
        self.ego.forget();
        Ok(samples)
    }
}

/// Median of the later half of a sample, 0 where it is empty.
fn late_median(sample: &[f64]) -> f64 {
    median(&sample[sample.len() / 2..]).unwrap_or(0.0)
}

fn ms(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}
