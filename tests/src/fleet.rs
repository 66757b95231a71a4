//! Fleets as processes: `v2vloc up` on small scenes, with untrained detectors.

use std::collections::BTreeMap;
use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::sync::OnceLock;
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use fusion::Method;
use fusion::model::CooperativeModel;
use perception::model_config::{DetectorConfig, ShrinkConfig};
use perception::weights;
use serde_json::{Value, json};
use support::file_digests::FileDigests;

use crate::locks::random_generator_lock;

/// Longer than any step of a test takes, under any load.
pub const TIMEOUT: Duration = Duration::from_secs(120);

/// The folder of the profile that this test was built with, where cargo puts programs.
///
/// # Panics
/// When the test has no file.
#[must_use]
pub(crate) fn programs_dir() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| {
        // target/<profile>/deps/<this test>
        let test = std::env::current_exe().expect("a test has a file");
        test.ancestors()
            .nth(2)
            .expect("a folder of the profile")
            .to_path_buf()
    })
}

/// The folder of the programs under test, built if they are not.
///
/// # Panics
/// When they cannot be built.
pub fn programs() -> &'static Path {
    static BUILT: OnceLock<()> = OnceLock::new();
    let folder = programs_dir();
    BUILT.get_or_init(|| {
        // `cargo test` does not always build the programs of other packages: make sure they exist and are fresh.
        if let Some(cargo) = std::env::var_os("CARGO") {
            let mut build = Command::new(cargo);
            build
                .args(["build", "--quiet", "--workspace", "--bins"])
                .current_dir(env!("CARGO_MANIFEST_DIR"));
            // With cargo's variables for this test, a build script of another crate would take itself as moved, and
            // everything above it would be compiled anew.
            for (name, _) in std::env::vars_os() {
                let text = name.to_string_lossy();
                if text == "OUT_DIR"
                    || text.starts_with("CARGO_PKG_")
                    || text.starts_with("CARGO_MANIFEST_")
                {
                    build.env_remove(&name);
                }
            }
            if folder.ends_with("release") {
                build.arg("--release");
            }
            assert!(
                build.status().expect("cargo runs").success(),
                "the programs cannot be built"
            );
        }
    });
    folder
}

/// Path of a file or folder in `deploy`.
///
/// # Panics
/// When it is not there.
#[must_use]
pub fn deploy_file(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy");
    let path = path.join(name).canonicalize().unwrap();
    path.display().to_string()
}

/// `v2vloc` with these words, run to its end.
///
/// # Panics
/// When it cannot be started.
#[must_use]
pub fn v2vloc(words: &[&str]) -> Output {
    let mut v2vloc = Command::new(programs().join("v2vloc"));
    v2vloc.args(words).output().unwrap()
}

/// Writes weights of a small detector with random parameters, the same every time.
///
/// # Panics
/// When a file cannot be written.
pub fn write_weights(path: &Path) {
    write(path, &tiny(8));
}

/// The same with a head that detects vehicles everywhere: where boxes are compared there have to be some.
///
/// # Panics
/// When a file cannot be written.
pub fn write_sighted_weights(path: &Path) {
    write(path, &sighted(8));
}

/// The same of another network, whose maps have more channels.
///
/// # Panics
/// When a file cannot be written.
pub fn write_weights_of_another_network(path: &Path) {
    write(path, &sighted(12));
}

/// The same with a box input, which changes scores and boxes, and a refinement of the boxes that a vehicle sends.
///
/// # Panics
/// When a file cannot be written.
pub fn write_weights_with_box_input(path: &Path) {
    let mut model = sighted(8);
    model.train_box_input_only().expect("a box input");
    set(&model, "box_input.out.weight", 0.1);
    set(&model, "box_refinement.out.weight", 0.01);
    write(path, &model);
}

fn write(path: &Path, model: &CooperativeModel) {
    let mut about = model.about();
    // For every method: weights that name one are refused for others.
    about.remove(weights::METHOD_KEY);
    let precision = weights::Precision::Single;
    weights::save(path, &model.variables, &about, precision).expect("a writable folder");
}

