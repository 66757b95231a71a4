//! Sweeps: a grid of runs in simulation time, one CSV, charts, a report.
//!
//! Runs are cached one by one by everything that they are made of, so that an interrupted sweep resumes. The same experiment gives the
//! same CSV, byte for byte, with one process or with many.

mod charts;
mod generated_data;
pub(super) mod grid;
mod html;
mod table;
mod varying;
mod workers;

use std::fs;
use std::io::{self, BufRead, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use ego_fuser_offline::evaluation::AgentPool;
use fusion::Exchange;
use perception::weights::Weights;
use serde::Serialize;
use support::bounded_file::{self, MAX_TEXT_BYTES};
use support::cli::NotWritten;
use support::file_error::FileError;
use support::sampling::distinct;
use support::{atomic_file, output};
use terminal::progress;
use training::feature_store::FeatureStore;

pub use grid::{Point, points};
pub use table::csv;

use self::generated_data::is_generated;
use self::varying::VaryingTable;
use super::cell::{Cell, CellKey};
use super::check;
use super::evaluation::{OpenedData, Trial, compute, evaluate};
use super::slices::Slice;
use super::spec::Experiment;
pub(super) use generated_data::generate;

/// Number of ticks that are timed before a sweep begins, for its estimate.
const PROBED_TICKS: usize = 4;

/// A worker process of a sweep has ended, or reports why it cannot compute a run.
#[derive(Debug, thiserror::Error)]
#[error("a worker has failed: {0}")]
pub struct WorkerError(pub String);

/// A computed run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Run {
    /// Point of the grid.
    pub point: Point,
    /// Result.
    pub cell: Cell,
}

/// Reads, prepares and runs an experiment.
#[derive(Debug)]
pub struct ExperimentSweep {
    file: PathBuf,
    /// Text of the file when it was read; empty if there is no report to hold it.
    text: String,
    experiment: Experiment,
    points: Vec<Point>,
    data: OpenedData,
    out: PathBuf,
}

impl ExperimentSweep {
    /// Reads an experiment, generates its data if requested, and checks the one against the other.
    ///
    /// # Errors
    /// An error that names the file and the field.
    pub fn open(file: &Path, out: &Path) -> Result<Self> {
        let text = bounded_file::read_text(file, MAX_TEXT_BYTES);
        let text = text.with_context(|| file.display().to_string())?;
        let experiment = read(file)?;
        generate(&experiment)?;
        Self::over(experiment, text, file, out)
    }

