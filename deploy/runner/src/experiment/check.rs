//! Checks of an experiment: values out of bounds, contradictory fields, grids that take too long, tables.

use std::fmt::Debug;

use agent::config::SentBoxes;
use anyhow::{Result, anyhow, bail, ensure};
use ego_fuser::config::EgoSettings;
use ego_fuser_offline::evaluation::stepped::ComputeTimes;
use fusion::{Exchange, Method};
use link::{CapacityConfig, LatencyModel, LinkConfig, LossModel};

use super::evaluation::Trial;
use super::spec::{CodecSpec, Experiment, Grid, Row, Table};
use super::sweep::grid::{count, sizes};
use localization::pose_source::{NoiseMode, PoseSourceConfig};

/// Largest number of runs; more are a mistake.
const MOST_RUNS: usize = 10_000;

/// Checks everything that does not depend on the data.
pub(super) fn check(experiment: &Experiment) -> Result<()> {
    let grid = &experiment.grid;
    if experiment.tables.is_empty() {
        check_name("name", &experiment.name)?;
    }
    for (field, value) in [
        ("scenarios", experiment.scenarios),
        ("frames", experiment.frames),
    ] {
        ensure!(
            value != Some(0),
            "{field} is 0: there would be nothing to evaluate"
        );
    }
    experiment.ego.validate()?;
    experiment
        .poses
        .validate()
        .map_err(|error| anyhow!("poses: {error}"))?;
    experiment.compute.validate("compute")?;
    let limit_gb = experiment.feature_maps_limit_gb;
    number("feature_maps_limit_gb", limit_gb, 0.0, 10_000.0)?;
    check_used(experiment)?;
    let link = experiment.link().map(LinkConfig::open).transpose();
    let link = link.map_err(|error| anyhow!("link: {error}"))?;
    if !experiment.tables.is_empty() {
        return tables(experiment);
    }
    axes(grid)?;
    contradictions(experiment, &link.unwrap_or_default().0)?;
    let runs = count(grid);
    ensure!(
        runs <= MOST_RUNS,
        "the grid has {} = {runs} runs, {:.1} hours even at a second each; more than {MOST_RUNS} are refused",
        product(grid),
        runs as f64 / 3600.0
    );
    Ok(())
}

/// Refuses settings that no run of the experiment uses.
fn check_used(experiment: &Experiment) -> Result<()> {
    let (ego, unset) = (&experiment.ego, EgoSettings::default());
    if let Some(ego) = &ego.id {
        bail!("ego.id is {ego}: choose by protocol.ego_kind instead");
    }
    for (field, is_unset) in [
        ("inbox", ego.inbox == unset.inbox),
        ("pace", ego.pace == unset.pace),
        ("tracks", ego.tracks == unset.tracks),
    ] {
        ensure!(is_unset, "ego.{field} has no effect in an experiment");
    }
    let (mode, has_axis) = (experiment.noise_mode, experiment.grid.pose_noise.is_some());
    ensure!(
        mode == NoiseMode::default() || (has_axis && mode != NoiseMode::Replayed),
        "noise_mode is {}, but it is for grid.pose_noise, without a table of errors: name it in poses instead",
        mode.name()
    );
    let is_timed = experiment.link().is_some();
    ensure!(
        is_timed || experiment.compute == ComputeTimes::default(),
        "compute is given, but without link no time passes"
    );
    let deadline_ms = ego.deadline_ms;
    ensure!(
        is_timed || deadline_ms == unset.deadline_ms,
        "ego.deadline_ms is {deadline_ms}, but without link no time passes"
    );
    Ok(())
}

/// Checks the tables, each by itself and beside the other settings.
fn tables(experiment: &Experiment) -> Result<()> {
    let has_grid = experiment.grid != Grid::default();
    ensure!(!has_grid, "an experiment has a grid or tables, not both");
    let names = experiment.tables.iter().map(|table| table.name.clone());
    let names: Vec<String> = names.collect();
    values("tables", Some(&names), |it| check_name("table name", it))?;
    for table in &experiment.tables {
        let name = &table.name;
        check_names(table)?;
        for vehicles in table.rows.iter().filter_map(|row| row.vehicles) {
            let field = format!("table {name:?}: vehicles");
            number(&field, vehicles as f64, 1.0, 64.0)?;
        }
        check_effects(experiment, table)?;
        let is_late = table.columns.iter().any(|column| column.delay_ms > 0);
        ensure!(
            experiment.link.is_none() || !is_late,
            "table {name:?}: delay_ms and link contradict each other"
        );
    }
    Ok(())
}

