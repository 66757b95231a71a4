//! `ego-fuser eval`: AP of a method on recorded scenes.

use std::collections::BTreeSet;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use super::{DataSets, EvalSet, print_left_out, rows_with_provenance};
use anyhow::Result;
use dataset::average_precision::{Ordering, Scorer, THRESHOLDS};
use dataset::evaluation_protocol::{EvaluationProtocol, ProtocolConfig};
use dataset::frame::Frame;
use dataset::ground_truth::{self, GroundTruth};
use dataset::{LeftOut, LoadOptions};
use ego_fuser_offline::evaluation::{EvaluatedFrame, Evaluator, Setup, without_true_pose};
use ego_fuser_offline::multi_scale::{MULTI_SCALE_KIND, OfflineDetector};
use fusion::Method;
use perception::int8::InferencePrecision;
use perception::weights::{KIND_KEY, Weights};
use serde_json::{Value, json};
use support::cli::{BadInput, Outcome};
use support::output;
use support::sampling::repeated;
use support::statistics::mean;
use terminal::progress;
use terminal::text_table::number;

/// Measures AP on datasets, with true poses, without delay and without loss.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    data: DataSets,
    /// Weights of encoder and head.
    #[arg(long, value_name = "FILE")]
    weights: PathBuf,
    /// Number format in which networks are computed.
    #[arg(long, value_enum, default_value_t)]
    precision: InferencePrecision,
    /// Methods, one after another; none named: that of the weights.
    #[arg(long, value_name = "NAME", num_args = 1.., value_delimiter = ',')]
    method: Vec<Method>,
    /// Largest number of frames of each scenario [default: all].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    frames: Option<u32>,
    #[command(flatten)]
    protocol: ProtocolConfig,
    /// Torch threads.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: u16,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

impl Arguments {
    /// Evaluates and prints a line per method.
    pub(crate) fn run(self) -> Result<Outcome> {
        tch::set_num_threads(i32::from(self.threads));
        let mut left_out = LeftOut::default();
        if let Some(twice) = repeated(&self.method) {
            return Err(BadInput::new(format!("--method names {twice} twice")).into());
        }
        let frames = self.frames.map(|frames| frames as usize);
        let protocol = Some(&self.protocol);
        let data = self.data.evaluated(&mut left_out, protocol, frames)?;
        let weights = Weights::load(&self.weights).map_err(BadInput::of)?;
        let (rows, area_m) = if weights.metadata(KIND_KEY) == Some(MULTI_SCALE_KIND) {
            self.evaluate_multi_scale(&data, &mut left_out)?
        } else {
            let methods = match &self.method[..] {
                [] => vec![None],
                methods => methods.iter().copied().map(Some).collect(),
            };
            let mut rows = Vec::new();
            for method in methods {
                rows.push(self.evaluate(method, &data, &mut left_out)?);
            }
            (rows, weights.detector_config()?.lidar_range_m)
        };
        let protocols: Vec<_> = data.iter().map(|(one, _)| one.within(area_m)).collect();
        if self.json {
            self.print_json(rows, &data, &protocols)?;
        } else {
            let lines: BTreeSet<String> = protocols.iter().map(ToString::to_string).collect();
            lines.into_iter().try_for_each(output::line)?;
        }
        Ok(print_left_out(&left_out))
    }

    /// Row and area of a network that fuses at every level: it is one method of its own.
    fn evaluate_multi_scale(
        &self,
        data: &[EvalSet],
        left_out: &mut LeftOut,
    ) -> Result<(Vec<Value>, [f64; 6])> {
        if !self.method.is_empty() {
            let reason = "a multi-scale network has one method: leave --method out";
            return Err(BadInput::new(reason).into());
        }
        let mut detector = OfflineDetector::load(&self.weights).map_err(BadInput::of)?;
        let mut tally = MethodTotals::default();
        let all = data.iter().flat_map(|(protocol, scenarios)| {
            scenarios.iter().map(move |scenario| (protocol, scenario))
        });
        for (protocol, scenario) in all {
            let rule = protocol.rule_within(detector.config().lidar_range_m);
            for tick in 0..scenario.ticks.len() {
                let loaded =
                    scenario.load_tick(tick, 0..scenario.agents.len(), &LoadOptions::default());
                left_out.add_tick(&loaded);
                // The protocol puts the ego first: without its frame there is nothing to detect in.
                if loaded.frames.first().is_none_or(|(agent, _)| *agent != 0) {
                    continue;
                }
                let frames: Vec<Frame> =
                    loaded.frames.into_iter().map(|(_, frame)| frame).collect();
                if frames[0].world_from_lidar.is_none() {
                    left_out.add_unreadable(0, without_true_pose(scenario, tick, &frames[0].cav));
                    continue;
                }
                let all: Vec<&Frame> = frames.iter().collect();
                let truth = GroundTruth::of_tick(&all, 0, &rule);
                let near = ground_truth::contributors(&all, 0, rule.comm_range_m);
                let frames = frames.into_iter().enumerate();
                let near = frames.filter_map(|(place, it)| near.contains(&place).then_some(it));
                let (detections, sent_bytes) = match detector.detect(&Vec::from_iter(near)) {
                    Err(error) if error.is_of_frame() => {
                        let stem = &scenario.ticks[tick].stem;
                        let frame = format!("scenario {}, tick {stem}", scenario.name);
                        left_out.add_failed(&frame, &error.to_string());
                        continue;
                    }
                    detected => detected?,
                };
                tally.frames += 1;
                tally.scorer.add(&detections, &truth);
                let sent_bytes = sent_bytes.into_iter().map(|bytes| bytes as f64);
                tally.payload_bytes.extend(sent_bytes);
            }
        }
        left_out.add_scores("multi_scale", &tally.scorer);
        let row = self.row(&tally, "multi_scale")?;
        Ok((vec![row], detector.config().lidar_range_m))
    }