    /// Prints the number of runs and the time that they will take, and writes nothing: a data set that does not exist
    /// is not generated, and its runs are not timed.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn announce(file: &Path, out: &Path, jobs: usize) -> Result<()> {
        let experiment = read(file)?;
        if let Some(generate) = &experiment.generate
            && !is_generated(&experiment)?
        {
            let grid = &experiment.grid;
            let scenes = experiment.scenarios.unwrap_or(usize::MAX);
            let frames = experiment.frames.unwrap_or(usize::MAX);
            output::note(format_args!(
                "{}: {} = {} runs of {} frames; the data set {} is generated first",
                experiment.name,
                check::product(grid),
                points(&experiment).len(),
                generate.scenes.min(scenes) * generate.frames.min(frames),
                experiment.dataset.display()
            ));
            return Ok(());
        }
        let sweep = Self::over(experiment, String::new(), file, out)?;
        let known = sweep.known(&sweep.keys()?)?;
        sweep.print_estimate(&known, &missing(&known, 0..known.len()), jobs)
    }

    fn over(experiment: Experiment, text: String, file: &Path, out: &Path) -> Result<Self> {
        let mut trial = experiment.trial().context("link")?;
        let data = OpenedData::open(&trial)?;
        if data.frame_count(experiment.scenarios) == 0 {
            let dataset = experiment.dataset.display();
            let problem = format!("dataset {dataset}: there is no frame in it");
            return Err(FileError::new(file, problem).into());
        }
        for &vehicles in experiment.grid.vehicles.iter().flatten() {
            trial.setup.pool = AgentPool::First(vehicles);
            let checked = trial.check_participants(&data);
            checked.map_err(|problem| FileError::new(file, format!("grid.{problem}")))?;
        }
        Ok(Self {
            file: file.to_owned(),
            text,
            points: points(&experiment),
            experiment,
            data,
            out: out.to_owned(),
        })
    }

    /// Identity of the run of each point.
    fn keys(&self) -> Result<Vec<CellKey>> {
        self.points.iter().map(|point| self.key(point)).collect()
    }

    fn key(&self, point: &Point) -> Result<CellKey> {
        self.trial(point)?.key(&self.data, point.method)
    }

    fn trial(&self, point: &Point) -> Result<Trial> {
        point.trial(&self.experiment, &self.maps())
    }

    fn known(&self, keys: &[CellKey]) -> Result<Vec<Option<Cell>>> {
        let known = keys.iter().map(|key| Cell::read(key, &self.cells()));
        known.collect()
    }

    fn cells(&self) -> PathBuf {
        self.out.join("cells")
    }

    fn maps(&self) -> PathBuf {
        self.out.join("maps")
    }

    fn frames(&self) -> usize {
        self.data.frame_count(self.experiment.scenarios)
    }

    /// Computes the missing runs of a slice. Feature maps stay for the other slices.
    ///
    /// # Errors
    /// As [`Self::run`].
    pub fn run_slice(&self, slice: Slice, jobs: usize) -> Result<()> {
        let keys = self.keys()?;
        self.compute_missing(&keys, slice.part(keys.len()), jobs)
    }

    /// Computes the missing runs and writes table, charts and report. Returns the columns that vary between the runs, as
    /// printed on a terminal, and the runs, in the order of the grid.
    ///
    /// # Errors
    /// An error at the first run that cannot be computed; earlier runs are cached.
    pub fn run(&self, jobs: usize, keep_maps: bool) -> Result<(String, Vec<Run>)> {
        let keys = self.keys()?;
        self.compute_missing(&keys, 0..keys.len(), jobs)?;
        // Read back from the cache, as other processes may have computed them.
        let cells: Option<Vec<Cell>> = self.known(&keys)?.into_iter().collect();
        let cells = cells.ok_or_else(|| WorkerError("a run that was done is not there".into()))?;
        let runs = self.points.iter().cloned().zip(cells);
        let runs: Vec<Run> = runs.map(|(point, cell)| Run { point, cell }).collect();
        let table = self.write(&runs)?;
        // After the results are written: a failed write must not cost the maps too.
        if !keep_maps {
            self.remove_maps()?;
        }
        Ok((table, runs))
    }

    /// Computes the runs of `part` that are not cached.
    fn compute_missing(&self, keys: &[CellKey], part: Range<usize>, jobs: usize) -> Result<()> {
        let cells = self.cells();
        atomic_file::create_folder(&cells).with_context(|| NotWritten(cells.clone()))?;
        let known = self.known(keys)?;
        let missing = missing(&known, part);
        self.print_estimate(&known, &missing, jobs)?;
        // Maps before runs, so that every worker finds them in the cache.
        self.encode(&missing, jobs)?;
        let missing = missing.into_iter().map(|index| (index, &keys[index]));
        self.compute(&Vec::from_iter(missing), jobs)
    }

    /// Prints the number of runs and the estimated time of the missing ones.
    fn print_estimate(&self, known: &[Option<Cell>], missing: &[usize], jobs: usize) -> Result<()> {
        let (runs, frames) = (known.len(), self.frames());
        output::note(format_args!(
            "{}: {} = {runs} runs of {frames} frames, {} done before",
            self.experiment.name,
            check::product(&self.experiment.grid),
            known.iter().flatten().count()
        ));
        let lacking = (self.data).lacking(self.experiment.scenarios, self.experiment.frames);
        lacking.into_iter().for_each(output::note);
        let Some(&first) = missing.first() else {
            return Ok(());
        };
        let missing = missing.len();
        let done: Vec<&Cell> = known.iter().flatten().collect();
        let seconds: f64 = done.iter().map(|cell| cell.wall_seconds).sum();
        let judged: f64 = done.iter().map(|cell| cell.metrics.frames as f64).sum();
        // Times of cached runs cost nothing and are nearer to the truth than those of a few frames.
        let per_frame = if judged > 0.0 {
            seconds / judged
        } else {
            self.probe(&self.points[first])?
        };
        let jobs = jobs.clamp(1, missing);
        let minutes = per_frame * (missing * frames) as f64 / jobs as f64 / 60.0;
        output::note(format_args!(
            "about {minutes:.1} minutes for {missing} runs with {jobs} jobs"
        ));
        Ok(())
    }

    /// Time of a frame, seconds, from the first few without cached feature maps: an overestimate.
    fn probe(&self, point: &Point) -> Result<f64> {
        let mut trial = self.trial(point)?;
        trial.maps = None;
        trial.scenarios = Some(1);
        let frames = self.experiment.frames.unwrap_or(PROBED_TICKS);
        trial.setup.frames = Some(frames.min(PROBED_TICKS));
        // Opened again, as the ticks of a scenario are cut when it is opened.
        let data = OpenedData::open(&trial)?;
        let began = Instant::now();
        let metrics = evaluate(&trial, &data, point.method, &mut || {})?;
        Ok(began.elapsed().as_secs_f64() / metrics.frames.max(1) as f64)
    }

    /// Computes the feature maps of all sweeps, once for each encoder that is needed.
    fn encode(&self, missing: &[usize], jobs: usize) -> Result<()> {
        for weights in self.encoders(missing)? {
            let bar = progress::bar(0, "sweeps encoded");
            let kept = self.experiment.kept_maps(&self.maps());
            let (scenarios, digests) = (&self.data.scenarios, &self.data.digests);
            let on_sweep = &mut progress::shown_on(&bar);
            FeatureStore::open(&kept, &weights, scenarios, digests, jobs, on_sweep)?;
            bar.finish_and_clear();
        }
        Ok(())
    }

    /// Removes the feature maps of the experiment, which are most of what a sweep writes and are of no use once all runs
    /// are cached. Other files of their folder stay.
    fn remove_maps(&self) -> Result<()> {
        let kept = self.experiment.kept_maps(&self.maps());
        let all: Vec<usize> = (0..self.points.len()).collect();
        for weights in self.encoders(&all)? {
            let (scenarios, digests) = (&self.data.scenarios, &self.data.digests);
            // Methods that share an encoder share a file, which is gone the second time.
            remove(&FeatureStore::file(&kept, &weights, scenarios, digests)?)?;
        }
        // The folder stays where it holds anything else.
        let _ = fs::remove_dir(self.maps());
        Ok(())
    }

    /// Weights of the encoders of some points, each file once.
    fn encoders(&self, points: &[usize]) -> Result<Vec<Arc<Weights>>> {
        let points = points.iter().map(|&index| &self.points[index]);
        let points = points.filter(|point| point.method.exchange() != Exchange::Points);
        let experiment = &self.experiment;
        let files = points.map(|point| experiment.weights_of(point.method, point.codec.boxes));
        let files = distinct(files.collect::<Result<Vec<_>>>()?);
        let precision = experiment.precision;
        let weights = files.iter().map(|file| Weights::load(file));
        weights
            .map(|loaded| Ok(Arc::new(loaded?.with_precision(precision))))
            .collect()
    }

    fn compute(&self, missing: &[(usize, &CellKey)], jobs: usize) -> Result<()> {
        let bar = progress::bar(missing.len() * self.frames(), "frames");
        let done = AtomicUsize::new(0);
        let on_done = || {
            let done = 1 + done.fetch_add(1, Ordering::Relaxed);
            bar.set_message(format!("{done}/{} runs", missing.len()));
            if bar.is_hidden() {
                output::note(format_args!("{done}/{} runs done", missing.len()));
            }
        };
        let computed = if jobs > 1 && missing.len() > 1 {
            let (file, out) = (&self.file, &self.out);
            workers::run(file, out, missing, jobs, &|| bar.inc(1), &on_done)
        } else {
            missing.iter().try_for_each(|&(index, key)| {
                self.compute_one(index, key.clone(), &mut || bar.inc(1))?;
                on_done();
                Ok(())
            })
        };
        bar.finish_and_clear();
        computed
    }

    /// Computes the run of a point and caches it.
    fn compute_one(&self, index: usize, key: CellKey, on_frame: &mut dyn FnMut()) -> Result<()> {
        compute(&self.trial(&self.points[index])?, &self.data, key, on_frame)?.write(&self.cells())
    }

    /// Runs as a worker: computes the points that the parent process requests.
    ///
    /// # Errors
    /// An error when the parent process has ended.
    pub fn work(&self) -> Result<()> {
        const PARENT: &str = "the parent sweep";
        for line in io::stdin().lock().lines() {
            // A line that is no request is answered too, or the parent would wait for ever.
            let request: Result<(usize, CellKey)> =
                serde_json::from_str(&line.context(PARENT)?).context(PARENT);
            let computed = request.and_then(|(index, key)| {
                let point = self.points.get(index);
                let own = point.map(|point| self.key(point)).transpose()?;
                ensure!(
                    own.is_some_and(|own| own.sha256 == key.sha256),
                    "{} or a file that it names was changed while the sweep ran",
                    self.file.display()
                );
                // The parent may have ended; then the answer to the run fails too.
                self.compute_one(index, key, &mut || {
                    reply(workers::FRAME).unwrap_or_default()
                })
            });
            let answer = computed.map_or_else(
                |error| workers::failure(&error),
                |()| workers::DONE.to_owned(),
            );
            reply(&answer).context(PARENT)?;
        }
        Ok(())
    }

    /// Writes table, charts and report; returns the table for a terminal.
    fn write(&self, runs: &[Run]) -> Result<String> {
        let mut drawings = Vec::new();
        // Those of axes that the experiment had before must not stay beside its table.
        for name in charts::names() {
            remove(&self.out.join(name).with_extension("svg"))?;
            remove(&self.out.join(name).with_extension("png"))?;
        }
        for (name, charts) in charts::figures(&self.experiment, runs) {
            let path = self.out.join(name);
            write(&path.with_extension("svg"), &figures::svg(&charts)?)?;
            figures::save_png(&charts, &path.with_extension("png"))?;
            // On the page each chart is an image of its own, so that they wrap on a narrow screen.
            let each = charts.chunks(1).map(figures::svg);
            drawings.push(each.collect::<Result<Vec<_>, _>>()?);
        }
        let columns: Vec<&str> = table::COLUMNS.split(',').collect();
        let lines = runs.iter().map(|run| table::line(&self.experiment, run));
        let order = self.data.protocol.ap_order;
        let varying = VaryingTable::new(&columns, &Vec::from_iter(lines), order);
        let page = html::page(&self.experiment, &self.text, runs, &drawings, &varying);
        write(&self.out.join("report.html"), &page)?;
        let name = format!("{}.csv", self.experiment.name);
        write(&self.out.join(name), &csv(&self.experiment, runs))?;
        Ok(varying.text())
    }
}

/// Reads an experiment with a grid.
///
/// # Errors
/// As [`Experiment::read`]; also for a file of tables.
pub fn read(file: &Path) -> Result<Experiment, FileError> {
    let experiment = Experiment::read(file)?;
    match experiment.tables[..] {
        [] => Ok(experiment),
        _ => {
            let problem = "this is a file of tables: v2vloc eval --table FILE --out DIR";
            Err(FileError::new(file, problem))
        }
    }
}

/// Answers the parent process.
fn reply(line: &str) -> io::Result<()> {
    let mut output = io::stdout().lock();
    writeln!(output, "{line}").and_then(|()| output.flush())
}

/// Places in `part` whose runs are not cached.
fn missing(known: &[Option<Cell>], part: Range<usize>) -> Vec<usize> {
    part.filter(|&place| known[place].is_none()).collect()
}

/// Writes a file of the sweep.
fn write(path: &Path, text: &str) -> Result<()> {
    atomic_file::write(path, text).with_context(|| path.display().to_string())
}

/// Removes a file, if it is there.
fn remove(path: &Path) -> Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        removed => removed.with_context(|| path.display().to_string()),
    }
}