/// Refuses names that stand twice or divide a table.
fn check_names(table: &Table) -> Result<()> {
    let (name, rows) = (&table.name, &table.rows);
    let columns = table.columns.iter().map(|column| column.name.clone());
    let columns: Vec<String> = columns.collect();
    let labels = rows.iter().map(Row::label).collect();
    for (what, names) in [("columns", columns), ("rows", labels)] {
        let field = format!("table {name:?}: {what}");
        let is_plain = |name: &String| !name.contains(['|', '\n', '\r']);
        values(&field, Some(&names), |name| {
            ensure!(is_plain(name), "{field}: {name:?} has | or a line end");
            Ok(())
        })?;
    }
    Ok(())
}

/// Refuses settings of a row that have no effect with its method, and settings of a column that have none in any row.
fn check_effects(experiment: &Experiment, table: &Table) -> Result<()> {
    let name = &table.name;
    for row in &table.rows {
        let mut trial = Trial::default();
        row.apply(&mut trial.setup);
        let checked = trial.check(&[row.method]);
        checked.map_err(|problem| anyhow!("table {name:?}, row {}: {problem}", row.label()))?;
    }
    let methods: Vec<Method> = table.rows.iter().map(|row| row.method).collect();
    for column in &table.columns {
        let mut trial = Trial::default();
        trial.setup.ego = experiment.ego.clone();
        trial.setup.agents.boxes = table.rows.iter().find_map(|row| row.boxes);
        column.apply(&mut trial.setup);
        let checked = trial.check(&methods);
        checked.map_err(|problem| anyhow!("table {name:?}, column {}: {problem}", column.name))?;
    }
    Ok(())
}

/// Refuses a name that cannot be one of files.
fn check_name(field: &str, name: &str) -> Result<()> {
    let is_plain = name
        .chars()
        .all(|c| c.is_ascii_alphanumeric() || c == '-' || c == '_');
    ensure!(
        !name.is_empty() && is_plain,
        "{field} {name:?} is to name files: letters, digits, - and _"
    );
    Ok(())
}

/// Checks every axis on its own.
fn axes(grid: &Grid) -> Result<()> {
    values("grid.method", Some(&grid.method), |_| Ok(()))?;
    // A reference is a method of the same grid, so it may not repeat one of them.
    let all = [&grid.method[..], &grid.reference].concat();
    values("grid.method with grid.reference", Some(&all), |_| Ok(()))?;
    values("grid.codec", grid.codec.as_ref(), codec)?;
    let codecs = grid.codec.iter().flatten();
    let alone = codecs.filter(|codec| codec.boxes == Some(SentBoxes::Only));
    ensure!(alone.count() <= 1, "grid.codec names boxes: only twice");
    numbers("grid.latency_ms", &grid.latency_ms, 0.0, 600_000.0)?;
    numbers("grid.jitter_ms", &grid.jitter_ms, 0.0, 600_000.0)?;
    // Infinity stands for an unlimited link; the highest rate of a limited one is the link's own rule.
    let unlimited = f64::INFINITY;
    numbers("grid.bandwidth_mbps", &grid.bandwidth_mbps, 1e-6, unlimited)?;
    numbers("grid.loss", &grid.loss, 0.0, 1.0)?;
    values("grid.pose_noise", grid.pose_noise.as_ref(), |noise| {
        let (position_m, heading_deg) = (noise.position_std_m, noise.heading_std_deg);
        number("grid.pose_noise: position_std_m", position_m, 0.0, 1000.0)?;
        number("grid.pose_noise: heading_std_deg", heading_deg, 0.0, 360.0)
    })?;
    values("grid.vehicles", grid.vehicles.as_ref(), |count| {
        number("grid.vehicles", *count as f64, 1.0, 64.0)
    })?;
    values("grid.seed", grid.seed.as_ref(), |_| Ok(()))
}

