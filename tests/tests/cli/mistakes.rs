//! Mistakes on the command line: the exit code and the message of each, in one table; and the documented forms of values.

use std::fs;
use std::net::TcpListener;
use std::path::Path;
use std::process::Command;

use tests::fleet::programs;
use tests::scene;

/// A command line, its exit code, and a part of its message. `{d}` is a folder of files, `{s}` a small scene in it, `{w}`
/// the released weights, `{p}` a port that is in use.
type Row = (&'static str, i32, &'static str);

const EVAL: &str = "v2vloc eval --dataset {s} --weights {w} --method max";

/// Mistakes in options of an evaluation: what follows [`EVAL`].
const OF_AN_EVALUATION: [Row; 35] = [
    (
        "--noise-position-std-m 2",
        2,
        "--noise-position-std-m has no effect on pose source recorded",
    ),
    (
        "--head town1",
        2,
        "--head has no effect on pose source recorded",
    ),
    ("--measure-every 2", 2, "--measure-every has no effect"),
    ("--poses nofile.csv", 2, "--poses has no effect"),
    ("--baseline nofile", 2, "--baseline has no effect"),
    (
        "--pose-source pgc --head town9",
        2,
        "town9: no such file or released head",
    ),
    (
        "--pose-source noisy --noise-position-std-m -5",
        2,
        "noisy.position_std_m is -5: must be 0 to 1000",
    ),
    (
        "--pose-source noisy --noise-decay-s 3",
        2,
        "noise mode independent",
    ),
    ("--ground-truth-range-m 1,2,3", 2, "3 numbers, expected 6"),
    ("--gate 2", 2, "codec.gate.threshold is 2: must be below"),
    ("--seed 3", 2, "--link"),
    ("--slice 1/2", 2, "--table"),
    ("--print slurm --slices 2", 2, "--table"),
    ("--attackers 2", 2, "--attack"),
    ("--attack noise --attackers 0", 2, "attackers is 0"),
    (
        "--attack noise --attackers 5",
        2,
        "attackers is 5, but no scenario has",
    ),
    (
        "--delay-ms 20000",
        2,
        "delay_ms is 20000, must be 0 to 10000",
    ),
    (
        "--boxes only --dtype i8",
        2,
        "with boxes only max sends none",
    ),
    (
        "--link ideal --watch-queue",
        2,
        "--watch-queue: no map waits",
    ),
    (
        "--link opencood-real --bandwidth-mbps 6",
        2,
        "the latency of link opencood-real has a rate",
    ),
    (
        "--method late --boxes only",
        2,
        "boxes is for methods that exchange feature maps: late",
    ),
    (
        "--box-alignment",
        2,
        "box_alignment is for boxes of neighbours",
    ),
    ("--latency-ms -3", 2, "latency is -3"),
    ("--link nolink", 2, "neither a preset of a link"),
    ("--frames 0", 2, "0 is not in 1"),
    ("--frames 1 --out /proc/none", 1, "cannot be written"),
    (
        "--frames 1 --feature-maps /proc/none",
        1,
        "cannot be written",
    ),
    ("--frames -1", 2, "-1"),
    ("--map x", 2, "--map"),
    ("--method late --dtype f16", 2, "late sends none"),
    ("--method none --trust", 2, "none uses none"),
    ("--method maxx", 2, "maxx"),
    ("--method max,max", 2, "--method names max twice"),
    ("--method script:{d}/none.pt", 2, "none.pt: No such file"),
    (
        "--weights {d}/none.safetensors",
        2,
        "cannot be used multiple times",
    ),
];