fn sighted(channels: i64) -> CooperativeModel {
    let model = tiny(channels);
    set(&model, "cls_head.bias", 0.5);
    model
}

fn set(model: &CooperativeModel, name: &str, value: f64) {
    let mut variable = model.variables.variables()[name].shallow_clone();
    let _ = tch::no_grad(|| variable.fill_(value));
}

fn tiny(channels: i64) -> CooperativeModel {
    let _generator = random_generator_lock();
    tch::manual_seed(7);
    let config = DetectorConfig {
        name: "tiny".into(),
        lidar_range_m: [-25.6, -25.6, -3.0, 25.6, 25.6, 1.0],
        pillar_channels: 8,
        layer_nums: vec![1, 1, 1],
        num_filters: vec![8, 8, 8],
        num_upsample_filters: vec![8; 3],
        shrink: Some(ShrinkConfig::Pointwise { channels }),
        ..DetectorConfig::lean()
    };
    CooperativeModel::new(&config, Method::MAX, tch::Device::Cpu)
        .expect("a configuration that fits")
}

/// A folder with a scene of two vehicles, weights and a scenario.
///
/// # Panics
/// When a file cannot be written.
pub fn write_scenario(folder: &Path, ticks: usize, scene: &str, rest: &str) -> PathBuf {
    crate::scene::write(folder, &["4279", "4288"], ticks);
    write_weights(&folder.join("weights.safetensors"));
    let path = folder.join("scenario.yaml");
    let text = format!(
        "run: test\nscene: {{dir: scene, {scene}}}\nmodels: {{weights: weights.safetensors}}\nmethod: max\n{rest}\n"
    );
    fs::write(&path, text).expect("a writable folder");
    path
}

/// A running `v2vloc up`.
pub struct Up {
    child: Child,
    lines: Receiver<String>,
    output: Vec<String>,
    /// Its run folder.
    pub folder: PathBuf,
}

impl Up {
    /// Starts `v2vloc up` on a scenario named `test`, with run folders in `<folder>/runs`.
    ///
    /// # Panics
    /// When it cannot be started.
    #[must_use]
    pub fn start(folder: &Path, scenario: &Path) -> Self {
        Self::by(Command::new(programs().join("v2vloc")), folder, scenario)
    }

    /// The same by a command that runs `v2vloc`, for example on another host.
    ///
    /// # Panics
    /// When it cannot be started.
    #[must_use]
    pub fn by(mut v2vloc: Command, folder: &Path, scenario: &Path) -> Self {
        let runs = folder.join("runs");
        let mut child = v2vloc
            .arg("up")
            .arg(scenario)
            .arg("--runs")
            .arg(&runs)
            .stderr(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .expect("v2vloc runs");
        let (send, lines) = channel();
        let stderr = BufReader::new(child.stderr.take().expect("piped above"));
        std::thread::spawn(move || {
            for line in stderr.lines().map_while(Result::ok) {
                eprintln!("{line}");
                let _ = send.send(line);
            }
        });
        Self {
            child,
            lines,
            output: Vec::new(),
            folder: runs.join("test"),
        }
    }

    /// Waits for an output line that contains `text`, and returns the line.
    ///
    /// # Panics
    /// When it does not come in time.
    pub fn wait_for_line(&mut self, text: &str) -> String {
        let deadline = Instant::now() + TIMEOUT;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let line = self
                .lines
                .recv_timeout(left)
                .unwrap_or_else(|_| panic!("no line with {text:?}: {:?}", self.output));
            self.output.push(line.clone());
            if line.contains(text) {
                return line;
            }
        }
    }