fn codec(codec: &CodecSpec) -> Result<()> {
    // The smallest is less than a cell of any map, of which one is always sent.
    number("grid.codec: keep", codec.keep.unwrap_or(1.0), 1e-6, 1.0)?;
    number("grid.codec: fit", codec.fit.unwrap_or(1.0), 0.01, 1.0)?;
    let level = f64::from(codec.zstd_level.unwrap_or(1));
    number("grid.codec: zstd_level", level, 1.0, 22.0)?;
    let has_options = (codec.keep, codec.zstd_level, codec.fit) != (None, None, None);
    ensure!(
        codec.boxes != Some(SentBoxes::Only) || !has_options,
        "grid.codec: keep, zstd_level and fit are for feature maps, but boxes is only"
    );
    Ok(())
}

/// Checks an axis of numbers from `low` to `high`.
fn numbers(field: &str, axis: &Option<Vec<f64>>, low: f64, high: f64) -> Result<()> {
    values(field, axis.as_ref(), |value| {
        number(field, *value, low, high)
    })
}

/// Contradictory or impossible combinations of fields.
fn contradictions(experiment: &Experiment, link: &LinkConfig) -> Result<()> {
    let (grid, poses) = (&experiment.grid, &experiment.poses);
    let mut exchanges = grid.method.iter().map(|method| method.exchange());
    ensure!(
        experiment.weights.is_some(),
        "weights is left out: name a file, or a folder with one for each method"
    );
    ensure!(
        experiment.feature_maps.is_none(),
        "feature_maps is of tables: a sweep keeps its maps in the folder of --out"
    );
    link_axes(experiment, link)?;
    ensure!(
        grid.pose_noise.is_none() || *poses == PoseSourceConfig::Recorded,
        "grid.pose_noise is added to recorded poses, but poses is {}",
        poses.name()
    );
    if grid.codec.is_some() && exchanges.all(|it| it != Exchange::Features) {
        let names: Vec<&str> = grid.method.iter().map(|method| method.name()).collect();
        bail!(
            "grid.codec varies the encoding of feature maps, but grid.method ({}) sends none",
            names.join(", ")
        );
    }
    let of_messages = [
        ("vehicles", grid.vehicles.is_some()),
        ("latency_ms", grid.latency_ms.is_some()),
        ("bandwidth_mbps", grid.bandwidth_mbps.is_some()),
        ("loss", grid.loss.is_some()),
    ];
    if let Some((axis, _)) = of_messages.iter().find(|(_, is_given)| *is_given) {
        let mut methods = grid.method.iter().chain(&grid.reference);
        let sends = methods.any(|method| method.exchange() != Exchange::Nothing);
        ensure!(
            sends,
            "grid.{axis} varies messages, but grid.method is none: there are none"
        );
    }
    let has_seeds = grid.seed.as_ref().is_some_and(|seeds| seeds.len() > 1);
    ensure!(
        !has_seeds || is_random(experiment, link),
        "grid.seed has several values, but nothing in the experiment is random"
    );
    let mut trial = Trial::default();
    trial.setup.ego = experiment.ego.clone();
    let mut codecs = grid.codec.iter().flatten();
    trial.setup.agents.boxes = codecs.find_map(|codec| codec.boxes);
    trial.check(&[&grid.method[..], &grid.reference].concat())
}

/// Contradictions between the axes of a link, its own settings, and the times of the ego.
fn link_axes(experiment: &Experiment, link: &LinkConfig) -> Result<()> {
    let (grid, ego) = (&experiment.grid, &experiment.ego);
    let varies_rate = grid.bandwidth_mbps.is_some();
    let has_latency = grid.latency_ms.is_some() && link.latency != LatencyModel::None;
    let has_loss = grid.loss.is_some() && link.loss != LossModel::None;
    let is_serialised = link.latency.has_rate();
    let has_capacity = link.capacity != CapacityConfig::Unlimited;
    let twice = [
        (has_latency, "latency_ms", "latency"),
        (varies_rate && has_capacity, "bandwidth_mbps", "capacity"),
        (varies_rate && is_serialised, "bandwidth_mbps", "latency"),
        (has_loss, "loss", "loss"),
    ];
    if let Some((_, axis, field)) = twice.into_iter().find(|(is_twice, ..)| *is_twice) {
        let name = experiment.link.as_deref().unwrap_or_default();
        bail!("grid.{axis} and the {field} of link {name} contradict each other");
    }
    ensure!(
        grid.jitter_ms.is_none() || grid.latency_ms.is_some(),
        "grid.jitter_ms is the deviation of grid.latency_ms, which is left out"
    );
    let mut codecs = grid.codec.iter().flatten();
    ensure!(
        grid.bandwidth_mbps.is_some() || codecs.all(|codec| codec.fit.is_none()),
        "grid.codec.fit is a share of grid.bandwidth_mbps, which is left out"
    );
    // A map captured at t can be fused until t + max_age_ms + deadline_ms: in the last frame that
    // still accepts its age, at the end of that frame's wait.
    let oldest_ms = ego.max_age_ms as f64 + ego.deadline_ms as f64;
    if let Some(ms) = grid.latency_ms.iter().flatten().find(|ms| **ms > oldest_ms) {
        bail!(
            "grid.latency_ms is {ms}, but ego.max_age_ms is {}: every message would be too old to be fused",
            ego.max_age_ms
        );
    }
    Ok(())
}