const MISTAKES: [Row; 51] = [
    (
        "v2vloc eval --dataset {d}/none --weights {w} --method max",
        2,
        "none",
    ),
    (
        "v2vloc eval --dataset {d}/empty --weights {w} --method max",
        2,
        "empty",
    ),
    (
        "v2vloc eval --dataset {s} --weights {d}/none.safetensors --method max",
        2,
        "none.safetensors",
    ),
    (
        "v2vloc eval --table {d}/experiment.yaml --out {d}/tables --frames 2",
        2,
        "cannot be used with",
    ),
    (
        "v2vloc eval --table {d}/experiment.yaml --out {d}/tables --dtype f16",
        2,
        "cannot be used with",
    ),
    (
        "v2vloc eval --table {d}/experiment.yaml --out {d}/tables --attackers 2",
        2,
        "--attack",
    ),
    (
        "v2vloc eval --table {d}/experiment.yaml --out {d}/tables",
        2,
        "this is an experiment: v2vloc sweep FILE",
    ),
    (
        "v2vloc up {d}/experiment.yaml",
        2,
        "this is an experiment: v2vloc sweep FILE",
    ),
    ("v2vloc up {d}/typo.yaml", 2, "unknown field `metod`"),
    ("v2vloc up {d}/none.yaml", 2, "none.yaml: No such file"),
    (
        "v2vloc up {d}/scenario.yaml --runs {d}/scenario.yaml",
        2,
        "scenario.yaml: is a file, must be a folder",
    ),
    (
        "sim-replay synth --subset v2vdet --seed 1 --frames 1 --out {d}/scenario.yaml",
        2,
        "scenario.yaml: is a file, must be a folder",
    ),
    (
        "v2vloc up {d}/scenario.yaml --runs {d}/runs --metrics 127.0.0.1:{p}",
        2,
        "127.0.0.1:{p}",
    ),
    (
        "v2vloc up {d}/scenario.yaml --runs {d}/runs --set models.weights={w}/lean-none.safetensors --method pastat",
        2,
        "lean-none.safetensors",
    ),
    (
        "v2vloc sweep {d}/scenario.yaml",
        2,
        "this is a scenario: v2vloc up FILE",
    ),
    (
        "v2vloc sweep {d}/experiment.yaml --dry-run --keep-feature-maps",
        2,
        "cannot be used with",
    ),
    (
        "v2vloc sweep {d}/experiment.yaml --slice 1/2 --slices 3",
        2,
        "--print <ENGINE>",
    ),
    ("v2vloc demo --vehicles 9", 2, "9 is not in 2..=4"),
    (
        "v2vloc view nosuchrun --runs {d}",
        2,
        "there is no run nosuchrun",
    ),
    ("v2vloc report {d}/idle", 2, "nothing was played"),
    (
        "v2vloc status --connect tcp/127.0.0.1:9 --run x",
        1,
        "no router at tcp/127.0.0.1:9",
    ),
    (
        "v2vloc status --connect tcp/127.0.0.1:9 --run x --runs {d}",
        2,
        "--runs",
    ),
    ("v2vloc status x --keys {d}", 2, "--connect"),
    ("v2vloc view x --run y", 2, "--connect"),
    (
        "v2vloc router --listen tcp/127.0.0.1:{p}",
        2,
        "the port is in use",
    ),
    ("v2vloc router --run x", 2, "--keys"),
    (
        "v2vloc keys --out {d}/keys --days -1",
        2,
        "-1 is not in 1..=3650",
    ),
    (
        "sim-replay synth --subset town1loc --seed 1 --vehicles 3 --out {d}/new",
        2,
        "--vehicles is for --subset v2vdet",
    ),
    (
        "sim-replay synth --subset v2vdet --seed 1 --period-s 0.12 --out {d}/new",
        2,
        "--period-s is 0.12",
    ),
    (
        "sim-replay synth --subset v2vdet --seed 1 --frames 1 --out /proc/none",
        1,
        "/proc/none",
    ),
    (
        "sim-replay stream {s} --run x --seed 3",
        2,
        "sensor_link.seed is 3",
    ),
    (
        "sim-replay stream {s} --run x --egos 1",
        2,
        "wait.egos is 1",
    ),
    ("sim-replay link --print nolink", 2, "nolink"),
    (
        "sim-replay link --print {d}/experiment.yaml",
        2,
        "this is an experiment: v2vloc sweep FILE",
    ),
    (
        "agent locate {d}/none.pcd --head town9",
        2,
        "town9: no such file or released head",
    ),
    (
        "agent locate {d}/none.pcd --head {w}/surfels-town1.safetensors --encoder {w}/pgc-encoder.safetensors",
        2,
        "a surfel map has no encoder",
    ),
    (
        "agent eval --dataset {s} --head {w}/surfels-town1.safetensors --seed 4",
        2,
        "--seed need a head",
    ),
    ("agent eval --dataset {s} --measure-every 2", 2, "--tracked"),
    (
        "agent eval --dataset {s} --icp-map {s} --measure-every 2",
        2,
        "--tracked",
    ),
    (
        "agent eval --dataset {s} --tracked --by scan-context",
        2,
        "--retrieval",
    ),
    (
        "agent eval --dataset {s} --head town1 --map-spacing-m 3",
        2,
        "--icp-map",
    ),
    (
        "agent eval --dataset {s} --tracked --good-loss 0.3",
        2,
        "--fit-confidence",
    ),
    (
        "agent eval --dataset {s} --surfel-map town1 --good-loss 0.3",
        2,
        "--fit-confidence",
    ),
    (
        "agent eval --dataset {s} --max-wrong 0.001",
        2,
        "--fit-covariance",
    ),
    (
        "agent eval --dataset {s} --solver sc2pcr --seed 3",
        2,
        "--seed is for --solver ransac",
    ),
    (
        "agent run --run x --cav 1 --weights {w}/lean-max.safetensors --baseline b",
        2,
        "--baseline has no effect",
    ),
    (
        "agent train scene --dataset {s} --encoder e --validation-sweeps 3 --steps 1 --out {d}/new",
        2,
        "--validation",
    ),
    (
        "ego-fuser eval --dataset {s} --weights {w}",
        2,
        "a folder, must be one",
    ),
    (
        "ego-fuser train --dataset {s} --network lean --freeze-encoder --steps 1 --out {d}/new",
        2,
        "--init",
    ),
    (
        "ego-fuser train --dataset {s} --method max --noise-share 0.5 --steps 1 --out {d}/new",
        2,
        "--noise-position-std-m",
    ),
    (
        "ego-fuser train --dataset {s} --method max --ap-order frame --steps 1 --out {d}/new",
        2,
        "--ap-order",
    ),
];