    /// Row of one method over all data.
    fn evaluate(
        &self,
        method: Option<Method>,
        data: &[EvalSet],
        left_out: &mut LeftOut,
    ) -> Result<Value> {
        let mut tally = MethodTotals::default();
        let mut name = "";
        for (protocol, scenarios) in data {
            let mut setup = Setup {
                method,
                protocol: Some(protocol.clone()),
                ..Setup::default()
            };
            setup.models.weights.clone_from(&self.weights);
            setup.models.precision = self.precision;
            let mut evaluator = Evaluator::new(setup).map_err(BadInput::of)?;
            name = evaluator.ego.method().name();
            let frames = scenarios.iter().map(|scenario| scenario.ticks.len());
            let bar = progress::bar(frames.sum(), "frames").with_message(name);
            for scenario in scenarios {
                // The callback never ends the run.
                let _ = evaluator.run(scenario, &mut |frame| {
                    tally.add(&frame);
                    bar.inc(1);
                    ControlFlow::Continue(())
                })?;
            }
            bar.finish_and_clear();
            left_out.merge(&evaluator.left_out);
        }
        left_out.add_scores(name, &tally.scorer);
        Ok(self.row(&tally, name)?)
    }

    /// The row of a method, which is printed unless JSON is asked for.
    fn row(&self, tally: &MethodTotals, method: &str) -> std::io::Result<Value> {
        let row = tally.row(method);
        if !self.json {
            let [global, frame] = ["ap_global", "ap_frame_order"].map(|name| {
                let aps = THRESHOLDS.map(|iou| row[name][format!("{iou}")].as_f64());
                aps.map(|ap| number(ap, 4)).join(" ")
            });
            output::line(format_args!(
                "{:<10} AP@0.3/0.5/0.7 global {global}, frame order {frame}, {} frames, {} bytes a neighbour",
                row["method"].as_str().unwrap_or_default(),
                row["frames"],
                number(row["payload_bytes_mean"].as_f64(), 1)
            ))?;
        }
        Ok(row)
    }

    /// Prints rows as JSON with the protocol of each data set, as it applies to the area of the network, and with
    /// command and digests of the program, the weights, the scripts and the evaluated data.
    fn print_json(
        &self,
        mut rows: Vec<Value>,
        data: &[EvalSet],
        protocols: &[EvaluationProtocol],
    ) -> Result<()> {
        for row in &mut rows {
            row["protocols"] = json!(protocols);
        }
        let scripts = self.method.iter().filter_map(|method| method.script_file());
        let files = scripts.chain([self.weights.as_path()]).map(Path::to_owned);
        let scenarios = data.iter().flat_map(|(_, scenarios)| scenarios);
        output::line(rows_with_provenance(&rows, scenarios, files)?)?;
        Ok(())
    }
}

/// Totals over the frames of one method.
#[derive(Default)]
struct MethodTotals {
    scorer: Scorer,
    frames: usize,
    payload_bytes: Vec<f64>,
}

impl MethodTotals {
    /// Adds a frame. One that failed has no result to add, one without the ego's true pose nothing to compare it with.
    fn add(&mut self, frame: &EvaluatedFrame) {
        if frame.failure.is_some() || frame.true_pose().is_none() {
            return;
        }
        self.frames += 1;
        self.scorer.add(&frame.result.detections, &frame.truth);
        let fused = frame.result.fused.iter();
        let bytes = fused.map(|it| it.payload_bytes as f64);
        self.payload_bytes.extend(bytes);
    }

    fn row(&self, method: &str) -> Value {
        let [global, frame_order] = [Ordering::Global, Ordering::Frame].map(|ordering| {
            let found = self.scorer.average_precisions(ordering);
            let by_iou = THRESHOLDS.iter().zip(found);
            let by_iou = by_iou.map(|(iou, ap)| (iou.to_string(), json!(ap)));
            by_iou.collect::<serde_json::Map<_, _>>()
        });
        json!({
            "method": method,
            "frames": self.frames,
            "ap_global": global,
            "ap_frame_order": frame_order,
            // Unknown, rather than 0, where no neighbour sent anything.
            "payload_bytes_mean": mean(&self.payload_bytes),
        })
    }
}

#[cfg(test)]
mod tests {
    use std::process::ExitCode;

    use support::cli::exit_code;

    use super::*;

    #[test]
    fn without_objects_and_neighbours_ap_and_bytes_are_null() {
        let row = MethodTotals::default().row("late");
        assert_eq!(
            row["ap_global"],
            json!({"0.3": null, "0.5": null, "0.7": null})
        );
        assert_eq!(row["payload_bytes_mean"], Value::Null);
    }

    #[test]
    fn weights_that_are_not_there_are_bad_input() {
        let loaded = Weights::load(Path::new("no/such.safetensors"));
        let error = anyhow::Error::from(loaded.map_err(BadInput::of).unwrap_err());
        assert!(error.to_string().contains("no/such.safetensors"), "{error}");
        assert_eq!(exit_code(Err(error), |_| false), ExitCode::from(2));
    }
}