/// True if a seed makes a difference, by the axes of the grid, the pose source or the link.
fn is_random(Experiment { grid, poses, .. }: &Experiment, link: &LinkConfig) -> bool {
    let (mut loss, mut noise) = (grid.loss.iter().flatten(), grid.pose_noise.iter().flatten());
    let jitters = grid.jitter_ms.iter().flatten().any(|ms| *ms > 0.0);
    // A loss of 0 or 1 is certain, whatever the seed.
    let loses = loss.any(|share| *share > 0.0 && *share < 1.0);
    let errs = noise.any(|noise| noise.position_std_m > 0.0 || noise.heading_std_deg > 0.0);
    let is_noisy = match poses {
        PoseSourceConfig::Noisy(noisy) if noisy.mode == NoiseMode::Replayed => true,
        PoseSourceConfig::Noisy(noisy) => noisy.position_std_m.max(noisy.heading_std_deg) > 0.0,
        _ => false,
    };
    let is_steady = matches!(
        link.latency,
        LatencyModel::None | LatencyModel::ConstantMs(_) | LatencyModel::Trace
    );
    let (has_loss, reorders) = (link.loss != LossModel::None, link.reorder.is_some());
    let of_link = !is_steady || has_loss || reorders || link.duplicate > 0.0;
    jitters || loses || errs || is_noisy || of_link
}

/// Checks each value of an axis, or of a list of a table: at least one, and no duplicates.
fn values<T: PartialEq + Debug>(
    field: &str,
    values: Option<&Vec<T>>,
    check: impl Fn(&T) -> Result<()>,
) -> Result<()> {
    let Some(values) = values else { return Ok(()) };
    ensure!(!values.is_empty(), "{field} is empty: there is no run");
    for (place, value) in values.iter().enumerate() {
        check(value)?;
        let is_known = values[..place].contains(value);
        ensure!(!is_known, "{field} names {value:?} twice");
    }
    Ok(())
}

fn number(field: &str, value: f64, low: f64, high: f64) -> Result<()> {
    // NaN is in no range, so it is refused here.
    let is_allowed = (low..=high).contains(&value);
    ensure!(is_allowed, "{field} is {value}, must be {low} to {high}");
    Ok(())
}