/// Documented forms of values, in commands that go no further than to a data set that does not exist.
const FORMS: [&str; 27] = [
    "v2vloc eval --ground-truth-range-m -51.2,-38.4,-3,51.2,38.4,1 --weights {w} --method max",
    "v2vloc eval --ground-truth-range-m=-51.2,-38.4,-3,51.2,38.4,1 --weights {w} --method max",
    "v2vloc eval --ground-truth-range-m -51.2, -38.4, -3, 51.2, 38.4, 1 --weights {w} --method max",
    "v2vloc eval --classes truck,bus,van --weights {w} --method none, max",
    "v2vloc eval --gate 0.01 --weights {w} --method none,max",
    "v2vloc eval --gate 0.01,5,1 --weights {w} --method max",
    "v2vloc eval --gate -1,none --weights {w} --method max",
    "v2vloc eval --link dsrc --compute-ms 20,60,30 --weights {w} --method max",
    "v2vloc eval --bandwidth-mbps inf --latency-ms 100 --compute-ms 20, 60, 30 --weights {w} --method max",
    "v2vloc eval --intensity-scale 100 --weights {w} --method max",
    "v2vloc eval --pose-source pgc --head town1 --weights {w} --method max",
    "v2vloc eval --attack shifted_pose --attackers 2 --weights {w} --method max",
    "ego-fuser eval --method none, max --weights {w}/lean-max.safetensors",
    "ego-fuser align --method gnss,icp --boxes annotated",
    "ego-fuser alignment-error --shifts-m 0, 0.5 --turns-deg 1,2 --weights {w}/lean-pastat.safetensors",
    "ego-fuser quantise {d}/w.safetensors --frames 5",
    "ego-fuser train --method pastat --without ce,fsa --minutes 1 --out {d}/new",
    "ego-fuser train --ground-truth-range-m -51.2,-38.4,-3,51.2,38.4,1 --minutes 1 --out {d}/new",
    "agent eval --head town1=town1 town4:3=town4",
    "agent localize --head town1 --out {d}/new.csv",
    "agent train encoder --network lean --steps 1 --out {d}/new",
    "agent train scene --encoder {w}/pgc-encoder.safetensors --leave-out even-loss --steps 1 --out {d}/new",
    "sim-replay stream --run x --agents 1,-1 --loop=false",
    "sim-replay stream --run x --lockstep --egos 1, -1 --expect 4288/bev>ego-4279",
    "sim-replay stream --run x --latency-ms 100 --jitter-ms 20 --bandwidth-mbps 100 --loss 0.05 --seed 3",
    "sim-replay convert --layout opv2v --out {d}/new --intensity-scale 255",
    "sim-replay export --ros2 --lidar-mount -1,0,-1.5,90",
];