    /// Waits until `condition` holds for the results so far, oldest first.
    ///
    /// # Panics
    /// When it does not hold in time.
    pub fn wait_for_results(&mut self, what: &str, condition: impl Fn(&[Value]) -> bool) {
        let deadline = Instant::now() + TIMEOUT;
        loop {
            let results = results(&self.folder);
            if condition(&results) {
                return;
            }
            assert!(
                Instant::now() < deadline,
                "{what}: {} results",
                results.len()
            );
            assert!(
                self.child.try_wait().expect("a child").is_none(),
                "v2vloc ended before {what}"
            );
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Process ids of all processes that it has reported as running, last start of each.
    #[must_use]
    pub fn pids(&mut self) -> BTreeMap<String, u32> {
        self.output.extend(self.lines.try_iter());
        let started = |line: &String| {
            let (name, rest) = line.split_once(" runs (pid ")?;
            Some((name.to_owned(), rest.trim_end_matches(')').parse().ok()?))
        };
        self.output.iter().filter_map(started).collect()
    }

    /// Its own process id.
    #[must_use]
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Waits until it ends.
    ///
    /// # Panics
    /// When it does not end in time.
    pub fn wait(&mut self) -> ExitStatus {
        let deadline = Instant::now() + TIMEOUT;
        loop {
            if let Some(status) = self.child.try_wait().expect("a child") {
                return status;
            }
            assert!(Instant::now() < deadline, "v2vloc does not end");
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

impl Drop for Up {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The complete lines of a run's `detections.jsonl`.
#[must_use]
pub fn results(run: &Path) -> Vec<Value> {
    let text = fs::read_to_string(run.join("detections.jsonl")).unwrap_or_default();
    let whole = text.rfind('\n').map_or("", |end| &text[..end]);
    whole
        .lines()
        .filter_map(|line| serde_json::from_str(line).ok())
        .collect()
}

/// Checks that the metrics of a run name their protocol and all that they were made of, its weights among it.
///
/// # Panics
/// When they do not.
pub fn check_origin(run: &Path, weights: &Path) {
    let text = fs::read_to_string(run.join("metrics.json")).expect("metrics");
    let metrics: Value = serde_json::from_str(&text).expect("JSON");
    let (protocol, provenance) = (&metrics["protocol"], &metrics["provenance"]);
    let range_m = &protocol["ground_truth"]["x_m"];
    assert_eq!(
        (&protocol["name"], range_m),
        (&json!("opv2v"), &json!([-25.6, 25.6])),
        "the range ends at the area of the network"
    );
    let is_filled = |value: &Value| value.as_str().is_some_and(|text| !text.is_empty());
    let command = provenance["command"].as_array();
    assert!(
        command.is_some_and(|command| command.first().is_some_and(is_filled))
            && is_filled(&provenance["commit"]),
        "{provenance}"
    );
    for name in ["program_sha256", "data_sha256"] {
        let len = provenance[name].as_str().map(str::len);
        assert_eq!(len, Some(64), "{name}: {provenance}");
    }
    let weights_sha256 = FileDigests::default().sha256(weights).expect("weights");
    let files = provenance["files_sha256"].as_object();
    assert!(
        files.is_some_and(|files| files.values().any(|sha256| *sha256 == weights_sha256)),
        "{weights_sha256}: {provenance}"
    );
}

/// Number of neighbours that a result was fused from.
#[must_use]
pub fn fused(result: &Value) -> usize {
    result["fused"].as_array().map_or(0, Vec::len)
}

/// Sends a signal, for example `INT`.
///
/// # Panics
/// When there is no `kill`.
pub fn signal(pid: u32, name: &str) {
    let status = Command::new("kill")
        .arg(format!("-{name}"))
        .arg(pid.to_string())
        .status()
        .expect("kill runs");
    assert!(status.success(), "kill -{name} {pid}");
}

/// True if a process runs; a zombie does not.
#[must_use]
pub fn is_running(pid: u32) -> bool {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    stat.rsplit(')')
        .next()
        .is_some_and(|rest| !rest.is_empty() && !rest.trim_start().starts_with('Z'))
}