/// The axes with more than one value, multiplied: `3 method x 6 latency_ms`.
pub(super) fn product(grid: &Grid) -> String {
    let sizes = sizes(grid).into_iter().filter(|(_, size)| *size > 1);
    let factors: Vec<String> = sizes.map(|(axis, size)| format!("{size} {axis}")).collect();
    match &factors[..] {
        [] => "1".into(),
        factors => factors.join(" x "),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn problem(text: &str) -> String {
        let text = format!("name: e\ndataset: d\nweights: w\n{text}");
        let experiment: Experiment = serde_saphyr::from_str(&text).unwrap();
        check(&experiment)
            .err()
            .map_or(String::new(), |error| error.to_string())
    }

    #[test]
    fn every_contradiction_is_named_by_its_fields() {
        assert_eq!(problem("grid: {method: [max]}"), "");
        for (text, message) in [
            ("grid: {method: []}", "grid.method is empty"),
            ("grid: {method: [max], loss: [0, 1.5]}", "grid.loss is 1.5"),
            (
                "grid: {method: [max], loss: [0.1, 0.1]}",
                "grid.loss names 0.1 twice",
            ),
            (
                "grid: {method: [max], bandwidth_mbps: [0]}",
                "grid.bandwidth_mbps is 0",
            ),
            (
                "grid: {method: [max], codec: [{dtype: f16, keep: 0}]}",
                "keep is 0",
            ),
            (
                "grid: {method: [max], codec: [{dtype: f32, fit: 2}]}",
                "grid.codec: fit is 2",
            ),
            (
                "grid: {method: [max], jitter_ms: [5]}",
                "grid.latency_ms, which is left out",
            ),
            (
                "grid: {method: [max], codec: [{dtype: f32, fit: 0.2}]}",
                "grid.bandwidth_mbps, which is left out",
            ),
            (
                "link: dsrc\ngrid: {method: [max], bandwidth_mbps: [6]}",
                "capacity of link dsrc",
            ),
            (
                "link: opencood-real\ngrid: {method: [max], bandwidth_mbps: [6]}",
                "grid.bandwidth_mbps and the latency of link opencood-real",
            ),
            (
                "grid: {method: [max], codec: [{dtype: i8, boxes: only, keep: 0.1}]}",
                "grid.codec: keep, zstd_level and fit are for feature maps, but boxes is only",
            ),
            (
                "grid: {method: [max], codec: [{dtype: i8, boxes: only}, {dtype: f32, boxes: only}]}",
                "grid.codec names boxes: only twice",
            ),
            ("link: nowhere\ngrid: {method: [max]}", "nowhere"),
            (
                "ego: {max_age_ms: 300}\ngrid: {method: [max], latency_ms: [500]}",
                "ego.max_age_ms is 300",
            ),
            (
                "grid: {method: [late], codec: [{dtype: i8}]}",
                "grid.method (late) sends none",
            ),
            (
                "grid: {method: [max], seed: [1, 2]}",
                "nothing in the experiment is random",
            ),
            (
                "poses: {cached: {file: p.csv}}\ngrid: {method: [max], pose_noise: [{position_std_m: 1, heading_std_deg: 1}]}",
                "poses is cached",
            ),
            ("ego: {id: '7'}\ngrid: {method: [max]}", "protocol.ego_kind"),
            (
                "ego: {pace: every_sweep}\ngrid: {method: [max]}",
                "ego.pace has no effect",
            ),
            (
                "ego: {tracks: false}\ngrid: {method: [max]}",
                "ego.tracks has no effect",
            ),
            (
                "noise_mode: replayed\ngrid: {method: [max], pose_noise: [{position_std_m: 1, heading_std_deg: 1}]}",
                "noise_mode is replayed, but it is for grid.pose_noise, without a table",
            ),
            (
                "noise_mode: fixed\nposes: {noisy: {position_std_m: 2}}\ngrid: {method: [late]}",
                "noise_mode is fixed, but it is for grid.pose_noise",
            ),
            (
                "poses: {noisy: {step_s: 0}}\ngrid: {method: [max]}",
                "poses: noisy.step_s is 0",
            ),
            ("frames: 0\ngrid: {method: [max]}", "frames is 0"),
            (
                "grid: {method: [none], loss: [0, 0.5]}",
                "grid.loss varies messages, but grid.method is none",
            ),
            (
                "grid: {method: [none], latency_ms: [0], jitter_ms: [5]}",
                "grid.latency_ms varies messages, but grid.method is none",
            ),
        ] {
            let problem = problem(text);
            assert!(problem.contains(message), "{text}: {problem}");
        }
    }

    #[test]
    fn a_table_refuses_what_an_evaluation_refuses() {
        let of = |rows: &str, column: &str| {
            problem(&format!(
                "tables: [{{name: t, rows: [{rows}], columns: [{{name: c{column}}}]}}]"
            ))
        };
        let late = ", delay_ms: 100, trust: true";
        assert_eq!(of("{method: none}, {method: max, boxes: only}", late), "");
        for (rows, column, message) in [
            (
                "{method: max}",
                ", attack: {falsification: false_velocity}",
                "table \"t\", column c: attack false_velocity is for boxes",
            ),
            (
                "{method: max}",
                ", delay_ms: 20000",
                "table \"t\", column c: delay_ms is 20000, must be 0 to 10000",
            ),
            (
                "{method: max}",
                ", attack: {falsification: noise, attackers: 0}",
                "attackers is 0, must be 1 or more",
            ),
            (
                "{method: max}, {method: none, boxes: only}",
                "",
                "row none: boxes is for methods that exchange feature maps: none does not",
            ),
            ("{method: late, boxes: only}", "", "row late: boxes is for"),
            ("{method: none}", late, "none uses none"),
        ] {
            let problem = of(rows, column);
            assert!(problem.contains(message), "{rows} {column}: {problem}");
        }
        let of_sweep = problem("ego: {trust: true}\ngrid: {method: [none]}");
        assert!(of_sweep.contains("none uses none"), "{of_sweep}");
    }

    #[test]
    fn a_table_refuses_times_and_noise_that_no_run_uses() {
        let of = |settings: &str| {
            problem(&format!(
                "{settings}\ntables: [{{name: t, rows: [{{method: late}}], columns: [{{name: c}}]}}]"
            ))
        };
        let times = "ego: {deadline_ms: 20, max_age_ms: 100}";
        assert_eq!(of(&format!("link: ideal\n{times}")), "");
        assert_eq!(of("ego: {max_age_ms: 0}"), "");
        for (settings, message) in [
            (
                times,
                "ego.deadline_ms is 20, but without link no time passes",
            ),
            (
                "compute: {pose_ms: 0, map_ms: 0, fuse_ms: 9}",
                "compute is given, but without link",
            ),
            (
                "noise_mode: fixed",
                "noise_mode is fixed, but it is for grid.pose_noise",
            ),
        ] {
            let problem = of(settings);
            assert!(problem.contains(message), "{settings}: {problem}");
        }
    }

    #[test]
    fn names_that_are_equal_or_divide_a_table_are_refused() {
        let of = |rows: &str, columns: &str| {
            problem(&format!(
                "tables: [{{name: t, rows: [{rows}], columns: [{columns}]}}]"
            ))
        };
        let (two, noise) = (
            "{name: c}",
            ", attack: {falsification: noise, attackers: 3}",
        );
        let alone = "{method: late, vehicles: 1, name: alone}";
        let attacked = format!("{{name: d{noise}}}");
        assert_eq!(
            of("{method: late}, {method: max, weights: [a, b]}", two),
            ""
        );
        assert_eq!(of(&format!("{{method: late}}, {alone}"), &attacked), "");
        for (rows, columns, message) in [
            (
                "{method: late}",
                "{name: 0 ms | true poses}",
                "columns: \"0 ms | true poses\" has |",
            ),
            (
                "{method: late, name: \"a\\nb\"}",
                two,
                "rows: \"a\\nb\" has | or a line end",
            ),
            (
                "{method: late}",
                "{name: c}, {name: c, delay_ms: 9}",
                "table \"t\": columns names \"c\" twice",
            ),
            (
                "{method: late}, {method: late, vehicles: 2}",
                two,
                "rows names \"late\" twice",
            ),
            ("", two, "table \"t\": rows is empty"),
        ] {
            let problem = of(rows, columns);
            assert!(problem.contains(message), "{rows} {columns}: {problem}");
        }
    }

    #[test]
    fn noisy_poses_are_random() {
        let of = |std_m: f64| {
            let poses = format!("{{noisy: {{position_std_m: {std_m}, heading_std_deg: 0}}}}");
            problem(&format!(
                "poses: {poses}\ngrid: {{method: [max], seed: [1, 2]}}"
            ))
        };
        assert_eq!(of(0.5), "");
        assert!(of(0.0).contains("nothing in the experiment is random"));
    }

    #[test]
    fn a_grid_that_takes_too_long_is_refused_with_its_size() {
        let many = (0..101)
            .map(|k| k.to_string())
            .collect::<Vec<_>>()
            .join(", ");
        let text = format!(
            "grid: {{method: [max], latency_ms: [{many}], seed: [{many}], jitter_ms: [1]}}"
        );
        let problem = problem(&text);
        assert!(
            problem.contains(
                "101 latency_ms x 101 seed = 10201 runs, 2.8 hours even at a second each"
            ),
            "{problem}"
        );
    }
}