/// Files that the command lines name.
struct Files {
    folder: tempfile::TempDir,
    /// Holds the port.
    listener: TcpListener,
}

impl Files {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        scene::write(folder.path(), &["1", "2"], 2);
        let write = |name: &str, text: &str| fs::write(folder.path().join(name), text).unwrap();
        for name in ["empty", "idle"] {
            fs::create_dir(folder.path().join(name)).unwrap();
        }
        write(
            "experiment.yaml",
            "name: e\ndataset: scene\nweights: w\ngrid: {method: [max]}\n",
        );
        let scenario = "scene: {dir: scene}\nmodels: {weights: weights}\n";
        write("scenario.yaml", scenario);
        write("typo.yaml", &format!("{scenario}metod: max\n"));
        std::os::unix::fs::symlink(weights(), folder.path().join("weights")).unwrap();
        let spread = r#"{"p50":null,"p95":null,"max":null}"#;
        let pace = format!(
            r#"{{"ticks":0,"answered":0,"agents":{{}},"interval_ms":{spread},"rate_hz":null,"seconds":0}}"#
        );
        let report = format!(
            r#"{{"run":"idle","method":"max","pose_source":"recorded","clock":"wall","capacity":null,"pace":{pace},
            "latency_ms":{spread},"stages":[],"processes":[],"streams":[]}}"#
        );
        write("idle/report.json", &report);
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        Self { folder, listener }
    }

    fn filled(&self, text: &str) -> String {
        let folder = self.folder.path().display().to_string();
        let port = self.listener.local_addr().unwrap().port().to_string();
        text.replace("{s}", "{d}/scene")
            .replace("{d}", &folder)
            .replace("{w}", &weights())
            .replace("{p}", &port)
    }

    /// Exit code and standard error of a command line.
    fn run(&self, line: &str) -> (Option<i32>, String) {
        let line = self.filled(line);
        let (program, words) = line.split_once(' ').unwrap();
        let output = Command::new(programs().join(program))
            .args(words.split_whitespace())
            .current_dir(self.folder.path())
            .output()
            .unwrap();
        (
            output.status.code(),
            String::from_utf8_lossy(&output.stderr).into_owned(),
        )
    }

    /// Differences of a row from what the program does.
    fn fault(&self, line: &str, code: i32, fragment: &str) -> Option<String> {
        let (found, message) = self.run(line);
        let is_clean = !message.contains(".cargo") && message.matches("error: ").count() == 1;
        let is_right = found == Some(code) && message.contains(&self.filled(fragment)) && is_clean;
        (!is_right).then(|| {
            format!("{line}\n  exit code {found:?}, expected {code} and {fragment:?}: {message}")
        })
    }
}

fn weights() -> String {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/weights");
    folder.canonicalize().unwrap().display().to_string()
}

#[test]
fn a_mistake_has_its_exit_code_and_a_message_that_names_it() {
    let files = Files::new();
    let of_an_evaluation = OF_AN_EVALUATION.map(|(options, code, fragment)| {
        // A method of the row replaces the usual one.
        let usual = EVAL
            .strip_suffix(" --method max")
            .filter(|_| options.contains("--method"));
        (
            format!("{} {options}", usual.unwrap_or(EVAL)),
            code,
            fragment,
        )
    });
    let others = MISTAKES.map(|(line, code, fragment)| (line.to_owned(), code, fragment));
    let faults: Vec<String> = of_an_evaluation
        .iter()
        .chain(&others)
        .filter_map(|(line, code, fragment)| files.fault(line, *code, fragment))
        .collect();
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    assert!(
        !files.folder.path().join("new").exists(),
        "nothing is left behind"
    );
}

#[test]
fn documented_forms_of_values_are_accepted() {
    let files = Files::new();
    let faults: Vec<String> = FORMS
        .iter()
        .filter_map(|line| {
            let line = match line.starts_with("sim-replay") {
                true => line.replacen(" --", " {d}/no-such-data --", 1),
                false => format!("{line} --dataset {{d}}/no-such-data"),
            };
            let line = match line.contains("export") {
                true => format!("{line} {{d}}/out.mcap"),
                false => line,
            };
            // The data set is missing; every value before it was read.
            let (code, message) = files.run(&line);
            let is_read = code == Some(2) && message.contains("no-such-data");
            (!is_read).then(|| format!("{line}\n  {code:?}: {message}"))
        })
        .collect();
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}
